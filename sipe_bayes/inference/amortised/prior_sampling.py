"""What the estimators that learn from simulations of the prior share: regression, MAML, BayesSim, NPE, ABC.

Simulating goes block by block, kept in the cache; then the method trains once on what is valid. Simulations replay the
actions of the log in hand from its starts, so the trained state conditions on other trajectories if they have the same: of others
the posterior would be that of another experiment, and a warning says so (``unlike_experiment``).
"""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from sipe_bayes.core.checkpoint import State
from sipe_bayes.core.findings import Findings
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.inference.amortised.simulations import BLOCK, Cache, Simulations, describe_invalid
from sipe_bayes.inference.base import Estimator, Recorded, digest
from sipe_bayes.likelihood.noise_level import noise_level
from sipe_bayes.likelihood.settings import BudgetExhausted
from sipe_bayes.likelihood.windows import first_states
from sipe_bayes.models.statistics import step_statistics
from sipe_bayes.models.transitions import SMALLEST, control_steps
from sipe_bayes.posterior import Posterior
from sipe_bayes.simulation.callable_simulator import CallableSimulator

FloatArray = NDArray[np.float64]

_ROWS = 100  # simulations whose control steps are held at once
_SEEN = 500  # simulations that a log is compared with
_NEIGHBOURS = 20
_SAMPLES = 50
_FEWEST = 10  # valid simulations below which nothing is trained


class PriorSampling(Estimator):
    """Base of the estimators that simulate from the prior and then train.

    cache: folder for simulations, shared between estimators of one seed; default beside the checkpoint, else in memory.
    Simulated observations get the noise of the recorded ones: ``likelihood.noise_sd`` where stated, else none for
    trajectories with recorded states, which come from a simulator, and for a measured log what smoothing it takes away.

    A subclass writes ``train(simulations, trajectories) -> State``, of the valid simulations with noise added, and
    ``infer(state, trajectories) -> Posterior``; both without simulating.
    """

    amortised: ClassVar[bool] = True

    def __init__(self, simulator: Any, *, cache: str | Path | None = None, **settings: Any) -> None:
        super().__init__(simulator, **settings)
        beside = None if self.checkpoint is None else self.checkpoint.with_name("simulations")
        self.cache = beside if cache is None else self.stored("cache", cache)
        self._cached: tuple[Trajectories, Cache] | None = None

    @abstractmethod
    def train(self, simulations: Simulations, trajectories: Trajectories) -> State:
        """Arrays, numbers and text that ``infer`` needs."""

    @abstractmethod
    def infer(self, state: State, trajectories: Trajectories) -> Posterior: ...

    def start(self, trajectories: Trajectories) -> State:
        self._check(trajectories)
        self._affordable(trajectories)
        return {"simulated": 0, "trained": False, "done": False, "logs": digest(trajectories), "before": 0}

    def step(self, state: State, trajectories: Trajectories) -> State:
        """A block of simulations, or the training once the budget is spent."""
        if state["logs"] != digest(trajectories):  # other trajectories, other simulations; those made count
            state = {**state, "simulated": 0, "logs": digest(trajectories), "before": self.rollouts}
        most = self._affordable(trajectories, state["before"])
        if state["simulated"] < most:
            count = min(state["simulated"] + BLOCK, most)
            self._simulations(trajectories).first(count)
            self.rollouts = state["before"] + count * len(trajectories)
            return {**state, "simulated": count}
        return self._trained(state, trajectories)

    def posterior(self, state: State, trajectories: Trajectories) -> Posterior:
        self._check(trajectories)
        state = state if state["trained"] else self._trained(state, self._simulated(state, trajectories))
        other = unlike_experiment(state, trajectories, noise_level(trajectories, self.likelihood))
        if other is not None:
            self.doubt(other)
        log = self._looks(trajectories.observations[None], trajectories)
        alike = np.array_equal(np.isfinite(trajectories.observations).all(-1), state["seen_where"])
        how_far = max(unlikeness(state[name], log[name][0]) for name in log) if alike else float("nan")
        self.diagnostics["unlikeness"] = how_far
        if how_far > 1:
            said = "the log is unlike every simulation: widen the bounds, or correct the model, before you trust the result"
            self.doubt(said)
        return self.infer(state, trajectories)

    def statistics(self, observations: NDArray[np.floating], trajectories: Trajectories) -> FloatArray:
        """BayesSim's statistics (n, F) of observations (n, R, T+1, O), without the samples that the log lacks."""
        o, a = trajectories.observations.shape[-1], trajectories.actions.shape[-1]
        found = []
        for rows in np.split(observations, range(_ROWS, len(observations), _ROWS)):
            seen = np.where(np.isfinite(trajectories.observations), rows, np.nan)
            found.append(step_statistics(control_steps(seen, trajectories.actions, trajectories.length, None), o, a))
        return np.concatenate(found)

    def _affordable(self, trajectories: Trajectories, before: int = 0) -> int:
        """Simulations to train on that the budget has room for; raises BudgetExhausted if there are none."""
        most = (self.budget - before) // len(trajectories) - self.reserved
        if most < 1:
            raise BudgetExhausted(
                f"{1 + self.reserved} simulations of {len(trajectories)} rollouts are the least, the budget has "
                f"{self.budget - before}"
            )
        return most

    @property
    def reserved(self) -> int:
        """Simulations kept for after the training."""
        return 0

    def simulate(self, theta: FloatArray, trajectories: Trajectories, rng: np.random.Generator) -> Simulations:
        """Simulations of theta (n, N), which need not come from the prior, with noise; the caller counts them."""
        return self._noisy(self._simulations(trajectories).simulate(theta), trajectories, rng)

    def describe(self, state: State) -> str:
        return f"{self.name}: {'trained' if state['trained'] else 'simulating'}"

    def simulations(self, state: State, trajectories: Trajectories) -> Simulations:
        """The valid simulations so far, with noise."""
        made = self._simulations(trajectories).first(state["simulated"])
        self.judge(made)
        return self._usable(made, trajectories)

    def judge(self, made: Simulations) -> None:
        """Count all that were made so far and say where the invalid ones lie; raises ValueError where too few are valid."""
        self.findings = Findings(f for f in self.findings if f.text != self.diagnostics.get("invalid"))  # of fewer
        said = describe_invalid(made, self.space, self.simulator.failure)
        self.warn(said)
        self.diagnostics.update({"invalid": said} if said else {}, invalid_simulations=int((~made.valid).sum()))
        if made.valid.sum() < _FEWEST:
            raise ValueError(
                f"budget: {int(made.valid.sum())} of {len(made)} simulations are valid, {self.name} needs {_FEWEST}"
                f"{self._lost(made)}; raise the budget{'' if made.valid.all() else ', or narrow the bounds'}"
            )

    def still_improving(self, converged: bool, passes: int, unit: str, argument: str) -> None:
        """A warning where a training ended at ``argument``, its limit on ``passes`` of a unit, and not by itself."""
        if not converged:
            self.warn(f"the training was still improving after {passes} {unit}; raise {argument}")

    def _usable(self, made: Simulations, trajectories: Trajectories) -> Simulations:
        return self._noisy(made.usable(), trajectories, np.random.default_rng([self.seed, 1]))

    def _lost(self, made: Simulations) -> str:
        return "" if made.valid.all() else f", the others {self.simulator.failure}"

    def _noisy(self, made: Simulations, trajectories: Trajectories, rng: np.random.Generator) -> Simulations:
        sd = noise_level(trajectories, self.likelihood)
        if not sd.any():
            return made
        noise = (sd * rng.standard_normal(made.observations.shape)).astype(np.float32)
        return Simulations(made.theta, made.observations + noise, made.valid)

    def _looks(self, observations: NDArray[np.floating], trajectories: Trajectories) -> dict[str, FloatArray]:
        """What tells a log from simulations: statistics, and up to 50 samples as they are (of what the log has)."""
        there = np.nonzero(np.isfinite(trajectories.observations).all(-1))
        kept = np.linspace(0, len(there[0]) - 1, min(_SAMPLES, len(there[0]))).round().astype(int)
        samples = observations[:, there[0][kept], there[1][kept]].reshape(len(observations), -1)
        return {"seen_statistics": self.statistics(observations, trajectories), "seen_samples": samples.astype(float)}

    def _trained(self, state: State, trajectories: Trajectories) -> State:
        simulations = self.simulations(state, trajectories)
        self._check_units(simulations)
        seen = self._looks(simulations.observations[-_SEEN:], trajectories)
        trained = self.train(simulations, trajectories)
        where = np.isfinite(trajectories.observations).all(-1)
        replayed = _experiment(trajectories, simulations.observations[:, :, 0])
        return {**state, **trained, **seen, **replayed, "seen_where": where, "trained": True, "done": True}

    def _check_units(self, simulations: Simulations) -> None:
        """A warning where a function's outputs vary by less than networks take for rounding."""
        if isinstance(self.simulator, CallableSimulator):
            sd = simulations.observations[:, 0, 1].astype(float).std(0)
            small = np.flatnonzero((sd > 0) & (sd <= SMALLEST)).tolist()
            if small:
                self.warn(
                    f"x{small} vary by {sd[small].max():.0e} only, as rounding does; give fn's outputs in smaller units"
                )

    def _simulated(self, state: State, trajectories: Trajectories) -> Trajectories:
        """The trajectories whose simulations the untrained state counts: these, or the last ones that were stepped on."""
        for candidate in (trajectories, *([] if self._cached is None else [self._cached[0]])):
            if digest(candidate) == state["logs"]:
                return candidate
        raise ValueError(
            "trajectories: nothing was simulated for these; call update_parameter_estimate with them first"
        )

    def _simulations(self, trajectories: Trajectories) -> Cache:
        if self._cached is None or self._cached[0] is not trajectories:
            starts = first_states(self.simulator, trajectories)
            made = Cache(self.simulator, self.prior, trajectories, starts, self.seed, self.cache)
            self._cached = (trajectories, made)
        return self._cached[1]

    def _recorded(self, given: Recorded) -> Recorded:
        """As the base's; an observed x of a CallableSimulator must be whole, as what these methods learn from is."""
        found = super()._recorded(given)
        if isinstance(self.simulator, CallableSimulator):
            for trajectory in [found] if isinstance(found, Trajectory) else found:
                missing = np.flatnonzero(np.isnan(trajectory.observations).any(0)).tolist()
                if missing:
                    raise ValueError(
                        f"x: {self.name} learns from whole ones, but x{missing} is NaN; leave it out of fn and of x"
                    )
        return found

    def _check(self, trajectories: Trajectories) -> None:
        environment = self.simulator.environment
        channels, found = list(environment.channels), trajectories.observations.shape[2]
        if found != len(channels):
            raise ValueError(
                f"trajectories: expected observations of the {len(channels)} channels {channels}, got {found}"
            )
        if trajectories.actions.shape[2] != environment.num_actions:
            raise ValueError(
                f"trajectories: expected {environment.num_actions} actions, got {trajectories.actions.shape[2]}"
            )


def _experiment(trajectories: Trajectories, first: NDArray[np.floating]) -> State:
    """What the simulations replayed: actions (R, T, A), steps (R,), seconds (R,), starting states (R, S) where recorded, else
    (0, 0), and the range of the simulations' first samples (n, R, O)."""
    states = trajectories.states
    return {
        "replayed_actions": np.asarray(trajectories.actions, float),
        "replayed_length": np.asarray(trajectories.length, np.int64),
        "replayed_dt": np.asarray(trajectories.dt, float),
        "replayed_starts": np.empty((0, 0)) if states is None else np.asarray(states[:, 0], float),
        "first_low": np.asarray(first.min(0), float),
        "first_high": np.asarray(first.max(0), float),
    }


def unlike_experiment(state: State, trajectories: Trajectories, noise: FloatArray) -> str | None:
    """What is to be said where trajectories are not of the experiment that the simulations of ``state`` replayed; None where they are.

    Actions, lengths and seconds have to be equal. So have starting states where both are recorded; else the first samples
    must lie within the simulated ones' range, give or take three sds of the ``noise`` (O,): velocities do not show in them.
    """
    differs = _differs(state, trajectories, noise)
    if differs is None:
        return None
    return (
        f"the log's {differs} differ from those that the simulations replayed: the posterior is that of another experiment; "
        "fit again with this log"
    )


def _differs(state: State, trajectories: Trajectories, noise: FloatArray) -> str | None:
    """What of the experiment differs."""
    length, dt, actions = (state[f"replayed_{name}"] for name in ("length", "dt", "actions"))
    if not np.array_equal(length, trajectories.length):
        return "number or lengths"
    if not (
        np.allclose(dt, trajectories.dt, rtol=1e-9, atol=0) and np.allclose(actions, trajectories.actions, rtol=1e-9)
    ):
        return "actions"
    starts, first = state["replayed_starts"], trajectories.observations[:, 0]
    if len(starts) and trajectories.states is not None:  # noise may have been added to what was observed
        same = np.allclose(starts[:, 1:], trajectories.states[:, 0, 1:], rtol=1e-6, atol=1e-6)
        return None if same else "starting states"
    low, high = state["first_low"], state["first_high"]
    slack = 3 * noise + 1e-5 * (1 + np.maximum(np.abs(low), np.abs(high)))
    return "starting states" if ((first < low - slack) | (first > high + slack)).any() else None


def unlikeness(seen: FloatArray, log: FloatArray) -> float:
    """Local outlier factor of a log's statistics (F,) among simulated ones (n, F), over the largest of the simulations' own
    (M. Breunig et al. 2000, https://doi.org/10.1145/342009.335388): above 1 happens by chance once in n + 1 logs,
    of two looks twice as often."""
    from sklearn.neighbors import LocalOutlierFactor

    sd = seen.std(0)
    varies = sd > 1e-9 * (np.abs(seen).max(0) + 1e-30)
    if not varies.any() or not np.isfinite(log).all():
        return 0.0
    scaled, point = seen[:, varies] / sd[varies], log[varies] / sd[varies]
    factor = LocalOutlierFactor(min(_NEIGHBOURS, len(scaled) - 1), novelty=True).fit(scaled)
    return float(-factor.score_samples(point[None])[0] / np.max(-factor.negative_outlier_factor_))


def recorded_steps(trajectories: Trajectories) -> torch.Tensor:
    """The recorded control steps (M, 2 O + A) without missing samples; raises ValueError when there are none."""
    steps = control_steps(trajectories.observations[None], trajectories.actions, trajectories.length)[0]
    steps = steps[np.isfinite(steps).all(-1)]
    if not len(steps):
        raise ValueError(
            "trajectories: expected control steps with all channels measured at both ends, got none; "
            "resample the log, or leave out a channel that is rarely measured"
        )
    return torch.from_numpy(steps)
