"""How the commands end on wrong input and on an interruption."""

from __future__ import annotations

import errno
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import typer

BAD_INPUT, _INTERRUPTED = 2, 130
_REMEDIES = {
    errno.EACCES: "make it writable, or choose another folder",
    errno.ENOSPC: "free some space, and the same command goes on",
    errno.ENOENT: "look at the name, or choose another folder",
}


@contextmanager
def refusing(then: str = "") -> Iterator[None]:
    """Input errors are one line on standard error and exit code 2; an interruption says what to do ``then``."""
    try:
        yield
    except (ValueError, ImportError, OSError, RuntimeError) as error:
        if type(error).__name__.endswith("LinAlgError") or isinstance(error, NotImplementedError | RecursionError):
            raise  # no input is at fault
        print(f"sipe: {' '.join(_text(error).split())}", file=sys.stderr)
        raise typer.Exit(BAD_INPUT) from None
    except KeyboardInterrupt:
        print(f"sipe: interrupted{then}", file=sys.stderr)
        raise typer.Exit(_INTERRUPTED) from None


def _text(error: Exception) -> str:
    """Of an error of the file system: the path, what is wrong, and a remedy."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror.lower()}; {_REMEDIES.get(error.errno or 0, 'choose another folder')}"
    return str(error)
