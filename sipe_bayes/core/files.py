"""Files appear whole or not at all, and are read through one door.

Written in the same folder under a name of their own, then renamed. Read within ``reading``, which turns whatever a file
can cause into one line, and bounded before anything is allocated for what a file claims.
"""

from __future__ import annotations

import errno
import json
import math
import os
import re
import stat
import tempfile
import uuid
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from filelock import FileLock, Timeout

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

LOG_GIB, MODEL_GIB, MODEL_SECONDS = "SIPE_LOG_GIB", "SIPE_MODEL_GIB", "SIPE_MODEL_SECONDS"
TRUST_MODELS, DATA = "SIPE_TRUST_MODELS", "SIPE_BAYES_DATA"
LOCK = ".lock"
"""What keeps a second run out of a folder of results."""
LONGEST_TEXT = 2**25
"""Bytes of JSON or TOML: what it becomes in memory is twenty times as much."""
LIMITS = {LOG_GIB: 1.0, MODEL_GIB: 4.0, MODEL_SECONDS: 20.0}
"""What files may ask for, unless an environment variable of that name says otherwise."""
_LEAST = {LOG_GIB: 1e-6, MODEL_GIB: 1.0, MODEL_SECONDS: 1.0}  # with less no log, and no MuJoCo, comes to an end
_MOST = 1e6
VARIABLES = {
    LOG_GIB: "GiB that a log's columns, or the arrays of a file, may take in memory; a file that has more itself may",
    MODEL_GIB: "GiB that MuJoCo may take for a model file and its first steps",
    MODEL_SECONDS: "s of CPU time that MuJoCo may take for a model file and its first steps",
    TRUST_MODELS: "`1`: model files are not tried in a process of their own, and may include files from outside "
    "their folder",
    DATA: "the folder of the trajectory sets and what else lies outside the package; default `sipe_bayes` in the "
    "user's cache (`XDG_CACHE_HOME`, or `~/.cache`)",
}
"""Every environment variable that this package reads for itself, and what it is."""
_WORDS = 200  # characters of what a library says


FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""What the system says where a disk, a quota or a limit on the size of files leaves no room."""
_NATIVE = re.compile(r"\(os error (\d+)\)|\berrno\W+(\d+)")  # as libraries that are not Python's word it


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path to write to, which becomes ``path`` at the end and is removed where something fails.

    Missing folders are made.
    """
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex}{path.suffix}")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.filename is not None:
            raise
        raise OSError(error.errno or errno.EIO, error.strerror or str(error), str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def no_room(error: BaseException) -> OSError | None:
    """The error of a full disk that an exception is or comes from, if any; with the file's name where it is known."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.errno in FULL:
            return cause
        native = _NATIVE.search(str(cause))
        code = int(native[1] or native[2]) if native else 0
        if code in FULL:
            return OSError(code, os.strerror(code))
        cause = cause.__cause__ or cause.__context__
    return None


def was_interruption(error: BaseException) -> bool:
    """Whether an exception is what a library made of an interruption, as native modules do while they are imported."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, KeyboardInterrupt):
        cause = cause.__cause__ or cause.__context__
    return cause is not None


@contextmanager
def scratch() -> Iterator[Path]:
    """A folder that is gone at the end; OSError where none can be written, which tempfile says in its own way."""
    try:
        folder = tempfile.TemporaryDirectory()
    except FileNotFoundError as error:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "temporary folder (TMPDIR)") from error
    with folder as name:
        yield Path(name)


def write_bytes(path: Path, content: bytes) -> None:
    """Write a whole file."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: Path, text: str) -> None:
    """Write a whole file of UTF-8."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


class LineError(ValueError):
    """Its message is one line that prints, whatever names of a file stand in it."""

    def __init__(self, message: str) -> None:
        super().__init__(shortened(message))


class FileError(LineError):
    """A file that cannot be used; the message is one line with the file, what is wrong and the remedy."""


@contextmanager
def reading(path: object, what: str, remedy: str, kind: type[ValueError] = FileError) -> Iterator[None]:
    """Whatever a file causes while it is decoded and held against what it should say becomes one line.

    Only what decodes or checks stands within: a mistake of this package there would be blamed on the file. What was
    raised stays attached as the cause.

    Args:
        path: what the line names.
        what: it was expected to be.
        remedy: what to do about it.
        kind: of the error; one of its kind, which has its line already, passes.

    Raises:
        ValueError: of the kind.
    """
    try:
        if isinstance(path, Path) and _is_stream(path):
            raise ValueError("is a pipe, a socket or a device, no plain file")
        yield
    except (kind, FileError, ModuleNotFoundError):
        raise
    except Exception as error:
        if isinstance(error, FileNotFoundError) and error.errno is None:  # in our words
            raise
        raise kind(f"{path}: cannot be read as {what} ({reason(error)}); {remedy}") from error


def _is_stream(path: Path) -> bool:
    """Whether it is what may never come to an end."""
    try:
        mode = path.stat().st_mode
    except OSError:  # what reads it says why
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


def is_file(path: str | os.PathLike[str]) -> bool:
    """Whether there is a file; a name that the system does not take, or that it may not look up, is none."""
    return os.path.isfile(path)


def is_folder(path: str | os.PathLike[str]) -> bool:
    """Whether there is a folder, as ``is_file``."""
    return os.path.isdir(path)


def check_text_size(path: Path) -> None:
    """Within ``reading``: ValueError for a file that is no text of ours, by its size."""
    if path.stat().st_size > LONGEST_TEXT:
        raise ValueError(f"has {path.stat().st_size} bytes, the most is {LONGEST_TEXT}")


def printed(text: str) -> str:
    """A text as one line that prints, so that no name ends a line, or a comment, that it stands in."""
    return "".join(c if c.isprintable() else " " if c.isspace() else "?" for c in text)


def shortened(text: str) -> str:
    """A line that prints, in which no word is longer than anybody reads."""
    return re.sub(rf"\S{{{_WORDS},}}", lambda word: f"{word[0][:60]}...{word[0][-60:]}", printed(text))


def reason(error: Exception) -> str:
    """One line of an exception, which may have no words of its own."""
    if isinstance(error, MemoryError):
        return "more than the memory holds"
    if isinstance(error, RecursionError):
        return "nested too deep"
    several = getattr(error, "errors", None)  # of pydantic, which has a paragraph for each
    first = next(iter(several()), None) if callable(several) else None
    text = f"{'.'.join(map(str, first['loc']))}: {first['msg']}" if first else str(error)
    if isinstance(error, OSError) and error.strerror:
        text = error.strerror
    text = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    short = text if len(text) <= _WORDS else f"{text[: _WORDS - 3]}..."
    return short if short and isinstance(error, OSError | ValueError | EOFError) else f"{type(error).__name__} {short}"


def limit(name: str) -> float:
    """A limit on what files may ask for: the environment variable of that name, which no file can set, or its default.

    Raises:
        FileError: for a variable that is no such number, or beyond sense.
    """
    given = os.environ.get(name, "")
    try:
        value = float(given) if given else LIMITS[name]
    except ValueError:
        value = math.nan
    if not _LEAST[name] <= value <= _MOST:
        expected = f"expected a number from {_LEAST[name]:g} to {_MOST:g}"
        raise FileError(f"{name}={given}: {expected}; {LIMITS[name]:g} is the default")
    return value


def read_text(path: Path, what: str, remedy: str, kind: type[ValueError] = FileError) -> str:
    """A file of UTF-8, of a size that is bounded; FileNotFoundError where it is missing, else as ``reading``."""
    if not os.path.exists(path):
        raise FileNotFoundError(f"{shortened(str(path))}: no such file; expected {what}")
    with reading(path, what, remedy, kind):
        if not path.is_file():
            raise ValueError("is a folder, no file")
        check_text_size(path)
        return path.read_text(encoding="utf-8")


def read_json(path: Path, what: str, remedy: str, kind: type[ValueError] = FileError) -> dict[str, object]:
    """The object that a JSON file holds; errors as those of ``read_text``."""
    text = read_text(path, what, remedy, kind)
    with reading(path, what, remedy, kind):
        plain = json.loads(text, parse_int=_whole)
        if not isinstance(plain, dict):
            raise ValueError(f"expected an object of JSON, got a {type(plain).__name__}")
        return plain


def _whole(digits: str) -> int:
    """A whole number of JSON; what no array holds is refused where it stands, not where it is used."""
    number = int(digits)
    if abs(number) >= 2**63:
        raise ValueError(f"a whole number of {len(digits)} digits")
    return number


def read_arrays(source: Path | IO[bytes]) -> dict[str, NDArray[np.generic]]:
    """The arrays of an npz, each checked against what its member holds before it is read; nothing is unpickled.

    To be called within ``reading``: what it raises has no file's name.

    Raises:
        ValueError: for what is no array of numbers or text, or claims more than it holds, or than ``SIPE_LOG_GIB``
            and more than the file itself.
    """
    with zipfile.ZipFile(source) as archive:
        members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
        total, there = sum(member.file_size for member in members), archive.fp.seek(0, os.SEEK_END) if archive.fp else 0
        if total > max(limit(LOG_GIB) * 2**30, there):
            raise ValueError(f"claims {total / 2**30:.3g} GiB of arrays, the most is {limit(LOG_GIB):g} ({LOG_GIB})")
        return {m.filename.removesuffix(".npy"): _array(archive, m) for m in members}


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[np.generic]:
    import numpy as np

    name = f"array {member.filename.removesuffix('.npy')!r}"
    if member.flag_bits & 1:
        raise ValueError(f"{name} is encrypted, save it without a password")
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # what NumPy writes
        raise ValueError(f"{name} is compressed in a way that npz has not, save it with numpy.savez_compressed")
    headers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    with archive.open(member) as file:
        header = headers.get(np.lib.format.read_magic(file))
        if header is None:
            raise ValueError(f"{name} has field names beyond ASCII, save each field as an array of its own")
        shape, by_columns, dtype = header(file)
        if dtype.hasobject:
            raise ValueError(f"{name} holds Python objects, which are not read, save it as numbers")
        size = math.prod(shape) * dtype.itemsize
        if min(shape, default=0) < 0 or size > member.file_size:
            raise ValueError(f"{name} claims the shape {shape}, more than its {member.file_size} bytes")
        data = bytearray(file.read(size))
    if len(data) < size:
        raise ValueError(f"{name} ends after {len(data)} of {size} bytes")
    if not size:
        return np.zeros(shape, dtype)
    return np.frombuffer(data, dtype).reshape(shape, order="F" if by_columns else "C")


class OutputError(LineError):
    """An output folder that cannot be used."""


def not_a_file(folder: Path) -> None:
    """Raises OutputError where the folder to write into is a file."""
    if os.path.exists(folder) and not is_folder(folder):
        raise OutputError(f"--out {folder}: is a file, not a folder; choose another name")


@contextmanager
def exclusive(folder: Path) -> Iterator[None]:
    """A folder of results, made if need be, for one run at a time; raises OutputError where another is at work."""
    not_a_file(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / LOCK).touch()  # where it can not be written, the error names it
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        raise OutputError(
            f"--out {folder}: another run is at work in it; wait for it, or choose another folder"
        ) from None
    try:
        yield
    finally:
        lock.release()


def installed_version(package: str) -> str:
    """Of a Python package, for the records of a run; "" where it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def to_json(data: object, indent: int | None = None) -> str:
    """JSON as the standard has it: what is not a finite number becomes null."""
    return json.dumps(_finite(data), indent=indent, allow_nan=False)


def _finite(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: _finite(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_finite(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data
