"""The command ``sipe explain``."""

from __future__ import annotations

from typing import Annotated

import typer

from sipe_bayes.cli.errors import exit_on_error


def explain(
    codes: Annotated[list[str] | None, typer.Argument(help="Of findings, such as not_mixed; none lists all.")] = None,
) -> None:
    """What a finding of a report or of result.json means, and what to do."""
    from sipe_bayes.core.finding_advice import ADVICE, plain
    from sipe_bayes.core.finding_texts import Code
    from sipe_bayes.core.validation import nearest_name

    known = {str(one): one for one in Code}
    with exit_on_error():
        for name in codes or ():
            if name.lower() not in known:
                hint = nearest_name(name, known) or "; `sipe explain` lists them"
                raise ValueError(f"CODES: expected the code of a finding, got {name!r}{hint}")
    if not codes:
        print("\n".join(f"{name} ({one.value.severity})" for name, one in known.items()))
    for name in codes or ():
        code = known[name.lower()]
        print(f"{code} ({code.value.severity})\n  {plain(code)}\n  {ADVICE[code]}")
