"""A search with a ``StateSpace`` as a flat state: how it begins, what it records of an optimum, and how it turns to the next start."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sipe_bayes.core.checkpoint import State
from sipe_bayes.core.findings import Code, finding
from sipe_bayes.inference.laplace.loose_jumps import rarity
from sipe_bayes.inference.laplace.smoother import border, penalty, process_penalty, scale
from sipe_bayes.inference.laplace.strategy import Optimum, SearchProblem
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.state_space.linearisation import ChainLinearisation, ChainNoise, eliminate_states, restricted

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class ChainOptimum(Optimum):
    """An optimum of a chain of states.

    Args:
        states: (K, S).
        slope: (K, D, N): states follow theta by minus this.
        process: (D,), sd of the process noise.
        movement: (D,), of a coordinate in a control step.
        loose: (K-1,), jumps that are let go.
        theta_step: (N,), of the finite differences; zero: short ones.
        state_step: (K, D).
        settled: whether the noise had.
        point: number of the starting point.
    """

    states: FloatArray
    slope: FloatArray
    process: FloatArray
    movement: FloatArray
    loose: BoolArray
    theta_step: FloatArray
    state_step: FloatArray
    settled: bool
    point: int


@dataclass(frozen=True)
class ChainState:
    """The state of a search over a chain of states, still as a dictionary."""

    data: State

    @property
    def done(self) -> bool:
        """Whether the last starting point has been followed to its end."""
        return bool(self.data["done"])

    @property
    def optima(self) -> tuple[ChainOptimum, ...]:
        """Those recorded."""
        data = {f.name: self.data[f"mode_{f.name}"] for f in fields(ChainOptimum)}
        scalars = {"evidence": float, "settled": bool, "point": int}
        return tuple(
            ChainOptimum(**{k: scalars[k](v[m]) if k in scalars else v[m] for k, v in data.items()})
            for m in range(len(data["evidence"]))
        )

    def describe(self) -> str:
        """Starting point and step."""
        return f"start {self.data['point'] + 1} of {len(self.data['points'])}, step {self.data['iteration']}"


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


def screened(search: SearchProblem, chain: Chain) -> FloatArray:
    """Starting points (R, N): the model as given and the best of a few draws from the prior, by the jumps that they leave
    between states as measured; raises ValueError where all diverge."""
    generator = torch.Generator().manual_seed(search.seed)
    draws = search.prior.sample((search.options.candidates,), generator=generator).numpy()
    points = np.concatenate([search.space.default_theta[None], draws])
    found = chain.compare(points, np.tile(chain.reference, (len(points), 1, 1)))
    good = [k for k, one in enumerate(found) if one is not None]
    if not good:
        raise ValueError(
            f"every one of {len(points)} starting points diverges in the simulation; narrow the bounds, "
            "or shorten the model's timestep"
        )
    if good[0] != 0:
        search.find(finding(Code.DIVERGES_AS_GIVEN))
    sizes = np.array([scale(one) for one in found if one is not None])
    order = np.argsort(np.log(sizes).sum(1), kind="stable")
    chosen = [good[k] for k in order if good[k] != 0]
    return points[([0] if good[0] == 0 else []) + chosen][: search.options.restarts]


def process_diagnostics(process: FloatArray, movement: FloatArray, loose: BoolArray) -> dict[str, Any]:
    """Of a fit: process noise and movement of each coordinate, and after which of the chain's states a jump is loose."""
    found = {"process_noise": process, "movement": movement, "loose": np.flatnonzero(loose)}
    return {name: values.tolist() for name, values in found.items()}


def evidence_of(
    search: SearchProblem, state: State, found: ChainLinearisation, noise: ChainNoise, settled: bool
) -> float:
    """log p(noise | y), states and theta integrated out, up to a constant; unless ``settled`` without what the next step would
    gain, were the model linear."""
    theta, prior = state["theta"], search.quadratic_prior
    hold = border(prior, theta, eliminate_states(found, noise).gradient)
    value = restricted(found, noise, hold, held=not settled)[0]
    return value - penalty(prior, theta) - rarity(noise) - process_penalty(noise, state["movement"])


def recorded(
    search: SearchProblem,
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
