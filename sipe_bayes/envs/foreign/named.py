"""Models by the names of packages: ``menagerie:unitree_go2``, ``robot_descriptions:go2_mj_description``."""

from __future__ import annotations

import importlib
from pathlib import Path

from sipe_bayes.core.files import reason
from sipe_bayes.envs.foreign.load import ModelError

_PACKAGES = {"menagerie": "mujoco_menagerie", "robot_descriptions": "robot_descriptions"}


def model_file(model: Path) -> Path:
    """The file of a model, which its package fetches where it has not yet; a path as it is.

    The name of a module of robot_descriptions needs no package before it.

    Raises:
        ModelError: the package is not installed, or has no such model.
    """
    source, colon, name = str(model).partition(":")
    if not colon and source.isidentifier() and source.endswith("_description"):
        source, name = "robot_descriptions", source
    if model.exists() or source not in _PACKAGES or not name.isidentifier():
        return model
    package = _PACKAGES[source]
    try:
        if source == "menagerie":
            robot = importlib.import_module(package).get(name)
            return Path(robot.xml(robot.default_model))
        module = importlib.import_module(f"{package}.{name}")
        return Path(getattr(module, "MJCF_PATH", "") or module.URDF_PATH)
    except Exception as error:
        if isinstance(error, ModuleNotFoundError) and error.name == package:
            command = f"pip install {package.replace('_', '-')}"
            raise ModelError(f"model: {model} needs the package {package}, which is not installed: {command}") from None
        raise ModelError(f"model: {model} cannot be had ({reason(error)}); correct the name, or give a file") from error
