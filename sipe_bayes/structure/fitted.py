"""One structure fitted: the plain model with some extensions, where ``laplace`` found its optimum, and its scores."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.budget import BudgetTooSmall
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.laplace import EVIDENCE_TUNING, Laplace
from sipe_bayes.inference.recorded import Progress
from sipe_bayes.likelihood import FLAT_PRECISION, BoundLikelihood, Linearisation, Noise, QuadraticPrior, Segments
from sipe_bayes.posterior import GaussianMixture, Posterior
from sipe_bayes.posterior import prior as default_prior
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.extension import Placed, extended
from sipe_bayes.structure.internal_starts import mapped_starts
from sipe_bayes.structure.scores import Pieces, predictive, scores


@dataclass(frozen=True)
class FittedStructure:
    """Where the fit of a structure ended.

    Args:
        labels: of its extensions, none for the plain model.
        theta: (N + P,), the optimum: the user's parameters, then those of the extensions in this order.
        mean: (N + P,), of the posterior's normal before truncation.
        covariance: (N + P, N + P), likewise.
        noise: (C,), of the residuals.
        starts: (W, D), of the windows.
        evidence: log p(y) in nats.
        held: pieces that were held out.
        rollouts: that the fit took.
        settled: whether the search had come to rest.
    """

    labels: tuple[str, ...]
    theta: FloatArray
    mean: FloatArray
    covariance: FloatArray
    noise: Noise
    starts: FloatArray
    evidence: float
    held: Pieces
    rollouts: int
    settled: bool

    @property
    def spanned(self) -> FloatArray:
        """The covariance (N + P, N + P), which reaches as far as an optimum beyond a sd: simulations are rough."""
        gap = np.where(_inside(self.theta), self.theta - self.mean, 0.0)
        far = np.abs(gap) > np.sqrt(np.diag(self.covariance))
        return self.covariance + np.outer(gap, gap) if far.any() else self.covariance

    def columns(self, placed: Sequence[Placed]) -> dict[str, IntArray]:
        """Where the parameters of each of its extensions are in theta, by label."""
        counts = [len(piece.parameters) for piece in placed]
        ends = len(self.theta) - sum(counts) + np.cumsum(counts)
        return {x: np.arange(end - n, end) for x, end, n in zip(self.labels, ends, counts, strict=True)}


@dataclass(frozen=True)
class Fitting:
    """What every structure is fitted to.

    Args:
        environment: the user's model.
        trajectories: the logs.
        holdout: logs that no structure is fitted to, if there are such.
        likelihood: windows with coloured noise.
        prior: of the user's parameters.
        seed: of the searches.
        num_threads: native ones.
        ends: on the monotonic clock, when fits end with what they have.
        spans: whether the logs are spans of logs, between contacts: then nothing is of a single log.
    """

    environment: MjcfEnvironment
    trajectories: Trajectories
    holdout: Trajectories | None
    likelihood: Segments
    prior: Posterior
    seed: int
    num_threads: int
    ends: float = math.inf
    spans: bool = False

    @property
    def is_late(self) -> bool:
        """Whether fits are to end with what they have."""
        return time.monotonic() > self.ends

    def enough(self, placed: Sequence[Placed]) -> int:
        """Rollouts that a fit may have: those of forty steps (its optimum takes twenty to thirty), at least 2,000."""
        windows = self.windows(self.simulator(placed))
        return max(2000, 40 * (windows.num_theta + windows.num_start + 2) * len(self.trajectories))

    def simulator(self, placed: Sequence[Placed]) -> Simulator:
        """Of the model with extensions."""
        return Simulator(extended(self.environment, placed) if placed else self.environment, self.num_threads)

    def windows(self, simulator: Simulator) -> BoundLikelihood:
        """The logs bound to a model."""
        return BoundLikelihood(self.likelihood, simulator, self.trajectories)

    def prior_of(self, simulator: Simulator) -> Posterior:
        """The user's prior beside those of the extensions."""
        own, n = default_prior(simulator.space), len(self.prior.space)
        given = [x.numpy() for x in self.prior.gaussian_moments()]
        usual = default_prior(self.prior.space).gaussian_moments()
        if len(simulator.space) == n:
            return self.prior
        if all(np.array_equal(a, b) for a, b in zip(usual, given, strict=True)):
            return own
        mean, covariance = (x.numpy().copy() for x in own.gaussian_moments())
        covariance[np.isinf(covariance)] = 1e6  # a sd of 1,000 cubes stands for a uniform prior beside a normal one
        mean[:n], covariance[:n, :n] = given
        return GaussianMixture(torch.zeros(1), mean[None], covariance[None], simulator.space)

    def fit(
        self,
        placed: Sequence[Placed],
        initial: FloatArray | None,
        budget: int,
        progress: Progress | None = None,
        begin: FittedStructure | None = None,
        part: FittedStructure | None = None,
    ) -> FittedStructure:
        """The best optimum of a structure, and its scores, of ``budget`` rollouts at most.

        The search begins at ``initial`` (N + P,), by default as ``laplace`` does, and with the initial states of the
        structure ``begin``, if it has as many. A structure that fits worse than ``part``, which has some of these
        extensions, is at another local optimum; it is fitted again from the part's.

        Raises:
            BudgetTooSmall: where it ends before there is an optimum.
        """
        simulator = self.simulator(placed)
        prior, windows = self.prior_of(simulator), self.windows(simulator)
        # what an extension's own states are nobody knows: then the search begins as one without an estimate does
        starts = begin.starts if begin is not None and begin.starts.shape[-1] == windows.num_start else None
        begins = [(initial, starts)] + ([] if part is None else [self._part_optimum(placed, simulator, part)])
        rollouts, found = 0, list[FittedStructure]()
        for at in begins:
            left = budget - rollouts - windows.rollouts - self._scoring(windows)
            if found and left < rollouts:
                break
            laplace = Laplace(
                simulator,
                prior=prior,
                budget=max(left, 1),
                seed=self.seed,
                likelihood=self.likelihood,
                progress=progress,
                initial=None if at[0] is None else at[0][None],
                tuning=EVIDENCE_TUNING,
            )
            laplace.initial_starts, laplace.time_limit = at[1], max(self.ends - time.monotonic(), 0.0)
            try:
                laplace.fit(self.trajectories)
                end = laplace.result
                assert end is not None
                assert end.starts is not None
                score = scores(windows, end.theta, end.starts, end.noise, QuadraticPrior.of(prior))
                labels, normal = tuple(one.label for one in placed), (end.theta, end.mean, end.covariance)
                found.append(FittedStructure(labels, *normal, end.noise, end.starts, *score, 0, end.finding is None))
            except (BudgetTooSmall, ValueError):  # LinAlgError is one; what was found stands
                if not found and (at is begins[-1] or left <= laplace.rollouts or self.is_late):
                    raise
            rollouts += laplace.rollouts
            ahead = part is None or (found and found[-1].evidence >= part.evidence - 10.0)  # nats
            if ahead or (found and self.is_late):
                break
        best = max(found, key=lambda one: (one.settled, one.evidence))
        if self.holdout is not None:
            held = BoundLikelihood(self.likelihood, simulator, self.holdout)
            best = replace(best, held=best.held.beside(_held_out(held, best), len(self.trajectories)))
            windows.rollouts += held.rollouts
        settled = best.settled and bool(ahead or not self.is_late)  # else its part's optimum is still to be tried
        return replace(best, rollouts=rollouts + windows.rollouts, settled=settled)

    def needs(self, placed: Sequence[Placed], one: FittedStructure) -> tuple[dict[str, float], int]:
        """By how many nats a structure would fit worse without each extension, and rollouts that were taken.

        All else follows to first order, from a simulation without it. Of one without parameters nothing is known: zero.
        """
        windows, columns = self.windows(self.simulator(placed)), one.columns(placed)
        prior = QuadraticPrior.of(self.prior_of(windows.simulator))
        lin, n = windows.linearise(one.theta, one.starts), windows.num_theta

        def square(residual: FloatArray, keep: IntArray) -> float:
            kept = np.append(keep, np.arange(n, lin.jacobian.shape[-1]))
            moments = windows.moments(Linearisation(residual, lin.jacobian[..., kept], True))
            normal = moments.normal(one.noise)
            arrow = windows.eliminate(normal, len(keep), one.starts)
            belief = (prior.precision + FLAT_PRECISION * np.eye(n))[np.ix_(keep, keep)]
            step = np.linalg.solve(arrow.precision + belief, arrow.gradient)
            return float(normal[:, -1, -1].sum()) - arrow.explained - float(arrow.gradient @ step)

        out, whole = dict[str, float](), square(lin.residual, np.arange(n))
        for piece in placed:
            own, theta = columns[piece.label], one.theta.copy()
            if not len(own):
                out[piece.label] = 0.0
                continue
            theta[own] = piece.plain
            (residual,), (valid,) = windows.residuals(theta[None], one.starts[None])
            left = square(residual, np.setdiff1d(np.arange(n), own)) if valid else math.inf
            out[piece.label] = 0.5 * (left - whole)
        return out, windows.rollouts

    def _scoring(self, windows: BoundLikelihood) -> int:
        """Rollouts that the scores of an optimum take."""
        held = 0 if self.holdout is None else len(self.holdout)
        each = windows.num_theta + windows.num_start + 2
        return each * len(self.trajectories) + (each + windows.starts_cost) * held

    def _part_optimum(
        self, placed: Sequence[Placed], simulator: Simulator, part: FittedStructure
    ) -> tuple[FloatArray, FloatArray]:
        """Theta (N + P,) and starts (W, D) of a structure where a part of it ended: further extensions do nothing."""
        by_label = {one.label: one for one in placed}
        extensions = [by_label[label] for label in part.labels]
        columns, n = part.columns(extensions), len(self.prior.space)
        theta = [part.theta[columns[one.label]] if one.label in columns else one.plain for one in placed]
        starts = mapped_starts(self.simulator(extensions).model, simulator.model, part.starts)
        return np.concatenate([part.theta[:n], *theta]), starts


def _held_out(windows: BoundLikelihood, best: FittedStructure) -> Pieces:
    """Pieces of held-out logs under the posterior at an optimum, of which a step that was not taken is none."""
    pull = np.linalg.solve(best.covariance, best.mean - best.theta)
    pull[_inside(best.theta)] = 0.0
    mean = best.theta + best.covariance @ pull
    posterior = GaussianMixture(torch.zeros(1), mean[None], best.covariance[None], windows.simulator.space)
    return predictive(windows, best.theta, best.noise, QuadraticPrior.of(posterior))


def _inside(theta: FloatArray) -> BoolArray:
    """Which parameters (N,) are not at a bound of the cube."""
    return (theta > 1e-3) & (theta < 1 - 1e-3)
