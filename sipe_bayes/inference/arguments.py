"""What every estimator is given, checked, and what it says of the device that it simulated on."""

from __future__ import annotations

from collections.abc import Callable

from sipe_bayes.core.findings import Code, Finding, finding
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.likelihood import Segments, StateSpace
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


def without_likelihood(simulator: object) -> bool:
    """Whether only simulating can tell what the log says: a function that makes its own noise, or states none."""
    return isinstance(simulator, CallableSimulator) and simulator.noise_sd is None


def check_comparison(simulator: object, likelihood: object, progress: object, name: str, searches: bool) -> None:
    """Raise ValueError for a likelihood that the method called ``name`` does not take, or no function of progress."""
    if searches and without_likelihood(simulator):
        raise ValueError(
            f"likelihood: {name} needs one; make CallableSimulator(fn, space, likelihood=sd of the noise), or use npe"
        )
    if not isinstance(likelihood, Segments | StateSpace | None):
        raise ValueError(f"likelihood: expected sipe.Segments(...), got {likelihood!r}; or give sipe.StateSpace(...)")
    if isinstance(likelihood, StateSpace) and not searches:
        raise ValueError(f"likelihood: StateSpace is for laplace and mcmc; give {name} sipe.Segments(...)")
    if progress is not None and not callable(progress):
        raise ValueError(f"progress: expected a function (what, rollouts, budget), got {progress!r}")


def check_named(simulator: Simulator | CallableSimulator, name: str, given: object) -> None:
    """Raise ValueError where the argument ``name`` gives a path for a function without a name of its own."""
    if given is not None and isinstance(simulator, CallableSimulator) and not simulator.name:
        raise ValueError(
            f"name: {name}= needs one to tell functions apart, and {simulator.fn!r} has none of its own; make "
            'CallableSimulator(fn, space, name="...")'
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


def differentiable(simulator: Simulator | CallableSimulator) -> Simulator | CallableSimulator:
    """The same in float64, of which differences can be taken."""
    return simulator.on_processor if isinstance(simulator, Simulator) else simulator


def device_findings(
    method: str,
    asked: Simulator | CallableSimulator,
    used: Simulator | CallableSimulator,
    simulate_again: Callable[[], None],
) -> list[Finding]:
    """Findings of a fit on a GPU; none of one on the processor.

    Args:
        method: the estimator's name.
        asked: the simulator that it was given.
        used: the one that it simulated with.
        simulate_again: simulates the estimate, which is compared with float64.
    """
    if not isinstance(asked, Simulator) or asked.audit is None:
        return []
    if used is not asked:
        return [finding(Code.ON_PROCESSOR, method=method, device=asked.device)]
    with asked.audit.every():
        simulate_again()
    return asked.audit.findings()
