"""One structure fitted: the plain model with some extensions, where ``laplace`` found its optimum, and its scores."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from sipe_bayes.core.arrays import FloatArray, IntArray
from sipe_bayes.core.budget import BudgetTooSmall
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.laplace import EVIDENCE_TUNING, Laplace
from sipe_bayes.inference.recorded import Progress
from sipe_bayes.likelihood import (
    FLAT_PRECISION,
    BoundLikelihood,
    FitResult,
    Linearisation,
    Noise,
    QuadraticPrior,
    Segments,
)
from sipe_bayes.posterior import GaussianMixture, Posterior
from sipe_bayes.posterior import prior as default_prior
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.extension import Placed, extended
from sipe_bayes.structure.internal_starts import mapped_starts
from sipe_bayes.structure.scores import Pieces, Scores, predictive, scores

_STEPS = 40  # of a fit, which takes twenty to thirty
_EDGE = 1e-3  # of the cube: at a bound
_UNNEEDED = 10.0  # nats: an extension that explains nothing lowers the evidence by no more
_FLAT_SD = 1e3  # of the cube: stands for a uniform prior beside a normal one


@dataclass(frozen=True)
class FittedStructure:
    """Where the fit of a structure ended.

    Args:
        labels: of its extensions, none for the plain model.
        theta: (N + P,), the optimum: the user's parameters, then those of the extensions in this order.
        mean: (N + P,), of the posterior's normal before truncation.
        covariance: (N + P, N + P), likewise.
        sd: (C,), of the noise.
        tau: (C,), its correlation time in seconds.
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
    sd: FloatArray
    tau: FloatArray
    starts: FloatArray
    evidence: float
    held: Pieces
    rollouts: int
    settled: bool

    @property
    def spanned(self) -> FloatArray:
        """The covariance (N + P, N + P), which reaches as far as an optimum beyond a sd: simulations are rough."""
        inside = (self.theta > _EDGE) & (self.theta < 1 - _EDGE)
        gap = np.where(inside, self.theta - self.mean, 0.0)
        far = np.abs(gap) > np.sqrt(np.diag(self.covariance))
        return self.covariance + np.outer(gap, gap) if far.any() else self.covariance

    @property
    def noise(self) -> Noise:
        """Of the residuals."""
        return Noise(self.sd, self.tau)


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
        """Rollouts of as many steps of a fit as lead to its optimum."""
        windows = self.windows(self.simulator(placed))
        return _STEPS * (windows.num_theta + windows.num_start + 2) * len(self.trajectories)

    def simulator(self, placed: Sequence[Placed]) -> Simulator:
        """Of the model with extensions."""
        return Simulator(extended(self.environment, placed) if placed else self.environment, self.num_threads)

    def windows(self, simulator: Simulator) -> BoundLikelihood:
        """The logs bound to a model."""
        return BoundLikelihood(self.likelihood, simulator, self.trajectories)

    def prior_of(self, simulator: Simulator) -> Posterior:
        """The user's prior beside those of the extensions."""
        return beside(self.prior, simulator.space)

    def fit(
        self,
        placed: Sequence[Placed],
        initial: FloatArray | None,
        budget: int,
        progress: Progress | None = None,
        begin: FittedStructure | None = None,
        part: FittedStructure | None = None,
    ) -> FittedStructure:
        """The best optimum of a structure, and its scores.

        A structure that fits worse than a part of it is at another local optimum; it is fitted again from the part's.

        Args:
            placed: its extensions.
            initial: (N + P,), where the search begins; default as ``laplace`` does.
            budget: rollouts at most.
            progress: called along the way.
            begin: the structure whose initial states the search begins with, if it has as many.
            part: a structure with some of these extensions; none by default.

        Raises:
            BudgetTooSmall: where it ends before there is an optimum.
        """
        simulator = self.simulator(placed)
        prior = self.prior_of(simulator)
        windows = self.windows(simulator)
        # what an extension's own states are nobody knows: then the search begins as one without an estimate does
        known = begin is not None and begin.starts.shape[-1] == windows.num_start
        begins: list[tuple[FloatArray | None, FloatArray | None]] = [
            (initial, begin.starts if known and begin else None)
        ]
        begins += [] if part is None else [self._part_optimum(placed, simulator, part)]
        rollouts, found = 0, list[tuple[Scores, FitResult]]()
        for at in begins:
            left = budget - rollouts - windows.rollouts - self._scoring(windows)
            if found and left < rollouts:
                break
            laplace = self._laplace(simulator, prior, at, max(left, 1), progress)
            try:
                laplace.fit(self.trajectories)
                assert laplace.result is not None
                found.append((self._scores(windows, laplace.result, prior), laplace.result))
            except (BudgetTooSmall, ValueError):  # LinAlgError is one; what was found stands
                if not found and (at is begins[-1] or left <= laplace.rollouts or self.is_late):
                    raise
            rollouts += laplace.rollouts
            ahead = part is None or (found and found[-1][0].evidence >= part.evidence - _UNNEEDED)
            if ahead or (found and self.is_late):
                break
        (evidence, pieces), best = max(found, key=lambda one: (one[1].finding is None, one[0].evidence))
        assert best.starts is not None
        if self.holdout is not None:
            held = BoundLikelihood(self.likelihood, simulator, self.holdout)
            pull = np.linalg.solve(best.covariance, best.mean - best.theta)
            pull[(best.theta > _EDGE) & (best.theta < 1 - _EDGE)] = 0.0  # a step that was not taken is none
            mean = best.theta + best.covariance @ pull
            posterior = GaussianMixture(torch.zeros(1), mean[None], best.covariance[None], simulator.space)
            own = predictive(held, best.theta, best.noise, QuadraticPrior.of(posterior))
            pieces = pieces.beside(own, len(self.trajectories))
            windows.rollouts += held.rollouts
        return FittedStructure(
            tuple(one.label for one in placed),
            best.theta,
            best.mean,
            best.covariance,
            best.noise.sd,
            best.noise.tau,
            best.starts,
            evidence,
            pieces,
            rollouts + windows.rollouts,
            best.finding is None and (ahead or not self.is_late),  # else its part's optimum is still to be tried
        )

    def needs(self, placed: Sequence[Placed], one: FittedStructure) -> tuple[dict[str, float], int]:
        """By how many nats a structure would fit worse without each extension, and rollouts that were taken.

        All else follows to first order, from a simulation without it. Of one without parameters nothing is known: zero.
        """
        windows = self.windows(self.simulator(placed))
        prior = QuadraticPrior.of(self.prior_of(windows.simulator))
        lin, n, first = windows.linearise(one.theta, one.starts), windows.num_theta, len(self.prior.space)

        def square(residual: FloatArray, keep: IntArray) -> float:
            columns = np.append(keep, np.arange(n, lin.jacobian.shape[-1]))
            moments = windows.moments(Linearisation(residual, lin.jacobian[..., columns], True))
            normal = moments.normal(one.noise)
            arrow = windows.eliminate(normal, len(keep), one.starts)
            belief = (prior.precision + FLAT_PRECISION * np.eye(n))[np.ix_(keep, keep)]
            step = np.linalg.solve(arrow.precision + belief, arrow.gradient)
            return float(normal[:, -1, -1].sum()) - arrow.explained - float(arrow.gradient @ step)

        out, whole = dict[str, float](), square(lin.residual, np.arange(n))
        for piece in placed:
            own = np.arange(first, first + len(piece.parameters))
            first += len(own)
            theta = one.theta.copy()
            theta[own] = piece.plain
            (residual,), (valid,) = windows.residuals(theta[None], one.starts[None])
            left = square(residual, np.setdiff1d(np.arange(n), own)) if valid else math.inf
            out[piece.label] = 0.5 * (left - whole) if len(own) else 0.0
        return out, windows.rollouts

    @staticmethod
    def _scores(windows: BoundLikelihood, best: FitResult, prior: Posterior) -> Scores:
        assert best.starts is not None
        return scores(windows, best.theta, best.starts, best.noise, QuadraticPrior.of(prior))

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
        n = len(self.prior.space)
        theta, first = {"": part.theta[:n]}, n
        for one in extensions:
            theta[one.label] = part.theta[first : first + len(one.parameters)]
            first += len(one.parameters)
        starts = mapped_starts(self.simulator(extensions).model, simulator.model, part.starts)
        return np.concatenate([theta[""], *(theta.get(one.label, one.plain) for one in placed)]), starts

    def _laplace(
        self,
        simulator: Simulator,
        prior: Posterior,
        begin: tuple[FloatArray | None, FloatArray | None],
        budget: int,
        progress: Progress | None,
    ) -> Laplace:
        """What finds the optimum, beginning at theta (N + P,) and starts (W, D) where these are given."""
        theta, starts = begin
        laplace = Laplace(
            simulator,
            prior=prior,
            budget=budget,
            seed=self.seed,
            likelihood=self.likelihood,
            progress=progress,
            initial=None if theta is None else theta[None],
            tuning=EVIDENCE_TUNING,
        )
        laplace.initial_starts = starts
        laplace.time_limit = max(self.ends - time.monotonic(), 0.0)
        return laplace


def beside(prior: Posterior, space: ParameterSpace) -> Posterior:
    """The user's prior of the first parameters of a space, and the others' own."""
    own, n = default_prior(space), len(prior.space)
    mine = default_prior(prior.space)
    same = zip(mine.gaussian_moments(), prior.gaussian_moments(), strict=True)
    if len(space) == n or all(torch.equal(a, b) for a, b in same):
        return own if len(space) > n else prior
    mean, covariance = (x.numpy().copy() for x in own.gaussian_moments())
    covariance[np.isinf(covariance)] = _FLAT_SD**2
    mean[:n], covariance[:n, :n] = (x.numpy() for x in prior.gaussian_moments())
    return GaussianMixture(torch.zeros(1), mean[None], covariance[None], space)
