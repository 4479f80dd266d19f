"""Laplace's approximation of the posterior by windowed least squares.

Theta and the windows' starts minimise the whitened squares of the residuals plus the prior (``least_squares``), the
noise maximises its restricted likelihood (``sipe_bayes.noise``); the two alternate, after a rough search with white
noise of the size of the present residuals. At the optimum the starts are marginalised and the curvature gives a normal in
theta, truncated to the unit cube. Where a parameter sits at a bound, the normal's mean lies beyond it, at the optimum
of the quadratic model: the truncated density is right up to the bound.

With ``noise="sandwich"`` the optimum is that of plain least squares and only the width comes from the autoregressive
noise (``noise.sandwich``). Where the model is wrong at low frequencies, the full likelihood puts the misfit down to slow
noise and may leave the parameters behind it undetermined; plain least squares keeps what predicts best.

Several starting points (the model as given and the best of a few draws from the prior) are followed; optima that are
not the same become components of a mixture, weighted by their restricted likelihood.

With ``StateSpace`` every sample's state is unknown and the search is that of ``state_space_search``.

Simulations are what a fit costs, so they are spared where they add nothing. Where the log tells the windows' starts, theta
moves alone first, on every other window, until a step gains little. The Jacobian of the starts is kept as long as it foretells the gain of a step
to a fifth; an optimum is only accepted where what was foretold since it was taken is wrong by less than half a nat. A later starting point is dropped once
the search has all but come to an optimum that is already known.

Where a direction is open (a ridge), the search goes on once from its middle, since the width across a ridge may differ from
place to place, and the place would otherwise be an accident of the start.

Where the starts are recorded and theta alone is searched, points around each optimum are tried as well (``poll``), and the search
goes on from a better one, with finite differences no longer than the way there. The normal that is left is no narrower than the
shortest of these ways, and holds the points that fit as well as the optimum, whatever the curvature says; one that fits as
well but lies beyond worse ones becomes a further starting point.

Deviations from the textbook: directions that the data leave open get a normal of sd 10 about the cube's centre, flat
within the cube to half a percent, so that the covariance exists and the result does not depend on the start; the
uncertainty of the noise widens the normal by the moments over a handful of weighted noise values. Residuals below what the
simulation's own rounding leaves are no independent evidence: such a channel counts as one sample, not as many.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from sipe_bayes.checks import whole
from sipe_bayes.inference import state_space_search
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.least_squares import FLAT_PRECISION, Fit, QuadraticPrior, energy_of, step
from sipe_bayes.inference.poll import SHORTEST, Around, cost, poll
from sipe_bayes.inference.state import State
from sipe_bayes.likelihood import Linearisation, Windows
from sipe_bayes.noise import (
    Arrow,
    Moments,
    Noise,
    Pulls,
    eliminate,
    estimate_noise,
    noise_cloud,
    restricted,
    sandwich,
)
from sipe_bayes.posterior import GaussianMixture
from sipe_bayes.state_space import Chain
from sipe_bayes.trajectory import Trajectories

FloatArray = NDArray[np.float64]

_MANY, _ELITE, _LEAST_SPREAD = 40, 6, 1e-3  # candidates; how many of the best lead on; sd, in the cube
_TOLERANCE = 0.02  # nats
_ROUGH = 1e-4  # of the energy
_SAME_NOISE = 0.03  # relative
_DROP = 10.0  # nats below the best optimum
_MAX_ITERATIONS = 80
_HALF, _LITTLE = 0.5, 0.1  # of the energy: gains below which the starts move along, as foretold or not
_FAIR, _DRIFT = 0.2, 0.5  # how well the starts' Jacobian must foretell gains: relative, nats in all
_NEAR = 0.1  # of the way to a known optimum
_OPEN, _OFF_CENTRE, _AS_GOOD = 0.5, 0.1, 2.0  # sd of an open direction, distance from its middle, nats
_MOST_POLLS = 20  # looks around that lead on from one starting point
_MOST_POINTS = 10  # starting points, with those found on the way
_LEAST_EIGENVALUE = 1e-12  # of a precision scaled to ones on its diagonal
_AFRESH = {"residual": np.empty(0), "jacobian": np.empty(0), "drift": 0.0, "due": False, "damping": 1e-4}


class Laplace(Estimator):
    """Mixture of truncated normals at the optima of the windowed likelihood; see the module's docstring.

    restarts: starting points followed. candidates: points among which they are chosen: draws from the prior and, of 40 or more,
    later ones around the best. initial (R, N): the starting points themselves instead.
    """

    name: ClassVar[str] = "laplace"
    searches: ClassVar[bool] = True
    default_budget: ClassVar[int] = 5000

    def __init__(
        self,
        simulator: Any,
        *,
        restarts: int = 2,
        candidates: int = 8,
        initial: FloatArray | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(simulator, **settings)
        self.restarts, self.candidates = whole("restarts", restarts), whole("candidates", candidates, 0)
        self.initial = None if initial is None else np.clip(np.atleast_2d(self.space.check_shape(initial)), 0, 1)

    def settings(self) -> dict[str, Any]:
        initial = None if self.initial is None else self.initial.tolist()
        return {
            **super().settings(),
            "restarts": self.restarts,
            "candidates": self.candidates,
            "initial": initial,
        }

    @property
    def quadratic_prior(self) -> QuadraticPrior:
        """The prior's normal, before truncation."""
        mean, covariance = self.prior.gaussian_moments()
        return QuadraticPrior(mean.numpy(), np.linalg.inv(covariance.numpy()))

    def start(self, trajectories: Trajectories) -> State:
        windows = self.windows(trajectories)
        if isinstance(windows, Chain):
            return state_space_search.start(self, windows)
        starts = screen(self, windows, trajectories) if self.initial is None else self.initial
        n, w, d, c = len(self.space), windows.num_windows, windows.num_start, len(windows.channels)
        fresh = _begin(windows, starts[0])
        return {
            "done": False,
            "points": starts,
            "point": 0,
            **fresh,
            "mode_theta": np.empty((0, n)),
            "mode_starts": np.empty((0, w, d)),
            "mode_slope": np.empty((0, w, d, n)),
            "mode_mean": np.empty((0, n)),
            "mode_covariance": np.empty((0, n, n)),
            "mode_sd": np.empty((0, c)),
            "mode_tau": np.empty((0, c)),
            "mode_evidence": np.empty(0),
        }

    def describe(self, state: State) -> str:
        return f"laplace: start {state['point'] + 1} of {len(state['points'])}, step {state['iteration']}"

    def step(self, state: State, trajectories: Trajectories) -> State:
        """One linearisation and one accepted step of theta and starts; at an optimum, the noise is estimated anew.

        Rough search first: white noise with the sd of the present residuals, to a relative tolerance."""
        windows, prior = self.windows(trajectories), self.quadratic_prior
        if isinstance(windows, Chain):
            return state_space_search.step(self, windows, state)
        if state["held"]:
            return self._held_step(state, windows, prior)
        theta, starts, rough = state["theta"], state["starts"], state["rough"]
        linearisation, stale, drift = self._linearise(state, windows)
        if not linearisation.valid and state["peeked"]:  # every other window went well, but not all
            begin = _begin(windows, state["points"][state["point"]])
            return {**state, **begin, "held": False, "peeked": False}
        moments = windows.moments(linearisation, white=rough)
        noise = before = Noise(state["sd"], state["tau"])
        if rough:
            noise = _present_noise(windows, linearisation.residual)
        elif state["due"]:
            noise = _noise(windows, moments, before, theta, starts, prior, self.likelihood.noise == "ar1")
        value = energy_of(windows, noise, prior, theta, starts, linearisation.residual)
        tolerance = max(_ROUGH * value, _TOLERANCE) if rough else _TOLERANCE
        here = Fit(theta, starts, value, state["damping"], residual=linearisation.residual)
        fit = step(windows, noise, prior, here, moments, tolerance, stale)
        drift = drift + abs(fit.gained - fit.expected)
        converged = fit.converged and drift < _DRIFT
        iteration = state["iteration"] + 1
        # where theta does not move for the noise that is best there, both are
        best_of_both = not fit.gained or _same(noise, before)
        settled = converged and not rough and state["due"] and best_of_both
        state = {
            **state,
            "theta": fit.theta,
            "starts": fit.starts,
            "damping": fit.damping,
            "sd": noise.sd,
            "tau": noise.tau,
            "iteration": iteration,
            "rough": rough and not converged and iteration < _MAX_ITERATIONS // 2,
            "due": converged,
            "residual": fit.residual,
            "jacobian": linearisation.jacobian,
            "peeked": False,
            "drift": np.inf if fit.converged and not converged else drift,
            "keep_starts": _foretold(fit),
            "moved": fit.gained > 0,
        }
        if settled or iteration >= _MAX_ITERATIONS:
            if not settled:
                self.warn(
                    f"the search had not settled after {iteration} steps: look at the residuals before you trust the intervals"
                )
            elif fit.refused > _DRIFT:
                self.warn(
                    f"at the optimum the linearisation still foretold a gain of {fit.refused:.1f} nats that no step found: the "
                    "simulation is not smooth there (friction, contact or delay); compare with mcmc before you trust the intervals"
                )
            moments = windows.moments(linearisation) if rough else moments
            return self._finish(state, windows, moments, noise, theta, starts, linearisation.jacobian)
        return self._next(state, windows) if not state["polls"] and _known(state) else state

    def _held_step(self, state: State, windows: Windows, prior: QuadraticPrior) -> State:
        """A step of theta alone, the starts as the log tells them, on every other window; near the optimum the search goes
        on with all."""
        view, theta = windows.glimpse(), state["theta"]
        before = view.rollouts
        found = view.linearise(
            theta, view.no_starts(), with_starts=False, residual=state["residual"] if state["residual"].size else None
        )
        still = np.zeros((*found.residual.shape, windows.num_start))
        found = replace(found, jacobian=np.concatenate([found.jacobian, still], axis=-1))
        noise = _present_noise(view, found.residual)
        value = energy_of(view, noise, prior, theta, view.no_starts(), found.residual)
        here = Fit(theta, view.no_starts(), value, state["damping"], residual=found.residual)
        fit = step(view, noise, prior, here, view.moments(found, white=True), max(_ROUGH * value, _TOLERANCE))
        if view is not windows:
            share = view.steps.sum() / windows.steps.sum()
            windows.rollouts += int(np.ceil((view.rollouts - before) * share))
        held = not fit.converged and fit.gained > (_HALF if _foretold(fit) else _LITTLE) * value
        held &= state["iteration"] + 1 < _MAX_ITERATIONS // 4
        state = {
            **state,
            "theta": fit.theta,
            "damping": fit.damping,
            "iteration": state["iteration"] + 1,
            "held": held,
            "peeked": True,
            "residual": fit.residual if held or view is windows else np.empty(0),
        }
        return self._next(state, windows) if _known(state) else state

    def _linearise(self, state: State, windows: Windows) -> tuple[Linearisation, bool, float]:
        """Linearisation at the state's point, whether part of it is of an earlier one, and the drift of that part."""
        theta, starts, jacobian, n = state["theta"], state["starts"], state["jacobian"], windows.num_theta
        size = state["theta_step"]
        residual = state["residual"] if state["residual"].size else None
        if not jacobian.size or not np.isfinite(state["drift"]) or not state["keep_starts"]:
            return windows.linearise(theta, starts, residual=residual, theta_step=size), False, 0.0
        if not state["moved"]:
            return Linearisation(state["residual"], jacobian, True), state["drift"] > 0, state["drift"]
        found = windows.linearise(theta, starts, with_starts=False, residual=residual, theta_step=size)
        both = np.concatenate([found.jacobian, jacobian[..., n:]], axis=-1)
        return replace(found, jacobian=both), True, state["drift"]

    def _next(self, state: State, windows: Windows) -> State:
        """Turn to the next starting point, or end."""
        point = state["point"] + 1
        more = point < len(state["points"])
        fresh = _begin(windows, state["points"][point]) if more else {}
        return {**state, "point": min(point, len(state["points"]) - 1), **fresh, "done": not more}

    def _finish(
        self,
        state: State,
        windows: Windows,
        moments: Moments,
        noise: Noise,
        theta: FloatArray,
        starts: FloatArray,
        jacobian: FloatArray,
    ) -> State:
        """Record the optimum at the last linearisation and turn to the next starting point."""
        prior, pull = self.quadratic_prior, -windows.start_precision * starts
        arrow = eliminate(moments.normal(noise), moments.num_theta, windows.start_precision, pull)
        everything = replace(pulls(windows, prior, theta, starts, arrow.gradient), free=np.full(len(theta), True))
        prior_energy = prior.energy(theta) + 0.5 * float((starts**2 @ windows.start_precision).sum())
        evidence = restricted(moments, noise, everything) - prior_energy
        here = pulls(windows, prior, theta, starts, arrow.gradient)
        white = noise.sd
        if self.likelihood.noise == "sandwich":
            noise = _noise(windows, moments, noise, theta, starts, prior, coloured=True)
        mean, covariance = np.zeros(len(theta)), np.zeros((len(theta), len(theta)))
        centres = []
        for weight, point in noise_cloud(moments, noise, here, free_noise(windows), longest_tau(windows)):
            if self.likelihood.noise == "sandwich":
                middle = sandwich(jacobian, arrow.start_slope, white, windows.sequences, point)
                centre, spread = self.normal(theta, *_sandwiched(arrow, middle))
            else:
                point = _beyond_rounding(windows, point)
                inner = eliminate(moments.normal(point), moments.num_theta, windows.start_precision, pull)
                centre, spread = self.normal(theta, inner.precision, inner.gradient)
            mean += weight * centre
            covariance += weight * spread
            centres.append((weight, centre))
        for weight, centre in centres:
            covariance += weight * np.outer(centre - mean, centre - mean)
        searched = Noise(white, np.zeros(len(white))) if self.likelihood.noise == "sandwich" else noise
        around = self._around(windows, theta, searched, covariance)
        if around is not None:
            covariance = around.covariance
        elif state["polls"]:  # the budget ends: at least as wide as the optimum before, which this one betters
            covariance = covariance + state["mode_covariance"][-1]
        found = {
            "theta": theta,
            "starts": starts,
            "slope": arrow.start_slope,
            "mean": mean,
            "covariance": covariance,
            "sd": noise.sd,
            "tau": noise.tau,
            "evidence": np.array(evidence),
        }
        further = None if state["centred"] else self._middle(windows, theta, starts, noise, mean, covariance)
        if further is not None:
            return {**state, "theta": further, "centred": True, "moved": True, **_AFRESH}
        before = len(state["mode_evidence"]) - (state["polls"] > 0)  # an optimum that a poll has bettered is none
        modes = {f"mode_{k}": np.concatenate([state[f"mode_{k}"][:before], v[None]]) for k, v in found.items()}
        state, polls = {**state, **modes}, state["polls"]
        if around is not None and around.other is not None and len(state["points"]) < _MOST_POINTS:
            state = {**state, "points": np.concatenate([state["points"], around.other[None]])}
        if around is None or around.better is None or polls >= _MOST_POLLS:
            return self._next(state, windows)
        size = min(state["theta_step"], max(float(np.abs(around.better - theta).max()), SHORTEST))
        onward = {"theta": around.better, "theta_step": size, "polls": polls + 1, "iteration": 0, "moved": True}
        return {**state, **onward, **_AFRESH}

    def _around(self, windows: Windows, theta: FloatArray, noise: Noise, covariance: FloatArray) -> Around | None:
        """What a poll finds around an optimum; None where starts are searched too, or the budget leaves no room."""
        if windows.num_start:
            return None
        if windows.rollouts + cost(len(theta)) * len(windows.trajectories) >= windows.budget:
            self.warn(
                "the budget left no room to look around the optimum: where contact is rough, the intervals may be too narrow"
            )
            return None
        starts, prior = windows.no_starts(), self.quadratic_prior

        def energies(thetas: FloatArray) -> FloatArray:
            residual, valid = windows.residuals(thetas, np.tile(starts, (len(thetas), 1, 1)))
            values = [energy_of(windows, noise, prior, t, starts, r) for t, r in zip(thetas, residual, strict=True)]
            return np.where(valid, values, np.inf)

        return poll(energies, theta, covariance)

    def _middle(
        self,
        windows: Windows,
        theta: FloatArray,
        starts: FloatArray,
        noise: Noise,
        mean: FloatArray,
        covariance: FloatArray,
    ) -> FloatArray | None:
        """Where the search goes on: the middle of a ridge, so that the width across it is that of its middle wherever the
        search began; None where no direction is open or the middle does not fit as well."""
        eigenvalues, axes = np.linalg.eigh(covariance)
        open_axes = axes[:, eigenvalues > _OPEN**2]
        move = open_axes @ (open_axes.T @ (mean - theta))
        if not len(move) or np.abs(move).max() < _OFF_CENTRE:
            return None
        prior = self.quadratic_prior
        trials = np.clip(theta + np.array([0.0, 1.0, 0.5, 0.25])[:, None] * move, 0, 1)
        residual, valid = windows.residuals(trials, np.tile(starts, (len(trials), 1, 1)))
        values = [energy_of(windows, noise, prior, t, starts, r) for t, r in zip(trials, residual, strict=True)]
        good = [k for k in range(1, len(trials)) if valid[k] and values[k] < values[0] + _AS_GOOD]
        return trials[good[0]] if good else None

    def posterior(self, state: State, trajectories: Trajectories) -> GaussianMixture:
        if not len(state["mode_theta"]):
            raise ValueError(
                f"budget: {self.budget} rollouts were not enough for one optimum; "
                f"one step takes {self._cost(trajectories)} rollouts, so raise the budget"
            )
        means, covariances, evidence = [], [], []
        kept = distinct_modes(state)
        for m in kept:
            means.append(state["mode_mean"][m])
            covariances.append(state["mode_covariance"][m])
            evidence.append(state["mode_evidence"][m])
        self.diagnostics = {
            "modes": len(kept),
            "noise_sd": state["mode_sd"][kept[0]].tolist(),
            "noise_tau": state["mode_tau"][kept[0]].tolist(),
        }
        if "mode_process" in state:
            self.diagnostics["process_noise"] = state["mode_process"][kept[0]].tolist()
        if len(kept) > 1:
            self.warn(f"the search found {len(kept)} separate optima; the posterior is a mixture of them")
        weights = torch.tensor(np.array(evidence) - np.max(evidence))
        return GaussianMixture(weights, np.stack(means), np.stack(covariances), self.space)

    def normal(self, theta: FloatArray, precision: FloatArray, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance, before truncation, of the quadratic model of data and prior at theta."""
        prior = self.quadratic_prior
        covariance = _inverse(precision + prior.precision + FLAT_PRECISION * np.eye(len(theta)))
        pull = gradient + prior.pull(theta) + FLAT_PRECISION * (0.5 - theta)
        return theta + covariance @ pull, 0.5 * (covariance + covariance.T)

    def information(self) -> tuple[FloatArray, FloatArray]:
        """Optimum (N,), perhaps outside the cube, and information (N, N) of the data alone, after ``fit``."""
        if self._state is None or not len(self._state["mode_theta"]):
            raise ValueError("information: nothing has been fitted yet; call fit first")
        best, prior = distinct_modes(self._state)[0], self.quadratic_prior
        mean, total = self._state["mode_mean"][best], np.linalg.inv(self._state["mode_covariance"][best])
        flat = FLAT_PRECISION * np.eye(len(mean))
        eigenvalues, axes = np.linalg.eigh(total - prior.precision - flat)
        information = (axes * np.maximum(eigenvalues, 0.0)) @ axes.T
        right = total @ mean - prior.precision @ prior.mean - flat @ np.full(len(mean), 0.5)
        return np.linalg.pinv(information, rcond=1e-9, hermitian=True) @ right, information

    def _cost(self, trajectories: Trajectories) -> int:
        windows = self.windows(trajectories)
        return (windows.num_theta + windows.num_start + 2) * len(trajectories)


def _inverse(precision: FloatArray) -> FloatArray:
    """Positive definite also where rounding leaves a precision that is not, between parameters that do the same."""
    sd = 1 / np.sqrt(np.diag(precision))
    eigenvalues, axes = np.linalg.eigh(sd[:, None] * precision * sd)
    return sd[:, None] * ((axes / np.maximum(eigenvalues, _LEAST_EIGENVALUE)) @ axes.T) * sd


def _sandwiched(arrow: Arrow, middle: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Precision and gradient of plain least squares when the residuals' covariance gives ``middle``."""
    shift = np.linalg.pinv(arrow.precision, rcond=1e-12, hermitian=True) @ arrow.gradient
    precision = arrow.precision @ np.linalg.pinv(middle, rcond=1e-12, hermitian=True) @ arrow.precision
    return precision, precision @ shift


def screen(estimator: Laplace, windows: Windows, trajectories: Trajectories) -> FloatArray:
    """Starting points (R, N): the model as given and the best of ``candidates``, by their plain residuals.

    From ``_MANY`` candidates on, only the first 40 % are drawn from the prior, the others in ten generations from a normal around
    the best ones so far: the cross-entropy method, which finds the narrow valleys that contact leaves. Raises ValueError when every
    one of the first diverges."""
    generator, count = torch.Generator().manual_seed(estimator.seed), estimator.candidates
    later: list[int] = np.diff(np.linspace(2 * count // 5, count, 11).astype(int)).tolist() if count >= _MANY else []
    draws = estimator.prior.sample((count - sum(later),), generator=generator).numpy()
    points = np.concatenate([estimator.space.default_theta[None], draws])
    loss = _plain_loss(windows, points)
    if not np.isfinite(loss).any():
        raise ValueError(
            f"every one of {len(points)} starting points diverges in the simulation; narrow the bounds, "
            "shorten the model's timestep or the window"
        )
    rng = np.random.default_rng([estimator.seed, 1])
    for size in later:
        best = points[_by_loss(loss)[:_ELITE]]
        drawn = best.mean(0) + (best.std(0) + _LEAST_SPREAD) * rng.standard_normal((size, points.shape[1]))
        points = np.concatenate([points, np.clip(drawn, 0.0, 1.0)])
        loss = np.concatenate([loss, _plain_loss(windows, points[-size:])])
    chosen = _by_loss(loss)
    if np.isfinite(loss[0]):
        chosen = np.concatenate([[0], chosen[chosen != 0]])
    else:
        estimator.warn("the model as given diverges on these logs; the search started elsewhere")
    return points[chosen[: estimator.restarts]]


def _plain_loss(windows: Windows, points: FloatArray) -> FloatArray:
    """Squared residuals (B,) of points (B, N), in units of each channel's spread; infinite where a simulation diverges."""
    residual, valid = windows.residuals(points, np.tile(windows.no_starts(), (len(points), 1, 1, 1)))
    spread = np.maximum(np.nanstd(np.where(windows.observed, windows.measured, np.nan), axis=(0, 1)), 1e-12)
    return np.where(valid, ((residual / spread) ** 2).sum((1, 2, 3)), np.inf)


def _by_loss(loss: FloatArray) -> NDArray[np.int64]:
    """Places of the finite ones, the least first."""
    return np.argsort(loss, kind="stable")[: int(np.isfinite(loss).sum())]


def _begin(windows: Windows, theta: FloatArray) -> State:
    """A search that starts at theta, with a first guess of white noise."""
    fixed = fixed_sd(windows)
    spread = np.nanstd(np.where(windows.observed, windows.measured, np.nan), axis=(0, 1))
    sd = np.where(np.isnan(fixed), np.maximum(0.1 * spread, 1e-9), fixed)
    return {
        "theta": theta,
        "starts": windows.no_starts(),
        "damping": 1e-4,
        "sd": sd,
        "tau": np.zeros(len(sd)),
        "iteration": 0,
        "held": windows.starts_measured,
        "peeked": False,
        "rough": True,
        "due": False,
        "residual": np.empty(0),
        "jacobian": np.empty(0),
        "drift": 0.0,
        "keep_starts": False,
        "moved": True,
        "centred": False,
        "polls": 0,
        "theta_step": windows.theta_step,
    }


def fixed_sd(windows: Windows) -> FloatArray:
    """Given noise sd (C,) of the fitted channels, NaN where it is estimated."""
    given = windows.settings.noise_sd
    if given is None:
        return np.full(len(windows.channels), np.nan)
    return np.array([np.nan if given[c] is None else given[c] for c in windows.channels], float)


def pulls(windows: Windows, prior: QuadraticPrior, theta: FloatArray, starts: FloatArray, force: FloatArray) -> Pulls:
    """Prior and bounds at (theta, starts); ``force`` (N,): the data's pull on theta, which holds it at a bound."""
    flat = FLAT_PRECISION * np.eye(len(theta))
    total = force + prior.pull(theta)
    held = ((theta <= 0) & (total < 0)) | ((theta >= 1) & (total > 0))
    return Pulls(
        prior.precision + flat,
        prior.pull(theta),
        windows.start_precision,
        -windows.start_precision * starts,
        ~held,
    )


def _present_noise(windows: Windows, residual: FloatArray) -> Noise:
    """White noise with the root-mean-square of a residual (W, L, C), or the given sds."""
    fixed, counts = fixed_sd(windows), windows.observed.sum(axis=(0, 1))
    size = np.sqrt((residual**2).sum(axis=(0, 1)) / np.maximum(counts, 1))
    return Noise(np.where(np.isnan(fixed), np.maximum(size, windows.rounding), fixed), np.zeros(len(size)))


def _noise(
    windows: Windows,
    moments: Moments,
    before: Noise,
    theta: FloatArray,
    starts: FloatArray,
    prior: QuadraticPrior,
    coloured: bool,
) -> Noise:
    start_pull = -windows.start_precision * starts
    arrow = eliminate(moments.normal(before), moments.num_theta, windows.start_precision, start_pull)
    context = pulls(windows, prior, theta, starts, arrow.gradient)
    shortest, longest = float(windows.dt.min()), longest_tau(windows)
    found = estimate_noise(moments, before, context, fixed_sd(windows), coloured, shortest, longest)
    sd = np.where(np.isnan(fixed_sd(windows)), np.maximum(found.sd, windows.rounding), found.sd)
    return Noise(sd, found.tau)


def _beyond_rounding(windows: Windows, noise: Noise) -> Noise:
    """The noise with channels at the least sd, the simulation's rounding, as if they were one sample."""
    least, counts = windows.rounding * (1 + _SAME_NOISE), windows.observed.sum(axis=(0, 1))
    least = np.where(np.isnan(fixed_sd(windows)), least, 0.0)
    return Noise(np.where(noise.sd <= least, noise.sd * np.sqrt(np.maximum(counts, 1)), noise.sd), noise.tau)


def free_noise(windows: Windows) -> NDArray[np.int64]:
    """Which of (log sd (C), log tau (C)) are unknown; none of a chain of states, whose noise stays at its optimum."""
    if isinstance(windows, Chain):
        return np.empty(0, int)
    free = np.isnan(fixed_sd(windows))
    return np.flatnonzero(np.concatenate([free, np.full(len(free), windows.settings.noise != "white")]))


def longest_tau(windows: Windows) -> float:
    """The longest correlation time that the logs could show: the longest log's duration."""
    return float((windows.trajectories.length * windows.trajectories.dt).max())


def _same(a: Noise, b: Noise) -> bool:
    return bool(np.allclose(a.sd, b.sd, rtol=_SAME_NOISE) and np.allclose(a.tau, b.tau, rtol=3 * _SAME_NOISE))


def distinct_modes(state: State) -> list[int]:
    """Optima worth keeping, best first: within ``_DROP`` nats of the best, and not the same point twice."""
    order = np.argsort(-state["mode_evidence"], kind="stable")
    kept: list[int] = []
    for m in order:
        if state["mode_evidence"][m] < state["mode_evidence"][order[0]] - _DROP:
            continue
        if not any(_close(state, int(m), k) for k in kept):
            kept.append(int(m))
    return kept


def _foretold(fit: Fit) -> bool:
    """Whether a step gained what the linearisation foretold, to a fifth."""
    return abs(fit.gained - fit.expected) < _FAIR * max(fit.expected, _TOLERANCE)


def _known(state: State) -> bool:
    """Whether the search has come to one of the optima found earlier: in each principal direction of its normal within
    one sd, or within a tenth of the way that it had to come."""
    begin = state["points"][state["point"]]
    for mean, covariance in zip(state["mode_mean"], state["mode_covariance"], strict=True):
        eigenvalues, axes = np.linalg.eigh(covariance)
        sd = np.sqrt(eigenvalues)
        left, whole = np.abs((state["theta"] - mean) @ axes) / sd, np.abs((begin - mean) @ axes) / sd
        if (left < np.maximum(1.0, _NEAR * whole)).all():
            return True
    return False


def _close(state: State, a: int, b: int) -> bool:
    """Whether optimum b's normal holds optimum a well inside it."""
    gap = state["mode_mean"][a] - state["mode_mean"][b]
    return bool(gap @ np.linalg.solve(state["mode_covariance"][b], gap) < len(gap))
