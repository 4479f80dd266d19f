"""Extensions that are rows of a table: where one may be, what it is called, where it is described, and its parameters.

Bounds come from the sizes of the machine's motion at the site, or of functions of the machine in ``extensions.sites``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.mjcf import Edit
from sipe_bayes.structure.extension import WORLD, Extension, Kind, members
from sipe_bayes.structure.machine import Machine, Sizes

Probes = tuple[tuple[tuple[float, ...], ...], ...]
"""Theta of the parameters at which a row is tried: of each shape its directions."""
_OWNERS = {"channel": "sensor"}  # of targets, where not the kind itself
Bound = float | Callable[[Sizes], float]


@dataclass(frozen=True)
class Unknown:
    """A parameter of a row: ``SITE.name``, at a site of the world ``name``, with bounds in SI.

    ``target`` is what it writes behind the site's name, by default its own name; whole targets stand in a tuple.
    ``prior`` is the mean and the sd of a normal one.
    """

    name: str
    low: Bound
    high: Bound
    description: str
    target: str | tuple[str, ...] = ""
    scale: Literal["linear", "log"] = "linear"
    prior: tuple[float, float] | tuple[None, None] = (None, None)

    def at(self, kind: str, site: str, sizes: Sizes) -> Parameter:
        """At a site."""
        low, high = (bound if isinstance(bound, float) else bound(sizes) for bound in (self.low, self.high))
        name, targets = self.name if kind == WORLD else f"{site}.{self.name}", self.target or self.name
        if isinstance(targets, str):
            owners = [""] if kind == WORLD else [f"{_OWNERS.get(kind, kind)}:{member}." for member in members(site)]
            targets = tuple(owner + targets for owner in owners)
        made = Parameter(name, low, high, scale=self.scale, targets=targets, description=self.description)
        return replace(made, prior_mean=self.prior[0], prior_sd=self.prior[1])


def sizes_of(machine: Machine, kind: Kind, site: str) -> Sizes:
    """What bounds are made of at a site of a machine."""
    own = Sizes(machine.channels.get(site, math.nan))
    if kind in ("joint", "tendon"):
        own = (machine.joints if kind == "joint" else machine.tendons)[site]
    elif kind == "actuator":
        names = members(site)
        driven = machine.joint_of(site) if len(names) == 1 else None
        velocity = math.nan if driven is None else machine.joints[driven].velocity
        force, command = max(machine.forces[name] for name in names), max(machine.commands[name] for name in names)
        own = Sizes(velocity=velocity, force=force, command=command or 1.0)
    return replace(own, dt=machine.dt, step=machine.timestep)


@dataclass(frozen=True, eq=False)
class Row(Extension):
    """An extension with its parameters; fields and methods that ``Extension`` has are described there.

    Args:
        words: what it is, in the field's terms, with the site's name in braces.
        unknowns: its parameters, or what makes them of a machine and a site; none where it has no place.
        tried: where other than by a small step of each parameter; or what makes it of a machine and the first of them.
        alike: whether it may be the same at all actuators of one make.
        imitator: the attribute of the same site that does about the same.
        needs: whether a site has a place for it; by default every one.
        per_log: whether each log has a value of its own.
        error: what ``off`` gives, of ``share`` per cent at ``site``.
    """

    name: str
    kind: Kind
    words: str
    reference: str
    unknowns: Sequence[Unknown] | Callable[[Machine, str], Sequence[Unknown]]
    nearest: str = ""
    native: bool = True
    tried: Probes | Callable[[Machine, Parameter], FloatArray] = ()
    alike: bool = False
    imitator: str = ""
    needs: Callable[[Machine, str], bool] = lambda machine, site: True
    by_name: bool = False
    fixed: bool = False
    slow: int = 1
    per_log: bool = False
    error: str = ""
    wholes: Callable[[Machine, str], tuple[float, ...]] = lambda machine, site: ()
    memory: Callable[[float], float] = lambda dt: 0.0
    edit: Callable[[Machine, str], Edit | None] = lambda machine, site: None

    def sentence(self, site: str) -> str:
        """What it is."""
        return self.words.format(site)

    def off(self, site: str, share: float) -> str:
        """See ``error``."""
        return self.error.format(site=site, share=100 * share) if self.error else super().off(site, share)

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """By the sizes of the motion there."""
        if not self.needs(machine, site):
            return ()
        unknowns = self.unknowns(machine, site) if callable(self.unknowns) else self.unknowns
        sizes = sizes_of(machine, self.kind, site)
        made = tuple(unknown.at(self.kind, site, sizes) for unknown in unknowns)
        logs = machine.logs if self.per_log else ()
        return tuple(replace(p, name=f"{p.name}[{log}]", log=log) for p in made for log in logs) if logs else made

    def groups(self, machine: Machine) -> tuple[tuple[str, ...], ...]:
        """Actuators of one make."""
        return machine.alike if self.alike else ()

    def imitators(self, site: str) -> tuple[str, ...]:
        """See ``imitator``."""
        owner, names = _OWNERS.get(self.kind, self.kind), members(site) if self.imitator else ()
        return tuple(f"{owner}:{name}.{self.imitator}" for name in names)

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """See ``tried``."""
        if callable(self.tried):
            return self.tried(machine, parameters[0])
        return np.array(self.tried) if self.tried else super().probes(machine, parameters)
