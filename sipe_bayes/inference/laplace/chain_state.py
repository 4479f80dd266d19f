"""A search with a ``StateSpace`` as a flat state: how it begins, what it records of an optimum, and how it turns to the next start."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sipe_bayes.core.checkpoint import State
from sipe_bayes.inference.laplace.loose_jumps import rarity
from sipe_bayes.inference.laplace.optima import Search
from sipe_bayes.inference.laplace.smoother import border, penalty, process_penalty, scale
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.state_space.linearisation import ChainLinearisation, ChainNoise, eliminate_states, restricted

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


def opening(chain: Chain, points: FloatArray) -> State:
    """The first state of a fit from starting points (R, N)."""
    n, (k, d), c = chain.num_theta, chain.prior_precision.shape, len(chain.channels)
    shapes = {"theta": (n,), "states": chain.reference.shape, "slope": (k, d, n), "mean": (n,), "covariance": (n, n)}
    shapes |= {"sd": (c,), "tau": (c,), "process": (d,), "movement": (d,), "loose": (k - 1,)}
    shapes |= {"theta_step": (n,), "state_step": (k, d), "settled": (), "evidence": (), "point": ()}
    kinds = {"loose": bool, "settled": bool, "point": int}
    return {
        "done": False,
        "part": chain.part,
        "points": points,
        "point": 0,
        "regressed": np.empty((0, n)),
        **begin(chain, points[0]),
        **{f"mode_{name}": np.empty((0, *shape), kinds.get(name, float)) for name, shape in shapes.items()},
    }


def begin(chain: Chain, theta: FloatArray) -> State:
    """At one of them."""
    return {
        "theta": theta,
        "states": chain.reference,
        "sd": np.ones(len(chain.channels)),
        "process": np.ones(chain.num_start),
        "movement": np.ones(chain.num_start),
        "loose": np.zeros(len(chain.linked), bool),
        "theta_step": np.zeros(chain.num_theta),  # of differences, zero: short ones
        "state_step": np.zeros(chain.prior_precision.shape),
        "damping": 1e-4,
        "iteration": 0,
        "round": 0,
        "inner": 0,
        "due": False,
        "refused": np.zeros(len(chain.linked), bool),
        "let_go": 0,
        "held": True,  # the states as a first guess has them
        "round_theta": theta,  # of the last estimate of the noise
    }


def screened(search: Search, chain: Chain) -> FloatArray:
    """Starting points (R, N): the model as given and the best of a few draws from the prior, by the jumps that they leave
    between states as measured; raises ValueError where all diverge."""
    generator = torch.Generator().manual_seed(search.seed)
    draws = search.prior.sample((search.candidates,), generator=generator).numpy()
    points = np.concatenate([search.space.default_theta[None], draws])
    found = chain.compare(points, np.tile(chain.reference, (len(points), 1, 1)))
    good = [k for k, one in enumerate(found) if one is not None]
    if not good:
        raise ValueError(
            f"every one of {len(points)} starting points diverges in the simulation; narrow the bounds, "
            "or shorten the model's timestep"
        )
    if good[0] != 0:
        search.warn("the model as given diverges on these logs; the search started elsewhere")
    sizes = np.array([scale(one) for one in found if one is not None])
    order = np.argsort(np.log(sizes).sum(1), kind="stable")
    chosen = [good[k] for k in order if good[k] != 0]
    return points[([0] if good[0] == 0 else []) + chosen][: search.restarts]


def process_diagnostics(process: FloatArray, movement: FloatArray, loose: BoolArray) -> dict[str, Any]:
    """Of a fit: process noise and movement of each coordinate, and after which of the chain's states a jump is loose."""
    found = {"process_noise": process, "movement": movement, "loose": np.flatnonzero(loose)}
    return {name: values.tolist() for name, values in found.items()}


def evidence_of(search: Search, state: State, found: ChainLinearisation, noise: ChainNoise, settled: bool) -> float:
    """log p(noise | y), states and theta integrated out, up to a constant; unless ``settled`` without what the next step would
    gain, were the model linear."""
    theta, prior = state["theta"], search.quadratic_prior
    hold = border(prior, theta, eliminate_states(found, noise).gradient)
    value = restricted(found, noise, hold, held=not settled)[0]
    return value - penalty(prior, theta) - rarity(noise) - process_penalty(noise, state["movement"])


def recorded(
    search: Search,
    state: State,
    found: ChainLinearisation,
    noise: ChainNoise,
    evidence: float,
    settled: bool,
    untried: bool = False,
) -> State:
    """The optimum at its linearisation, in place of this starting point's earlier one: the normal about the best step from here, and where
    no step has been tried yet, also as wide as that step is long."""
    theta, solved = state["theta"], eliminate_states(found, noise)
    mean, covariance = search.normal(theta, solved.precision, solved.gradient)
    if untried:
        covariance = covariance + np.outer(mean - theta, mean - theta)
    here = {"theta": theta, "states": state["states"], "slope": solved.slope, "mean": mean, "covariance": covariance}
    here |= {"sd": noise.sd, "tau": np.zeros_like(noise.sd), "process": noise.process, "movement": state["movement"]}
    here |= {name: state[name] for name in ("loose", "theta_step", "state_step")}
    here |= {"settled": np.array(settled), "evidence": np.array(evidence), "point": np.array(state["point"])}
    others = state["mode_point"] != state["point"]
    return {**state, **{f"mode_{k}": np.concatenate([state[f"mode_{k}"][others], v[None]]) for k, v in here.items()}}


def diverged(chain: Chain, state: State) -> State:
    """Turn to the next starting point; raises ValueError where none is left and no optimum was found."""
    if state["point"] + 1 == len(state["points"]) and not len(state["mode_theta"]):
        raise ValueError(
            "trajectories: the simulation diverges from the measured states at every starting point; look at the log's "
            "channels and units, or shorten the model's timestep"
        )
    return onward(chain, state)


def onward(chain: Chain, state: State) -> State:
    """Turn to the next starting point, or end."""
    point = state["point"] + 1
    if point >= len(state["points"]):
        return {**state, "done": True}
    return {**state, "point": point, **begin(chain, state["points"][point])}
