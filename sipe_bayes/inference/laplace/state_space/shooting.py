"""A trajectory through contacts by multiple shooting: windows without process noise, twice as long each time.

A smoother changes all states at once, and one stiff impact refuses the step of the whole log; process noise then takes
what is left, with an estimate in a wrong valley of the trajectory. Short windows with free starts meet in theta alone,
so that each takes as much of a step as serves it best, and an impact that is missed holds back its own window. Fitted,
two of them foretell where a window twice as long starts, until whole logs follow without process noise (H. G. Bock,
"Recent advances in parameter identification techniques for ODE", 1983,
https://doi.org/10.1007/978-1-4684-7324-7_7). The beginnings of the windows grow as ``growing_windows`` has it.

A window that begins on the wrong side of a contact has no slope towards the right one, and its residual, tens of noise
sds, would take theta anywhere. So the starts of such a window are sought by draws, each round of them about the best
until then and over several scales, as an evolution strategy does; what still does not follow has no say in theta.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.laplace.state_space.noise import roughness
from sipe_bayes.inference.laplace.state_space.options import ShootingTuning
from sipe_bayes.inference.laplace.state_space.smoother import ChainPoint
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.inference.laplace.windows.growing_windows import counted, grown, level
from sipe_bayes.inference.laplace.windows.state import Phase, Position
from sipe_bayes.likelihood.binding import bind
from sipe_bayes.likelihood.settings import BudgetExhausted, Segments
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.windows import Windows


def shot(
    problem: SearchProblem, chain: Chain, theta: FloatArray, states: list[FloatArray], budget: float
) -> ChainPoint | None:
    """Theta and states where the longest windows that follow the logs end, from theta (N,).

    Each window begins at the one of ``states``, (K, S) each, that it follows best from.

    None where none follows them, or ``budget``, rollouts for all of it, ends first.
    """
    tuning = problem.options.tuning
    shooting = tuning.state_space.shooting
    horizon, best, least = shooting.first, None, np.inf
    limit = chain.rollouts + budget
    logs = Trajectories.stack([replace(t, states=None) for t in chain.trajectories])
    rng = np.random.default_rng([problem.seed, 3])
    for seconds in _lengths(chain, shooting.window):
        settings = Segments(seconds, "white", chain.settings.fit, chain.settings.noise_sd)
        windows = bind(settings, chain.simulator, logs)
        windows.budget = limit - chain.rollouts
        try:
            windows.reference = _best_starts(windows, theta, [one[_rows(chain, windows)] for one in states])
            here = Position.at(windows, theta, tuning.damping)
            here = replace(here, horizon=min(horizon, int(windows.steps.max())))
            for _ in range(shooting.rounds):
                here = replace(here, starts=_sought(chain, windows, here, shooting, rng))
                follows = _misfits(windows, here.theta, here.starts[None])[0] <= shooting.lost
                here = _descended(problem, windows, here, follows)
                follows = _misfits(windows, here.theta, here.starts[None])[0] <= shooting.lost
                if follows.all():
                    break
            simulated, misfit = _simulated(chain, windows, here)
        except BudgetExhausted:
            return best
        finally:
            chain.rollouts += math.ceil(windows.rollouts)
        if misfit > least * (shooting.follows if follows.all() else 1.0):
            return best  # chaos: longer ones follow no more
        theta, horizon, least = here.theta, int(windows.steps.max()), min(misfit, least)
        best, states = ChainPoint(theta, simulated), [*states, simulated]
    return best


def _descended(problem: SearchProblem, windows: Windows, here: Position, follows: BoolArray) -> Position:
    """Where theta and the starts of those windows (W,) that follow end, on beginnings that grow."""
    tuning, keep = problem.options.tuning, np.flatnonzero(follows)
    if not len(keep):
        return here
    part = windows if follows.all() else windows.part(keep)
    at = replace(here, phase=Phase.GROW, starts=here.starts[keep], damping=tuning.damping.first, iteration=0)
    while at.phase is Phase.GROW:
        at = grown(windows, part, problem.quadratic_prior, at, tuning.growing, tuning.damping)
    starts = here.starts.copy()
    starts[keep] = at.starts
    return replace(here, theta=at.theta, starts=starts, horizon=at.horizon)


def _sought(
    chain: Chain, windows: Windows, here: Position, tuning: ShootingTuning, rng: np.random.Generator
) -> FloatArray:
    """Starts (W, D) of the windows, those that do not follow replaced by draws that follow better."""
    starts, scale = here.starts.copy(), _scale(chain)
    misfit = _misfits(windows, here.theta, starts[None])[0]
    most = windows.rollouts + tuning.most_drawn
    for _ in range(tuning.draw_rounds):
        lost = np.flatnonzero(misfit > tuning.lost)
        if not len(lost) or windows.rollouts > most:
            break
        part, before = windows.part(lost), windows.rollouts
        part.rollouts, part.budget = before, windows.budget
        widths = 10.0 ** rng.uniform(*tuning.decades, (tuning.draws, len(lost), 1))
        tried = starts[lost] + widths * scale * rng.standard_normal((tuning.draws, len(lost), len(scale)))
        misfits = _misfits(part, here.theta, tried)
        counted(windows, part, before)
        best, each = misfits.argmin(0), np.arange(len(lost))
        better = misfits[best, each] < misfit[lost]
        starts[lost[better]] = tried[best, each][better]
        misfit[lost] = np.minimum(misfit[lost], misfits[best, each])
    return starts


def _scale(chain: Chain) -> FloatArray:
    """How far off (D,) a start may be: the noise of what measures a coordinate, else its movement in a control step."""
    scale, rough = chain.movement(chain.reference), roughness(chain)
    for channel, coordinate in enumerate(chain.coordinates):
        if coordinate is not None:
            scale[coordinate] = max(rough[channel], chain.least[0][channel])
    return scale


def _misfits(windows: Windows, theta: FloatArray, starts: FloatArray) -> FloatArray:
    """Root mean squares (B, W) of the windows' residuals in noise sds, at theta (N,) and starts (B, W, D)."""
    predicted, _ = windows.predict(np.tile(theta, (len(starts), 1)), starts)
    residual = np.where(windows.observed, (windows.measured - predicted) / level(windows).sd, 0.0)
    squares = (residual**2).sum((2, 3)) / np.maximum(windows.observed.sum((1, 2)), 1)
    return np.sqrt(np.where(np.isfinite(squares), squares, np.inf))


def _lengths(chain: Chain, first: int) -> Iterator[float | None]:
    """Seconds of the windows; at last None: whole logs."""
    seconds = first * float(chain.trajectories.dt.max())
    while seconds < float((chain.trajectories.length * chain.trajectories.dt).min()):
        yield seconds
        seconds *= 2
    yield None


def _rows(chain: Chain, windows: Windows) -> FloatArray:
    """Number (W,) of the chain's state where each window starts."""
    return np.asarray(np.flatnonzero(chain.first)[windows.log] + windows.start)


def _best_starts(windows: Windows, theta: FloatArray, states: list[FloatArray]) -> FloatArray:
    """Of first states (W, S) of the windows, for each window those from which a simulation follows it best."""
    squares, scale = [], level(windows).sd
    for one in states:
        windows.reference = one
        predicted, _ = windows.predict(theta[None], windows.no_starts()[None])
        square = np.where(windows.observed, ((windows.measured - predicted[0]) / scale) ** 2, 0.0).sum((1, 2))
        squares.append(np.where(np.isfinite(square), square, np.inf))
    best = np.argmin(squares, axis=0)
    return np.stack(states)[best, np.arange(len(best))]


def _simulated(chain: Chain, windows: Windows, here: Position) -> tuple[FloatArray, float]:
    """The chain's states (K, S) on the windows' simulations, and the worst channel's residual in noise sds."""
    windows.spend(1)
    thetas = np.tile(here.theta, (windows.num_windows, 1))
    begin = windows.states(here.theta[None], here.starts[None])[0]
    rollout = chain.simulator.rollout(thetas, windows.actions, begin, windows.dt, windows.names, goals=windows.goals)
    assert rollout.states is not None
    residual, valid = windows.residuals(here.theta[None], here.starts[None])
    if not valid[0]:
        return chain.reference, np.inf
    w, place = np.nonzero(windows.owned)
    at = _rows(chain, windows)[w] + place
    states = chain.reference.copy()
    states[at] = chain.moved(chain.reference[at], chain.difference(rollout.states[w, place], chain.reference[at]))
    squares = (residual[0] / level(windows).sd) ** 2
    return states, float(np.sqrt(squares.sum((0, 1)) / windows.observed.sum((0, 1))).max())
