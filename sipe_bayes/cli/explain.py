"""The command ``sipe explain``."""

from __future__ import annotations

from typing import Annotated

import typer

from sipe_bayes.cli.errors import exit_on_error


def explain(code: Annotated[str, typer.Argument(help="Of a finding, such as not_mixed; `all` lists them.")]) -> None:
    """What a finding of a report or of result.json means."""
    from sipe_bayes.core.finding_texts import Code
    from sipe_bayes.core.validation import nearest_name

    words = {str(one): one.value for one in Code}
    name = code.lower()
    if code == "all":
        for known, text in words.items():
            print(f"{known} ({text.severity})")
        return
    with exit_on_error():
        if name not in words:
            raise ValueError(f"no finding {code!r}{nearest_name(name, words) or '; `sipe explain all` lists them'}")
    print(f"{name} ({words[name].severity})\n{words[name].template}")
