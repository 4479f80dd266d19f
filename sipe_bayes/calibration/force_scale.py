"""Whether motion can tell the scale of the forces: asked before a fit, by simulating what it would not see."""

from __future__ import annotations

import re

import numpy as np

from sipe_bayes.calibration.problem import Problem
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.likelihood import UNIFORM_PRECISION, first_states

_OF_FORCES = re.compile(r"(?<![A-Za-z])(kg|N)(?![A-Za-z])")  # in units of what grows with the scale
_GROWN = 1.1  # times, of all of them
_SAME = 0.02  # of what masses alone change: no more than that is changed by all together
_KNOWN = 0.5  # of a uniform prior's sd: what is known that well sets the scale


def find_open_scale(problem: Problem) -> tuple[str, ...]:
    """Names of the parameters that can all grow together without any motion being another; none where there is a scale.

    Asked where both an actuator's gain and a mass are unknown and no prior says more of any of them than its bounds;
    costs a few rollouts of the beginning of a log.
    """
    space = problem.environment.space
    scaled = [j for j, p in enumerate(space) if p.log is None and (_OF_FORCES.search(p.unit) or _is_gain(p))]
    masses = [j for j in scaled if any(target.endswith(".mass") for target in space[j].targets)]
    gains = [j for j in scaled if any(target.startswith("actuator:") for target in space[j].targets)]
    sds = problem.prior.stddev.numpy()[scaled] * np.sqrt(UNIFORM_PRECISION)
    narrow = any(space[j].low > 0 and space[j].high < space[j].low * _GROWN**2 for j in scaled)
    if not masses or not gains or narrow or problem.environment.added or (sds < _KNOWN).any():
        return ()
    middle = np.clip(space.default_theta, 0.2, 0.8)
    values = np.tile(space.values(middle), (3, 1))
    for row, grown in zip(values[1:], (scaled, masses), strict=True):
        row[grown] *= _GROWN
    log = problem.train[0]
    steps = int(min(len(log), np.ceil(1.0 / log.dt)))  # a second is enough for what changes nothing at all
    state = first_states(problem.simulator, Trajectories.stack([log]))
    given = space.normalise(values), np.tile(log.actions[:steps], (3, 1, 1)), np.repeat(state, 3, axis=0)
    runs = problem.simulator.rollout(*given, dt=log.dt, logs=[log.name] * 3, allow_outside=True)
    seen = np.asarray(runs.observations)
    together, alone = (np.sqrt(np.nanmean((seen[k] - seen[0]) ** 2, axis=0)) for k in (1, 2))
    moves = alone > 1e-9
    return tuple(space[j].name for j in scaled) if moves.any() and (together < _SAME * alone)[moves].all() else ()


def _is_gain(parameter: Parameter) -> bool:
    """Whether it is by how much a command is multiplied, which has no unit where the command has that of a force."""
    return any(target.startswith("actuator:") and target.endswith(".gain") for target in parameter.targets)
