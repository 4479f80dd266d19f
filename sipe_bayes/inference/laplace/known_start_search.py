"""What ``laplace`` does step by step with a ``StateSpace`` whose logs' first states are known, in a flat state (``chain_state``).

The commands lead from there to states near the true ones once theta is roughly right, which ever longer beginnings of the logs make it
(``growing_horizon``). So no state has to be found from its measurement; what matters is to stay honest through contacts, and the
smoother's transitions are linearised as widely as states and theta are still open (``posterior_linearisation``).

Three Gauss-Newton steps and an estimate of the noise take turns. The estimate credits a step not yet taken only where next to nothing
is left to gain: through contact a linearisation promises what the simulation does not keep. It has settled where theta has hardly moved
since the last one, and a new noise gains next to nothing. Of each starting point the estimate that has settled is kept, or the likeliest one if none
has, or if it is far likelier. Its normal lies about the best step from there, which the slopes foretell better than the simulation grants. What a budget
that ends before any step leaves is as wide as that step is long.
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
from sipe_bayes.inference.laplace.growing_horizon import grown
from sipe_bayes.inference.laplace.posterior_linearisation import linearise
from sipe_bayes.inference.laplace.smoother import Point, border, descend, first_noise, infer_noise, quietest, sound
from sipe_bayes.inference.laplace.strategy import SearchProblem
from sipe_bayes.likelihood.settings import BudgetExhausted
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.state_space.linearisation import ChainLinearisation, ChainNoise, eliminate_states, restricted

FloatArray = NDArray[np.float64]

_TOLERANCE = 0.5  # nats that a step must promise
_INNER, _ROUNDS = 3, 8  # steps between estimates of the noise, and estimates at most
_SETTLED, _ROUGH = 2.0, 0.01  # nats that a new noise gains, in all or for each measurement, below which it has settled
_STILL = 0.1  # squared sds that a parameter has moved, below which it has
_AS_GOOD = 10.0  # nats
_THETA_STEP = (1e-4, 0.1)  # of the cube: a difference is as long as the sd, but within these
_STATE_STEP = (1e-6, 0.3)  # rad or m, and their rates; share of the coordinate's movement in a control step


@dataclass(frozen=True)
class KnownStartSearch:
    """The ``Strategy`` for a ``StateSpace`` whose first states are known.

    Args:
        problem: prior, starting points, options.
        chain: the logs.
    """

    problem: SearchProblem
    chain: Chain

    @property
    def step_rollouts(self) -> int:
        """Rollouts that a step takes."""
        return (2 * (self.chain.num_theta + self.chain.num_start) + 2) * len(self.chain.trajectories)

    def start(self) -> ChainState:
        """The first state of a fit."""
        return ChainState(start(self.problem, self.chain))

    def step(self, state: ChainState) -> ChainState:
        """One linearisation and what follows from it."""
        return ChainState(step(self.problem, self.chain, state.data))


def start(search: SearchProblem, chain: Chain) -> State:
    """The first state of a fit."""
    chain.rollouts += chain.prepared
    points = grown(search, chain) if search.initial is None else search.initial
    return opening(chain, screened(search, chain) if points is None else points)


def step(search: SearchProblem, chain: Chain, state: State) -> State:
    """One linearisation and what follows from it: a step of the smoother, or a new noise and a step."""
    chain.part = float(state["part"])
    after = _followed(search, chain, state) if state["held"] else _smoothed(search, chain, state)
    return {**after, "part": chain.part}


def _followed(search: SearchProblem, chain: Chain, state: State) -> State:
    """The states that the commands lead to, and a first guess of the noise about them."""
    theta, states, prior = state["theta"], chain.predicted(state["theta"]), search.quadratic_prior
    states = state["states"] if states is None else states
    found = chain.linearise(theta, states)
    if found is None:
        return diverged(chain, state)
    movement, fixed = chain.movement(states), chain.fixed_sd
    noise = first_noise(chain, found, movement)
    residual = np.sqrt((found.residual**2).sum(0) / found.observed.sum(0))
    smaller = np.maximum(np.minimum(noise.sd, residual), chain.least[0])
    noise = quietest(chain, found, replace(noise, sd=np.where(np.isnan(fixed), smaller, fixed)), prior, theta)
    noise = sound(found, noise)
    state = {**state, "held": False, "states": states, "sd": noise.sd, "process": noise.process, "movement": movement}
    evidence = evidence_of(search, state, found, noise, settled=False)
    state = recorded(search, state, found, noise, evidence, settled=False, untried=True)
    return {**state, **_steps(search, state, found, noise)}


def _smoothed(search: SearchProblem, chain: Chain, state: State) -> State:
    found = linearise(chain, state["theta"], state["states"], state["theta_step"], state["state_step"])
    if found is None:
        return diverged(chain, state)
    noise, due = sound(found, ChainNoise(state["sd"], state["process"])), state["inner"] >= _INNER
    if due:
        noise, state, done = _estimated(search, chain, state, found, noise)
        if done:
            return onward(chain, state)
    here = Point(state["theta"], state["states"], np.inf, state["damping"])
    try:
        here, still = descend(chain, found, noise, search.quadratic_prior, here, _TOLERANCE)
    except BudgetExhausted:
        if not due:
            raise
        return state  # what was recorded is kept, and the next step ends the search
    state = {**state, "theta": here.theta, "states": here.states, "damping": here.damping}
    state |= {"inner": _INNER if still else state["inner"] + 1, "iteration": state["iteration"] + 1}
    return {**state, **_steps(search, state, found, noise)}


def _estimated(
    search: SearchProblem, chain: Chain, state: State, found: ChainLinearisation, noise: ChainNoise
) -> tuple[ChainNoise, State, bool]:
    """The noise estimated anew, the state with it and with what is worth recording, and whether the search ends."""
    theta, prior, movement = state["theta"], search.quadratic_prior, state["movement"]
    hold = border(prior, theta, eliminate_states(found, noise).gradient)
    promised = restricted(found, noise, hold)[0] - restricted(found, noise, hold, held=True)[0]
    better, gain = infer_noise(chain, found, noise, prior, theta, movement, held=promised > _TOLERANCE)
    better = sound(found, better)
    away = theta - state["round_theta"]
    moved = float(away @ eliminate_states(found, better).precision @ away) / len(theta)
    enough = max(_SETTLED, _ROUGH * float(found.observed.sum()))
    settled = bool(state["round"] > 0 and gain < enough and moved < _STILL)
    best = state["mode_evidence"][state["mode_point"] == state["point"]].max(initial=-np.inf)
    evidence = evidence_of(search, state, found, better, settled=False)
    if evidence > best - settled * _AS_GOOD or state["round"] == 0:
        state = recorded(search, state, found, better, evidence, settled)
    now = {"sd": better.sd, "process": better.process, "round": state["round"] + 1, "inner": 0, "round_theta": theta}
    return better, {**state, **now}, settled or state["round"] + 1 >= _ROUNDS


def _steps(search: SearchProblem, state: State, found: ChainLinearisation, noise: ChainNoise) -> State:
    """How long the next differences are, by theta (N,) and by the states (K, D)."""
    solved = eliminate_states(found, noise)
    spread = np.einsum("kdd->kd", solved.covariances()[0])
    _, covariance = search.normal(state["theta"], solved.precision, solved.gradient)
    longest = np.maximum(_STATE_STEP[1] * state["movement"], _STATE_STEP[0])
    return {
        "theta_step": np.clip(np.sqrt(np.diag(covariance)), *_THETA_STEP),
        "state_step": np.clip(np.sqrt(spread), _STATE_STEP[0], longest),
    }
