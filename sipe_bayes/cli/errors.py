"""How the commands end on wrong input and on an interruption, and what every command says of itself."""

from __future__ import annotations

import errno
import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import typer

from sipe_bayes.cli.surroundings import broken_import, drop_output
from sipe_bayes.core.files import FULL, printed, reason, was_interruption
from sipe_bayes.core.validation import MOST, MOST_ROLLOUTS, most_threads

BAD_INPUT = 2
"""Exit code where input is at fault."""
NOTHING_USABLE = 3
"""Exit code of a calibration that ended, but none of whose values may be used within their intervals."""
_LONGEST = 1000  # characters of a word of the command line
_announced: list[str] = []  # interruptions that the command itself put into words
INTERRUPTED = 130  # exit code, as shells have it for SIGINT
_SPACE = "free some space, or raise the limit on the size of files, and the same command goes on"
_REMEDIES = {
    errno.EACCES: "make it writable, or choose another folder",
    **dict.fromkeys((*FULL, errno.EIO), _SPACE),
    errno.ENOENT: "look at the name, or choose another folder",
}


@contextmanager
def exit_on_error(then: str = "") -> Iterator[None]:
    """Input errors are one line on standard error and exit code 2.

    Args:
        then: what is said to do after an interruption, behind what the interruption itself says there is.

    Raises:
        typer.Exit: in place of the error.
    """
    try:
        yield
    except (NotImplementedError, RecursionError, typer.Exit):
        raise  # no input is at fault
    except (ValueError, ImportError, OSError, RuntimeError) as error:
        if was_interruption(error):
            say_interrupted(then)
            raise typer.Exit(INTERRUPTED) from None
        if type(error).__name__.endswith("LinAlgError"):
            raise
        print(f"sipe: {' '.join(printed(_text(error)).split())}", file=sys.stderr)
        raise typer.Exit(BAD_INPUT) from None
    except MemoryError:
        print("sipe: more memory is asked for than there is; ask for less, or use a larger machine", file=sys.stderr)
        raise typer.Exit(BAD_INPUT) from None
    except KeyboardInterrupt as interruption:
        so_far = str(interruption)
        say_interrupted(f": {so_far}{then}" if so_far else then)
        raise typer.Exit(INTERRUPTED) from None


def exit_code_of(error: Exception) -> int | None:
    """Of what no command is at fault for, after the line that says it: None for what is a mistake of ours.

    An interruption while a module is imported, a package that cannot be imported, and output that nobody takes.
    """
    if was_interruption(error):
        return INTERRUPTED
    package = broken_import(error)
    if package:
        remedy = "install it again, or look at the environment variables that it reads"
        print(f"sipe: {package} cannot be imported ({reason(error)}); {remedy}", file=sys.stderr)
        return BAD_INPUT
    if not isinstance(error, OSError) or error.errno not in (*FULL, errno.EIO, errno.EPIPE) or error.filename:
        return None
    drop_output()
    if error.errno == errno.EPIPE:  # as `| head` does
        return 1
    print(f"sipe: standard output: {os.strerror(error.errno or 0).lower()}; free some space there", file=sys.stderr)
    return BAD_INPUT


def say_interrupted(then: str) -> None:
    """Print it, and keep it for ``was_announced``."""
    _announced.append(then)
    print(f"sipe: interrupted{then}", file=sys.stderr)


def was_announced() -> bool:
    """Whether the command itself printed that it was interrupted; it does not where it had not begun."""
    interrupted = bool(_announced)
    _announced.clear()
    return interrupted


def _text(error: Exception) -> str:
    """Of an error of the file system: the path, what is wrong, and a remedy."""
    if isinstance(error, OSError) and error.strerror and (error.filename is not None or error.errno in FULL):
        remedy = _REMEDIES.get(error.errno or 0, "choose another folder")
        return f"{error.filename or 'a temporary file'}: {error.strerror.lower()}; {remedy}"
    if isinstance(error, FileNotFoundError) and (error.strerror or "").startswith("No usable temporary"):
        return f"temporary folder (TMPDIR): {os.strerror(errno.ENOSPC).lower()}; {_SPACE}"  # tempfile's, of a library
    return str(error)


def check_words(words: Sequence[str]) -> None:
    """See that no word of a command line is empty or holds what no terminal shows, which no name is meant to.

    Raises:
        ValueError: for such a word; the message shows it escaped.
    """
    for word in words:
        name, equals, value = word.partition("=")
        empty = not word.strip() or (name.startswith("--") and equals and not value.strip())
        if empty:
            raise ValueError(f"{word!r}: expected a value, got nothing; give one, or leave the option out")
        if len(word) > _LONGEST:
            raise ValueError(f"{word[:20]!r}...: has {len(word)} characters, the most is {_LONGEST}; shorten it")
        if not word.isprintable():
            raise ValueError(f"{word!r}: holds characters that cannot be printed; write it without them")


def check_least(least: int, **options: float | None) -> None:
    """See that options, named with ``_`` for ``-``, are large enough, and not beyond sense; one that is left out is."""
    most = {"threads": most_threads(), "jobs": most_threads(), "seed": MOST}
    for name, value in options.items():
        option = name.replace("_", "-")
        if value is not None and not value >= least:
            raise ValueError(f"--{option} {value}: expected at least {least}; raise it or leave it out")
        if value is not None and value > most.get(name, MOST_ROLLOUTS):
            raise ValueError(f"--{option} {value:.4g}: expected at most {most.get(name, MOST_ROLLOUTS)}; lower it")


def check_one_of(option: str, value: str, known: tuple[str, ...]) -> None:
    """See that an option is one of the legal words; raises ValueError which lists them."""
    if value not in known:
        raise ValueError(f"--{option} {value}: expected one of {', '.join(known)}")


def command_line() -> str:
    """The command that is running, as a shell takes it."""
    return shlex.join(["sipe", *sys.argv[1:]])


def say_early(line: str) -> None:
    """Print a line on standard error while a command runs."""
    print(f"sipe: {line}", file=sys.stderr, flush=True)
