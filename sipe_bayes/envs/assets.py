"""Model files of the packages that publish the environments, found without importing those packages, which is slow."""

from __future__ import annotations

import importlib.util
import warnings
from pathlib import Path

import mujoco


def package_file(package: str, file: str) -> Path:
    """A file inside an installed package; raises ModuleNotFoundError where that is missing."""
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        name = package.replace("_", "-")
        raise ModuleNotFoundError(f"{Path(file).name}: the model is part of {name}: pip install {name}")
    return Path(spec.origin).parent / file


def gymnasium_asset(file: str) -> Path:
    """One of Gymnasium's MuJoCo models."""
    return package_file("gymnasium", f"envs/mujoco/assets/{file}")


def robotics_asset(file: str) -> Path:
    """One of gymnasium-robotics' MuJoCo models."""
    return package_file("gymnasium_robotics", f"envs/assets/{file}")


def compiled_without_visuals(file: Path) -> mujoco.MjModel:
    """The model of an MJCF file without its textures, which can be twelve times the size of the rest."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*settotalmass.*")  # the half-cheetah's, and deprecated
        spec = mujoco.MjSpec.from_file(str(file))
        spec.compiler.discardvisual = True
        return spec.compile()
