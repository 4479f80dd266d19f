"""What a task of the leaderboard is: a simulator, logs, what a method is told, and what its answers are scored by."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.likelihood import BoundLikelihood, Segments, bind
from sipe_bayes.posterior import Posterior, prior
from sipe_bayes.simulation.callable_simulator import CallableSimulator
from sipe_bayes.simulation.simulator import Simulator

VERSION = "v1"
"""Of all tasks together: a task that changes makes another one."""


class Kind(StrEnum):
    """What the tasks of a group have in common."""

    ENVIRONMENT = "environment"
    REAL = "real"
    ARM = "arm"
    EXACT = "exact posterior"
    WRONG = "wrong model"


@dataclass(frozen=True, eq=False)
class Case:
    """One log of a task, or several that were recorded of one machine.

    Args:
        name: of the log.
        trajectories: what a method is given. Of recorded states those alone are there in which a
            window of the likelihood starts, the others are NaN.
        truth: theta (N,), NaN where it is not known.
        heldout: logs of the same machine that predictions are scored on.
        reference: draws (M, N) in theta of the exact posterior, where it is known.
    """

    name: str
    trajectories: Trajectories
    truth: FloatArray
    heldout: Trajectories | None = None
    reference: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class Problem:
    """A task, made: what a method is given.

    Args:
        simulator: what is calibrated.
        likelihood: how logs are cut into windows, and that they start where the log says.
        cases: the logs.
        stated: the prior, by default what the parameters say.
        settings: of the library's own searches, which a configuration asks for.
    """

    simulator: Simulator | CallableSimulator
    likelihood: Segments
    cases: tuple[Case, ...]
    stated: Posterior | None = None
    settings: Mapping[str, object] = field(default_factory=dict)

    @property
    def space(self) -> ParameterSpace:
        """The N unknowns."""
        return self.simulator.space

    @cached_property
    def prior(self) -> Posterior:
        """Of theta."""
        return self.stated or prior(self.space)

    def case(self, name: str) -> Case:
        """The case of a name; raises KeyError for another."""
        return {case.name: case for case in self.cases}[name]

    def windows(self, trajectories: Trajectories) -> BoundLikelihood:
        """Logs as they are compared with simulations."""
        return bind(self.likelihood, self.simulator, trajectories)

    def observed(self, case: Case) -> FloatArray:
        """What was measured, all logs and channels in a row (D,)."""
        windows = self.windows(case.trajectories)
        return windows.measured[windows.observed]

    def scale(self, case: Case) -> FloatArray:
        """By what each number of ``observed`` may be divided (D,): the spread of its channel, one where it has none."""
        windows = self.windows(case.trajectories)
        spread = np.where(windows.spread > 0, windows.spread, 1.0)
        return np.broadcast_to(spread, windows.measured.shape)[windows.observed]

    def simulate(self, case: Case, values: FloatArray) -> FloatArray:
        """What ``observed`` would be without the sensors' noise, for physical values (B, N).

        Each row costs one rollout for every log of the case.

        Returns:
            (B, D), in which a simulation that diverged is NaN throughout.
        """
        windows = self.windows(case.trajectories)
        theta = np.atleast_2d(self.space.normalise(values))
        if self.likelihood.starts == "estimated":
            starts = windows.no_starts(len(theta))
        else:
            starts = np.tile(windows.no_starts(), (len(theta), 1, 1))
        predicted, valid = windows.predict(theta, starts)
        return np.where(valid[:, None], predicted[:, windows.observed], np.nan)


@dataclass(frozen=True)
class Task:
    """What methods are compared on.

    Args:
        name: one word.
        kind: its group.
        about: a sentence.
        budget: rollouts that a method may use for each case.
        load: makes it; may take seconds.
        truths: whether some parameters' are known.
        heldout: whether logs are held out.
    """

    name: str
    kind: Kind
    about: str
    budget: int
    load: Callable[[], Problem]
    truths: bool = True
    heldout: bool = False

    def definition(self, problem: Problem) -> str:
        """A digest of what the scores depend on: an entry of another definition does not compare."""
        plain = [VERSION, self.name, self.budget, list(problem.space.names)]
        plain += [[f"{p.low:.9g}", f"{p.high:.9g}", p.scale] for p in problem.space]
        plain += [[case.name, [f"{x:.9g}" for x in case.truth]] for case in problem.cases]
        return hashlib.sha256(json.dumps(plain).encode()).hexdigest()[:12]


def known_start(trajectories: Trajectories, every: int | None = None) -> Trajectories:
    """Trajectories of whose recorded states the first alone is left, or each one after ``every`` control steps."""
    assert trajectories.states is not None
    states = trajectories.states.copy()
    left = np.arange(states.shape[1]) % (every or states.shape[1]) != 0
    states[:, left] = np.nan
    return replace(trajectories, states=states, rewards=None)


FROM_START = Segments(None, starts="recorded")
"""Each log as one window from its known start; the noise is the method's to find out."""
