"""What the estimators that learn from simulations of the prior share: regression, MAML, BayesSim, NPE, ABC.

Simulating goes block by block, kept in the cache; then the method trains once on what is valid. Simulations replay the
actions of the log in hand from its starts, so what was learned conditions on other logs of the same experiment.

**What was learned is kept.** A second ``fit`` with trajectories of the same form conditions: it neither simulates nor
trains, and ``rollouts`` is 0. Of the same form are trajectories with

- the same number, lengths, channels and seconds of a control step,
- the same commands, to nine digits,
- the same starting states, to six digits, where both logs hold states; else first samples that differ by no more than
  six sds of the noise (velocities do not show in them),
- the same goals, for a task that has goals; the same names, where a parameter belongs to one log alone,
- the same samples missing,
- a noise level, of each channel, at most twice or half as high: stated by ``likelihood.noise_sd``, else zero where
  states are recorded, else as estimated from the log. Estimates of coarsely sampled logs differ by more: state it.

So of logs that share commands and starts only observations differ. With trajectories of another form, or where a
setting of the estimator was changed, ``fit`` simulates and trains anew and notes why; ``fit(..., retrain=True)`` does
so in any case. A checkpoint holds what was learned: another estimator with the same settings and checkpoint conditions
too, and refuses trajectories of another form, since they belong into another file. ``get_parameter_estimate`` always
conditions and raises a doubt where the log is of another experiment.

``rounds`` > 1 targets one observation: every fit trains anew. ``maml`` keeps its meta-training and adapts to each log
anew, on simulations near the estimate, which ``rollouts`` counts.
"""

from __future__ import annotations

import hashlib
from abc import abstractmethod
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, from_numpy

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.budget import BudgetExhausted
from sipe_bayes.core.checkpoint import CheckpointError, Snapshot
from sipe_bayes.core.findings import Code, p_text
from sipe_bayes.core.options import Options, option
from sipe_bayes.core.seeding import torch_generator
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.inference.amortised.experiment import Experiment, measured
from sipe_bayes.inference.amortised.held_back import HeldBack, parted, scored
from sipe_bayes.inference.amortised.outside import Outside
from sipe_bayes.inference.amortised.simulations import BLOCK, Cache, Simulations, place_of_invalid
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.recorded import Recorded, digest
from sipe_bayes.likelihood import first_states, noise_level
from sipe_bayes.models.statistics import step_statistics
from sipe_bayes.models.transitions import SMALLEST, control_steps
from sipe_bayes.posterior import Posterior
from sipe_bayes.simulation.callable_simulator import CallableSimulator

_ROWS = 100  # simulations whose control steps are held at once, for memory alone
_SEEN = 500  # simulations that a log is compared with, for time alone

L = TypeVar("L")
S = TypeVar("S", bound="PriorSamplingState[Any]")


@dataclass(frozen=True)
class Learned(Generic[L]):
    """What a training left.

    Attributes:
        content: the method's own part of it.
        experiment: what its simulations replayed.
        outside: what tells a log from its simulations.
        log: digest of the trajectories that were in hand.
        held_back: what simulations that were not trained on say of the posteriors; None without.
    """

    content: L
    experiment: Experiment
    outside: Outside
    log: str
    held_back: HeldBack | None = None


@dataclass(frozen=True)
class PriorSamplingState(Generic[L]):
    """How far a fit is.

    Attributes:
        log: digest of the trajectories that it is for.
        before: rollouts spent on other ones.
        simulated: simulations for these.
        learned: None before a training.
        done: whether it has ended.
    """

    log: str
    before: int = 0
    simulated: int = 0
    learned: Learned[L] | None = None
    done: bool = False


@dataclass(frozen=True)
class PriorSamplingOptions(Options):
    """Options of all methods that simulate the prior."""

    cache: Path | None = option(
        None,
        "folder for simulations, shared between estimators of one seed; default beside the checkpoint, else in memory",
    )


class PriorSampling(Estimator[S], Generic[S, L]):
    """Base of the estimators that simulate from the prior and then train.

    Simulated observations get the noise of the recorded ones: ``likelihood.noise_sd`` where stated, else none for
    trajectories with recorded states, which come from a simulator, and for a measured log what smoothing takes away.

    A subclass writes ``train``, of the valid simulations with noise added, and ``infer``; both without simulating. Its
    ``state_type`` is ``PriorSamplingState`` of what ``train`` returns, or a subclass further fields with defaults.
    """

    amortised: ClassVar[bool] = True
    options_type: ClassVar[type[Options]] = PriorSamplingOptions
    state_type: ClassVar[type[PriorSamplingState[Any]]]
    options: PriorSamplingOptions

    def prepare(self) -> None:
        """Where simulations are kept; raises ValueError for no path, or a function without a name."""
        beside = None if self.checkpoint is None else self.checkpoint.with_name("simulations")
        self.cache = beside if self.options.cache is None else self.stored("cache", self.options.cache)
        self._cached: tuple[Trajectories, Cache] | None = None

    @abstractmethod
    def train(self, simulations: Simulations, trajectories: Trajectories) -> L:
        """What ``infer`` needs of the simulations: a frozen dataclass."""

    @abstractmethod
    def infer(self, learned: L, trajectories: Trajectories) -> Posterior:
        """The posterior of the trajectories."""

    def settings(self) -> dict[str, object]:
        """As the base's, without the cache, which changes no result."""
        return {name: value for name, value in super().settings().items() if name != "cache"}

    @property
    def keeps(self) -> bool:
        """Whether what it learns serves other trajectories of the same form."""
        return True

    @property
    def reserved(self) -> int:
        """Simulations kept for after the training."""
        return 0

    def start(self, trajectories: Trajectories) -> S:
        """Nothing simulated yet; raises BudgetExhausted where nothing could be."""
        self._check(trajectories)
        self._affordable(trajectories)
        return cast(S, self.state_type(digest(trajectories)))

    def step(self, state: S, trajectories: Trajectories) -> S:
        """A block of simulations, or the training once the budget is spent."""
        if state.log != digest(trajectories):  # other trajectories, other simulations; those made count
            state = replace(state, simulated=0, log=digest(trajectories), before=self.rollouts)
        most = self._affordable(trajectories, state.before)
        if state.simulated >= most:
            return replace(self._trained(state, trajectories), done=True)
        cache = self.prior_simulations(trajectories)
        count = min(state.simulated + max(BLOCK, cache.wave), most)
        cache.first(count)
        self.rollouts = state.before + count * len(trajectories)
        return replace(state, simulated=count)

    def posterior(self, state: S, trajectories: Trajectories) -> Posterior:
        """That of what was learned so far, with doubts where the log does not belong to it."""
        self._check(trajectories)
        if state.learned is None:
            state = self._trained(state, self._simulated(state, trajectories))
        learned: Learned[L] = state.learned  # type: ignore[assignment]  # just trained
        other = learned.experiment.other(trajectories, noise_level(trajectories, self.likelihood, self.simulator))
        if other is not None:
            self.find(Code.OTHER_EXPERIMENT, differs=other)
        p = float("nan")
        if np.array_equal(measured(trajectories), learned.experiment.measured):
            p = learned.outside.p_value(*self._looks(trajectories.observations[None], trajectories))
            if learned.outside.alarm(p):
                self.find(Code.UNLIKE_SIMULATIONS, p=p_text(p, learned.outside.floor))
        self.diagnostics["p_of_simulations"] = p
        inferred = self.infer(learned.content, trajectories)
        if learned.held_back is None:
            return inferred
        return learned.held_back.mended(inferred, torch_generator([self.seed, 6]))

    def describe(self, state: S) -> str:
        """What is being done, for the progress bar."""
        return f"{self.name}: {'simulating' if state.learned is None else 'trained'}"

    def _fingerprint(self, trajectories: Trajectories) -> str:
        """What is learned is told apart by the settings alone, ``Experiment`` says what trajectories it serves."""
        if not self.keeps:
            return super()._fingerprint(trajectories)
        return hashlib.sha256(repr(self.settings()).encode()).hexdigest()

    def _resumed(self, trajectories: Trajectories, fingerprint: str) -> Snapshot[S] | None:
        """What was learned in an earlier fit, or where a checkpoint's fit of these trajectories stopped."""
        if not self.keeps:
            return super()._resumed(trajectories, fingerprint)
        self._check(trajectories)
        if self._last is not None and self._run == fingerprint:
            last = self._recalled(self._last, trajectories)
            if last is not None:
                return last
        stored = super()._resumed(trajectories, fingerprint)
        if stored is None or stored.state.log == digest(trajectories):
            return stored
        last = self._recalled(stored, trajectories)
        if last is None:
            raise CheckpointError(
                f"checkpoint {self.checkpoint}: belongs to another run, of trajectories of another form; choose "
                "another file, or give fit(..., retrain=True) to replace it"
            )
        return last

    def _recalled(self, last: Snapshot[S], trajectories: Trajectories) -> Snapshot[S] | None:
        """Where a fit begins for which enough was learned before; None where it was not, and a note says why."""
        if last.state.learned is None:
            return None
        noise = noise_level(trajectories, self.likelihood, self.simulator)
        other = last.state.learned.experiment.other_form(self.simulator, trajectories, noise)
        if other is not None:
            self.find(Code.TRAINED_ANEW, differs=other)
            return None
        findings = tuple(item for item in last.findings if item.code is not Code.BUDGET_SPENT)
        return Snapshot(self.recall(last.state, trajectories), 0, findings, last.diagnostics)

    def recall(self, state: S, trajectories: Trajectories) -> S:
        """The state of a fit that begins with what another one has learned; with nothing left to do by default."""
        return replace(state, done=True)

    def statistics(self, observations: NDArray[np.floating], trajectories: Trajectories) -> FloatArray:
        """BayesSim's statistics of observations, without the samples that the log lacks.

        Args:
            observations: (n, R, T+1, O).
            trajectories: R, the log.

        Returns:
            (n, F).
        """
        o, a = trajectories.observations.shape[-1], trajectories.actions.shape[-1]
        parts = []
        for rows in np.split(observations, range(_ROWS, len(observations), _ROWS)):
            seen = np.where(np.isfinite(trajectories.observations), rows, np.nan)
            parts.append(step_statistics(control_steps(seen, trajectories.actions, trajectories.length, None), o, a))
        return np.concatenate(parts)

    def simulate(self, theta: FloatArray, trajectories: Trajectories, rng: np.random.Generator) -> Simulations:
        """Simulations of theta (n, N), which need not come from the prior, with noise; the caller counts them."""
        return self._noisy(self.prior_simulations(trajectories).simulate(theta), trajectories, rng)

    def simulate_again(self, theta: FloatArray, trajectories: Trajectories) -> None:
        """See ``Estimator``."""
        self.prior_simulations(trajectories).simulate(theta)

    def simulations(self, state: S, trajectories: Trajectories) -> Simulations:
        """The valid simulations so far, with noise."""
        made = self.prior_simulations(trajectories).first(state.simulated)
        self.judge(made)
        return self._usable(made, trajectories)

    def prior_simulations(self, trajectories: Trajectories) -> Cache:
        """The simulations of the prior that replay these trajectories."""
        if self._cached is None or self._cached[0] is not trajectories:
            starts = first_states(self.simulator, trajectories)
            self._cached = trajectories, Cache(self.simulator, self.prior, trajectories, starts, self.seed, self.cache)
        return self._cached[1]

    def judge(self, made: Simulations) -> None:
        """Count all that were made so far and say where the invalid ones lie.

        Raises:
            ValueError: where too few are valid.
        """
        self.findings.drop(Code.INVALID_SIMULATIONS)  # of fewer
        valid = int(made.valid.sum())
        invalid, failure = len(made) - valid, self.simulator.failure
        if invalid:
            place = place_of_invalid(made, self.space)
            self.find(Code.INVALID_SIMULATIONS, invalid=invalid, made=len(made), failure=failure, place=place)
        self.diagnostics["invalid_simulations"] = invalid
        if valid < THRESHOLDS.few_valid:
            lost, narrow = (f", the others {failure}", ", or narrow the bounds") if invalid else ("", "")
            raise ValueError(
                f"budget: {valid} of {len(made)} simulations are valid, {self.name} needs {THRESHOLDS.few_valid}"
                f"{lost}; raise the budget{narrow}"
            )

    def still_improving(self, converged: bool, passes: int, unit: str, argument: str) -> None:
        """A finding where a training ended at ``argument``, its limit on ``passes`` of a unit, and not by itself."""
        if not converged:
            self.find(Code.STILL_IMPROVING, passes=passes, unit=unit, argument=argument)

    def _affordable(self, trajectories: Trajectories, before: int = 0) -> int:
        """Simulations to train on that the budget has room for; raises BudgetExhausted if there are none."""
        most = (self.budget - before) // len(trajectories) - self.reserved
        if most < 1:
            raise BudgetExhausted(
                f"{1 + self.reserved} simulations of {len(trajectories)} rollouts are the least, the budget has "
                f"{self.budget - before}"
            )
        return most

    def _usable(self, made: Simulations, trajectories: Trajectories) -> Simulations:
        return self._noisy(made.usable(), trajectories, np.random.default_rng([self.seed, 1]))

    def _noisy(self, made: Simulations, trajectories: Trajectories, rng: np.random.Generator) -> Simulations:
        sd = noise_level(trajectories, self.likelihood, self.simulator)
        if not sd.any():
            return made
        noise = (sd * rng.standard_normal(made.observations.shape)).astype(np.float32)
        return replace(made, observations=made.observations + noise)

    def _looks(self, observations: NDArray[np.floating], trajectories: Trajectories) -> tuple[FloatArray, FloatArray]:
        """Samples (n, D) and statistics (n, E) of what the log has."""
        seen = np.where(np.isfinite(trajectories.observations), observations, np.nan).astype(float)
        return seen.reshape(len(seen), -1), self.statistics(observations, trajectories)

    def _trained(self, state: S, trajectories: Trajectories) -> S:
        simulations = self.simulations(state, trajectories)
        self._check_units(simulations)
        noise = noise_level(trajectories, self.likelihood, self.simulator)
        known = isinstance(self.simulator, CallableSimulator) or trajectories.states is not None
        every = np.tile(noise, trajectories.observations[..., 0].size)
        outside = Outside.of(*self._looks(simulations.observations[-_SEEN:], trajectories), every, known)
        simulations, kept_back = parted(simulations, self.options)
        content = self.train(simulations, trajectories)
        held_back = scored(partial(self.infer, content), kept_back, trajectories, torch_generator([self.seed, 5]))
        experiment = Experiment.of(self.simulator, trajectories, noise, simulations.observations[:, :, 0])
        return replace(state, learned=Learned(content, experiment, outside, digest(trajectories), held_back))

    def _check_units(self, simulations: Simulations) -> None:
        """A finding where a function's outputs vary by less than networks take for rounding."""
        if isinstance(self.simulator, CallableSimulator):
            sd = simulations.observations[:, 0, 1].astype(float).std(0)
            small = np.flatnonzero((sd > 0) & (sd <= SMALLEST)).tolist()
            if small:
                self.find(Code.ROUNDED_OUTPUTS, outputs=small, sd=sd[small].max())

    def _simulated(self, state: S, trajectories: Trajectories) -> Trajectories:
        """The trajectories that the untrained state counts simulations of: these, or the last ones stepped on."""
        for candidate in (trajectories, *([] if self._cached is None else [self._cached[0]])):
            if digest(candidate) == state.log:
                return candidate
        raise ValueError(
            "trajectories: nothing was simulated for these; call update_parameter_estimate with them first"
        )

    def _recorded(self, given: Recorded) -> Recorded:
        """As the base's; an observed x of a CallableSimulator must be whole, as what these methods learn from is."""
        recorded = super()._recorded(given)
        if isinstance(self.simulator, CallableSimulator):
            for trajectory in [recorded] if isinstance(recorded, Trajectory) else recorded:
                missing = np.flatnonzero(np.isnan(trajectory.observations).any(0)).tolist()
                if missing:
                    raise ValueError(
                        f"x: {self.name} learns from whole ones, but x{missing} is NaN; leave it out of fn and of x"
                    )
        return recorded

    def _check(self, trajectories: Trajectories) -> None:
        environment = self.simulator.environment
        channels, width = list(environment.channels), trajectories.observations.shape[2]
        if width != len(channels):
            raise ValueError(
                f"trajectories: expected observations of the {len(channels)} channels {channels}, got {width}"
            )
        if trajectories.actions.shape[2] != environment.num_actions:
            raise ValueError(
                f"trajectories: expected {environment.num_actions} actions, got {trajectories.actions.shape[2]}"
            )


def recorded_steps(trajectories: Trajectories) -> Tensor:
    """The recorded control steps (M, 2 O + A) without missing samples; raises ValueError when there are none."""
    steps = control_steps(trajectories.observations[None], trajectories.actions, trajectories.length)[0]
    steps = steps[np.isfinite(steps).all(-1)]
    if not len(steps):
        raise ValueError(
            "trajectories: expected control steps with all channels measured at both ends, got none; "
            "resample the log, or leave out a channel that is rarely measured"
        )
    return from_numpy(steps)
