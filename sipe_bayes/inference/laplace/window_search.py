"""What ``laplace`` does step by step with windows: from starting point to recorded optimum, in a flat state.

Simulations are what a fit costs, so they are spared where they add nothing. Where the log tells the windows' starts, theta
moves alone first, on every other window, until a step gains little. The Jacobian of the starts is kept as long as it foretells the gain of a step
to a fifth; an optimum is only accepted where what was foretold since it was taken is wrong by less than half a nat. A later starting point is dropped once
the search has all but come to an optimum that is already known.

Where a direction is open (a ridge), the search goes on once from its middle, since the width across a ridge may differ from
place to place, and the place would otherwise be an accident of the start.

An optimum at which differences have been too short to see what a parameter does (a delay below two physics steps) is searched on with longer ones.

Where the starts are recorded and theta alone is searched, points around each optimum are tried as well (``poll``), and the search
goes on from a better one, with finite differences no longer than the way there. The normal that is left is no narrower than the
shortest of these ways, and holds the points that fit as well as the optimum, whatever the curvature says; one that fits as
well but lies beyond worse ones becomes a further starting point. Where already the shortest way leads to a far worse fit, the optimum is a stroke
of luck: then its neighbours say how large the noise is and what fits as well, and a warning says so.

Where theta alone is searched and the budget ends before the first optimum, what is kept of it is spent on such a look at the best point so far.
Of that, of an optimum where no step found the gain that its linearisation foretold, and of one that is a stroke of luck, the normal says
nothing; its sd is guessed: the way from the starting point (root mean square over theta), times the share of the first misfit that is left, as a misfit that is theta's shrinks with
the distance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from sipe_bayes.core.checkpoint import State
from sipe_bayes.inference.laplace.least_squares import Fit, QuadraticPrior, energy_of
from sipe_bayes.inference.laplace.least_squares import step as descend
from sipe_bayes.inference.laplace.optima import Search, known
from sipe_bayes.inference.laplace.poll import SHORTEST, Around, cost, nearest, poll
from sipe_bayes.inference.laplace.window_noise import (
    beyond_rounding,
    free_noise,
    louder,
    present_noise,
    pulls,
    same_noise,
    updated_noise,
)
from sipe_bayes.likelihood.block_tridiagonal import Eliminated
from sipe_bayes.likelihood.moments import Moments
from sipe_bayes.likelihood.noise import Noise
from sipe_bayes.likelihood.noise_spread import noise_cloud, sandwich
from sipe_bayes.likelihood.restricted import eliminate_starts, restricted
from sipe_bayes.likelihood.settings import BudgetExhausted
from sipe_bayes.likelihood.windows import Linearisation, Windows

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_MANY, _ELITE, _LEAST_SPREAD = 40, 6, 1e-3  # candidates; how many of the best lead on; sd, in the cube
_TOLERANCE = 0.02  # nats
_ROUGH = 1e-4  # of the energy
_MAX_ITERATIONS = 80
_HALF, _LITTLE = 0.5, 0.1  # of the energy: gains below which the starts move along, as foretold or not
_FAIR, _DRIFT = 0.2, 0.5  # how well the starts' Jacobian must foretell gains: relative, nats in all
_OPEN, _OFF_CENTRE, _AS_GOOD = 0.5, 0.1, 2.0  # sd of an open direction, distance from its middle, nats
_MOST_POLLS = 20  # looks around that lead on from one starting point
_STILL = 1e-9  # of the largest spread of a channel: one below it does not move
_TRIALS = 10  # rollouts of a step beside its linearisation
_MOST_POINTS = 10  # starting points, with those found on the way
_AFRESH = {"residual": np.empty(0), "jacobian": np.empty(0), "drift": 0.0, "due": False, "damping": 1e-4}


def start(search: Search, windows: Windows) -> State:
    """The first state of a fit."""
    starts = screen(search, windows) if search.initial is None else search.initial
    n, w, d, c = len(search.space), windows.num_windows, windows.num_start, len(windows.channels)
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
        "mode_guessed": np.empty(0, bool),
        "mode_reason": [],
    }


def screen(search: Search, windows: Windows) -> FloatArray:
    """Starting points (R, N): the model as given and the best of ``candidates``, by their plain residuals.

    From ``_MANY`` candidates on, only the first 40 % are drawn from the prior, the others in ten generations from a normal around
    the best ones so far: the cross-entropy method, which finds the narrow valleys that contact leaves. Raises ValueError when every
    one of the first diverges."""
    generator, count = torch.Generator().manual_seed(search.seed), search.candidates
    later: list[int] = np.diff(np.linspace(2 * count // 5, count, 11).astype(int)).tolist() if count >= _MANY else []
    draws = search.prior.sample((count - sum(later),), generator=generator).numpy()
    points = np.concatenate([search.space.default_theta[None], draws])
    loss = _plain_loss(windows, points)
    if not np.isfinite(loss).any():
        raise ValueError(
            f"every one of {len(points)} starting points diverges in the simulation; narrow the bounds, "
            "shorten the model's timestep or the window"
        )
    rng = np.random.default_rng([search.seed, 1])
    for size in later:
        best = points[_by_loss(loss)[:_ELITE]]
        drawn = best.mean(0) + (best.std(0) + _LEAST_SPREAD) * rng.standard_normal((size, points.shape[1]))
        points = np.concatenate([points, np.clip(drawn, 0.0, 1.0)])
        loss = np.concatenate([loss, _plain_loss(windows, points[-size:])])
    chosen = _by_loss(loss)
    if np.isfinite(loss[0]):
        chosen = np.concatenate([[0], chosen[chosen != 0]])
    else:
        search.warn("the model as given diverges on these logs; the search started elsewhere")
    return points[chosen[: search.restarts]]


def _plain_loss(windows: Windows, points: FloatArray) -> FloatArray:
    """Squared residuals (B,) of points (B, N), in units of each channel's spread; infinite where a simulation diverges."""
    residual, valid = windows.residuals(points, np.tile(windows.no_starts(), (len(points), 1, 1, 1)))
    spread = np.maximum(np.nanstd(np.where(windows.observed, windows.measured, np.nan), axis=(0, 1)), 1e-12)
    return np.where(valid, ((residual / spread) ** 2).sum((1, 2, 3)), np.inf)


def _misfit(windows: Windows, residual: FloatArray) -> float:
    """Root mean square of residuals (W, L, C), in units of the spread of each channel that has one."""
    spread = np.nanstd(np.where(windows.observed, windows.measured, np.nan), axis=(0, 1))
    moves = spread > _STILL * spread.max()
    size = np.where(moves, spread, np.inf) if moves.any() else np.ones_like(spread)
    return float(np.sqrt(((residual / size)[windows.observed] ** 2).mean())) or 1e-300


def _by_loss(loss: FloatArray) -> NDArray[np.int64]:
    """Places of the finite ones, the least first."""
    return np.argsort(loss, kind="stable")[: int(np.isfinite(loss).sum())]


def _begin(windows: Windows, theta: FloatArray) -> State:
    """A search that starts at theta, with a first guess of white noise."""
    fixed = windows.fixed_sd
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
        "misfit": 0.0,
        "theta_step": windows.theta_step,
        "long": False,
    }


def step(search: Search, windows: Windows, state: State) -> State:
    """One linearisation and one accepted step of theta and starts; at an optimum, the noise is estimated anew.

    Rough search first: white noise with the sd of the present residuals, to a relative tolerance."""
    prior = search.quadratic_prior
    if state["held"]:
        return _held_step(windows, state, prior)
    theta, starts, rough = state["theta"], state["starts"], state["rough"]
    linearisation, stale, drift = _linearise(windows, state)
    if not linearisation.valid and state["peeked"]:  # every other window went well, but not all
        begin = _begin(windows, state["points"][state["point"]])
        return {**state, **begin, "held": False, "peeked": False}
    white = windows.settings.noise == "white"
    moments = windows.moments(linearisation, white=rough or white)
    noise = before = Noise(state["sd"], state["tau"])
    if rough:
        noise = present_noise(windows, linearisation.residual)
    elif state["due"]:
        noise = updated_noise(windows, moments, before, theta, starts, prior, windows.settings.noise == "ar1")
    value = energy_of(windows, noise, prior, theta, starts, linearisation.residual)
    tolerance = max(_ROUGH * value, _TOLERANCE) if rough else _TOLERANCE
    here = Fit(theta, starts, value, state["damping"], residual=linearisation.residual)
    unrecorded = not windows.num_start and not len(state["mode_evidence"])
    try:
        fit = descend(windows, noise, prior, here, moments, tolerance, stale)
    except BudgetExhausted:
        if not unrecorded:
            raise
        fit = here
    drift = drift + abs(fit.gained - fit.expected)
    converged = fit.converged and drift < _DRIFT
    iteration = state["iteration"] + 1
    # where theta does not move for the noise that is best there, both are
    best_of_both = not fit.gained or same_noise(noise, before)
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
        "misfit": state["misfit"] or _misfit(windows, linearisation.residual),
    }
    ends = unrecorded and (fit is here or _ends(windows, len(theta)))
    if settled or iteration >= _MAX_ITERATIONS or ends:
        reason = ""
        if ends and not settled:
            reason = (
                "the budget ended before the search had settled: the estimate is the best so far, and its intervals are guessed from the way "
                "it has come; raise the budget"
            )
        elif not settled:
            reason = f"the search had not settled after {iteration} steps: look at the residuals before you trust the intervals"
        elif fit.refused > _DRIFT:
            reason = (
                f"at the optimum the linearisation still foretold a gain of {fit.refused:.1f} nats that no step found: the "
                "simulation is not smooth there (friction, contact or delay); compare with mcmc before you trust the intervals"
            )
        moments = windows.moments(linearisation) if rough and not white else moments
        left, gone = _misfit(windows, linearisation.residual) / state["misfit"], theta - state["points"][state["point"]]
        guess = float(np.sqrt((gone**2).mean())) * min(1.0, left)
        doubtful = not windows.num_start and ((ends and not settled) or fit.refused > _DRIFT)
        return _finish(
            search,
            windows,
            state,
            _Optimum(theta, starts, noise, moments, linearisation.jacobian, guess, doubtful, reason),
        )
    return _next(windows, state) if not (state["polls"] or state["long"]) and known(state) else state


def _held_step(windows: Windows, state: State, prior: QuadraticPrior) -> State:
    """A step of theta alone, the starts as the log tells them, on every other window; near the optimum the search goes
    on with all."""
    view, theta = windows.glimpse(), state["theta"]
    before = view.rollouts
    found = view.linearise(
        theta,
        view.no_starts(),
        with_starts=False,
        residual=state["residual"] if state["residual"].size else None,
        theta_step=view.theta_step,
    )
    still = np.zeros((*found.residual.shape, windows.num_start))
    found = replace(found, jacobian=np.concatenate([found.jacobian, still], axis=-1))
    noise = present_noise(view, found.residual)
    value = energy_of(view, noise, prior, theta, view.no_starts(), found.residual)
    here = Fit(theta, view.no_starts(), value, state["damping"], residual=found.residual)
    fit = descend(view, noise, prior, here, view.moments(found, white=True), max(_ROUGH * value, _TOLERANCE))
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
        "misfit": state["misfit"] or _misfit(view, found.residual),
        "residual": fit.residual if held or view is windows else np.empty(0),
    }
    return _next(windows, state) if known(state) else state


def _linearise(windows: Windows, state: State) -> tuple[Linearisation, bool, float]:
    """Linearisation at the state's point, whether part of it is of an earlier one, and the drift of that part."""
    theta, starts, jacobian, n = state["theta"], state["starts"], state["jacobian"], windows.num_theta
    size = np.maximum(state["theta_step"], windows.least_steps(theta) if state["long"] else 0.0)
    residual = state["residual"] if state["residual"].size else None
    if not jacobian.size or not np.isfinite(state["drift"]) or not state["keep_starts"]:
        return windows.linearise(theta, starts, residual=residual, theta_step=size), False, 0.0
    if not state["moved"]:
        return Linearisation(state["residual"], jacobian, True), state["drift"] > 0, state["drift"]
    found = windows.linearise(theta, starts, with_starts=False, residual=residual, theta_step=size)
    both = np.concatenate([found.jacobian, jacobian[..., n:]], axis=-1)
    return replace(found, jacobian=both), True, state["drift"]


def _next(windows: Windows, state: State) -> State:
    """Turn to the next starting point, or end."""
    point = state["point"] + 1
    more = point < len(state["points"])
    fresh = _begin(windows, state["points"][point]) if more else {}
    return {**state, "point": min(point, len(state["points"]) - 1), **fresh, "done": not more}


@dataclass(frozen=True)
class _Optimum:
    """Where a search ended: theta (N,), starts (W, D), noise, and the linearisation (W, L, C, N + D) there with its moments; guess: of
    an sd, from the way and the misfit; doubtful: whether the normal says nothing."""

    theta: FloatArray
    starts: FloatArray
    noise: Noise
    moments: Moments
    jacobian: FloatArray
    guess: float
    doubtful: bool
    reason: str


def _summary(search: Search, windows: Windows, optimum: _Optimum) -> State:
    """What is recorded of an optimum: the normal's mean and covariance over the noise's uncertainty, and the evidence."""
    theta, starts, noise, moments = optimum.theta, optimum.starts, optimum.noise, optimum.moments
    prior, pull, sandwiched = search.quadratic_prior, -windows.start_precision * starts, _sandwiches(windows)
    solved = eliminate_starts(moments.normal(noise), moments.num_theta, windows.start_precision, pull)
    here = pulls(windows, prior, theta, starts, solved.gradient)
    prior_energy = prior.energy(theta) + 0.5 * float((starts**2 @ windows.start_precision).sum())
    evidence = restricted(moments, noise, replace(here, free=np.full(len(theta), True))) - prior_energy
    white = noise.sd
    if sandwiched:
        noise = updated_noise(windows, moments, noise, theta, starts, prior, coloured=True)
    mean, covariance = np.zeros(len(theta)), np.zeros((len(theta), len(theta)))
    centres = []
    for weight, point in noise_cloud(moments, noise, here, free_noise(windows), windows.trajectories.longest):
        if sandwiched:
            middle = sandwich(optimum.jacobian, solved.slope, white, windows.sequences, point)
            centre, spread = search.normal(theta, *_sandwiched(solved, middle))
        else:
            point = beyond_rounding(windows, point)
            inner = eliminate_starts(moments.normal(point), moments.num_theta, windows.start_precision, pull)
            centre, spread = search.normal(theta, inner.precision, inner.gradient)
        mean += weight * centre
        covariance += weight * spread
        centres.append((weight, centre))
    for weight, centre in centres:
        covariance += weight * np.outer(centre - mean, centre - mean)
    found = {"theta": theta, "starts": starts, "slope": solved.slope, "mean": mean, "covariance": covariance}
    return {**found, "sd": noise.sd, "tau": noise.tau, "evidence": np.array(evidence)}


def _sandwiches(windows: Windows) -> bool:
    return windows.settings.noise == "sandwich"


def _finish(search: Search, windows: Windows, state: State, optimum: _Optimum) -> State:
    """Record an optimum and turn to the next starting point, or go on from a better or a more central one."""
    theta, found, white = optimum.theta, _summary(search, windows, optimum), optimum.noise
    searched = Noise(white.sd, np.zeros(len(white.sd))) if _sandwiches(windows) else white
    around = _around(search, windows, theta, searched, found["covariance"])
    reason = optimum.reason
    if around is not None:
        found["covariance"] = around.covariance
        if around.rough:
            reason = (
                "the simulation is rough at every scale around the optimum (contact): the intervals hold what fits no worse than its nearest "
                "neighbours, and the search may have missed a better place; compare with npe or bayessim"
            )
    elif not windows.num_start:
        reason = reason or (
            "the budget left no room to look around the optimum: where contact is rough, the intervals may be too narrow"
        )
    if (
        around is None and state["polls"]
    ):  # the budget ends: no narrower than the optimum before, which this one betters
        found["covariance"] = found["covariance"] + state["mode_covariance"][-1]
    found["guessed"] = np.array(optimum.doubtful or (around is not None and around.rough))
    if found["guessed"]:
        found["covariance"] = found["covariance"] + optimum.guess**2 * np.eye(len(theta))
    further = None if state["centred"] else _middle(search, windows, found)
    if further is not None:
        return {**state, "theta": further, "centred": True, "moved": True, **_AFRESH}
    before = len(state["mode_evidence"]) - (state["polls"] > 0 or state["long"])  # one that a poll has bettered is none
    modes = {f"mode_{k}": np.concatenate([state[f"mode_{k}"][:before], v[None]]) for k, v in found.items()}
    state, polls = {**state, **modes, "mode_reason": [*state["mode_reason"][:before], reason]}, state["polls"]
    if not state["long"] and windows.least_steps(theta).any():
        return {**state, "long": True, "moved": True, "iteration": 0, **_AFRESH}
    if around is not None and around.other is not None and len(state["points"]) < _MOST_POINTS:
        state = {**state, "points": np.concatenate([state["points"], around.other[None]])}
    if around is None or around.better is None or polls >= _MOST_POLLS:
        return _next(windows, state)
    size = min(state["theta_step"], max(float(np.abs(around.better - theta).max()), SHORTEST))
    onward = {"theta": around.better, "theta_step": size, "polls": polls + 1, "iteration": 0, "moved": True}
    return {**state, **onward, **_AFRESH}


def _around(search: Search, windows: Windows, theta: FloatArray, noise: Noise, covariance: FloatArray) -> Around | None:
    """What a poll finds around an optimum; None where starts are searched too, or the budget leaves no room."""
    if windows.num_start:
        return None
    if windows.rollouts + cost(len(theta)) * len(windows.trajectories) >= windows.budget:
        return None
    starts, prior = windows.no_starts(), search.quadratic_prior

    def simulated(thetas: FloatArray) -> tuple[FloatArray, BoolArray]:
        return windows.residuals(thetas, np.tile(starts, (len(thetas), 1, 1)))

    near = nearest(theta)
    residual, valid = simulated(near)
    noise = louder(windows, noise, residual[valid])

    def energies(thetas: FloatArray) -> FloatArray:
        residual, valid = simulated(thetas)
        values = [energy_of(windows, noise, prior, t, starts, r) for t, r in zip(thetas, residual, strict=True)]
        return np.where(valid, values, np.inf)

    levels = [energy_of(windows, noise, prior, t, starts, r) for t, r in zip(near[valid], residual[valid], strict=True)]
    return poll(energies, theta, covariance, max(levels) if levels else -np.inf)


def _middle(search: Search, windows: Windows, found: State) -> FloatArray | None:
    """Where the search goes on: the middle of a ridge, so that the width across it is that of its middle wherever the
    search began; None where no direction is open or the middle does not fit as well."""
    theta, starts, noise = found["theta"], found["starts"], Noise(found["sd"], found["tau"])
    eigenvalues, axes = np.linalg.eigh(found["covariance"])
    open_axes = axes[:, eigenvalues > _OPEN**2]
    move = open_axes @ (open_axes.T @ (found["mean"] - theta))
    if not len(move) or np.abs(move).max() < _OFF_CENTRE:
        return None
    prior = search.quadratic_prior
    trials = np.clip(theta + np.array([0.0, 1.0, 0.5, 0.25])[:, None] * move, 0, 1)
    if windows.rollouts + len(trials) * len(windows.trajectories) > windows.budget:
        return None
    residual, valid = windows.residuals(trials, np.tile(starts, (len(trials), 1, 1)))
    values = [energy_of(windows, noise, prior, t, starts, r) for t, r in zip(trials, residual, strict=True)]
    good = [k for k in range(1, len(trials)) if valid[k] and values[k] < values[0] + _AS_GOOD]
    return trials[good[0]] if good else None


def _sandwiched(solved: Eliminated, middle: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Precision and gradient of plain least squares when the residuals' covariance gives ``middle``."""
    shift = np.linalg.pinv(solved.precision, rcond=1e-12, hermitian=True) @ solved.gradient
    precision = solved.precision @ np.linalg.pinv(middle, rcond=1e-12, hermitian=True) @ solved.precision
    # rounding leaves some of an open direction negative
    eigenvalues, axes = np.linalg.eigh(0.5 * (precision + precision.T))
    precision = (axes * np.maximum(eigenvalues, 0.0)) @ axes.T
    return precision, precision @ shift


def _ends(windows: Windows, size: int) -> bool:
    """Whether the budget leaves no room for another step; or, where a look around takes less than half of it, for that as well."""
    each = len(windows.trajectories)
    left, step, look = windows.budget - windows.rollouts, (size + _TRIALS) * each, cost(size) * each
    return left < step or (2 * look < windows.budget and left < step + look)


def _foretold(fit: Fit) -> bool:
    """Whether a step gained what the linearisation foretold, to a fifth."""
    return abs(fit.gained - fit.expected) < _FAIR * max(fit.expected, _TOLERANCE)
