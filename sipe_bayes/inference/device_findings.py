"""What an estimator says of the device that it simulated on."""

from __future__ import annotations

from collections.abc import Callable

from sipe_bayes.core.findings import Code, Finding, finding
from sipe_bayes.simulation.callable_simulator import CallableSimulator
from sipe_bayes.simulation.simulator import Simulator


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
