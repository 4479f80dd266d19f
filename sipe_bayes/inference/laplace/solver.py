r"""The fit of smooth segments: first plain least squares of theta, then theta, initial states and noise together.

**Unknowns**: theta (N,) in the unit cube, and the initial state of each segment as its tangent x_w (D,) from the one
that the log measures, with a prior as wide as that measurement is uncertain. **Energy** for a noise:

.. math:: E = \tfrac12 r^\top V^{-1} r + \tfrac12 \sum_w x_w^\top P_x x_w + \tfrac12 (\theta-\mu)^\top P (\theta-\mu)

**Phases**, one step of each is a linearisation and the best of a few damped steps (Levenberg, Marquardt):

1. PLAIN: theta alone, the segments begin as measured, white noise of the residuals' present size. On a part of the
   segments first, a quarter of what follows, of a single segment its beginning; then on as many as
   ``linearised_steps`` allows. A quarter of short logs that leaves a direction open (sd above a tenth of the cube) is
   left after a step. The end is the plain fit, the first answer. Of steps that gain about the same the shortest is
   taken: what a log leaves open stays near the model as given.
2. FIT: theta and the initial states, noise by restricted likelihood before each step; on the same part, then on
   ``whole`` times as many segments. Columns of the initial states are kept while they predict what a step gains. Each
   segment has a trust region of its own for its initial state: where a joint sticks or slips, one segment jumps, and
   damping all of them for its sake would stop the fit. The first step holds plain against generalised least squares
   (``_noise_takes_over``), unless initial states explain nearly all that plain ones leave.
3. COMPARE: the plain fit and the posterior mode each run free along the whole training logs. Where the mode is worse by
   more than 3 %, coloured noise explains what parameters should.

**Plain least squares have the last word** where coloured noise explains what parameters should. By the first step of
FIT: PLAIN goes on from its end, on ``whole`` times as many segments; where velocities are not measured, and by COMPARE,
initial states are fitted as well. The interval is the sandwich (``likelihood.restricted``), which holds for coloured
residuals. A free-run error above the plain fit's is told by ``behind_plain``.

**Differences** of theta run along the principal axes of the posterior and are a third of its sd along each. So slopes
are those of the posterior's width, whatever dry friction or a delay does below it.

**Other optima** that fit as well are looked for after the fit, unless ``restarts`` is one: two distances of a centre of
mass from its joint give a pendulum one period. Plain fits go down from four points far from the optimum, and from the
best draws of the prior where residuals are larger than ``poor`` times the samples' scatter; first on half seconds of
few segments, mostly a twentieth of the cost so far, then on the smallest part. One that leads back to an optimum in
every direction is given up. If one ends elsewhere, fits as well, and what lies between fits worse, FIT follows it. From
known states FIT also follows an end that fits clearly better than a poor optimum. All optima are kept, weighted by
their evidence. Where simulations from measured initial states miss the log by far more than the noise, plain fits tell
nothing: a poor fit is followed by one from the best draw, no other.

**Impacts** make simulations jump. There beginnings of the segments are fitted first, two control steps and then ever
more. On the shortest ones plain fits go down from the nominal model and the best of some draws from the prior; the best
end is followed, and the next one where residuals stay larger than the known noise (``optimum.beyond_known_noise``).

**Limit**: four points do not reach every optimum. Of two that a few segments do not tell apart the other is not found.

A. Bock's multiple shooting (1981, https://doi.org/10.1007/978-3-642-67917-5_8) with initial states eliminated
(``likelihood.block_tridiagonal``).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import StrEnum, auto
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from scipy.stats import chi2

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.budget import BudgetExhausted
from sipe_bayes.core.findings import Code, finding
from sipe_bayes.inference.laplace.optimum import (
    WindowEnergy,
    WindowOptimum,
    WindowState,
    beyond_known_noise,
    gain_of_noise,
    present_noise,
    summarised,
    updated_noise,
)
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.likelihood.block_tridiagonal import damped_box_step
from sipe_bayes.likelihood.moments import Moments
from sipe_bayes.likelihood.noise import Noise
from sipe_bayes.likelihood.quadratic_prior import FLAT_PRECISION
from sipe_bayes.likelihood.restricted import eliminate_starts, marginal, sandwich
from sipe_bayes.likelihood.settings import Segments
from sipe_bayes.likelihood.wild_samples import wild_residuals
from sipe_bayes.likelihood.windows import Linearisation, Windows, inward

_DAMPINGS = np.array([0.03, 1.0, 30.0, 1000.0])  # tried together, times the damping of the step before
_SHARES = np.array([1.0, 0.3, 0.0])  # of a change of initial states that are tried, segment by segment
_FORETOLD = 0.75  # of the gain that the linearisation expects: with less it does not hold
_DIFFERENCE = 0.3  # conditional posterior sds that a finite difference is long
_THROUGH_IMPACTS = 100  # draws from the prior, of which the best are followed where simulations jump
_SCOUTED_STEPS = 16  # after which the next of them is followed: most fits that settle do so by then
_SCOUTS = 4  # of them that are followed on the shortest beginnings
_WORSE = 1.03  # free-run error over the plain fit's from which white noise takes over


class Stage(StrEnum):
    """What the next step does."""

    PLAIN = auto()
    FIT = auto()
    COMPARE = auto()


@dataclass(frozen=True)
class Here:
    """Where a fit stands; K of the W segments are those of its part."""

    stage: Stage  # what the next step does
    part: int  # of the segments that is simulated: 0 the smallest
    theta: FloatArray  # (N,)
    starts: FloatArray  # (W, D), of all segments
    noise: Noise  # as last estimated
    damping: float  # of the next step
    iteration: int = 0  # steps until now
    scale: FloatArray = field(default_factory=lambda: np.zeros(0))  # (N + D,), lengths of the finite differences
    axes: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))  # (N, N), rows of theta's; empty at first
    residual: FloatArray | None = None  # (K, L, C); None where they are to be simulated
    starts_jacobian: FloatArray | None = None  # (K, L, C, D), kept; None where it is to be taken anew
    exact: bool = False  # whether the step before gained what was expected, so that its kept columns still hold
    gained: float = np.inf  # nats, by the step before
    held: FloatArray = field(default_factory=lambda: np.zeros(0))  # (W,), further damping of each initial state
    enough: float = 0.0  # nats that plain least squares may leave; 0: as their residual tells
    white: bool = False  # whether the noise is white, as the configuration or the comparison asks


@dataclass(frozen=True)
class SolverState(WindowState):
    """A fit of segments."""

    here: Here
    plain: FloatArray = field(default_factory=lambda: np.zeros(0))  # (N,), from the first starting point; empty before
    compared: bool = False  # whether coloured noise has been held against plain least squares
    freed: bool = False  # whether the mode's free-run error has been compared with the plain fit's
    wider: float = 1.0  # times the variance of plain least squares that coloured residuals make of a white one
    behind: float = 0.0  # how many times the plain fit's that error was; 0 where it was not larger
    ends: tuple[float, ...] = ()  # energies of plain fits of the shortest beginnings, by starting point through impacts
    reached: tuple[FloatArray, ...] = ()  # theta (N,) there
    rounds: int = 0  # of further draws from the prior that were followed
    elsewhere: bool = False  # whether another optimum is being looked for, from where plain fits of few segments ended

    @property
    def behind_noise(self) -> bool:
        """Whether the interval is the sandwich, since coloured noise would have taken over what parameters explain."""
        return self.here.white and (self.compared or self.behind > 0)


class _Trial(NamedTuple):
    """The best of a few damped steps, to theta (N,) and starts (K, D), and the residual (K, L, C) there.

    gained: nats, not above zero where no step lowered the energy; expected: of the least damped step, by the
    linearisation; damping: of the best; held: (K,) further damping of the next steps of each segment's initial state.
    """

    theta: FloatArray
    starts: FloatArray
    residual: FloatArray
    gained: float
    expected: float
    damping: float
    held: FloatArray


class _Point(NamedTuple):
    """Where a step led: theta (N,), starts (K, D), the residual (K, L, C) there and the energy."""

    theta: FloatArray
    starts: FloatArray
    residual: FloatArray
    energy: float


class _PlainStep(NamedTuple):
    """A step of plain least squares: where the fit stands after it, and linearisation and Hessian (N, N) before it.

    energy: after it, nats; gained: not above zero where no step lowered the energy; expected: of the step that was
    taken, by the linearisation; stuck: whether none is worth trying any more.
    """

    after: Here
    lin: Linearisation
    hessian: FloatArray
    energy: float
    gained: float
    expected: float
    stuck: bool

    def ends(self, enough: float, foretold: bool = True) -> bool:
        """Whether a fit stands still that gains ``enough`` nats or fewer; ``foretold``: by its next step.

        Newton's errors are squared from step to step, so the next gain is this one times the square of its surprise.
        """
        surprise = self.gained / self.expected - 1 if self.expected > 0 and foretold else np.inf
        return self.stuck or 0 < self.gained * min(surprise**2, 1.0) <= enough


class _End(NamedTuple):
    """Where plain least squares ended: theta (N,), the energy in nats and its Hessian (N, N)."""

    theta: FloatArray
    energy: float
    hessian: FloatArray


class SegmentSolver:
    """The ``Strategy`` for segments."""

    def __init__(self, problem: SearchProblem, windows: Windows) -> None:
        self.problem, self.windows = problem, windows
        self.tuning, self.prior = problem.options.tuning.solver, problem.quadratic_prior
        self._views: dict[int, tuple[IntArray, Windows]] = {}

    @property
    def step_rollouts(self) -> int:
        """Rollouts that a step takes, but for shorter changes of initial states, which need not be tried."""
        windows = self.windows
        return (windows.num_theta + windows.num_start + len(_DAMPINGS) + 1) * len(windows.trajectories)

    def start(self) -> SolverState:
        """The first state: where the priors expect it, or at the starting point that the options name."""
        options, nominal = self.problem.options, np.clip(self.problem.space.expected_theta, 0, 1)
        residual, valid = None, True
        if options.initial is not None:
            points = options.initial
        elif self._beginnings and options.restarts > 1 and self._may_screen():
            points, residual, valid = self.screened(nominal, _THROUGH_IMPACTS)
        else:
            points, residual, valid = self.screened(nominal, 0)
            if not valid:
                points, residual, _ = self.screened(nominal, options.candidates)
                points = points[:1]
        if not valid:
            self.problem.find(finding(Code.DIVERGES_AS_GIVEN))
        return SolverState(points, 0, replace(self._begin(points[0]), residual=residual))

    def onward(self, state: WindowState, theta: FloatArray, starts: FloatArray | None = None) -> SolverState | None:
        """A fit that had ended, from a better place (N,) and initial states (W, D); None where it has had enough."""
        assert isinstance(state, SolverState)
        if len(state.points) >= self.tuning.most_points or self._leaves_no_room():
            return None
        here = self._begin_fit(state, theta, state.here.enough > 0)
        if starts is not None and here.stage is Stage.FIT:
            here = replace(here, starts=starts, part=self._last(Stage.FIT))
        points = np.concatenate([state.points, theta[None]])
        return replace(state, points=points, point=len(state.points), here=here, elsewhere=False, ends=(), done=False)

    def step(self, state: WindowState) -> SolverState:
        """One linearisation and the best of a few steps; or the comparison at the end."""
        assert isinstance(state, SolverState)
        self.windows.mask(state.wild)
        self._views = {}
        if state.elsewhere:
            settled = tuple(one for one in state.optima if not one.early)
            begin, theta = state.points[state.point], state.here.theta
            precisions = [np.asarray(np.linalg.inv(one.covariance), np.float64) for one in settled]
            if any(is_back(theta, begin, one.mean, p) for one, p in zip(settled, precisions, strict=True)):
                return replace(state, optima=settled, done=True)
        stages = {Stage.PLAIN: self._plain, Stage.FIT: self._fit, Stage.COMPARE: self._compare}
        return stages[state.here.stage](state)

    def _begin(self, theta: FloatArray) -> Here:
        windows = self.windows
        fixed = windows.fixed_sd
        sd = np.where(np.isnan(fixed), np.maximum(0.1 * windows.spread, windows.rounding), fixed)
        stage = Stage.PLAIN if self._may_begin_plain else Stage.FIT
        noise = Noise(sd, np.zeros(len(sd)))
        white = windows.settings.noise != "ar1"
        held = np.zeros(windows.num_windows)
        return Here(stage, 0, theta, windows.no_starts(), noise, self.tuning.damping, held=held, white=white)

    def usual_rest(self, state: SolverState) -> float:
        """Rollouts that a fit still takes as a rule, by the steps that real arms and servos took of each stage."""
        windows, here = self.windows, state.here
        n, d, logs = windows.num_theta, windows.num_start, len(windows.trajectories)
        whole = len(self._beginnings)  # the first part of whole segments
        course = [(Stage.PLAIN, 0, 6), (Stage.PLAIN, 1, 6), (Stage.FIT, 1, 4), (Stage.FIT, 2, 4)]
        course = [(stage, part + whole, steps) for stage, part, steps in course]
        look = 0.0 if state.behind_noise or state.done else 2.0 * (1 + 4 * n)  # at what lies beyond the normal
        stands = here.stage, max(here.part, whole)
        now = next((k for k, (stage, part, _) in enumerate(course) if (stage, part) == stands), 3)
        for k, (stage, part, steps) in enumerate(course[now:] if not state.done else ()):
            columns = n + (d if stage is Stage.FIT else 0) + 2  # trials: mostly one
            new = part == whole or self._share(part - 1) < 1 or stage is not course[max(now + k - 1, 0)][0]
            look += steps * (0.5 if k == 0 else 1.0) * columns * min(self._share(part), 1.0) * new
        return look * logs

    # Parts of the segments

    @property
    def _may_begin_plain(self) -> bool:
        """Whether initial states are measured, so that plain least squares tell something."""
        return self.windows.starts_measured or self.windows.rates_measured

    @cached_property
    def _beginnings(self) -> list[int]:
        """Control steps of the segments' beginnings that are fitted before the whole: ever more through impacts."""
        if not self.windows.impacts:
            return []
        return growing_steps(self.windows.telling_steps(2), int(self.windows.steps.max()), self.tuning.growth)

    def _share(self, part: int) -> float:
        """Of the segments that a part holds."""
        windows = self.windows
        if not windows.has_parts:
            return math.inf
        columns = windows.num_theta + windows.num_start + 1
        sizes = (*(0.25 for _ in self._beginnings), 0.25, 1.0, self.tuning.whole)
        share = float(self.tuning.linearised_steps / columns / windows.physics_steps)
        if part == len(self._beginnings) and self._may_begin_plain:  # a quarter even of what is little
            least = self.tuning.least_samples * windows.num_theta / max(int(windows.observed.sum()), 1)
            return min(sizes[part] * share, max(sizes[part], least))
        return sizes[part] * share

    def _view(self, part: int) -> tuple[IntArray, Windows]:
        """Numbers (K,) of the segments of a part, and these or their beginnings."""
        if part not in self._views:
            share, windows = self._share(part), self.windows
            keep = np.arange(windows.num_windows)
            if share < 1:
                keep = spread_segments(windows.log, share)
                windows = windows.part(keep)
                if part == len(self._beginnings) and len(keep) == len(np.unique(self.windows.log)) > 0:
                    steps = share * self.windows.num_windows / len(keep) * windows.steps.max()
                    windows = windows.beginnings(self._least_steps(windows, int(steps)))
            if part < len(self._beginnings):
                windows = windows.beginnings(self._beginnings[part])
            self._views[part] = keep, windows
        return self._views[part]

    def _least_steps(self, windows: Windows, steps: int = 1) -> int:
        """Control steps, at least so many, of a beginning that tells as much as a segment of the default length."""
        return windows.telling_steps(max(steps, math.ceil((Segments.window or 0.0) / float(windows.dt.min()))))

    def count_segments(self) -> int:
        """How many segments the fit uses in the end."""
        return len(self._view(self._last(Stage.FIT))[0])

    def _last(self, stage: Stage, white: bool = False) -> int:
        """The largest part that a stage simulates; ``white``: where plain least squares have the last word."""
        return len(self._beginnings) + (1 if stage is Stage.PLAIN and not white else 2)

    def _next_part(self, stage: Stage, part: int, white: bool = False) -> int | None:
        """The next part with more segments; None where there is none."""
        size = self._view(part)[1].observed.size
        for other in range(part + 1, self._last(stage, white) + 1):
            if self._view(other)[1].observed.size > size:
                return other
        return None

    # Steps

    def _may_screen(self) -> bool:
        """Whether the budget leaves room for draws from the prior."""
        share = self._view(0)[1].steps.sum() / self.windows.steps.sum()
        return self.windows.has_room(math.ceil(_THROUGH_IMPACTS * share) + 1)

    def screened(self, nominal: FloatArray, draws: int, number: int = 0) -> tuple[FloatArray, FloatArray | None, bool]:
        """The best of the nominal model (N,) and draws from the prior, best first, and the first one's residual.

        And whether the nominal model is valid: then it is among them, last at least. By plain residuals of the smallest
        part; each ``number`` has draws of its own.
        """
        view = self._view(0)[1]
        generator = torch.Generator().manual_seed(self.problem.seed + number)
        drawn = self.problem.prior.sample((draws,), generator=generator).numpy()
        thetas = np.concatenate([nominal[None], drawn])
        with self.windows.counting(view):
            residual, valid = view.residuals(thetas, view.no_starts(len(thetas)))
        loss = np.array([self._profile(view, r) if ok else np.inf for r, ok in zip(residual, valid, strict=True)])
        if draws and not valid.any():
            raise ValueError(
                f"every one of {draws} starting points diverges in the simulation; narrow the bounds, "
                "shorten the model's timestep or the window"
            )
        order = np.argsort(loss, kind="stable")
        best = [int(k) for k in order if np.isfinite(loss[k])][:_SCOUTS]
        if best and valid[0] and 0 not in best:
            best[-1] = 0
        return thetas[best] if draws else thetas, residual[best[0]] if best else None, bool(valid[0])

    def _profile(self, view: Windows, residual: FloatArray) -> float:
        """Energy of a residual (K, L, C) with white noise of its own size."""
        noise, counts = present_noise(view, residual), view.observed.sum((0, 1))
        free = np.isnan(view.fixed_sd)
        square = (residual**2).sum((0, 1)) / noise.sd**2
        return float((counts * np.log(noise.sd))[free].sum() + 0.5 * square[~free].sum())

    def _lengths(self, view: Windows, here: Here) -> FloatArray:
        """Lengths (N + D,) of the finite differences."""
        n, scale = view.num_theta, here.scale
        if not len(scale):
            known = _DIFFERENCE / np.sqrt(np.maximum(view.start_precision, 1e-12))
            scale = np.concatenate([np.full(n, 1e-3), np.clip(known, 1e-6, 1e-3)])
        return np.concatenate([np.maximum(scale[:n], view.least_steps(here.theta)), scale[n:]])

    def _scaled(self, view: Windows, precision: FloatArray, starts: FloatArray | None) -> FloatArray:
        """Lengths (N + D,) for the next differences, of the diagonals of precisions (N, N) and (D,)."""
        of_theta = np.clip(_DIFFERENCE / np.sqrt(np.maximum(np.diag(precision), 1e-12)), 1e-6, 0.02)
        known = view.start_precision if starts is None else starts
        return np.concatenate([of_theta, np.clip(_DIFFERENCE / np.sqrt(np.maximum(known, 1e-12)), 1e-7, 1e-2)])

    def _axes(self, view: Windows, theta: FloatArray, hessian: FloatArray, scale: FloatArray) -> FloatArray:
        """Rows (N, N) along which theta (N,) is changed for the next differences: the posterior's principal axes.

        Each is as long as a part of the posterior's sd along it, so that slopes are those of the posterior's width.
        Parameters near a bound, and those whose differences are long anyway, are changed by themselves, by ``scale``.
        """
        length = np.maximum(scale[: len(theta)], view.least_steps(theta))
        axes = np.diag(length)
        free = np.flatnonzero((view.least_steps(theta) == 0) & (np.minimum(theta, 1 - theta) > 3 * length))
        if len(free):
            values, vectors = np.linalg.eigh(hessian[np.ix_(free, free)])
            sd = _DIFFERENCE / np.sqrt(np.maximum(values, 1e-12))
            longest = 0.02 / np.abs(vectors).max(0)
            axes[np.ix_(free, free)] = (vectors * np.clip(sd, 1e-6, longest)).T
        return axes

    def _usable(self, here: Here) -> FloatArray | None:
        """The axes of the differences; None where theta has come so near to a bound that they have no room there."""
        if not len(here.axes):
            return None
        moves = inward(here.theta, here.axes)
        short = np.linalg.norm(moves, axis=1) < 0.05 * np.linalg.norm(here.axes, axis=1)
        outside = ((here.theta + moves < 0) | (here.theta + moves > 1)).any(1)
        return None if (short | outside).any() else here.axes

    def _plain(self, state: SolverState) -> SolverState:
        here, (keep, view) = state.here, self._view(state.here.part)
        with self.windows.counting(view):
            step = self._plain_step(view, here)
        if not step.lin.valid:  # diverges on what the part before did not hold
            return replace(state, here=replace(here, stage=Stage.FIT, residual=None, starts_jacobian=None))
        after, more = step.after, self._next_part(Stage.PLAIN, here.part, here.enough > 0)
        enough = self._plain_enough(view, here, step.lin.residual)
        if here.part == 0 and more and not self._beginnings and self._share(1) >= 1:  # a quarter of little
            open_directions = np.linalg.eigvalsh(step.hessian)[0] < 1 / 0.1**2  # it would lead astray along them
            enough = np.inf if open_directions else max(0.2 * view.observed.sum(), enough)
        elif here.part == 0 and more:
            enough *= 10.0
        if not step.ends(enough, foretold=not here.enough) and after.iteration < self.tuning.most_steps:
            return replace(state, here=after)
        if here.part == 0 and self._beginnings and len(state.ends) < len(state.points):
            state, after = self._scouted(state, after, step.energy)
            if after.part == 0:
                return replace(state, here=after)
            more = self._next_part(Stage.PLAIN, 0)
        if more is not None and after.iteration < self.tuning.most_steps:
            return replace(state, here=replace(after, part=more, residual=None))
        return self._plain_ended(replace(state, here=here), after, step.lin, keep, view)

    def _plain_step(self, view: Windows, here: Here) -> _PlainStep:
        """One linearisation in theta alone and the best of a few damped steps."""
        n, starts, scale, axes = view.num_theta, view.no_starts(), self._lengths(view, here), self._usable(here)
        lin = view.linearise(here.theta, starts, True, False, here.residual, scale[:n], axes=axes)
        noise = present_noise(view, lin.residual)
        rows = (lin.jacobian / noise.sd[:, None]).reshape(-1, n)
        precision, pull = rows.T @ rows, rows.T @ (lin.residual / noise.sd).ravel()
        pull = pull + self.prior.pull(here.theta)
        hessian = precision + self.prior.precision + FLAT_PRECISION * np.eye(n)
        energy = self._profile(view, lin.residual) + self.prior.energy(here.theta)
        thetas = np.stack([self._moved(hessian, pull, here.theta, d) for d in self._dampings(here)])

        def energy_of(theta: FloatArray, _: FloatArray, residual: FloatArray) -> float:
            return self._profile(view, residual) + self.prior.energy(theta)

        enough = self._plain_enough(view, here, lin.residual)
        no_starts = view.no_starts(len(thetas))
        residuals, valid = view.residuals(thetas, no_starts)
        best, values = best_step(thetas, no_starts, residuals, valid, energy_of, energy, enough)
        gained, damping = energy - float(values[best]), float(here.damping * _DAMPINGS[best])
        scale, after = self._scaled(view, precision, None), replace(here, iteration=here.iteration + 1)
        after = replace(after, scale=scale, axes=self._axes(view, here.theta, hessian, scale), noise=noise)
        if gained > 0:
            after = replace(after, theta=thetas[best], residual=residuals[best], damping=self._damped(damping))
        else:
            after = replace(after, residual=lin.residual, damping=self._damped(damping * _DAMPINGS[-1]))
        move = thetas[best] - here.theta
        expected, stuck = float(pull @ move - 0.5 * move @ hessian @ move), gained <= 0 and here.damping >= 1.0
        return _PlainStep(after, lin, hessian, min(energy, float(values[best])), gained, expected, stuck)

    def _plain_enough(self, view: Windows, here: Here, residual: FloatArray) -> float:
        """Nats that plain least squares may leave: more where a residual (K, L, C) follows itself."""
        if here.enough:
            return here.enough
        series = (residual[:, :, c].ravel()[s.index] for c, s in enumerate(view.sequences))
        follows = np.clip([float(z[1:] @ z[:-1]) / max(float(z @ z), 1e-300) for z in series], 0.0, 0.98)
        return float(self.tuning.plain_gain * view.num_theta * np.exp(np.log((1 + follows) / (1 - follows)).mean()))

    def _scouted(self, state: SolverState, here: Here, energy: float) -> tuple[SolverState, Here]:
        """After a plain fit of the smallest part: from the next starting point, or on from the best end of all."""
        state = replace(state, ends=(*state.ends, energy), reached=(*state.reached, here.theta))
        if (point := len(state.ends)) < len(state.points):
            return replace(state, point=point), self._begin(state.points[point])
        return self._from_end(state, int(np.argmin(state.ends)))

    def _from_end(self, state: SolverState, number: int) -> tuple[SolverState, Here]:
        """On longer beginnings, from where one of the plain fits of the shortest ended; it is not followed again."""
        ends = tuple(np.inf if k == number else end for k, end in enumerate(state.ends))
        return replace(state, point=number, ends=ends), replace(self._begin(state.reached[number]), part=1)

    def _plain_ended(
        self, state: SolverState, here: Here, lin: Linearisation, keep: IntArray, view: Windows
    ) -> SolverState:
        """From the plain fit on theta, initial states and noise are fitted together."""
        if not len(state.plain):
            state = replace(state, plain=here.theta)
            self.problem.tell("first estimate", self.windows.rollouts)
        if not state.optima:
            still = np.zeros((*lin.residual.shape, view.num_start))
            lin = replace(lin, jacobian=np.concatenate([lin.jacobian, still], axis=-1))
            at = replace(state.here, noise=here.noise, iteration=here.iteration)
            state = replace(
                state, optima=(self._optimum(state, at, lin, view.moments(lin, True), keep, view, False, True),)
            )
            if here.residual is not None and len(wild := wild_residuals(view, here.residual)):
                state = replace(state, wild=np.concatenate([state.wild, wild]))
                here = replace(here, residual=None)
        return replace(state, here=replace(here, stage=Stage.FIT, damping=self.tuning.damping, starts_jacobian=None))

    def _moved(self, hessian: FloatArray, pull: FloatArray, theta: FloatArray, damping: float) -> FloatArray:
        """Where a damped step from theta (N,) leads (N,)."""
        move = damped_box_step(hessian, pull, theta, damping)
        return np.clip(theta + np.clip(move, -0.3, 0.3), 0.0, 1.0)

    def _dampings(self, here: Here) -> FloatArray:
        """Those that are tried."""
        columns = self.windows.num_theta + self.windows.num_start + 1
        easy = 2 if here.damping <= self.tuning.damping else 3
        return np.asarray(here.damping * _DAMPINGS[: max(easy, min(columns // 8, len(_DAMPINGS)))])

    def _damped(self, damping: float) -> float:
        return float(np.clip(damping, 1e-7, 1e4))

    def _fit(self, state: SolverState) -> SolverState:
        here, (keep, view) = state.here, self._view(state.here.part)
        if here.white:  # initial states are known as well as smoothed measurements tell them
            view = copy.copy(view)
            view.start_precision = view.measured_precision
        with self.windows.counting(view):
            lin, fresh, scale = self._linearised(view, here, here.starts[keep])
            if not lin.valid:  # on more segments than before: from the initial states that were measured
                here = replace(here, starts=self.windows.no_starts(), residual=None)
                lin, fresh, scale = self._linearised(view, replace(here, starts_jacobian=None), here.starts[keep])
            compares = self.tuning.compares and len(state.plain) and not (state.compared or here.white)
            if compares:
                held = self._starts_explain(view, here, lin)
                takes_over, wider = (False, 1.0) if held else self._noise_takes_over(view, here, lin)
                here, state = replace(here, white=takes_over), replace(state, compared=True, wider=wider)
                if takes_over and self.windows.rates_measured:
                    return replace(state, here=self._begin_fit(state, state.plain, plain=True))
            moments, noise = view.moments(lin, white=here.white), here.noise
            if here.iteration == 0 or not noise.tau.any():
                noise = present_noise(view, lin.residual)
            if not here.enough:
                noise = updated_noise(view, moments, noise, here.theta, here.starts[keep], self.prior, not here.white)
                tolerance = self.tuning.tolerance * max(view.num_theta, 1)
                own = here.starts[keep], here.held[keep]
                trial, lengths = self._tried(view, here, lin, moments, noise, *own, tolerance)
        if here.enough:
            return self._ended(state, replace(here, noise=noise), lin, moments, keep, view, True)
        scale, axes = (scale, here.axes) if lengths is None else lengths
        exact = here.exact if trial.expected < tolerance else abs(trial.gained / trial.expected - 1) < 0.05
        after = replace(here, iteration=here.iteration + 1, noise=noise, gained=trial.gained)
        damped = here.held.copy()
        damped[keep] = trial.held
        after = replace(after, exact=exact, scale=scale, axes=axes, held=damped)
        slow = trial.gained < tolerance and (here.damping <= 1.0 or here.gained < tolerance)
        small = trial.expected < tolerance or slow
        settled = small and gain_of_noise(moments, here.noise, noise) < tolerance
        stuck = trial.gained <= 0 and here.damping >= 1e3
        elsewhere = bool(np.isfinite(state.ends).any()) and after.iteration >= _SCOUTED_STEPS
        last = elsewhere or after.iteration >= self.tuning.most_steps or self._leaves_no_room()
        if (settled or stuck) and not (fresh or last or (settled and here.exact)):
            return replace(state, here=replace(after, starts_jacobian=None))
        if settled or stuck or last:
            part = None if last else self._next_part(Stage.FIT, here.part)
            if part is not None and state.elsewhere and self._is_behind(state, after, keep, view):
                return replace(state, optima=tuple(one for one in state.optima if not one.early), done=True)
            if part is not None:
                state = self._recorded(state, self._optimum(state, after, lin, moments, keep, view, False, True))
                return replace(state, here=replace(after, part=part, residual=None, starts_jacobian=None))
            return self._ended(state, after, lin, moments, keep, view, settled or stuck)
        foretold = trial.gained > _FORETOLD * trial.expected
        kept = lin.jacobian[..., view.num_theta :] if foretold and view.num_start else None
        after = replace(after, starts_jacobian=None if kept is None else np.ascontiguousarray(kept))
        if trial.gained <= 0:
            return replace(
                state, here=replace(after, residual=lin.residual, damping=self._damped(here.damping * _DAMPINGS[-1]))
            )
        starts = here.starts.copy()
        starts[keep] = trial.starts
        after = replace(after, theta=trial.theta, starts=starts, residual=trial.residual)
        return replace(state, here=replace(after, damping=self._damped(trial.damping)))

    def _begin_fit(self, state: SolverState, theta: FloatArray, plain: bool = False) -> Here:
        """From theta (N,) by FIT on the first part; ``plain``: by least squares, which have the last word, on all."""
        here = replace(self._begin(theta), white=state.here.white or plain)
        if not plain:
            return replace(here, stage=Stage.FIT)
        enough = 3.0 * self.tuning.tolerance * len(theta) * state.wider  # half an sd of the sandwich at most
        return replace(here, part=self._last(Stage.PLAIN, white=True), enough=enough)

    def _starts_explain(self, view: Windows, here: Here, lin: Linearisation) -> bool:
        """Whether initial states explain nearly all that plain least squares leave, which then have no last word.

        Residuals that a smoothed velocity leaves are lines in time, which coloured noise would explain as well.
        """
        plain, moments = present_noise(view, lin.residual), view.moments(lin, white=True)
        starts = here.starts[self._view(here.part)[0]]
        left = updated_noise(view, moments, plain, here.theta, starts, self.prior, coloured=False)
        return self._share_left(left.sd, plain.sd) < self.tuning.explained

    def _share_left(self, sd: FloatArray, plain: FloatArray) -> float:
        """Of squares, by sds (C,) over the ``plain`` ones; one where all are given."""
        free = np.isnan(self.windows.fixed_sd)
        return float(np.exp(2.0 * np.log(sd / plain)[free].mean())) if free.any() else 1.0

    def _noise_takes_over(self, view: Windows, here: Here, lin: Linearisation) -> tuple[bool, float]:
        """Whether coloured noise would move theta farther from plain least squares than coloured noise itself could.

        Hausman's specification test (J. Hausman 1978, "Specification Tests in Econometrics", Econometrica 46): if the
        noise is coloured and the model right, the steps of plain and of generalised least squares differ by no more
        than the sandwich covariance of the plain one.
        """
        white, starts = present_noise(view, lin.residual), here.starts[self._view(here.part)[0]]
        n, pull = view.num_theta, -view.start_precision * starts
        prior = self.prior.precision + FLAT_PRECISION * np.eye(n)
        coloured = view.moments(lin)
        noise = updated_noise(view, coloured, white, here.theta, starts, self.prior, coloured=True)
        steps: list[FloatArray] = []
        spread: FloatArray = np.eye(n)
        plain: FloatArray = np.eye(n)
        for moments, own in ((view.moments(lin, white=True), white), (coloured, noise)):
            solved = eliminate_starts(moments.normal(own), n, view.start_precision, pull)
            inverse: FloatArray = np.asarray(np.linalg.inv(solved.precision + prior), np.float64)
            steps.append(inverse @ (solved.gradient + self.prior.pull(here.theta)))
            if own is white:
                middle = sandwich(lin.jacobian, solved.slope, white.sd, view.sequences, noise)
                spread, plain = inverse @ (middle + prior) @ inverse, inverse
        apart = steps[1] - steps[0]
        wider = float(np.exp(np.log(np.diag(spread) / np.diag(plain)).mean()))
        return bool(chi2.sf(apart @ np.linalg.solve(spread, apart), n) < 1e-3), max(wider, 1.0)

    def _linearised(self, view: Windows, here: Here, starts: FloatArray) -> tuple[Linearisation, bool, FloatArray]:
        """Linearisation of a part, whether all of it is new, and the lengths of its differences."""
        scale, n = self._lengths(view, here), view.num_theta
        axes = self._usable(here)
        if here.starts_jacobian is not None:
            lin = view.linearise(here.theta, starts, True, False, here.residual, scale[:n], axes=axes)
            both = np.concatenate([lin.jacobian, here.starts_jacobian * view.observed[..., None]], axis=-1)
            return replace(lin, jacobian=both), False, scale
        lin = view.linearise(here.theta, starts, True, True, here.residual, scale[:n], scale[n:], axes)
        return lin, True, scale

    def _tried(
        self,
        view: Windows,
        here: Here,
        lin: Linearisation,
        moments: Moments,
        noise: Noise,
        starts: FloatArray,
        held: FloatArray,
        tolerance: float,
    ) -> tuple[_Trial, tuple[FloatArray, FloatArray] | None]:
        """The best of a few damped steps of theta and the initial states, and lengths of the next differences."""
        energy, n = WindowEnergy(view, noise, self.prior), view.num_theta
        normal = moments.normal(noise)
        now = energy(here.theta, starts, lin.residual)
        pull, thetas, changes, expected = -view.start_precision * starts, [], [], 0.0
        scale = None
        for k, damping in enumerate(self._dampings(here)):
            solved = eliminate_starts(normal, n, view.start_precision, pull, damping + held[:, None])
            hessian = solved.precision + self.prior.precision + FLAT_PRECISION * np.eye(n)
            gradient = solved.gradient + self.prior.pull(here.theta)
            theta = self._moved(hessian, gradient, here.theta, float(damping))
            move = theta - here.theta
            if k == 0:
                expected = float(gradient @ move - 0.5 * move @ hessian @ move) + 0.5 * solved.explained
                own = normal[:, n : n + view.num_start, n : n + view.num_start]
                diagonal = np.median(np.diagonal(own, axis1=1, axis2=2), axis=0) if view.num_start else np.zeros(0)
                lengths = self._scaled(view, solved.precision, view.start_precision + diagonal)
                scale = lengths, self._axes(view, here.theta, hessian, lengths)
                if expected < tolerance:
                    return _Trial(here.theta, starts, lin.residual, 0.0, expected, here.damping, held), scale
            thetas.append(theta)
            changes.append(solved.blocks(move))
        stacked, moved = np.stack(thetas), np.stack(changes)
        all_starts, shares = starts + moved, np.ones(moved.shape[:2])
        residuals, valid = view.residuals(stacked, all_starts)
        best, values = best_step(stacked, all_starts, residuals, valid, energy, now, 0.1 * tolerance)
        surprised = now - values[best] < _FORETOLD * expected and not self._beginnings  # impacts surprise always
        if view.num_start and surprised and view.has_room(2 * len(thetas)):
            given = view, noise, stacked, starts, moved, residuals, valid
            all_starts, residuals, valid, shares = shorter_starts(*given)
            best, values = best_step(stacked, all_starts, residuals, valid, energy, now, 0.1 * tolerance)
        damping = float(here.damping * _DAMPINGS[best])
        gained = now - float(values[best])
        held = np.where(shares[best] < 1, np.clip(10 * held, 1.0, 1e4), np.where(held > 0.1, 0.1 * held, 0.0))
        return _Trial(stacked[best], all_starts[best], residuals[best], gained, expected, damping, held), scale

    def _leaves_no_room(self) -> bool:
        """Whether the budget leaves no room for another step."""
        windows = self.windows
        return not windows.has_room(windows.num_theta + windows.num_start + len(_DAMPINGS) + 1)

    # The end

    def _optimum(
        self,
        state: SolverState,
        here: Here,
        lin: Linearisation,
        moments: Moments,
        keep: IntArray,
        view: Windows,
        settled: bool,
        early: bool = False,
    ) -> WindowOptimum:
        """The normal where a part of the segments was linearised; ``early``: of a stage on the way."""
        if settled and here.white and self.windows.settings.noise != "white":
            view = view.part(np.arange(view.num_windows))
            view.settings, moments = replace(view.settings, noise="sandwich"), view.moments(lin)
        optimum = summarised(self.problem, view, here.theta, here.starts[keep], here.noise, moments, lin)
        slope = np.zeros((self.windows.num_windows, self.windows.num_start, view.num_theta))
        slope[keep] = optimum.slope
        reason = None
        if not settled:
            steps, whole = here.iteration, here.iteration >= self.tuning.most_steps
            cut_short = not whole and (early or self._leaves_no_room())
            reason = finding(Code.SEARCH_CUT_SHORT) if cut_short else finding(Code.SEARCH_UNSETTLED, steps=steps)
        elif (times := beyond_known_noise(view, optimum.sd, lin.residual)) is not None:
            reason = finding(Code.BEYOND_START_NOISE, times=times)
        return replace(optimum, starts=here.starts, slope=slope, finding=reason, early=early)

    def _ended(
        self,
        state: SolverState,
        here: Here,
        lin: Linearisation,
        moments: Moments,
        keep: IntArray,
        view: Windows,
        settled: bool,
    ) -> SolverState:
        """Record the optimum; then compare it with the plain fit, or go on from further starting points."""
        optimum = self._optimum(state, here, lin, moments, keep, view, settled)
        state = self._recorded(state, optimum)
        state = replace(state, here=replace(here, residual=None, starts_jacobian=None))
        if state.ends and optimum.finding is None:
            return replace(state, done=True)
        if np.isfinite(state.ends).any():
            state, here = self._from_end(state, int(np.argmin(state.ends)))
            return replace(state, here=here)
        if state.ends and state.rounds < 2 and self._may_screen():
            points = self.screened(optimum.theta, _THROUGH_IMPACTS, state.rounds + 1)[0]
            again = replace(state, points=points, point=0, ends=(), reached=(), rounds=state.rounds + 1)
            return replace(again, here=self._begin(points[0]))
        if state.point + 1 < len(state.points):
            point = state.point + 1
            return replace(state, point=point, here=self._begin(state.points[point]))
        if self.tuning.compares and (not here.white or state.behind) and len(state.plain) and not state.freed:
            return replace(state, here=replace(here, stage=Stage.COMPARE, residual=None, starts_jacobian=None))
        return self._finish(state)

    def _recorded(self, state: SolverState, optimum: WindowOptimum) -> SolverState:
        """With an optimum in the place of what was recorded on the way to it."""
        ends = tuple(one for one in state.optima if not one.early)
        if optimum.early and ends:
            return state  # fewer samples do not compare
        return replace(state, optima=(*ends, optimum))

    def _is_poor(self, optimum: WindowOptimum) -> bool:
        """Whether it has a finding, or residuals far larger than samples scatter by and a good part of the motion."""
        windows = self.windows
        if optimum.finding is not None:
            return True
        large = optimum.sd > 0.1 * windows.spread
        return bool((large & (optimum.sd > self.tuning.poor * windows.level.sd)).any())

    def _compare(self, state: SolverState) -> SolverState:
        """Hold the mode's free-run error against the plain fit's."""
        best = max(state.optima, key=lambda one: one.evidence)
        error, plain = self.free_run_errors(best.theta, state.plain)
        behind = error > _WORSE * plain
        if state.here.white:  # the second time
            if behind:
                self.problem.find(finding(Code.BEHIND_PLAIN, error=100 * error, plain=100 * plain))
            return self._finish(replace(state, freed=True))
        state = replace(state, freed=not behind, behind=error / plain if behind else 0.0)
        if not behind:
            return self._finish(state)
        early = replace(best, finding=finding(Code.SEARCH_CUT_SHORT), early=True)
        self.problem.tell("white noise, from the plain fit", self.windows.rollouts)
        return replace(state, optima=(early,), here=replace(self._begin_fit(state, state.plain), white=True))

    def free_run_errors(self, theta: FloatArray, plain: FloatArray) -> tuple[float, float]:
        """Free-run errors of theta (N,) and of ``plain`` (N,): geometric means over logs and channels.

        In shares of what the channels do; alike where nothing can be compared. Each training log is one simulation from
        the measured first state; where theta is worse from there, from the one that fits best. Where that follows no
        log, as in chaotic motion, the segments stand in its place.
        """
        windows = self.windows
        settings = replace(windows.settings, window=None, windows=(), noise="white", seconds=None)
        for view in (Windows(settings, windows.simulator, windows.trajectories), windows):
            view, starts = copy.copy(view), view.no_starts(2)
            view.start_precision = view.measured_precision  # else an initial state hides what parameters should explain
            for _ in range(2):
                windows.spend(2)
                residual, valid = view.residuals(np.stack([theta, plain]), starts)
                sizes = np.stack([_log_errors(view, r) for r in residual])
                moving = np.isfinite(sizes).all(0) & (sizes > view.rounding).all(0) & np.isnan(view.fixed_sd)
                with np.errstate(divide="ignore", invalid="ignore"):
                    shares = np.log(sizes / view.spread)[:, moving]
                if not valid.all() or not moving.any() or shares[1].mean() > np.log(0.5):
                    break
                error, other = (float(x) for x in np.exp(shares.mean(1)))
                if error <= _WORSE * other or starts.any():
                    return error, other
                starts = np.stack([self._best_starts(view, at) for at in (theta, plain)])
        return 1.0, 1.0

    def _best_starts(self, view: Windows, theta: FloatArray) -> FloatArray:
        """Initial states (W, D) that fit best at theta (N,), to first order from the measured ones."""
        self.windows.spend(view.num_start + 1)
        lin = view.linearise(theta, view.no_starts(), with_theta=False)
        moments, noise = view.moments(lin, white=True), present_noise(view, lin.residual)
        return marginal(moments, noise, view.no_starts(), view.start_precision)[1]

    # Other optima

    def _finish(self, state: SolverState) -> SolverState:
        """The end; or a further starting point, where another optimum fits as well as those recorded."""
        windows = self.windows
        fit = 8 * (windows.num_theta + windows.num_start + len(_DAMPINGS)) * min(self._share(2), 1.0)  # as a rule
        if not self._is_worth_looking(state) or not windows.has_room(math.ceil(fit)):
            return replace(state, done=True)
        try:
            theta = self._find_elsewhere(state)
        except BudgetExhausted:
            windows.short, theta = True, None
        if theta is None:
            return replace(state, done=True)
        points, here = np.concatenate([state.points, theta[None]]), self._begin_fit(state, theta, state.here.enough > 0)
        return replace(state, points=points, point=len(state.points), here=here, elsewhere=True)

    def _is_worth_looking(self, state: SolverState) -> bool:
        """Whether another optimum is worth looking for: with restarts left, unless one led back to another."""
        options, ends = self.problem.options, [one for one in state.optima if not one.early]
        most = self.tuning.most_points if self._may_begin_plain else options.restarts
        asked = options.restarts > 1 and options.initial is None and len(state.points) < most
        return asked and not self._beginnings and not any(one.holds(ends[-1]) for one in ends[:-1])

    def _tells(self, optimum: WindowOptimum) -> bool:
        """Whether a plain fit tells anything: measured initial states leave little beside an optimum's noise."""
        windows = self.windows
        if not self._may_begin_plain:
            return False
        view = self._take_few(1)
        with windows.counting(view):
            residual, valid = view.residuals(optimum.theta[None], view.no_starts(1))
        left = present_noise(view, residual[0])
        return bool(valid[0] and self._share_left(optimum.sd, left.sd) > self.tuning.silent)

    def _find_elsewhere(self, state: SolverState) -> FloatArray | None:
        """Where plain least squares fit as well as at the optima, theta (N,); None if nowhere.

        From points far from the last optimum, and where that is poor from draws: on a few segments first, then on the
        smallest part. Where initial states are not measured it is the best draw itself.
        """
        last, n, optima = state.optima[-1], self.windows.num_theta, [one.theta for one in state.optima]
        poor = self._is_poor(last)
        better = poor and not self.windows.num_start  # then the last optimum need be none of plain least squares
        points = self._pick_drawn(state) if poor else []
        if not self._tells(last):
            return next(iter(points), None) if len(state.points) < self.problem.options.restarts else None
        points += self._pick_far(last.theta, np.diag(last.covariance) < 0.1**2)  # of others the log says little
        few = self._take_few((6 * len(points) + 2 * len(optima)) * (n + 3))  # most take six steps, from an optimum two
        for view in (few, self._view(0)[1]):
            if not points:
                return None
            ends = self._follow(view, optima, points)
            points = [end.theta for end in ends[0 if better else len(optima) :]]
        known = last.theta if better else ends[0].theta
        return next((point for point in points if self._is_as_good(view, known, point, better)), None)

    def _follow(self, view: Windows, optima: list[FloatArray], points: list[FloatArray]) -> list[_End]:
        """Ends of plain fits from the optima; then of those from the points that end elsewhere and fit as well."""
        ends: list[_End] = []
        with self.windows.counting(view):
            for k, theta in enumerate([*optima, *points]):
                if (end := self._descend(view, theta, ends if k >= len(optima) else [])) is not None:
                    ends.append(end)
        return ends

    def _pick_far(self, theta: FloatArray, narrow: BoolArray) -> list[FloatArray]:
        """Points (N,) far from theta (N,) in the parameters that are ``narrow`` (N,), on either side of each.

        Half of the way to the bounds: farther, most motions are unlike any that was logged. Then three quarters.
        """
        generator, out = np.random.default_rng(self.problem.seed), []
        for way in (0.5, 0.75) if narrow.any() else ():
            up = generator.random(len(theta)) < 0.5
            out += [np.where(narrow, theta + way * (side - theta), theta) for side in (up, ~up)]
        return out

    def _pick_drawn(self, state: SolverState) -> list[FloatArray]:
        """The best of draws from the prior; none where they all diverge."""
        theta, options = state.optima[-1].theta, self.problem.options
        try:
            best = self.screened(theta, max(options.candidates, 1), len(state.points))[0]
        except ValueError:
            return []
        return [one for one in best if (one != theta).any()][: options.restarts - 1]

    def _take_few(self, thetas: int) -> Windows:
        """So few segments that simulations of ``thetas`` take a twentieth of what the fit took, or one of two logs.

        Of longer ones as much as a segment holds by default.
        """
        windows = self.windows
        if not windows.has_parts:
            return windows
        room = 0.05 * windows.rollouts / len(windows.trajectories) * windows.num_windows / max(thetas, 1)
        count = min(max(int(room), min(2, len(windows.trajectories))), len(self._view(0)[0]))
        few = windows.part(((np.arange(count) + 0.5) * windows.num_windows / count).astype(int))
        return few.beginnings(self._least_steps(few))

    def _descend(self, view: Windows, theta: FloatArray, known: list[_End]) -> _End | None:
        """Where plain least squares end from theta (N,); None where that is near a known end or fits worse than it."""
        here, worst = self._begin(theta), np.inf
        if known:  # residuals larger by a tenth: initial states as measured leave some of that
            worst = min(end.energy for end in known) + 0.1 * view.observed.sum()
        for left in range(7, -1, -1):  # eight steps: two more than most take
            step = self._plain_step(view, here)
            here = step.after
            assert here.residual is not None
            energy = self._profile(view, here.residual) + self.prior.energy(here.theta)
            if any(is_back(here.theta, theta, end.theta, end.hessian) for end in known):
                return None
            if left < 6 and energy - left * max(step.gained, 0.0) > worst:
                return None  # at this pace it does not get there
            if step.ends(self._plain_enough(view, here, step.lin.residual), foretold=False):
                break
        return None if energy > worst else _End(here.theta, energy, step.hessian)

    def _is_as_good(self, view: Windows, theta: FloatArray, other: FloatArray, better: bool) -> bool:
        """Whether another theta (N,) fits as well, and what lies between fits worse; or, if asked, clearly ``better``.

        Fits are compared segment by segment (Q. Vuong 1989, Econometrica 57, 307). Ten nats as ``distinct``.
        """
        between = np.array([0.0, 1.0, 0.25, 0.5, 0.75])[:, None]
        with self.windows.counting(view):
            thetas = theta + between * (other - theta)
            residual, valid = view.residuals(thetas, view.no_starts(len(thetas)))
        energy = 0.5 * ((residual / present_noise(view, residual[0]).sd) ** 2).sum((2, 3))
        worse, barrier = energy[1] - energy[0], energy[2:].sum(1) - energy[:2].sum(1).max()
        clear = max(10.0, 3.0 * np.sqrt(len(worse)) * worse.std())
        if worse.sum() > clear or (better and worse.sum() < -clear):
            return bool(worse.sum() < 0)
        return bool(barrier[valid[2:]].max(initial=-np.inf) > 10.0 or not valid.all())

    def _is_behind(self, state: SolverState, here: Here, keep: IntArray, view: Windows) -> bool:
        """Whether the best optimum fits the segments (K,) of a part better by more nats than ``distinct`` keeps."""
        best = max((one for one in state.optima if not one.early), key=lambda one: one.evidence)
        thetas, starts = np.stack([best.theta, here.theta]), np.stack([best.starts[keep], here.starts[keep]])
        with self.windows.counting(view):
            residual, valid = view.residuals(thetas, starts)
        energy = WindowEnergy(view, Noise(best.sd, best.tau), self.prior)
        first, other = (energy(*one) for one in zip(thetas, starts, residual, strict=True))
        return bool(valid.all() and other - first > 10.0 * (state.wider if here.white else 1.0))


def is_back(theta: FloatArray, begin: FloatArray, optimum: FloatArray, precision: FloatArray) -> bool:
    """Whether a fit that began at a point (N,) has come, at theta (N,), to a known optimum (N,) of precision (N, N).

    In each principal direction within one sd, or within a tenth of the way that it had to come.
    """
    eigenvalues, axes = np.linalg.eigh(precision)
    left, whole = (np.abs((point - optimum) @ axes) * np.sqrt(np.maximum(eigenvalues, 0)) for point in (theta, begin))
    return bool((left < np.maximum(1.0, 0.1 * whole)).all())


def shorter_starts(
    view: Windows,
    noise: Noise,
    thetas: FloatArray,
    starts: FloatArray,
    changes: FloatArray,
    residuals: FloatArray,
    valid: BoolArray,
) -> tuple[FloatArray, FloatArray, BoolArray, FloatArray]:
    """Initial states of steps, each segment's change as long as fits that segment best, by itself.

    A joint that sticks or slips makes one segment jump. Damping for its sake would hold all the others back.

    Args:
        view: K segments.
        noise: (C,) of the residuals.
        thetas: (M, N), of the steps.
        starts: (K, D), where they begin.
        changes: (M, K, D), of the whole steps.
        residuals: (M, K, L, C), after the whole steps.
        valid: (M,), which of these are.

    Returns:
        Starts (M, K, D), residuals (M, K, L, C), which of the M are valid, and the share of each change (M, K).
    """
    tried = starts + _SHARES[:, None, None, None] * changes
    shape, flat = tried.shape[:2], tried.reshape(-1, *starts.shape)
    predicted, _ = view.predict(np.tile(thetas, (len(_SHARES) - 1, 1)), flat[len(thetas) :])
    more = np.where(view.observed, view.measured - predicted, 0.0)  # not finite where a segment diverges
    residuals = np.concatenate([np.where(valid[:, None, None, None], residuals, np.nan), more])
    energies = view.energies(flat, residuals, noise)
    energies = np.where(np.isfinite(energies), energies, np.inf).reshape(*shape, -1)
    best, rows, segments = energies.argmin(0), np.arange(shape[1])[:, None], np.arange(len(starts))
    residuals, whole = residuals.reshape(*shape, *residuals.shape[1:]), np.isfinite(energies.min(0)).all(1)
    return tried[best, rows, segments], residuals[best, rows, segments], np.asarray(whole), _SHARES[best]


def best_step(
    thetas: FloatArray,
    starts: FloatArray,
    residuals: FloatArray,
    valid: BoolArray,
    energy: Callable[[FloatArray, FloatArray, FloatArray], float],
    now: float,
    slack: float,
) -> tuple[int, FloatArray]:
    """Of ever shorter steps to thetas (M, N) and starts (M, W, D) with their residuals the best: its number, energies.

    From an energy ``now`` it is the shortest that gains half of what the best gains, and all but ``slack`` nats: where
    a log tells little, parameters stay near the model as given.
    """
    each = zip(thetas, starts, residuals, valid, strict=True)
    values = np.array([energy(t, s, r) if ok else np.inf for t, s, r, ok in each])
    values[np.isnan(values)] = np.inf
    lowest = float(values.min())
    if lowest == np.inf:  # as where the simulation diverges from here on
        return len(values) - 1, values
    best = int(np.flatnonzero(values <= lowest + min(slack, max(0.5 * (now - lowest), 0.0)))[-1])
    return best, values


def _log_errors(view: Windows, residual: FloatArray) -> FloatArray:
    """Root mean squares (logs, C) of a residual (W, L, C); NaN where a log has no sample."""
    out = np.full((len(view.trajectories), residual.shape[-1]), np.nan)
    for log in np.unique(view.log):
        count = view.observed[view.log == log].sum((0, 1))
        square = (residual[view.log == log] ** 2).sum((0, 1))
        out[log] = np.where(count > 0, np.sqrt(square / np.maximum(count, 1)), np.nan)
    return out


def spread_segments(log: IntArray, share: float) -> IntArray:
    """Numbers of the segments that are kept of each log, spread evenly over it: one at least."""
    kept = []
    for number in np.unique(log):
        own = np.flatnonzero(log == number)
        count = min(len(own), max(1, round(share * len(own))))
        kept.append(own[((np.arange(count) + 0.5) * len(own) / count).astype(int)])
    return np.concatenate(kept)


def growing_steps(first: int, longest: int, growth: float) -> list[int]:
    """Control steps of beginnings that grow by a factor, from ``first`` on and below ``longest``."""
    steps, size = [], float(first)
    while round(size) < longest:
        steps.append(round(size))
        size = max(size * growth, size + 1)
    return steps
