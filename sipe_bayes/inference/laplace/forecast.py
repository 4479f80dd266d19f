"""How many rollouts a search over windows needs as a rule: a tenth to a half of what it may.

Real logs of a pendulum, a Furuta pendulum and a pan-tilt head took 10 to 70 steps from each starting point, and up to
340 draws.
"""

from __future__ import annotations

from sipe_bayes.inference.laplace.windows.state import WindowState

_STEPS, _LEFT = 30, 0.3  # from a starting point; and of them the share that is to come where they are passed
_TRIALS = 2  # that a step takes beside its differences
_DRAWS, _EACH = 300, 2  # draws in place of the normal, and rollouts of each log that one takes


def usual_rollouts(unknowns: int, logs: int, starts: int = 1) -> float:
    """Of a whole fit.

    Args:
        unknowns: parameters, and coordinates of a window's start.
        logs: fitted together.
        starts: starting points of the search.
    """
    return (starts * _STEPS * (unknowns + _TRIALS) + _DRAWS * _EACH) * logs


def usual_rest(state: WindowState, drawn: int, unknowns: int, logs: int) -> float:
    """Of what is to come.

    Args:
        state: of the search.
        drawn: draws that have been made.
        unknowns: parameters, and coordinates of a window's start.
        logs: fitted together.
    """
    draws = max(_DRAWS - drawn, _LEFT * _DRAWS) * _EACH
    later = len(state.points) - state.point - 1
    here = max(1 - state.here.iteration / _STEPS, _LEFT)
    steps = 0 if drawn else (later + here) * _STEPS * (unknowns + _TRIALS)
    return (steps + draws) * logs
