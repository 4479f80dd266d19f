"""What a command needs of where it is started, seen to before it begins: open streams, a folder, a drawing back end."""

from __future__ import annotations

import os
import sys
import traceback
from pathlib import Path

_PACKAGE = str(Path(__file__).parents[1])


def settle() -> None:
    """Streams that are closed lead nowhere, figures are drawn without a screen.

    Raises:
        ValueError: where the folder in which the command is started is gone.
    """
    for number, name in ((0, "stdin"), (1, "stdout"), (2, "stderr")):
        if getattr(sys, name) is None:  # else the next file that is opened would take its number
            opened = open(os.devnull, "r" if not number else "w", encoding="utf-8")  # noqa: SIM115
            if opened.fileno() != number:
                os.dup2(opened.fileno(), number)
            setattr(sys, name, opened)
    os.environ["MPLBACKEND"] = "agg"
    try:
        os.getcwd()
    except OSError:
        raise ValueError("the folder that this is started in is gone; change to another one") from None


def drop_output() -> None:
    """What is still to be printed leads nowhere, and fails no more."""
    sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115


def broken_import(error: BaseException) -> str:
    """Which package cannot be imported, if that is what an exception says; a mistake of ours is none."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [k for k, frame in enumerate(frames) if frame.filename.startswith(_PACKAGE)]
    if not ours or ours[-1] + 1 >= len(frames) or frames[ours[-1] + 1].name != "<module>":
        return ""
    parts = Path(frames[ours[-1] + 1].filename).parts
    within = parts[parts.index("site-packages") + 1 :] if "site-packages" in parts else parts[-1:]
    return within[0].removesuffix(".py")
