"""log p(trajectory | theta) by windows of the log (multiple shooting), each window's start estimated with theta.

A log of T samples is cut into windows of ``window`` seconds; each is simulated from its own starting state, which is
unknown and is estimated (``laplace``) or marginalised (``mcmc``) with theta. Every sample is predicted by one window:
what a late or filtered sensor (``Environment.remembers``) tells of the time before a window by the one before, which is
simulated on for it, and what it tells of the time before a log by none. Long open loops are chaotic and one model error
would dominate them; short windows with measured starts give away the noise of the measurement: both cost coverage.
Residuals are white or first-order autoregressive, across windows too (``sipe_bayes.likelihood.noise``). That of an
orientation is the rotation vector from the predicted to the measured one, three numbers of one noise scale.

A start is the tangent (dq (nv), dv (nv), dact (na)) of the state at the one that the log measures, seen through the
sensors of theta (``starts.measured``). Its normal prior is as wide as that measurement is uncertain, and far wider
where nothing measures it (``Environment.start_sd``), so that the equations are not singular.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.budget import BudgetExhausted, Deadline
from sipe_bayes.core.rotations import nearest, written_near
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.likelihood.block_tridiagonal import Eliminated
from sipe_bayes.likelihood.moments import Moments
from sipe_bayes.likelihood.noise import Noise, chosen_sd, noise_level, noise_scales, pooled, whiten
from sipe_bayes.likelihood.restricted import Pulls, eliminate_starts, estimate_noise, marginal
from sipe_bayes.likelihood.sequences import Sequence, compared_samples, cut, reached, sequences, spread_blocks
from sipe_bayes.likelihood.settings import Segments, chosen_channels, fitted_rotations
from sipe_bayes.likelihood.starts.estimates import (
    STATE_STEP,
    all_starts_measured,
    are_states,
    contacts_of,
    estimate_states,
    start_sd,
)
from sipe_bayes.likelihood.starts.history import FilterStarts, past_commands, with_history
from sipe_bayes.likelihood.starts.measured import MeasuredStarts, measurement_sd
from sipe_bayes.simulation.contacts import Contacts, apart_along, may_touch
from sipe_bayes.simulation.prompt import prompt
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.simulation.tangents import moved

_BY_SAMPLE = ("owned", "compared", "measured", "observed")  # what a part of the windows has a part of
_BY_WINDOW = ("number", "log", "start", "stride", "lead", "begin", "left", "steps", "dt", "actions", "reference")
_SHORTER = (1.0, 0.5, 0.2, 0.05)  # steps of the starts that are tried, the next where one led uphill
_SETTLED = 1e-3  # of the sum of squares: a step of the starts that gained less was the last
_ITERATIONS = 2  # in which starts are looked for, near the measured ones


@dataclass(frozen=True)
class Linearisation:
    """residual (W, L, C) = measured - predicted; jacobian (W, L, C, N + D) of the prediction; valid: all simulated."""

    residual: FloatArray
    jacobian: FloatArray
    valid: bool

    def part(self, keep: IntArray) -> Linearisation:
        """That of some of the windows."""
        return Linearisation(self.residual[keep], self.jacobian[keep], self.valid)


class Windows:
    """Recorded trajectories cut into W windows of at most L samples and C fitted channels, with D start unknowns.

    Args:
        settings: of the likelihood.
        simulator: what is calibrated.
        trajectories: the logs.
        like: windows of these logs, of which only the same samples are compared.

    Raises:
        ValueError: for logs that do not fit the simulator or the settings.
    """

    has_parts: ClassVar[bool] = True
    sequences: list[Sequence]
    lead: IntArray
    begin: IntArray
    deadline = Deadline()  # of a fit; never by default
    _masked = 0
    _unmasked: BoolArray

    def __init__(
        self, settings: Segments, simulator: Simulator, trajectories: Trajectories, like: Windows | None = None
    ) -> None:
        self.simulator, self.trajectories, self.settings = simulator, trajectories, settings
        self.rollouts, self.budget, self.short = 0, math.inf, False
        self.channels = chosen_channels(simulator, trajectories, settings.fit)
        self.rotations = fitted_rotations(simulator.environment.rotations, self.channels)
        self.scales = noise_scales(len(self.channels), self.rotations)
        if settings.starts == "recorded" and not are_states(simulator, trajectories.states):
            raise ValueError(
                "starts: 'recorded' needs trajectories with states of this model; use 'estimated' for a measured log"
            )
        if like is not None:
            self.contacts = like.contacts
        self._cut(trajectories, like)
        self._read_samples(trajectories, like)

    @property
    def fitted(self) -> list[str]:
        """Names of the C fitted channels."""
        return [self.simulator.environment.channels[c] for c in self.channels]

    def _cut(self, trajectories: Trajectories, like: Windows | None) -> None:
        pieces, overrides = [], dict(self.settings.windows)
        for k, trajectory in enumerate(trajectories):
            window = overrides.get(trajectory.name, self.settings.window)
            steps = len(trajectory) if window is None else max(1, round(window / trajectory.dt))
            if window is not None and steps > len(trajectory):
                raise ValueError(
                    f"log {trajectory.name!r}: lasts {len(trajectory) * trajectory.dt:.3g} s, shorter than one window "
                    f"of {window:g} s; use a shorter window"
                )
            steps = self.simulator.engine.firmware.whole(steps, trajectory.dt)
            pieces += [(k, s, min(steps, len(trajectory) - s)) for s in range(0, len(trajectory), steps)]
        self.log, self.start, self.stride = (np.array(x) for x in zip(*pieces, strict=True))
        if like is not None:
            self.log, self.start, self.stride = like.log, like.start, like.stride
        elif self.settings.seconds is not None:
            lasting = float((self.stride * trajectories.dt[self.log]).sum())
            keep = spread_blocks(self.log, self.settings.seconds / lasting)
            self.log, self.start, self.stride = self.log[keep], self.start[keep], self.stride[keep]
        self.dt = trajectories.dt[self.log]
        self.names = [(trajectories.names or [None] * len(trajectories))[k] for k in self.log]

    def _read_samples(self, trajectories: Trajectories, like: Windows | None) -> None:
        simulator, known = self.simulator, self.settings.starts == "recorded"
        environment = simulator.environment
        named = [dict(self.settings.late).get(name, 0.0) for name in self.fitted]
        late = np.maximum(named, environment.remembers[self.channels])
        own = reached(late, self.dt, self.log, self.start, self.stride)
        self.lead, self.begin = own[:2] if like is None else (like.lead, like.begin)
        self.left: IntArray = own[2] if like is None else like.left
        self.steps, left = np.minimum(self.stride + self.lead.max(1), self.left), self.left
        place = np.arange(int(self.steps.max()) + 1)
        sample, none = self.start[:, None] + place, np.zeros((len(left), 1), np.int64)
        self.owned = compared_samples(place, self.stride, left, none, none, known)[..., 0]
        self.compared = compared_samples(place, self.stride, left, self.begin, self.lead, known)
        clipped = np.minimum(sample, trajectories.length[self.log][:, None])
        self.measured = trajectories.observations[self.log[:, None], clipped][:, :, self.channels]
        self.observed = self.compared & np.isfinite(self.measured)
        self.actions = trajectories.actions[
            self.log[:, None], np.minimum(sample, trajectories.length[self.log][:, None] - 1)
        ][:, :-1]
        self._in_order()
        guesses = {k: estimate_states(simulator, trajectories[k]) for k in np.unique(self.log).tolist()}
        reference = np.stack([guesses[k][s] for k, s in zip(self.log, self.start, strict=True)])
        self.goals = environment.recorded_goals(trajectories.observations[self.log, 0])
        past = past_commands(simulator, trajectories, self.log, self.start, self.dt)
        recorded = are_states(simulator, trajectories.states)
        self.reference = with_history(simulator, reference, past, self.dt, self.start, recorded)
        self.number = np.arange(len(self.log))
        self.filters = FilterStarts(simulator, trajectories, self.reference, self.log, self.start, recorded)
        free = start_sd(simulator, trajectories) if self.settings.starts == "estimated" else np.zeros(0)
        self.num_start, self.weak_precision = len(free), free**-2.0
        tight, slopes = measurement_sd(simulator, trajectories)
        self.measured_precision = np.minimum(free, np.maximum(tight[: len(free)], 1e-9)) ** -2.0
        self.slope_precision = np.where(slopes[: len(free)], self.measured_precision, self.weak_precision)
        self.sensors = MeasuredStarts(simulator, trajectories, self.filters.numbers)

    @cached_property
    def start_precision(self) -> FloatArray:
        """Of the prior of a start (D,): as well as it is measured, but weak through impacts, which smoothing hides.

        Coloured noise hides in what is measured itself, not in its slopes.
        """
        if not self.num_start or self.impacts:
            return self.weak_precision
        return self.slope_precision if self.settings.noise == "ar1" else self.measured_precision

    @cached_property
    def rates_measured(self) -> bool:
        """Whether measurements tell the velocity of each degree of freedom where a window starts."""
        rates = slice(self.simulator.model.nv, 2 * self.simulator.model.nv)
        return bool((self.measured_precision[rates] > self.weak_precision[rates]).all())

    @cached_property
    def impacts(self) -> bool:
        """Whether bodies strike something or slip on it, so that simulations jump and short ones are smoother.

        From known initial states, of which little else may be known, whether anything touches.
        """
        return meets_impacts(self.simulator, self.contacts, known=not self.num_start)

    @cached_property
    def physics_steps(self) -> int:
        """Of all windows together."""
        skip = np.array([self.simulator.physics_steps(float(dt))[0] for dt in self.dt])
        return int((self.steps * skip).sum())

    @cached_property
    def contacts(self) -> Contacts:
        """What bodies touch along the logs."""
        return contacts_of(self.simulator, [self.trajectories[k] for k in np.unique(self.log).tolist()])

    @property
    def apart(self) -> BoolArray:
        """(W,): in which windows nothing touches."""
        logs = {k: apart_along(self.simulator, self._sampled(k)) for k in np.unique(self.log).tolist()}
        ends = zip(self.log.tolist(), self.start.tolist(), (self.start + self.steps).tolist(), strict=True)
        return np.array([logs[k][first : last + 1].all() for k, first, last in ends], bool)

    def spans_apart(self, least: int) -> list[Trajectory]:
        """The spans of the logs, of so many control steps at least, in which nothing touches."""
        spans = list[Trajectory]()
        for k in np.unique(self.log).tolist():
            log, apart = self.trajectories[k], apart_along(self.simulator, self._sampled(k))
            edges = np.flatnonzero(np.diff(np.concatenate([[False], apart, [False]]).astype(int)))
            for first, last in zip(edges[::2].tolist(), (edges[1::2] - 1).tolist(), strict=True):
                if last - first >= least:
                    name = f"{log.name} from {first * log.dt:.4g} s"
                    spans.append(replace(log.slice(first, last), name=name))
        return spans

    def _sampled(self, log: int) -> FloatArray:
        """States (T+1, S) along a log by its samples, which smoothing would lift off what they touch."""
        return estimate_states(self.simulator, self.trajectories[log], True)

    def mask(self, samples: IntArray) -> None:
        """Leave out samples (k, 3), each by log, number in it and channel of the model, and no others.

        They are those of the last time, and more, or fewer where a search begins anew. Starts stay where they are, and
        parts that were taken of the windows before as they are.
        """
        length = self.observed.shape[1]
        if len(samples) == self._masked:
            return
        if len(samples) < self._masked:
            self.observed, self._masked = self._unmasked.copy(), 0
        elif not self._masked:
            self._unmasked = self.observed.copy()
        for log, sample, channel in samples[self._masked :].tolist():
            place = sample - self.start
            own = np.flatnonzero((self.log == log) & (place >= 0) & (place < length))
            self.observed[own, place[own], self.channels.index(channel)] = False
        self._masked = len(samples)
        self._in_order()

    def telling_steps(self, least: int) -> int:
        """Control steps, at least so many, after whose beginning every channel that has samples has one."""
        seen = self.observed[:, 1:].any(0)
        return max(least, 1 + int(seen[:, seen.any(0)].argmax(0).max(initial=0)))

    def beginnings(self, steps: int) -> Windows:
        """The first control ``steps`` of every window, as its latest sensor sees them; itself where none is longer."""
        steps += int(max(self.lead.max(), self.begin.max(1).min()))
        if steps >= self.steps.max():
            return self
        view = copy.copy(self)
        view.steps, view.actions = np.minimum(self.steps, steps), self.actions[:, :steps]
        for name in _BY_SAMPLE:
            setattr(view, name, getattr(self, name)[:, : steps + 1])
        return view._in_order()

    def spread_over(self, most_steps: int, every_log: bool = False, at_least: int = 8) -> IntArray:
        """Numbers of windows, spread evenly over the logs, for what a part of them answers.

        Args:
            most_steps: control steps that they have together, about.
            every_log: whether one of every log is among them, whatever they take.
            at_least: so many windows, whatever they take; all where there are no more.
        """
        every, count = self.num_windows, max(int(most_steps / self.steps.mean()), at_least)
        if count >= every:
            return np.arange(every)
        kept = ((np.arange(count) + 0.5) * every / count).astype(int)
        if every_log:
            missed = np.setdiff1d(self.log, self.log[kept])
            kept = np.sort(np.concatenate([kept, [np.flatnonzero(self.log == log)[0] for log in missed]]).astype(int))
        return kept

    def part(self, keep: IntArray, observed: BoolArray | None = None) -> Windows:
        """Some of the windows, and samples (K, L, C) of theirs."""
        view = copy.copy(self)
        for name in (*_BY_WINDOW, *_BY_SAMPLE):
            setattr(view, name, getattr(self, name)[keep])
        view.goals = None if self.goals is None else self.goals[keep]
        view.names = [self.names[w] for w in keep]
        view.observed = view.observed if observed is None else observed
        view._masked = 0
        return view._in_order()

    def cut(self, first: IntArray) -> Windows:
        """These windows, whose noise at the beginning of some, ``first``, does not depend on what was before."""
        view = copy.copy(self)
        view.sequences = [cut(sequence, first) for sequence in self.sequences]
        return view

    @contextmanager
    def counting(self, view: Windows) -> Iterator[None]:
        """Count what a view, a share of these windows, simulates meanwhile; it may spend what is left."""
        before, share = self.rollouts, float(view.steps.sum() / self.steps.sum())
        view.rollouts, view.budget = before, before + (self.budget - before) / share
        try:
            yield
        finally:
            self.rollouts = before + math.ceil((view.rollouts - before) * share)

    def _in_order(self) -> Windows:
        """After other samples have become those that count."""
        for name in ("spread", "rounding", "physics_steps"):
            vars(self).pop(name, None)
        sample = self.start[:, None] + np.arange(self.observed.shape[1])
        self.sequences = sequences(self.observed, sample, self.log, self.dt)
        return self

    @property
    def level(self) -> Noise:
        """White noise of the size that the samples' roughness shows, or as given."""
        rough = noise_level(self.trajectories, self.settings, self.simulator)[self.channels]
        rough = pooled(np.maximum(rough, self.rounding), self.scales)
        return Noise(np.where(np.isnan(self.fixed_sd), rough, self.fixed_sd), np.zeros(len(rough)))

    @cached_property
    def spread(self) -> FloatArray:
        """Sd (C,) of what each channel measured."""
        return np.asarray(np.nanstd(np.where(self.observed, self.measured, np.nan), axis=(0, 1)))

    @cached_property
    def rounding(self) -> FloatArray:
        """Noise sd (C,) below which finite differences are mostly rounding: no fit comes closer.

        A ten millionth of a channel's size: what the tolerance of MuJoCo's contact solver leaves, in rare steps.
        """
        size = np.sqrt(np.nanmean(np.where(self.observed, self.measured, np.nan) ** 2, axis=(0, 1)))
        moving = size[size > 0]
        return 1e-7 * np.maximum(size, 1e-3 * np.median(moving) if len(moving) else 1e-3)

    @property
    def fixed_sd(self) -> FloatArray:
        """Given noise sd (C,) of the fitted channels, NaN where it is inferred."""
        return chosen_sd(self.settings.noise_sd, self.channels, self.simulator.environment.channels)

    @property
    def theta_step(self) -> float:
        """Of the finite differences: the longer a window, the less smooth the effect of a change."""
        return max(1e-5, 1e-3 / int(self.steps.max()))

    def least_steps(self, theta: FloatArray) -> FloatArray:
        """Least changes (N,) of theta (N,) that finite differences can be taken over."""
        return self.simulator.environment.least_steps(theta)

    @property
    def num_windows(self) -> int:
        """W."""
        return len(self.log)

    @property
    def num_theta(self) -> int:
        """N."""
        return len(self.simulator.space)

    def no_starts(self, batch: int | None = None) -> FloatArray:
        """The starts (W, D) at their reference, or a batch (B, W, D) of them."""
        shape = (self.num_windows, self.num_start)
        return np.zeros(shape if batch is None else (batch, *shape))

    def states(self, theta: FloatArray, starts: FloatArray) -> FloatArray:
        """Starting states (B, W, S) of starts (B, W, D) under theta (B, N)."""
        if not self.num_start:
            return np.broadcast_to(self.reference, (*starts.shape[:-1], self.reference.shape[-1])).copy()
        offsets = self.sensors.offsets(theta, self.log, self.start, self.reference)
        begin = moved(self.simulator.model, self.reference, starts if offsets is None else starts + offsets)
        return self.filters.put(begin, theta, starts, self.number)

    def predict(self, theta: FloatArray, starts: FloatArray, in_float64: bool = False) -> tuple[FloatArray, BoolArray]:
        """Simulate every window.

        Args:
            theta: (B, N).
            starts: (B, W, D).
            in_float64: on the processor, whatever the simulator's device.

        Returns:
            Predictions (B, W, L, C), NaN from the sample on at which a window diverged, rotation vectors written near
            the measured ones; and which of the B (B,) stayed valid throughout.

        Raises:
            BudgetExhausted: instead of simulating beyond the budget.
        """
        batch = len(theta)
        self.spend(batch)
        thetas = np.repeat(theta, self.num_windows, axis=0)
        states = self.states(theta, starts).reshape(batch * self.num_windows, -1)
        actions = np.tile(self.actions, (batch, 1, 1))
        goals = None if self.goals is None else np.tile(self.goals, (batch, 1))
        dt, names = np.tile(self.dt, batch), self.names * batch
        result = self._simulators[in_float64].rollout(thetas, actions, states, dt, names, goals=goals)
        shape = (batch, self.num_windows)
        good = result.valid.reshape(*shape, -1)
        predicted = result.observations.reshape(*shape, *result.observations.shape[1:])[..., self.channels]
        predicted = np.where(good[..., None], predicted, np.nan)
        predicted = written_near(predicted, self.measured, self.rotations)
        needed = self.owned | self.compared.any(-1)
        return predicted, np.asarray((good | ~needed).all(axis=(1, 2)))

    def simulate(self, theta: FloatArray) -> FloatArray:
        """Predictions (B, W, L, C) of thetas (B, N) from the measured initial states.

        Raises:
            BudgetExhausted: instead of simulating beyond the budget.
        """
        together = max(32, self.simulator.wave(self.actions.shape[1]) // self.num_windows)
        batches = np.split(theta, range(together, len(theta), together))
        return np.concatenate([self.predict(rows, self.no_starts(len(rows)))[0] for rows in batches])

    @cached_property
    def _simulators(self) -> tuple[Simulator, Simulator]:
        """What simulates the windows, and the same in float64 on the processor."""
        contacts = may_touch(self.simulator.model) and self.contacts.touch
        return prompt(self.simulator, contacts), prompt(self.simulator.on_processor, contacts)

    def spend(self, batch: int) -> None:
        """Count the rollouts of ``batch`` thetas; raises BudgetExhausted where too few or too little time are left."""
        self.deadline.check()
        cost = batch * len(self.trajectories)
        if self.rollouts + cost > self.budget:
            raise BudgetExhausted(f"{self.rollouts} of {self.budget:g} rollouts used, the next step takes {cost}")
        self.rollouts += cost

    def has_room(self, batch: int) -> bool:
        """Whether the budget leaves room for ``batch`` thetas; ``short`` tells that it once did not."""
        self.short |= (full := self.rollouts + batch * len(self.trajectories) > self.budget)
        return not full

    def residuals(self, theta: FloatArray, starts: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Measured minus predicted (B, W, L, C), zero where nothing was measured, and which of the B are valid."""
        predicted, valid = self.predict(theta, starts)
        with np.errstate(invalid="ignore"):
            residual = np.where(self.observed, self.measured - predicted, 0.0)
        return np.where(valid[:, None, None, None], residual, 0.0), valid

    @cached_property
    def starts_measured(self) -> bool:
        """Whether the log tells where every window starts: recorded states, or a measured position of each joint."""
        return all_starts_measured(self.simulator, self.trajectories)

    @property
    def starts_cost(self) -> int:
        """Rollouts of each log that ``fit_starts`` takes at most."""
        return 1 + _ITERATIONS * (self.num_start + len(_SHORTER))

    def fit_starts(self, theta: FloatArray, noise: Noise) -> tuple[FloatArray, FloatArray, bool]:
        """Starts (W, D) that minimise the whitened residuals at a fixed theta (N,), each window by itself.

        Returns:
            Them, the residuals (W, L, C) from them, and whether that simulation is valid.
        """

        def simulated(starts: FloatArray) -> tuple[FloatArray, bool]:
            residual, valid = self.residuals(theta[None], starts[None])
            return residual[0], bool(valid[0])

        starts = self.no_starts()
        residual, valid = simulated(starts)
        energy = self.energies(starts[None], residual[None], noise)[0]
        for _ in range(_ITERATIONS if valid and np.isfinite(residual).all() else 0):
            linearisation = self.linearise(theta, starts, with_theta=False, residual=residual)
            move = self.log_density(self.moments(linearisation), noise, starts)[1]
            before, rest = energy.sum(), np.ones(len(starts), bool)
            for share in _SHORTER:
                tried = np.where(rest[:, None], starts + share * move, starts)
                left, good = simulated(tried)
                after = self.energies(tried[None], left[None], noise)[0] if good else np.full(len(starts), np.inf)
                better = rest & (after < energy)
                starts = np.where(better[:, None], tried, starts)
                residual, energy = np.where(better[:, None, None], left, residual), np.where(better, after, energy)
                rest &= ~better
                if not rest.any():
                    break
            # a window's first sample is whitened by the last one before it
            energy = self.energies(starts[None], residual[None], noise)[0]
            if not energy.sum() < (1 - _SETTLED) * before:
                break
        return starts, residual, valid

    def linearise(
        self,
        theta: FloatArray,
        starts: FloatArray,
        with_theta: bool = True,
        with_starts: bool = True,
        residual: FloatArray | None = None,
        theta_step: float | FloatArray | None = None,
        start_step: float | FloatArray = STATE_STEP,
        axes: FloatArray | None = None,
    ) -> Linearisation:
        """Residual and Jacobian: one batch of N + D + 1 simulations of the logs, in float64.

        Args:
            theta: (N,), where.
            starts: (W, D), where.
            with_theta: whether the Jacobian holds the columns of theta.
            with_starts: whether it holds those of the starts.
            residual: (W, L, C), of a valid simulation at this very point, which spares the one.
            theta_step: of the differences, of the cube; default ``self.theta_step``; ``least_steps`` where longer.
            start_step: the same of the starts, a number or (D,).
            axes: (N, N), rows along which theta is changed in place of each parameter by itself.

        Raises:
            BudgetExhausted: instead of simulating beyond the budget.
        """
        n, d = (self.num_theta if with_theta else 0), (self.num_start if with_starts else 0)
        size = np.maximum(self.theta_step if theta_step is None else theta_step, self.least_steps(theta))
        ways = size * np.eye(self.num_theta) if axes is None else axes
        of_starts = np.broadcast_to(start_step, self.num_start)[:d]
        thetas, all_starts = np.tile(theta, (n + d + 1, 1)), np.tile(starts, (n + d + 1, 1, 1))
        moves = inward(theta, ways[:n])
        thetas[1 : n + 1] += moves
        for j in range(d):
            all_starts[n + 1 + j, :, j] += of_starts[j]
        if residual is None:
            predicted, valid = self.predict(thetas, all_starts, True)
        else:
            here = np.where(self.observed, self.measured - residual, np.nan)
            predicted, valid = self.predict(thetas[1:], all_starts[1:], True)
            predicted, valid = np.concatenate([here[None], predicted]), np.append(True, valid)
        wrong = [j for j in range(n) if not valid[j + 1]]
        # a step across a physical limit: look the other way
        if wrong and valid[0]:
            rows, again = np.array(wrong) + 1, np.clip(theta - moves[wrong], 0, 1)
            moves[wrong] = np.where(np.abs(again - theta) > 0, again - theta, -moves[wrong])
            predicted[rows], valid[rows] = self.predict(again, all_starts[: len(wrong)], True)
        predicted[1:] = self.continued(predicted[1:], predicted[0])
        with np.errstate(invalid="ignore"):
            change = predicted[1:] - predicted[0]
        change = np.where(self.observed & valid[1:, None, None, None], change, 0.0)
        change[n:] /= of_starts[:, None, None, None]
        if n and axes is None:
            change[:n] /= np.diag(moves)[:, None, None, None]
        elif n:
            change[:n] = np.tensordot(np.linalg.inv(moves), change[:n], axes=1)
        jacobian = change
        residual = np.where(self.observed, self.measured - predicted[0], 0.0)
        return Linearisation(residual, np.moveaxis(jacobian, 0, -1), bool(valid[0]))

    def continued(self, predicted: FloatArray, here: FloatArray) -> FloatArray:
        """Predictions (B, W, L, C) whose differences from those ``here`` (W, L, C) jump nowhere.

        The residual of an orientation does where it is half a turn.
        """
        for triple in map(list, self.rotations):
            measured = self.measured[..., triple]
            near = nearest(measured - predicted[..., triple], measured - here[..., triple])
            predicted[..., triple] = measured - near
        return predicted

    def moments(self, lin: Linearisation, white: bool = False) -> Moments:
        """Products of the linearised rows, from which the normal equations of any noise follow, or of white alone."""
        n = lin.jacobian.shape[-1] - self.num_start
        return Moments(lin.residual, lin.jacobian, n, self.sequences, white)

    def chi_square(self, residual: FloatArray, noise: Noise) -> FloatArray:
        """Whitened sum of squares (B,) of residuals (B, W, L, C)."""
        return np.asarray(sum((p**2).sum(-1) for p in self.whitened(residual, noise)))

    def energies(self, starts: FloatArray, residual: FloatArray, noise: Noise) -> FloatArray:
        """Of each window (B, W) the whitened squares of its residual (B, W, L, C) and of its start (B, W, D)."""
        squares = starts**2 @ self.start_precision
        for rows, s in zip(self.whitened(residual, noise), self.sequences, strict=True):
            for own, row in zip(squares, rows, strict=True):
                own += np.bincount(s.window, row**2, minlength=len(own))
        return np.asarray(squares)

    def whitened(self, residual: FloatArray, noise: Noise) -> list[FloatArray]:
        """Of each channel the whitened rows (B, n) of residuals (B, W, L, C), in the order of ``sequences``."""
        flat, pairs = residual.reshape(len(residual), -1, len(self.channels)), zip(noise.sd, noise.tau, strict=True)
        return [whiten(flat[..., c], self.sequences[c], float(sd), float(tau)) for c, (sd, tau) in enumerate(pairs)]

    def pulls(
        self, precision: FloatArray, pull: FloatArray, starts: FloatArray, free: BoolArray | None = None
    ) -> Pulls:
        """What besides the data pulls at theta and ``starts`` (W, D).

        precision (N, N) and pull (N,): of the prior of theta. free (N,): which parameters may move, default all.
        """
        free = np.ones(len(pull), bool) if free is None else free
        return Pulls(precision, pull, self.start_precision, -self.start_precision * starts, free)

    def estimate_noise(self, moments: Moments, before: Noise, pulls: Pulls, coloured: bool) -> Noise:
        """Noise that maximises the restricted likelihood of a linearisation; see ``restricted.estimate_noise``."""
        span = float(self.dt.min()), self.trajectories.longest
        return estimate_noise(moments, before, pulls, self.fixed_sd, coloured, *span, self.scales)

    def eliminate(self, normal: FloatArray, num_theta: int, starts: FloatArray | None = None) -> Eliminated:
        """Normal equations of theta with initial states marginalised, at ``starts`` (W, D), default zero.

        normal (W, K, K): as of ``Moments.normal``, whose first columns are those of theta.
        """
        starts = self.no_starts() if starts is None else starts
        return eliminate_starts(normal, num_theta, self.start_precision, -self.start_precision * starts)

    def log_density(self, moments: Moments, noise: Noise, starts: FloatArray) -> tuple[float, FloatArray, float]:
        """Log-likelihood at ``starts`` (W, D) with these integrated out, their best change, and the nats that it gains.

        moments: of the residuals there and their Jacobian by initial states alone.
        """
        return marginal(moments, noise, starts, self.start_precision)


def meets_impacts(simulator: Simulator, contacts: Contacts, known: bool = False) -> bool:
    """Whether bodies strike something or slip on it along logs; a free body that touches anything may.

    known: whether initial states are known, between which anything may have happened.
    """
    touches = known or bool(simulator.environment.poses)
    return may_touch(simulator.model) and (contacts.change or contacts.rough or (contacts.touch and touches))


def inward(theta: FloatArray, ways: FloatArray) -> FloatArray:
    """Changes (K, N) of theta (N,), each to the side that the unit cube leaves more room for, and no longer than it."""
    room = np.where(ways > 0, 1 - theta, theta), np.where(ways > 0, theta, 1 - theta)
    shares = [np.where(ways == 0, np.inf, side / np.maximum(np.abs(ways), 1e-300)).min(1) for side in room]
    sign = np.where((shares[0] >= 1) | (shares[0] >= shares[1]), 1.0, -1.0)
    share = np.minimum(np.where(sign > 0, *shares), 1.0)
    return np.asarray((sign * np.where(share > 0, share, 1.0))[:, None] * ways)
