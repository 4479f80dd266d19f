"""What every estimator is given, checked."""

from __future__ import annotations

from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.posterior import Posterior
from sipe_bayes.posterior import prior as default_prior
from sipe_bayes.simulation.callable_simulator import CallableSimulator
from sipe_bayes.simulation.simulator import Simulator


def check_simulator(given: object) -> None:
    """Raise ValueError for anything but a simulator."""
    if not isinstance(given, Simulator | CallableSimulator):
        raise ValueError(
            f"simulator: expected a Simulator or a CallableSimulator, got {given!r}; sipe.get_estimator takes "
            "the name of an environment as well"
        )


def stated_prior(given: Posterior | None, space: ParameterSpace) -> Posterior:
    """The prior over a simulator's parameters, by default the one that they state.

    Raises:
        ValueError: for one without a density, or over others.
    """
    if given is None:
        return default_prior(space)
    if not isinstance(given, Posterior):
        raise ValueError(f"prior: expected a posterior with a density, such as load_posterior(path), got {given!r}")
    if given.space.names != space.names or not given.has_density:
        raise ValueError(f"prior: expected a density over {list(space.names)}, got {given!r}")
    difference = given.space.difference(space)
    if difference:
        raise ValueError(f"prior: {difference} in the simulator; use the same bounds and scale")
    return given
