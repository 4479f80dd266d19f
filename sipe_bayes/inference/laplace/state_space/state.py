"""The state of a search over a chain of states: where it stands, what it recorded, how it turns to the next start."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum, auto
from typing import Self

import numpy as np
import torch
from scipy.stats import chi2

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.findings import Code, finding
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.inference.laplace.state_space.noise import jump_scale, process_penalty
from sipe_bayes.inference.laplace.state_space.options import ChainTuning
from sipe_bayes.inference.laplace.state_space.outlying_jumps import rarity
from sipe_bayes.inference.laplace.state_space.smoother import ChainPoint, border, penalty
from sipe_bayes.inference.laplace.strategy import Optimum, SearchProblem, StrategyState
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.state_space.differences import compare
from sipe_bayes.likelihood.state_space.linearisation import ChainLinearisation, ChainNoise, eliminate_states, restricted


class Phase(StrEnum):
    """What the next step of the search does."""

    REGRESS = auto()
    """Theta by regression on the measured states."""
    FOLLOW = auto()
    """States where the commands lead, and a first guess of the noise about them."""
    SMOOTH = auto()
    """A step of theta and all states."""
    NOISE = auto()
    """The noise is estimated anew before the step."""
    WIDEN = auto()
    """On with wide differences."""


@dataclass(frozen=True)
class Position:
    """Where the search from one starting point stands.

    Args:
        phase: what the next step does.
        theta: (N,), within the cube.
        states: (K, S).
        noise: as last estimated; ones before the first guess.
        movement: (D,), of a coordinate in a control step; ones before the first guess.
        damping: of the next step.
        iteration: steps until now.
        estimates: of the noise until now.
        steps: since the last of them.
        theta_step: (N,), of the next differences; short ones where all are zero.
        state_step: (K, D).
        estimate_theta: (N,), where the noise was estimated last by wide ones.
        back: whether the search has come back to where it was likeliest, for the noise to settle.
        refused: jumps (K-1,) that turned out to be no outliers.
        proposals: how often outliers were proposed.
    """

    phase: Phase
    theta: FloatArray
    states: FloatArray
    noise: ChainNoise
    movement: FloatArray
    damping: float
    iteration: int = 0
    estimates: int = 0
    steps: int = 0
    theta_step: FloatArray = field(default_factory=lambda: np.zeros(0))
    state_step: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    estimate_theta: FloatArray = field(default_factory=lambda: np.zeros(0))
    back: bool = False
    refused: BoolArray = field(default_factory=lambda: np.zeros(0, bool))
    proposals: int = 0

    @property
    def point(self) -> ChainPoint:
        """Its theta and states."""
        return ChainPoint(self.theta, self.states)

    @property
    def is_wide(self) -> bool:
        """Whether differences have the posterior's lengths."""
        return bool(self.state_step.any())


@dataclass(frozen=True)
class ChainOptimum(Optimum):
    """An optimum of a chain of states.

    Args:
        states: (K, S).
        slope: (K, D, N): states follow theta by minus this.
        process: (D,), sd of the process noise.
        movement: (D,), of a coordinate in a control step.
        outliers: (K-1,), jumps that are.
        theta_step: (N,), of the finite differences; zero: short ones.
        state_step: (K, D).
        settled: whether the noise had.
        point: number of the starting point.
        absorbed: squares of the jumps over their variance: numbers of the log that process noise explains.
        rough: whether some step jumps by more than its process noise within the differences.
        excess: the largest of ``sd`` over a channel's scatter from sample to sample, which is that of ``noisiest``;
            zero before the judges.
        averaged: covariance (N, N) with the noise integrated out; ``covariance`` holds it, as the judges of the normal
            do. None before the judges.
        shift: (N,), of the mean by several linearisations; None where they are not asked.
        scatter: (N, N), what they add to its covariance.
    """

    states: FloatArray
    slope: FloatArray
    process: FloatArray
    movement: FloatArray
    outliers: BoolArray
    theta_step: FloatArray
    state_step: FloatArray
    settled: bool
    point: int
    absorbed: float = 0.0
    rough: bool = False
    excess: float = 0.0
    noisiest: str = ""
    averaged: FloatArray | None = None
    shift: FloatArray | None = None
    scatter: FloatArray | None = None

    @property
    def centre(self) -> FloatArray:
        """By several linearisations, where they scatter."""
        return self.mean if self.shift is None else self.mean + self.shift

    @property
    def spread(self) -> FloatArray:
        """Averaged over the noise, once it is, and with the scatter of linearisations."""
        narrow = self.covariance if self.averaged is None else self.averaged
        return narrow if self.scatter is None else narrow + self.scatter

    @property
    def as_linearised(self) -> ChainOptimum:
        """By its own linearisation and noise alone, which draws are held against."""
        return replace(self, averaged=None, shift=None, scatter=None)

    def beside_scatter(self, excess: FloatArray, channels: Sequence[str]) -> Self:
        """With the largest of the channels' excesses (C,), and its name."""
        worst = int(excess.argmax())
        return replace(self, excess=float(excess[worst]), noisiest=channels[worst])

    @property
    def noise(self) -> ChainNoise:
        """Of measurements and jumps."""
        return ChainNoise(self.sd, self.process, self.movement, self.outliers)

    def diagnostics(self) -> dict[str, list[float] | list[int]]:
        """Process noise and movement of each coordinate, and after which of the chain's states a jump is an outlier."""
        return {
            "process_noise": self.process.tolist(),
            "movement": self.movement.tolist(),
            "outliers": np.flatnonzero(self.outliers).tolist(),
        }


def contradiction(optima: Sequence[ChainOptimum]) -> float | None:
    """How far, in sds, an optimum lies from the likeliest that another start ended in and that might as well be right.

    None where none excludes it: seen from the wider of the two, further off than one in a thousand would be. What is
    less likely by more than the likeliest one's process noise takes, in nats, is no alternative: the right trajectory
    would need none, and gain that much at most.
    """
    best = max(optima, key=lambda one: one.evidence)
    least = best.evidence - max(10.0, 0.5 * best.absorbed)
    distances = [min(best.distance(one), one.distance(best)) for one in optima if one.evidence > least]
    furthest = max(distances)
    return furthest if chi2.sf(furthest**2, len(best.mean)) < THRESHOLDS.contradiction else None


@dataclass(frozen=True)
class ChainState(StrategyState[Position]):
    """A search over a chain of states.

    Args:
        uncounted: part of a rollout that is not counted yet.
        regressed: thetas (R, N) at which regressions have ended.
        led: whether segments have led to a further starting point, or failed to.
    """

    optima: tuple[ChainOptimum, ...] = ()
    uncounted: float = 0.0
    regressed: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    led: bool = False

    @property
    def recorded(self) -> ChainOptimum | None:
        """This starting point's optimum; None before there is one."""
        return next((one for one in self.optima if one.point == self.point), None)

    @property
    def best_evidence(self) -> float:
        """Its evidence; minus infinity before there is one."""
        return -np.inf if self.recorded is None else self.recorded.evidence

    def with_optimum(self, optimum: ChainOptimum) -> Self:
        """With an optimum in place of the earlier one of its starting point."""
        return replace(self, optima=(*(one for one in self.optima if one.point != optimum.point), optimum))

    def after_divergence(self, begin: Callable[[FloatArray], Position]) -> Self:
        """Turn to the next starting point after a linearisation that diverged.

        Raises:
            ValueError: where none is left and no optimum was found.
        """
        if self.point + 1 == len(self.points) and not self.optima:
            raise ValueError(
                "trajectories: the simulation diverges from the measured states at every starting point; look at the "
                "log's channels and units, or shorten the model's timestep"
            )
        return self.next_point(begin)


@dataclass(frozen=True)
class ChainSearch:
    """What a search over a chain of states is, whatever its phases do."""

    problem: SearchProblem
    chain: Chain

    @property
    def tuning(self) -> ChainTuning:
        """Numbers of the search."""
        return self.problem.options.tuning.state_space

    @abstractmethod
    def phases(self) -> dict[Phase, Callable[[ChainState, ChainLinearisation], ChainState]]:
        """What a step does in each phase with the linearisation where the search stands."""

    @abstractmethod
    def _begin(self, theta: FloatArray) -> Position:
        """The position at a starting point (N,)."""

    @abstractmethod
    def _linearised(self, here: Position) -> ChainLinearisation | None:
        """The linearisation that a step needs at a position; None where it diverges."""

    def step(self, state: ChainState) -> ChainState:
        """One linearisation and what follows from it; what it does is the phase's.

        Raises:
            BudgetExhausted: the state that went in is kept.
        """
        self.chain.uncounted, here = state.uncounted, state.here
        states = self.chain.predicted(here.theta) if here.phase is Phase.FOLLOW else None
        state = state if states is None else state.at(replace(here, states=states))
        linear = self._linearised(state.here)
        try:
            after = None if linear is None else self.phases()[here.phase](state, linear)
        except np.linalg.LinAlgError:  # no process noise makes these slopes' equations solvable
            after = None
        after = state.after_divergence(self._begin) if after is None else after
        return replace(after, uncounted=self.chain.uncounted)


def unknown_noise(chain: Chain) -> ChainNoise:
    """Ones, before the first guess."""
    none = np.zeros(len(chain.linked), bool)
    return ChainNoise(np.ones(len(chain.channels)), np.ones(chain.num_start), np.ones(chain.num_start), none)


def screened(problem: SearchProblem, chain: Chain) -> FloatArray:
    """Starting points (R, N): the model as given and the best of a few draws from the prior.

    What counts are the jumps that a point leaves between states as measured.

    Raises:
        ValueError: where all diverge.
    """
    generator = torch.Generator().manual_seed(problem.seed)
    draws = problem.prior.sample((problem.options.candidates,), generator=generator).numpy()
    points = np.concatenate([problem.space.default_theta[None], draws])
    compared = compare(chain, points, np.tile(chain.reference, (len(points), 1, 1)))
    valid = [k for k, one in enumerate(compared) if one is not None]
    if not valid:
        raise ValueError(
            f"every one of {len(points)} starting points diverges in the simulation; narrow the bounds, "
            "or shorten the model's timestep"
        )
    if valid[0] != 0:
        problem.find(finding(Code.DIVERGES_AS_GIVEN))
    sizes = np.array([jump_scale(one) for one in compared if one is not None])
    order = np.argsort(np.log(sizes).sum(1), kind="stable")
    chosen = [valid[k] for k in order if valid[k] != 0]
    return points[([0] if valid[0] == 0 else []) + chosen][: problem.options.restarts]


def evidence(
    problem: SearchProblem, here: Position, linear: ChainLinearisation, noise: ChainNoise, settled: bool
) -> float:
    """Evidence log p(noise | y), states and theta integrated out, up to a constant.

    Unless ``settled`` it lacks what the next step would gain, were the model linear.
    """
    prior, tuning = problem.quadratic_prior, problem.options.tuning.state_space
    hold = border(prior, here.theta, eliminate_states(linear, noise).gradient)
    value = restricted(linear, noise, hold, held=not settled)[0]
    value = value - penalty(prior, here.theta) - rarity(noise, tuning.outliers)
    return value - process_penalty(noise, here.movement, tuning.noise)


def optimum_at(
    problem: SearchProblem,
    state: ChainState,
    linear: ChainLinearisation,
    noise: ChainNoise,
    value: float,
    settled: bool,
) -> ChainOptimum:
    """The optimum at its linearisation, its normal about the best step from there.

    value: the evidence; settled: whether the noise has.
    """
    here, solved = state.here, eliminate_states(linear, noise)
    mean, covariance = problem.normal(here.theta, solved.precision, solved.gradient)
    none = np.zeros(len(linear.linked), bool)
    return ChainOptimum(
        theta=here.theta,
        mean=mean,
        covariance=covariance,
        evidence=value,
        sd=noise.sd,
        tau=np.zeros_like(noise.sd),
        states=here.states,
        slope=solved.slope,
        process=noise.process,
        movement=here.movement,
        outliers=none if noise.outliers is None else noise.outliers,
        theta_step=np.zeros(len(mean)),
        state_step=np.zeros_like(linear.offset),
        settled=settled,
        point=state.point,
        absorbed=float((linear.jump**2 / linear.jump_variance(noise))[linear.linked].sum()),
        rough=bool((linear.error > noise.jump_sd**2)[linear.linked].any()),
    )
