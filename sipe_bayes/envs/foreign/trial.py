"""A model file is compiled and stepped a little in a process of its own before this one does it.

MuJoCo is native code: a file can crash it, keep it busy for ever, or have it ask for more memory than there is. The
process has limits of time and memory (``SIPE_MODEL_SECONDS``, ``SIPE_MODEL_GIB``), so that all that is one line. It
takes about .3 s for each content of a file, once in a command. ``SIPE_TRUST_MODELS=1`` leaves it out, and lets a model
include files from outside its folder, which is refused otherwise: what a file may do, no file decides.

Run by itself, ``python -m sipe_bayes.envs.foreign.trial MODEL.xml``, it is that process.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import html
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from sipe_bayes.core.files import LONGEST_TEXT, MODEL_GIB, MODEL_SECONDS, TRUST_MODELS, is_file, limit, scratch

_STEPS = 5
_START = 10.0  # s that a process may take until it reads the file
_PATIENCE = 1 if sys.platform == "win32" else 5  # times the limit on a clock: elsewhere the processor's time is limited
MOST_FILES = 1000
"""That a model may include."""
# an element up to its end, whatever its attributes hold; possessive, so that no file makes it look twice
_INCLUDE = re.compile(r"<\s*+(?:include|model)\b((?:[^<>\"']++|\"[^\"]*+\"|'[^']*+')*+)", re.IGNORECASE)
_FILE = re.compile(r"\bfile\s*=\s*(?:\"([^\"]*)\"|'([^']*)')", re.IGNORECASE)


def trusted() -> bool:
    """Whether the user vouches for every model."""
    return os.environ.get(TRUST_MODELS, "") not in ("", "0")


def refusal(path: Path) -> str:
    """Why a model file is not to be compiled here; empty where nothing speaks against it.

    Args:
        path: an MJCF file.

    Raises:
        FileError: for limits that are no numbers.
    """
    if trusted():
        return ""
    try:
        files = list(_files(path))
    except _UnfitError as error:
        return str(error)
    except OSError as error:
        return f"or a file that it includes cannot be read ({error.strerror or error}); correct it"
    digest = hashlib.sha256()
    for file in files:
        digest.update(str(file).encode() + file.read_bytes())
    return _tried(str(path.resolve()), digest.hexdigest(), limit(MODEL_SECONDS), limit(MODEL_GIB))


class _UnfitError(Exception):
    """Files that are no model, or leave its folder."""


def _files(path: Path) -> Iterator[Path]:
    """A model and what it includes, each once."""
    root, waiting, seen = path.resolve().parent, [path.resolve()], set[Path]()
    while waiting:
        file = waiting.pop()
        if file in seen:
            continue
        seen.add(file)
        if len(seen) > MOST_FILES:
            raise _UnfitError(f"includes more than {MOST_FILES} files")
        if file.stat().st_size > LONGEST_TEXT:
            raise _UnfitError(f"has, or includes, a file of more than {LONGEST_TEXT} bytes; put meshes into files")
        yield file
        text = file.read_text(encoding="utf-8", errors="replace")
        for pair in (pair for attributes in _INCLUDE.findall(text) for pair in _FILE.findall(attributes)):
            name = html.unescape(pair[0] or pair[1])
            places = {(folder / name).resolve() for folder in (root, file.parent)}
            if not all(place.is_relative_to(root) for place in places):
                remedy = f"move it there, or set {TRUST_MODELS}=1 if you trust this model"
                raise _UnfitError(f"includes {name!r} from outside its folder {root}; {remedy}")
            waiting += [place for place in places if is_file(place)]


@functools.cache
def _tried(path: str, content: str, seconds: float, gib: float) -> str:
    """What the process came to; of a content that was tried before, what it came to then."""
    command = [sys.executable, "-m", __name__, path, str(seconds), str(gib)]
    package = str(Path(__file__).parents[3])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([package, os.environ.get("PYTHONPATH", "")])}
    with scratch() as folder:
        try:
            done = subprocess.run(
                command,
                cwd=folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=_PATIENCE * seconds + _START,
            )
        except subprocess.TimeoutExpired:
            return _slow(seconds)
    outcome = done.stdout.decode(errors="replace").strip()
    if done.returncode == 0 and outcome == "done":
        return ""
    if outcome.startswith("error"):
        why = " ".join(outcome.split()[1:])[:200]
        return f"cannot be compiled by MuJoCo within {gib:g} GiB ({why}); make it smaller, or set {MODEL_GIB}"
    if outcome == "memory":
        return f"takes more than {gib:g} GiB of memory; make it smaller, or set {MODEL_GIB}"
    if outcome == "time" or -done.returncode in _TIME_SIGNALS:
        return _slow(seconds)
    return f"crashes MuJoCo (exit code {done.returncode}); make it smaller or simpler until it does not"


def _slow(seconds: float) -> str:
    return f"takes MuJoCo longer than {seconds:g} s for {_STEPS} steps; make it smaller, or set {MODEL_SECONDS}"


_TIME_SIGNALS = (24, 14)  # SIGXCPU, SIGALRM


def _limited(seconds: float, gib: float) -> None:
    """Bound this process, as far as the system can."""
    try:
        import resource
        import signal
    except ImportError:  # Windows: the parent's patience alone
        return
    with contextlib.suppress(OSError, AttributeError):
        import ctypes

        ctypes.CDLL(None).prctl(1, int(signal.SIGKILL))  # ends with its parent, on Linux
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (int(seconds) + 1, int(seconds) + 2))
    kind = resource.RLIMIT_DATA if sys.platform == "linux" else resource.RLIMIT_AS
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(kind, (int(gib * 2**30), resource.getrlimit(kind)[1]))


def _main(path: str, seconds: str, gib: str) -> None:
    _limited(float(seconds), float(gib))
    import mujoco

    from sipe_bayes.envs.foreign.quiet import quiet
    from sipe_bayes.envs.foreign.urdf import parsed

    try:
        with quiet:
            model = parsed(Path(path)).compile()
            data = mujoco.MjData(model)
            for _ in range(_STEPS):
                mujoco.mj_step(model, data)
    except ValueError as error:  # what MuJoCo says of a file, this process's parent lets it say again
        if "alloc" in str(error).lower():
            print("memory", flush=True)
            os._exit(0)
    except Exception as error:  # it ran out of memory, one way or another
        print("memory" if "alloc" in str(error).lower() or isinstance(error, MemoryError) else f"error {error}")
        sys.stdout.flush()
        os._exit(0)
    print("done", flush=True)
    os._exit(0)


if __name__ == "__main__":
    _main(*sys.argv[1:])
