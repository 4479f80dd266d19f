"""A posterior on disk: ``<path>.safetensors`` (tensors) and ``<path>.json`` (everything else). Never pickle.

Each file is written to a temporary name in the same directory and renamed. The JSON holds the checksum of the
tensors, so that a pair torn by a crash between the two renames is refused and not silently mixed.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, TypedDict, cast

import h5netcdf
import numpy as np
import safetensors.torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from sipe_bayes.core.files import FileError, is_file, read_json, reading, scratch, shortened, write_bytes
from sipe_bayes.core.parameters import ParameterSpace, Plain

FORMAT = "sipe_bayes.posterior/1"
SAVE_AGAIN = "save it again with posterior.save(path)"


class Header(TypedDict):
    """What the JSON holds besides format and checksum."""

    family: str
    space: list[Plain]
    settings: dict[str, Any]


def pair_paths(path: str | os.PathLike[str]) -> tuple[Path, Path]:
    """The two files of ``path``: (tensors, header). A suffix of either is dropped first."""
    stem = Path(path)
    if stem.suffix in (".safetensors", ".json"):
        stem = stem.with_suffix("")
    return stem.with_name(stem.name + ".safetensors"), stem.with_name(stem.name + ".json")


def write_pair(path: str | os.PathLike[str], header: Header, tensors: dict[str, Tensor]) -> None:
    """Write header and tensors of a posterior; missing folders are made.

    Args:
        path: with or without a suffix.
        header: what the JSON holds.
        tensors: by name.
    """
    tensor_path, header_path = pair_paths(path)
    content = safetensors.torch.save({k: v.detach().clone().contiguous() for k, v in tensors.items()})
    stored = {"format": FORMAT, **header, "sha256": hashlib.sha256(content).hexdigest()}
    text = json.dumps(stored, indent=1, default=float)
    write_bytes(tensor_path, content)
    write_bytes(header_path, text.encode())


def read_pair(path: str | os.PathLike[str]) -> tuple[Header, dict[str, Tensor]]:
    """Header and tensors of a saved posterior.

    Args:
        path: with or without a suffix.

    Raises:
        FileNotFoundError: for a missing file.
        ValueError: for one that cannot be read.
    """
    tensor_path, header_path = pair_paths(path)
    for file in (header_path, tensor_path):
        if not is_file(file):
            both = f"{tensor_path.name} beside {header_path.name}"
            raise FileNotFoundError(shortened(f"{file}: no such file; a saved posterior is {both}"))
    header = read_json(header_path, "a posterior's header", SAVE_AGAIN)
    if header.get("format") != FORMAT:
        raise FileError(f"{header_path}: expected a posterior header of format {FORMAT!r}; {SAVE_AGAIN}")
    with reading(tensor_path, "safetensors", SAVE_AGAIN):
        content = tensor_path.read_bytes()
        if header.get("sha256") != hashlib.sha256(content).hexdigest():
            raise FileError(f"{tensor_path}: does not match the checksum in {header_path.name}; {SAVE_AGAIN}")
        return cast(Header, header), safetensors.torch.load(content)


def draws_by_name(name: str, given: Mapping[str, ArrayLike] | None, theta: Tensor) -> dict[str, NDArray[np.generic]]:
    """Arrays (chain, draw, ...) by name, one for each draw of theta (chain, draw, N).

    Raises:
        ValueError: for other chains or draws; the message names the argument ``name``.
    """
    arrays = {key: np.asarray(x) for key, x in (given or {}).items()}
    for key, x in arrays.items():
        if x.shape[:2] != theta.shape[:2]:
            raise ValueError(f"{name}: expected {key} {(*theta.shape[:2], '...')}, chains and draws, got {x.shape}")
    return arrays


def ready_arviz() -> ModuleType:
    """ArviZ, imported; it notes in the user's cache folder that it was, and where it cannot, in one that goes."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # arviz < 1 announces its successor on import
        try:
            import arviz
        except OSError:
            cache = os.environ.get("XDG_CACHE_HOME")
            with scratch() as folder:
                os.environ["XDG_CACHE_HOME"] = str(folder)
                import arviz
            del os.environ["XDG_CACHE_HOME"]
            os.environ |= {} if cache is None else {"XDG_CACHE_HOME": cache}
    return arviz


def _hdf5_name(word: str) -> str:
    """A name as HDF5 takes it, to which a slash is a folder, and a dot the one that it stands in."""
    return word.replace("/", "|").replace("\0", "") if word.strip(".") else f"parameter{word}"


def netcdf(groups: Mapping[str, Mapping[str, ArrayLike]], space: ParameterSpace) -> bytes:
    """A netCDF of draws as ArviZ reads it, the same bytes for the same draws.

    It is made in memory, for on a full disk HDF5 crashes, and without ArviZ, whose import takes as long as many a fit.

    Args:
        groups: arrays (chain, draw) by name, by group; empty ones are left out.
        space: of the parameters, which get their units and descriptions.
    """
    about = {p.name: {"units": p.unit, "description": p.description} for p in space}
    buffer = io.BytesIO()
    with h5netcdf.File(buffer, "w") as file:
        for key, given in groups.items():
            arrays = {name: np.asarray(values) for name, values in given.items()}
            if not arrays:
                continue
            group = file.create_group(key)
            for name, size in zip(("chain", "draw"), next(iter(arrays.values())).shape, strict=True):
                group.dimensions[name] = size
                group.create_variable(name, (name,), data=np.arange(size))
            for name, values in arrays.items():
                kept = group.create_variable(_hdf5_name(name), ("chain", "draw"), data=values, compression="gzip")
                kept.attrs.update(about.get(name, {}))
    return buffer.getvalue()
