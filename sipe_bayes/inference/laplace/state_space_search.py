"""What ``laplace`` does step by step with a ``StateSpace``: from starting point to recorded optimum, in a flat state (``chain_state``).

A search regresses theta on the measured states, or follows the commands where some coordinate is not measured, then smooths and infers
the noise in turn (``inference.smoother``). A later starting point is dropped once its regression ends where an earlier one did. Where the
logs' first states are known another search is made (``known_start_search``).

At an optimum, or where the noise does not settle, jumps that stand out are let go (``loose_jumps``) and the search goes on; from
the optimum without them the filter tries to close them, and where that is likelier the search goes on from there. It turns to
the next starting point once it comes to nothing likelier. Of each starting point the likeliest optimum is kept: its normal in
theta, with the states integrated out, is what ``laplace`` makes its truncated normal of.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.core.checkpoint import State
from sipe_bayes.inference.laplace.chain_state import (
    ChainState,
    diverged,
    evidence_of,
    onward,
    opening,
    recorded,
    screened,
)
from sipe_bayes.inference.laplace.loose_jumps import needed, outstanding
from sipe_bayes.inference.laplace.smoother import (
    Point,
    descend,
    filtered,
    first_noise,
    infer_noise,
    quietest,
    regress,
    sound,
)
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior
from sipe_bayes.likelihood.settings import BudgetExhausted
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.state_space.linearisation import ChainLinearisation, ChainNoise

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_STILL, _REGRESSIONS = 0.01, 6  # a move of theta below which the regression ends, and its steps at most
_TOLERANCE = 0.5  # nats that a step must promise
_SETTLED = 1.0  # nats below which a new noise does not matter
_ROUNDS, _FILTERS = 10, 3  # estimates of the noise at most, and after how many at most the filter runs:
_DROPPED = 0.5  # where the process noise dropped by more than this, in logs
_INNER = (3, 2)  # steps between them: before the first, later
_AFTER_FILTER = 4
_UNSETTLED, _LET_GO = 4, 3  # estimates of the noise after which jumps that stand out are let go; how often they are
_SAME = 0.02  # distance of regressed thetas that is none


@dataclass(frozen=True)
class StateSpaceSearch:
    """The ``Strategy`` for a ``StateSpace``.

    Args:
        problem: prior, starting points, options.
        chain: the logs.
    """

    problem: SearchProblem
    chain: Chain

    @property
    def step_rollouts(self) -> int:
        """Rollouts that a step takes."""
        return ((self.chain.num_theta + self.chain.num_start) + 2) * len(self.chain.trajectories)

    def start(self) -> ChainState:
        """The first state of a fit."""
        return ChainState(start(self.problem, self.chain))

    def step(self, state: ChainState) -> ChainState:
        """One linearisation and what follows from it."""
        return ChainState(step(self.problem, self.chain, state.data))


def start(search: SearchProblem, chain: Chain) -> State:
    """The first state of a fit."""
    chain.rollouts += chain.prepared
    return opening(chain, screened(search, chain) if search.initial is None else search.initial)


def step(search: SearchProblem, chain: Chain, state: State) -> State:
    """One linearisation and what follows from it: a step of the regression or the smoother, or a new noise."""
    chain.part = float(state["part"])
    return {**_stepped(search, chain, state), "part": chain.part}


def _stepped(search: SearchProblem, chain: Chain, state: State) -> State:
    held = bool(state["held"])
    if held and not chain.placed.all():
        return _followed(search, chain, state)
    found = chain.linearise(state["theta"], state["states"], with_states=not held)
    if found is None:
        return diverged(chain, state)
    if held:
        return _regressed(search, chain, state, found)
    prior, noise = search.quadratic_prior, ChainNoise(state["sd"], state["process"], state["movement"], state["loose"])
    here = Point(state["theta"], state["states"], np.inf, state["damping"])
    state = {**state, "iteration": state["iteration"] + 1, "inner": state["inner"] + 1}
    still = False
    if not state["due"]:
        here, still = descend(chain, found, noise, prior, here, _TOLERANCE)
        if not still:
            return {**state, **_at(here), "due": state["inner"] >= _INNER[min(state["round"], 1)]}
    noise = sound(found, noise)
    better, gain = infer_noise(chain, found, noise, prior, here.theta, state["movement"])
    settled, last = bool(gain < _SETTLED and still), state["round"] >= _ROUNDS
    struggling = state["round"] >= _UNSETTLED and not state["loose"].any() and _candidates(state, found, noise).any()
    if state["round"] and (settled or last or struggling):
        return _ended(search, chain, state, found, noise, settled)
    here, _ = descend(chain, found, better, prior, here, _TOLERANCE)
    dropped = np.log(noise.process / better.process).mean() > _DROPPED
    if state["round"] == 0 or (state["round"] < _FILTERS and dropped):
        there = _refiltered(chain, found, better, prior, here.theta, state["states"])
        here = there if there is not None and there.energy < here.energy else here
    return {
        **state,
        **_at(here),
        "sd": better.sd,
        "process": better.process,
        "round": state["round"] + 1,
        "inner": 0,
        "due": False,
    }


def _at(point: Point) -> State:
    return {"theta": point.theta, "states": point.states, "damping": point.damping}


def _regressed(search: SearchProblem, chain: Chain, state: State, found: ChainLinearisation) -> State:
    theta = regress(found, search.quadratic_prior, state["theta"])
    still = np.abs(theta - state["theta"]).max() < _STILL or state["iteration"] + 1 >= _REGRESSIONS
    state = {**state, "theta": theta, "iteration": state["iteration"] + 1, "held": not still}
    if not still:
        return state
    if any(np.abs(theta - earlier).max() < _SAME for earlier in state["regressed"]):
        return onward(chain, state)
    movement = chain.movement(state["states"])
    noise = first_noise(chain, found, movement)
    regressed = np.concatenate([state["regressed"], theta[None]])
    return {**state, "sd": noise.sd, "process": noise.process, "movement": movement, "regressed": regressed}


def _followed(search: SearchProblem, chain: Chain, state: State) -> State:
    """Where some coordinate is not measured: the filter's states, about those that the commands lead to."""
    theta, states = state["theta"], chain.predicted(state["theta"])
    states = state["states"] if states is None else states
    found = chain.linearise(theta, states)
    if found is None:
        return diverged(chain, state)
    movement = chain.movement(states)
    noise = quietest(chain, found, first_noise(chain, found, movement), search.quadratic_prior, theta)
    noise = sound(found, noise)
    better = filtered(chain, found, noise, theta, states)
    known = {"sd": noise.sd, "process": noise.process, "movement": movement}
    return {**state, **known, "held": False, "states": states if better is None else better}


def _refiltered(
    chain: Chain,
    found: ChainLinearisation,
    noise: ChainNoise,
    prior: QuadraticPrior,
    theta: FloatArray,
    states: FloatArray,
) -> Point | None:
    """Where Gauss-Newton comes from the filter's states; found: at ``states``."""
    begin = filtered(chain, found, noise, theta, states)
    if begin is None:
        return None
    there = Point(theta, begin, np.inf, 1e-4)
    for _ in range(_AFTER_FILTER):
        taken = chain.linearise(there.theta, there.states)
        if taken is None:
            return None
        there, still = descend(chain, taken, noise, prior, there, _TOLERANCE)
        if still:
            break
    return there


def _ended(
    search: SearchProblem, chain: Chain, state: State, found: ChainLinearisation, noise: ChainNoise, settled: bool
) -> State:
    """After an optimum: keep it if it is likelier than those before, and go on from it."""
    before = float(state["mode_evidence"][state["mode_point"] == state["point"]].max(initial=-np.inf))
    loose = needed(found, noise, search.quadratic_prior, state["theta"])
    if not np.array_equal(loose, state["loose"]):
        state = {**state, "loose": loose, "refused": state["refused"] | (state["loose"] & ~loose)}
        noise = replace(noise, outliers=loose)
        likelier = loose.any() or evidence_of(search, state, found, noise, True) > before + _SETTLED
        if likelier and state["round"] < _ROUNDS:
            return {**state, "inner": 0, "due": False}
    evidence = evidence_of(search, state, found, noise, settled)
    if evidence <= before + _SETTLED:
        return onward(chain, state)
    state = recorded(search, state, found, noise, evidence, settled)
    again = {**state, "round": 1, "inner": 0, "due": False}
    if loose.any():
        closed = _closed(search, chain, state, found, noise)
        if closed is None or closed[1] <= evidence + _SETTLED:
            return onward(chain, state)
        return {**again, **_at(closed[0]), "loose": np.zeros_like(loose)}
    proposed = _candidates(state, found, noise)
    if not proposed.any():
        return onward(chain, state)
    return {**again, "loose": proposed, "let_go": state["let_go"] + 1}


def _candidates(state: State, found: ChainLinearisation, noise: ChainNoise) -> BoolArray:
    """Jumps (K-1,) to let go: none that turned out not to need it, and none after a few times."""
    return outstanding(found, noise) & ~state["refused"] & (state["let_go"] < _LET_GO)


def _closed(
    search: SearchProblem, chain: Chain, state: State, found: ChainLinearisation, noise: ChainNoise
) -> tuple[Point, float] | None:
    """Where the filter leads with no jump loose, and the evidence there; None where the budget ends or it diverges."""
    tight, prior = sound(found, replace(noise, outliers=np.zeros_like(state["loose"]))), search.quadratic_prior
    try:
        there = _refiltered(chain, found, tight, prior, state["theta"], state["states"])
        taken = None if there is None else chain.linearise(there.theta, there.states)
    except BudgetExhausted:
        return None
    if there is None or taken is None:
        return None
    return there, evidence_of(search, {**state, **_at(there)}, taken, sound(taken, tight), False)
