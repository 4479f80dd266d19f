"""What a model may get: an extension is a piece of physics with parameters of its own, placed at a joint or elsewhere.

It is the plain model where its parameters have their defaults. Those of this package are rows of
``structure.extensions.table``; one of your own is a subclass of ``Extension`` that is named by its import path::

    from sipe_bayes.core.parameters import Parameter
    from sipe_bayes.structure.extension import Extension

    class DryFriction(Extension):
        name, kind = "dry_friction", "joint"
        reference = "C. A. Coulomb 1785"

        def sentence(self, site):
            return f"dry friction at {site}"

        def parameters(self, machine, site):
            target = f"joint:{site}.frictionloss"
            return (Parameter(f"{site}.dry_friction", 0.0, machine.joints[site].force, targets=(target,)),)
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.mjcf import Edit, MjcfEnvironment
from sipe_bayes.envs.target import TargetError
from sipe_bayes.envs.targets import bind
from sipe_bayes.envs.unknowns import physical_targets
from sipe_bayes.structure.machine import Machine

Kind = Literal["joint", "tendon", "actuator", "body", "channel", "world"]
KINDS: tuple[str, ...] = get_args(Kind)
PROBE = 0.03  # of a parameter's range, how far a probe goes: an effect that is still about linear
WORLD = "world"  # the one site of an extension of the world
_AND = " and\u00a0"  # between the names of a site that is several: no name of one holds a no-break space


class Extension(ABC):
    """A piece of physics that a model may lack, placed at a site of its ``kind`` and described in ``reference``."""

    name: str
    kind: Kind
    reference: str
    native: bool = True  # MJCF has an element for it
    nearest: str = ""  # the element of MJCF that comes nearest, where it has none of its own
    by_name: bool = False  # tried only where it is named
    fixed: bool = False  # nothing about it is unknown: it has no parameters
    slow: int = 1  # how many times as long a simulation takes; if longer, what parameters do is about the same without

    @abstractmethod
    def sentence(self, site: str) -> str:
        """What it is, in a report: such as "dry friction at elbow"."""

    @abstractmethod
    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """Its unknowns, their bounds in SI from the sizes of the machine's motion; none where it does not apply."""

    def wholes(self, machine: Machine, site: str, /) -> tuple[float, ...]:
        """Of each parameter, in its unit, what a tolerance is a share of; none of numbers that logs alone tell."""
        return ()

    def off(self, site: str, share: float) -> str:
        """What it is where a number with a tolerance is off by this share, in a report."""
        return f"{self.sentence(site)} ({100 * share:.3g} %)"

    def memory(self, dt: float, /) -> float:
        """Seconds that a sample at most tells of the past, of logs with ``dt``: see ``Environment.remembers``."""
        return 0.0

    def groups(self, machine: Machine) -> tuple[tuple[str, ...], ...]:
        """Names of sites at which it may be one and the same thing, beside those that the user takes to be alike."""
        return ()

    def edit(self, machine: Machine, site: str, /) -> Edit | None:
        """What is changed in the MJCF, where parameters of it are not enough."""
        return None

    def imitators(self, site: str) -> tuple[str, ...]:
        """Targets, in its one parameter's unit, that do about the same, such as a delay beside a lag.

        Where one parameter of the model writes them, a probe takes from it what it adds. Where one writes those of
        several sites, these are a site together.
        """
        return ()

    def probes(self, machine: Machine, parameters: tuple[Parameter, ...]) -> FloatArray:
        """Theta (K, P) of its P parameters at which it is tried: by default a small step of each away from its default.

        (G, K, P) where there are G shapes, of which one is to be chosen: several speeds, or numbers of poles.
        """
        plain = plain_theta(parameters)
        return plain + np.diag(np.where(plain > 1 - 2 * PROBE, -PROBE, PROBE))


def members(site: str) -> tuple[str, ...]:
    """The names of a site, of which one that is several has more than one."""
    return tuple(site.split(_AND))


def imitating(extension: Extension, site: str, parameters: Sequence[Parameter]) -> int | None:
    """Number of the parameter that writes nothing but what imitates an extension at a site; None without one."""
    alike = set(extension.imitators(site))
    own = (k for k, p in enumerate(parameters) if p.targets and p.log is None and set(p.targets) <= alike)
    return next(own, None)


def plain_theta(parameters: Sequence[Parameter]) -> FloatArray:
    """Theta (P,) where parameters have their defaults, or the cube's middle of those without one."""
    return np.array([0.5 if p.default is None else float(p.normalise(p.default)) for p in parameters])


@dataclass(frozen=True)
class Placed:
    """An extension at a site: the name of a joint, tendon, actuator, body or channel, or of several; or ``WORLD``.

    ``parameters`` have the model's own values as defaults; ``edit``, ``probes`` (G, K, P) and ``wholes`` see
    ``Extension``.
    """

    extension: Extension
    site: str
    parameters: tuple[Parameter, ...]
    edit: Edit | None
    probes: FloatArray
    wholes: tuple[float, ...] = ()

    @property
    def label(self) -> str:
        """What tells it from others."""
        return f"{self.extension.name}:{self.site}"

    @property
    def sentence(self) -> str:
        """What it is."""
        return self.extension.sentence(self.site)

    @property
    def plain(self) -> FloatArray:
        """Theta (P,) where it changes nothing."""
        return plain_theta(self.parameters)

    @property
    def by_log(self) -> bool:
        """Whether it is of one log alone."""
        return any(parameter.log is not None for parameter in self.parameters)

    @property
    def remedy(self) -> str:
        """How it comes into the model."""
        if self.edit is not None:  # the model has no such part yet
            return f"let `sipe discover` put it in (--only {self.extension.name})"
        targets = [target for parameter in self.parameters for target in parameter.targets]
        what = "as a parameter (or widen its bounds)" if len(targets) == 1 else "as parameters (or widen their bounds)"
        return f"add {' and '.join(targets)} {what}"


def extended(environment: MjcfEnvironment, placed: Sequence[Placed]) -> MjcfEnvironment:
    """The environment with extensions, whose parameters follow its own.

    Raises:
        TargetError: where two write the same number.
        ModelError: where an edit breaks the model.
    """
    own, edits = environment, [*environment.edits, *(p.edit for p in placed if p.edit is not None)]
    parameters = [*own.parameters, *(q for p in placed for q in p.parameters)]
    return MjcfEnvironment.build(own.source, parameters, own.actuators, own.measurements, edits, own.added)


def placements(extension: Extension, machine: Machine) -> Iterator[Placed]:
    """The extension wherever the machine has a place for it."""
    sites = {
        "joint": tuple(machine.joints),
        "tendon": tuple(machine.tendons),
        "actuator": machine.environment.actuators,
        "body": tuple(machine.bodies),
        "channel": machine.environment.channels,
        "world": (WORLD,),
    }
    taken, count = machine.written(), len(machine.environment.parameters)
    for site in (*sites[extension.kind], *_together(extension, sites[extension.kind], machine)):
        with _user_code(extension, site):
            parameters = tuple(_with_own(machine, p) for p in extension.parameters(machine, site))
            edit = extension.edit(machine, site)
            if not (parameters or (extension.fixed and edit)) or any(t in taken for p in parameters for t in p.targets):
                continue
            draft = Placed(extension, site, parameters, edit, np.zeros((0, 0, len(parameters))))
            _ = draft.sentence
        try:
            space = extended(machine.environment, [draft]).space
        except ValueError:
            continue  # the model has no place for it, or a value of its own beyond these bounds
        own = tuple(space)[count:]
        with _user_code(extension, site):
            probes = np.asarray(extension.probes(machine, own), float)
            wholes = extension.wholes(machine, site)
        yield Placed(extension, site, own, edit, probes if probes.ndim == 3 else probes[None], wholes)


def _together(extension: Extension, sites: tuple[str, ...], machine: Machine) -> Iterator[str]:
    """Sites at which it is one thing: by its own account, or as one parameter writes what imitates it there."""
    written = (
        tuple(site for site in sites if set(parameter.targets) & set(extension.imitators(site)))
        for parameter in machine.environment.parameters
    )
    yield from (_AND.join(alike) for alike in dict.fromkeys((*extension.groups(machine), *written)) if len(alike) > 1)


def _with_own(machine: Machine, parameter: Parameter) -> Parameter:
    """A parameter whose bounds hold the model's own values and as much again."""
    low, high = parameter.low, parameter.high
    for target in physical_targets(parameter.targets):
        try:
            own = bind(machine.model, target).value
        except TargetError:  # what the extension itself brings
            continue
        if math.isfinite(own) and not low <= own <= high:
            low, high = min(low, 2 * own), max(high, 2 * own)
    return replace(parameter, low=low, high=high)


@contextmanager
def _user_code(extension: Extension, site: str) -> Iterator[None]:
    """Whatever an extension raises as one line."""
    try:
        yield
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(f"structure: extension {extension.name!r} fails at {site!r} ({reason}); correct it") from error
