"""MJCF or URDF of a path or MJCF of a text as MjSpec and MjModel: what is wrong with it is one line."""

from __future__ import annotations

from pathlib import Path

import mujoco

from sipe_bayes.core.files import LineError, is_file
from sipe_bayes.core.validation import nearest_name
from sipe_bayes.envs.foreign.quiet import quiet
from sipe_bayes.envs.foreign.trial import refusal
from sipe_bayes.envs.foreign.urdf import parsed

LEAST_TIMESTEP = 1e-6
"""Seconds of a physics step: a shorter one gives a control step more physics than anybody waits for."""


class ModelError(LineError):
    """An MJCF that does not compile, or that MuJoCo does not survive."""


def load_spec(source: str) -> mujoco.MjSpec:
    """MjSpec of a path or of MJCF text.

    A file is tried in a process of its own before: see ``trial``. A text is its caller's own.

    Raises:
        ModelError: with MuJoCo's first line, or what the trial came to.
    """
    text = source.lstrip().startswith("<")
    if not text and not is_file(source):
        near = nearest_name(Path(source).name, _beside(Path(source)), 0.8)
        raise ModelError(f"model: no file {source!r}; give the path of an MJCF file, or the MJCF text itself{near}")
    why = "" if text else refusal(Path(source))
    if why:
        raise ModelError(f"model: {source} {why}")
    try:
        with quiet:
            return mujoco.MjSpec.from_string(source) if text else parsed(Path(source))
    except ValueError as error:
        raise ModelError(f"model: {_where(source)} is not valid MJCF: {_line(error)}; correct it") from None


def compile_spec(spec: mujoco.MjSpec, source: str) -> mujoco.MjModel:
    """MjModel of a spec; raises ModelError with MuJoCo's first line, and for a physics step that is none."""
    try:
        with quiet:
            model = spec.compile()
    except ValueError as error:
        raise ModelError(f"model: {_where(source)} does not compile: {_line(error)}; correct it") from None
    if not LEAST_TIMESTEP <= model.opt.timestep < float("inf"):
        expected = f"expected a timestep of at least {LEAST_TIMESTEP:g} s"
        raise ModelError(f"model: {_where(source)}: {expected}, got {model.opt.timestep:g}; correct <option timestep>")
    return model


def _beside(path: Path) -> list[str]:
    """Names of the models in the folder of a path."""
    return [entry.name for kind in ("*.xml", "*.urdf", "*.mjcf") for entry in sorted(path.parent.glob(kind))]


def _where(source: str) -> str:
    return "the MJCF text" if source.lstrip().startswith("<") else source


def _line(error: Exception) -> str:
    return " ".join("".join(c if c.isprintable() else " " for c in str(error)).split())[:500]
