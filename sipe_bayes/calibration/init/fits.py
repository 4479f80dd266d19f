"""What is left of windows when the model's unknowns and the windows' starts may move, for each delay of the commands.

Gauss-Newton on the windows of a ``Trial``: starts are eliminated window by window, unknowns stay within their bounds.
Each delay has values and starts of its own; the slopes are those at the best delay, for all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.optimize

from sipe_bayes.calibration.init.draft import Unknown
from sipe_bayes.calibration.init.trials import Assumption, Trial, spread_of
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.inference.recorded import Tell, silent

_STEP = 0.02  # of the cube, of finite differences
_START_STEP = 1e-4  # rad or m, rad/s or m/s
_PRIOR = 0.4  # sd in the cube of what a model does not know
_LOOSE = 1e-6  # what starts that nothing tells are held by
_ROUNDING = 1e-13  # of a matrix's trace
_LOST = 1e6  # of a simulation that has diverged
_LEAST = 2e-3  # of the motion: noise is taken for no smaller
_SETTLED = 0.02  # of the logarithm of what is left, of all channels together
_TELLING = 0.02  # of the squared miss, from which a delay is asked for
AFFORDED = 250_000
"""Physics steps of a round of a fit: about 6 s with a dozen joints on a free base."""
_FEWEST = 9  # windows, whatever they cost: less of a log tells little
_LITTLE = 1.1  # times the miss without a delay, below which it is uncertain
_EVEN = 4.0  # both sides of the best delay are about as steep, or no parabola goes through them


@dataclass(frozen=True)
class Fit:
    """What is left when the unknowns may move.

    Args:
        delays: control steps that were tried, rising.
        miss: (D,) what is left at each, in terms of what is at the best.
        theta: (N,) of the unknowns at the best.
        jacobian: (R, N) of what is left there, in units of its size.
        misses: (C,) as ``Trial.misses``, starts having moved.
    """

    delays: tuple[int, ...]
    miss: FloatArray
    theta: FloatArray
    jacobian: FloatArray
    misses: FloatArray

    @property
    def best(self) -> int:
        """The delay that leaves least."""
        return self.delays[int(np.argmin(self.miss))]

    @property
    def finer(self) -> float:
        """The same, between control steps: where a parabola through three has its lowest point."""
        i = int(np.argmin(self.miss))
        if 0 < i < len(self.delays) - 1:
            x, y = np.array(self.delays[i - 1 : i + 2], float), self.miss[i - 1 : i + 2] ** 2
            curve = np.polyfit(x, y, 2)
            if curve[0] > 0 and y.max() - y[1] < _EVEN * (y[y > y[1]].min() - y[1]):
                return float(np.clip(-curve[1] / (2 * curve[0]), x[0], x[2]))
        return float(self.delays[i])


@dataclass(frozen=True)
class _Point:
    """Values (N,) and moved starts (W, F) at one delay, and the logarithm of what they leave; infinite before."""

    theta: FloatArray
    starts: FloatArray
    cost: float = np.inf


@dataclass(frozen=True)
class _Slopes:
    """Differences left (D, W, R) in units of ``size`` (C,), slopes by_theta (N, W, R) and by_start (W, R, F)."""

    left: FloatArray
    by_theta: FloatArray
    by_start: FloatArray
    size: FloatArray

    @property
    def inner(self) -> FloatArray:
        """(W, F, F) of the starts."""
        free = self.by_start
        full = np.einsum("wrf,wrg->wfg", free, free)
        held = _LOOSE + _ROUNDING * np.trace(full, axis1=1, axis2=2)  # of windows that diverged, more than rounding
        return full + held[:, None, None] * np.eye(free.shape[2])

    def start_of(self, values: FloatArray) -> FloatArray:
        """What starts (..., W, F) take of differences (..., W, R)."""
        taken = np.einsum("wrf,...wr->...wf", self.by_start, values)
        return np.asarray(np.linalg.solve(self.inner, taken[..., None])[..., 0])

    def without(self, values: FloatArray) -> FloatArray:
        """What starts leave of differences (..., W, R)."""
        return values - np.einsum("wrf,...wf->...wr", self.by_start, self.start_of(values))


def fit(
    trial: Trial,
    assumption: Assumption,
    delays: Sequence[int],
    rounds: int,
    tell: Tell = silent,
    afforded: int = AFFORDED,
) -> Fit:
    """Gauss-Newton steps at every delay, of which those near the best are followed.

    Args:
        trial: windows and simulations.
        assumption: how columns are read; its delay is where the search begins.
        delays: control steps that are tried first.
        rounds: of steps.
        tell: called with how far it is.
        afforded: physics steps of a round, for which windows are left out.
    """
    trial = trial.thinned(_windows(trial, len({*delays, assumption.delay}), afforded))
    zero = np.zeros((trial.flight(assumption).count, 2 * trial.simulator.model.nv))
    begun = {d: _Point(trial.theta, zero) for d in sorted({*delays, assumption.delay})}
    points, slopes, best = _descended(trial, assumption, begun, assumption.delay, rounds, tell)
    if best != assumption.delay and best != max(begun):  # that no delay is as good, from where the late one ended
        there, near = points[best], {assumption.delay, best - 1, best, best + 1}
        again = {d: _Point(there.theta, there.starts) for d in sorted(near)}
        others, other_slopes, other = _descended(trial, assumption, again, best, rounds, tell)
        if others[other].cost < there.cost:
            slopes, best = other_slopes, other
        points |= {d: point for d, point in others.items() if d not in points or point.cost < points[d].cost}
        points = {d: points[d] for d in sorted(points)}
    return _outcome(trial, slopes, points, best)


def _windows(trial: Trial, delays: int, afforded: int) -> int:
    """Windows of a fit: the more parameters and starts there are, the more simulations each of them takes."""
    return max(_FEWEST, int(afforded / _steps_of_window(trial, delays)))


def fit_steps(trial: Trial, delays: int, afforded: int) -> float:
    """Physics steps of a round of a fit at so many delays."""
    windows = min(_windows(trial, delays, afforded), sum(map(len, trial.places)))
    return windows * _steps_of_window(trial, delays)


def _steps_of_window(trial: Trial, delays: int) -> float:
    each = delays + len(trial.theta) + 2 * trial.simulator.model.nv
    return each * trial.steps / sum(map(len, trial.places))


def _descended(
    trial: Trial, assumption: Assumption, begun: dict[int, _Point], best: int, rounds: int, tell: Tell
) -> tuple[dict[int, _Point], _Slopes, int]:
    """The best point of each delay that was followed to the end, the last slopes, and the best delay, where they are.

    It ends where all of them have come to rest: a delay that has not loses against one that has. Slopes are those of
    the best point where it was linearised: a last step that went too far may have left nothing to be told apart.
    """
    points, tentative, by_delay = dict(begun), dict(begun), dict[int, _Slopes]()
    widest, last = max(points), dict.fromkeys(points, np.inf)
    for turn in range(rounds):
        tell(f"step {turn + 1} of {rounds} at most")
        slopes, linearised = _slopes(trial, assumption, tentative, best), best
        for (d, point), cost in zip(list(tentative.items()), _costs(slopes, trial), strict=True):
            known = points.get(d, point)
            if cost > known.cost:  # the last step went too far
                tentative[d] = _Point(0.5 * (known.theta + point.theta), 0.5 * (known.starts + point.starts))
            else:
                points[d] = replace(point, cost=cost)
        if tentative[linearised].theta is points[linearised].theta:
            by_delay[linearised] = slopes
        best = min(tentative, key=lambda d: points[d].cost)
        still = any(tentative[d].theta is not points[d].theta for d in tentative)
        if turn == rounds - 1 or not (
            still or any(last.get(d, np.inf) - points[d].cost >= _SETTLED for d in tentative)
        ):
            break
        last = {d: points[d].cost for d in tentative}
        tentative = _stepped(slopes, tentative, points)
        if turn:
            near = [d for d in range(best - 2, best + 3) if 0 <= d <= widest]
            tentative = {d: tentative.get(d, tentative[best]) for d in sorted({0, *near})}
    return {d: points[d] for d in sorted(tentative) if d in points}, by_delay.get(best, slopes), best


def _slopes(trial: Trial, assumption: Assumption, points: dict[int, _Point], best: int) -> _Slopes:
    """Simulations at all points, and differences of them at the best one."""
    here, simulator = points[best], trial.simulator
    n, free = len(here.theta), here.starts.shape[1]
    signs = np.where(here.theta + _STEP > 1, -1.0, 1.0)
    thetas = [point.theta for point in points.values()]
    flights = [trial.flight(replace(assumption, delay=d)).moved(simulator, p.starts) for d, p in points.items()]
    base = trial.flight(replace(assumption, delay=best))
    thetas += list(here.theta + _STEP * np.diag(signs)) + [here.theta] * free
    flights += [base.moved(simulator, here.starts)] * n
    flights += [base.moved(simulator, here.starts + _START_STEP * row) for row in np.eye(free)]
    measured, seen = base.measured, trial.seen(flights, np.stack(thetas))
    at, count = list(points).index(best), len(points)
    least = np.maximum(_LEAST * spread_of(trial.bent(measured[None]))[0], 1e-12)  # of what rests, without noise, none
    size = np.maximum(spread_of(trial.bent(measured - seen[at : at + 1]))[0], least)
    scaled = np.nan_to_num((measured - seen) / size, nan=_LOST, posinf=_LOST, neginf=-_LOST)
    flat = np.clip(scaled, -_LOST, _LOST).reshape(len(seen), len(measured), -1)
    by_theta = (flat[count : count + n] - flat[at]) / (signs * _STEP)[:, None, None]
    by_start = np.moveaxis((flat[count + n :] - flat[at]) / _START_STEP, 0, 2)
    return _Slopes(flat[:count], by_theta, by_start, size)


def _by_channel(values: FloatArray, channels: int) -> FloatArray:
    """Root mean squares (D, C) of differences (D, W, R)."""
    return np.asarray(np.sqrt((values.reshape(len(values), -1, channels) ** 2).mean(axis=1)))


def _costs(slopes: _Slopes, trial: Trial) -> FloatArray:
    """The logarithm of what is left at each delay (D,), starts having moved, of all channels together."""
    sizes = slopes.size * np.maximum(_by_channel(slopes.without(slopes.left), len(slopes.size)), _LEAST)
    return np.asarray(np.log(sizes).sum(axis=1))


def _stepped(slopes: _Slopes, tentative: dict[int, _Point], points: dict[int, _Point]) -> dict[int, _Point]:
    """The next step at each delay, within the bounds; those whose last one went too far keep their half of it."""
    n = len(slopes.by_theta)
    by_theta = slopes.without(slopes.by_theta).reshape(n, -1)
    root = np.linalg.cholesky(by_theta @ by_theta.T + np.eye(n) / _PRIOR**2)
    out = {}
    for (d, point), left in zip(tentative.items(), slopes.left, strict=True):
        if points[d].theta is not point.theta:
            out[d] = point
            continue
        wanted = np.linalg.solve(root, -by_theta @ slopes.without(left[None]).ravel())
        step = np.linalg.solve(root.T, wanted)
        if n and ((point.theta + step < 0) | (point.theta + step > 1)).any():
            room = (-point.theta - 1e-9, 1 - point.theta + 1e-9)
            step = scipy.optimize.lsq_linear(root.T, wanted, room, method="bvls").x
        moved = point.starts - slopes.start_of(left + np.einsum("n,nwr->wr", step, slopes.by_theta))
        out[d] = _Point(np.clip(point.theta + step, 0.0, 1.0), moved)
    return out


def _outcome(trial: Trial, slopes: _Slopes, points: dict[int, _Point], best: int) -> Fit:
    costs = np.array([point.cost for point in points.values()])
    channels = len(slopes.size)
    whole = np.maximum(spread_of(trial.bent(trial.flight(trial.given).measured[None]))[0], 1e-12)
    n = len(slopes.by_theta)
    by_theta = slopes.without(slopes.by_theta).reshape(n, -1)
    at = points[best]
    mean = float(np.exp(at.cost / channels)) / float(np.exp(np.log(slopes.size).mean()))
    misses = np.full(channels, np.exp(at.cost / channels)) / np.exp(np.log(whole).mean())
    miss = np.exp(np.clip((costs - at.cost) / channels, -20, 20))
    return Fit(tuple(points), miss, at.theta, by_theta.T / max(mean, _LEAST), misses)


def delay_of(actuators: Sequence[str], fit: Fit, dt: float) -> tuple[list[Unknown], str]:
    """The delay as an unknown where one shows, and what is to be said of it; dt in s."""
    if not actuators or len(fit.delays) < 2:
        return [], ""
    at_zero = float(fit.miss[fit.delays.index(0)] ** 2)
    best, late = fit.best, fit.finer
    if not best or at_zero - 1 < _TELLING:
        return [], "commands arrive at once: a delay would not lessen what simulations miss"
    if best == fit.delays[-1]:
        why = "which other things than a delay do as well: look at the model and at what drives it; none is asked for"
        return [], f"the later commands arrive the better, up to the {1e3 * dt * best:.3g} ms that were tried, {why}"
    high = rounded_up(dt * max(2 * best, best + 3))
    targets = tuple(f"actuator:{name}.delay" for name in actuators)
    times, when = float(np.sqrt(at_zero)), f"{1e3 * dt * late:.3g} ms late, {late:.2g} samples"
    note = f"commands arrive about {when}: without that, simulated windows miss {times:.2f} times as much"
    if times < _LITTLE:
        share = 100 * (1 - 1 / times)
        note = f"commands may arrive about {when}: uncertain, for it explains {share:.1g} % of what simulations miss"
    return [Unknown("delay", targets, 0.0, high, False, note)], note  # none at all is what the model has


def rounded_up(value: float) -> float:
    """Upwards to two digits."""
    digits = 10.0 ** (np.floor(np.log10(value)) - 1)
    return float(f"{np.ceil(value / digits) * digits:.2g}")
