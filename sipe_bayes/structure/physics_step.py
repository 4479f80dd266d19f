"""How long a physics step is: a machine has none.

A step of h seconds moves a simulation by an error of the order h: MuJoCo's Euler steps lead an accelerated joint by
about h/2. The same prediction by half the step tells how large that is, extrapolated to no step at all (L. F.
Richardson 1911, https://doi.org/10.1098/rsta.1911.0009), as for an integrator of first order: of a higher one the error
is small, and here too large.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.extension import Extension
from sipe_bayes.structure.internal_starts import mapped_starts
from sipe_bayes.structure.machine import Machine

RUNS = 2  # rollouts of each log


class PhysicsStep(Extension):
    """A step that is none; nothing that is unknown, so not in the registry."""

    name, kind = "physics_step", "world"
    reference = "L. F. Richardson 1911"

    def sentence(self, site: str) -> str:
        """In a report."""
        return "what a shorter physics step would change"

    def off(self, site: str, share: float) -> str:
        """In a report."""
        return self.sentence(site)

    def parameters(self, machine: Machine, site: str) -> tuple[Parameter, ...]:
        """None."""
        return ()


PHYSICS_STEP = PhysicsStep()


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
            f'write <option timestep="{half:g}"/> into the model, or use it at no other step than {self.timestep:g} s'
        )


def step_error(windows: Windows, theta: FloatArray, starts: FloatArray) -> StepError | None:
    """The error at theta (N,) and starts (W, D), by ``RUNS`` rollouts; None where a run diverges or nothing changes.

    None either where the model with half the step does not compile, or has other states, which the logs' recorded ones
    do not tell.

    Raises:
        BudgetExhausted: where the windows' budget has no room.
    """
    simulator = windows.simulator
    environment = simulator.environment
    assert isinstance(environment, MjcfEnvironment)
    edits = [*environment.edits, _halved]
    try:
        finer = MjcfEnvironment.build(
            environment.source,
            environment.parameters,
            environment.actuators,
            environment.measurements,
            edits,
            environment.added,
        )
        half = Simulator(finer, simulator.num_threads)
    except ValueError:  # what the user's MJCF has that depends on the step
        return None
    if windows.settings.starts != "estimated" and half.model.nhistory != simulator.model.nhistory:
        return None
    bound = Windows(windows.settings, half, windows.trajectories, windows)
    bound.budget = windows.budget - windows.rollouts
    try:
        fine, finely = bound.predict(theta[None], mapped_starts(simulator.model, half.model, starts)[None])
    finally:
        windows.rollouts += bound.rollouts
    plain, plainly = windows.predict(theta[None], starts[None])
    with np.errstate(invalid="ignore"):
        change = np.where(windows.observed, fine[0] - plain[0], 0.0)
    if not (finely[0] and plainly[0] and np.isfinite(change).all() and change.any()):
        return None
    steps = [np.array([s.physics_steps(float(dt))[1] for dt in windows.dt]) for s in (simulator, half)]
    extrapolated = steps[0] / (steps[0] - steps[1])
    return StepError(extrapolated[:, None, None] * change, float(steps[0].max()))


def _halved(spec: mujoco.MjSpec) -> None:
    """With histories of commands and measurements that are as long as before."""
    spec.option.timestep /= 2
    for owner in (*spec.actuators, *spec.sensors):
        owner.nsample *= 2
