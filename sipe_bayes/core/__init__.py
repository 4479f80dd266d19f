"""What every room uses: parameters, trajectories, units, checks, findings, options, checkpoints, seeds and files."""

import importlib
from types import ModuleType

__version__ = "0.2.0"

VIEWS: dict[str, str] = {}
"""What draws a thing: its name -> a module of a room below, which the package's root fills in."""


def view(name: str) -> ModuleType:
    """The module that draws a thing, loaded when a figure or a page is wanted."""
    return importlib.import_module(VIEWS[name])
