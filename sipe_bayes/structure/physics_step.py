"""How long a physics step is: a machine has none.

A step of h seconds moves a simulation by an error of the order h: MuJoCo's Euler steps, explicit or implicit in the
velocity, lead an accelerated joint by about h/2. The same prediction by half the step tells how large that is,
extrapolated to no step at all (L. F. Richardson 1911, https://doi.org/10.1098/rsta.1911.0009). Of RK4, whose error is
of fourth order, twice the change is 15/8 of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood import BoundLikelihood
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.extension import Extension, Placed, extended
from sipe_bayes.structure.internal_starts import mapped_starts
from sipe_bayes.structure.machine import Machine

RUNS = 2  # rollouts of each log, at most


class PhysicsStep(Extension):
    """A step that is none; nothing that is unknown, so not in the registry."""

    name, kind = "physics_step", "world"
    reference = "L. F. Richardson 1911"

    def sentence(self, site: str) -> str:
        """In a report."""
        return "what a shorter physics step would change"

    def off(self, site: str, share: float) -> str:
        """In a report."""
        return "the effect of the physics step"

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """None."""
        return ()


PHYSICS_STEP = PhysicsStep()


class ShorterSteps(PhysicsStep):
    """Steps of the size that their site is named by."""

    def sentence(self, site: str) -> str:
        """In a report."""
        return f"physics steps of {site}"


@dataclass(frozen=True)
class StepLadder:
    """Shorter and shorter physics steps, of which a structure has one at most.

    Args:
        labels: of the pieces, the longest step first.
    """

    labels: tuple[str, ...] = ()

    def pieces(self, labels: Iterable[str]) -> tuple[str, ...]:
        """Those that are no steps."""
        return tuple(label for label in labels if label not in self.labels)

    def rung(self, labels: Sequence[str]) -> int:
        """How short the steps of a structure are: zero for the model's own."""
        return max((1 + k for k, label in enumerate(self.labels) if label in labels), default=0)

    def finer(self, labels: Sequence[str]) -> tuple[str, ...] | None:
        """A structure in the next shorter steps; None where there are none."""
        onward = self.labels[self.rung(labels) :]
        return (*self.pieces(labels), onward[0]) if onward else None


@dataclass(frozen=True)
class StepError:
    """What physics steps do to predictions.

    Args:
        change: (W, L, C) of the predictions without them.
        timestep: seconds.
    """

    change: FloatArray
    timestep: float

    @property
    def remedy(self) -> str:
        """For a report."""
        half = 0.5 * self.timestep
        return (
            f'write <option timestep="{half:g}"/> into the model, and shorter ones until values stay what they are; or '
            f"use it at no other step than {self.timestep:g} s"
        )


def shorter_steps(windows: BoundLikelihood) -> list[Placed]:
    """A quarter of the model's physics step, and a quarter of that; none where it does not compile with the logs."""
    environment, pieces = windows.simulator.environment, list[Placed]()
    assert isinstance(environment, MjcfEnvironment)
    step = float(windows.simulator.model.opt.timestep)
    for shorter in (step / 4, step / 16):
        edit, site = partial(_stepped, timestep=shorter), f"{1e3 * shorter:.3g} ms"
        piece = Placed(ShorterSteps(), site, (), edit, np.zeros((0, 0, 0)))
        try:
            finer = Simulator(extended(environment, [piece]), windows.simulator.num_threads)
            BoundLikelihood(windows.settings, finer, windows.trajectories)
        except ValueError:
            break
        pieces.append(piece)
    return pieces


def step_error(windows: BoundLikelihood, theta: FloatArray, starts: FloatArray) -> StepError | None:
    """The error at theta (N,) and starts (W, D), by at most ``RUNS`` rollouts.

    None where a run diverges, nothing changes, or the model does not compile with half the step. None either where it
    then has other states, a longer history of commands, than those that the logs' recorded ones are to be held to.

    Raises:
        BudgetExhausted: where the windows' budget has no room.
    """
    simulator = windows.simulator
    steps = _timesteps(simulator, windows)
    try:
        half = _finer(simulator, 0.5 * float(steps.min()))
        if windows.settings.starts != "estimated" and half.model.nhistory != simulator.model.nhistory:
            return None
        bound = BoundLikelihood(windows.settings, half, windows.trajectories, windows)
    except ValueError:  # what the user's MJCF has that depends on the step
        return None
    own = 1 + simulator.model.nq + simulator.model.nv + simulator.model.na  # columns: time and what moves
    bound.reference[:, :own] = windows.reference[:, :own]
    bound.budget, bound.deadline = windows.budget - windows.rollouts, windows.deadline
    begun = mapped_starts(simulator.model, half.model, starts)
    try:
        fine, finely = bound.predict(theta[None], begun[None], in_float64=True)
    finally:
        windows.rollouts += bound.rollouts
    plain, plainly = windows.predict(theta[None], starts[None], in_float64=True)
    extrapolated = steps / (steps - _timesteps(half, windows))
    with np.errstate(invalid="ignore"):
        change = np.where(windows.observed, windows.continued(fine, plain[0])[0] - plain[0], 0.0)
        change *= extrapolated[:, None, None]
    if not (finely[0] and plainly[0] and np.isfinite(change).all() and change.any()):
        return None
    return StepError(change, float(steps.max()))


def _timesteps(simulator: Simulator, windows: BoundLikelihood) -> FloatArray:
    """Seconds (W,) of a physics step in each window."""
    return np.array([simulator.physics_steps(float(dt))[1] for dt in windows.dt])


def _finer(simulator: Simulator, timestep: float) -> Simulator:
    """The same in steps of at most so many seconds."""
    environment = simulator.environment
    assert isinstance(environment, MjcfEnvironment)
    finer = MjcfEnvironment.build(
        environment.source,
        environment.parameters,
        environment.actuators,
        environment.measurements,
        [*environment.edits, partial(_stepped, timestep=timestep)],
        environment.added,
    )
    return Simulator(finer, simulator.num_threads)


def _stepped(spec: mujoco.MjSpec, timestep: float) -> None:
    """With histories of commands and measurements that are as long as before."""
    times = max(1, math.ceil(spec.option.timestep / timestep * (1 - 1e-9)))
    spec.option.timestep = min(timestep, spec.option.timestep)
    for owner in (*spec.actuators, *spec.sensors):
        owner.nsample *= times
