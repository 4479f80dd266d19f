"""The executor of many machines: Ray's, from `pip install sipe-bayes[ray]`.

A unit is a task of one CPU that returns its files; the process that started the run writes them. When a node dies, Ray
runs its units again on another. The folder of results may be on a file system that the nodes share: then they read its
simulations, and a training goes on from its checkpoints; where it is not, each cell makes the rows it needs itself, and
they are the same. Agents of the transfer read the estimates that they train under, and so need a shared one.
"""

from __future__ import annotations

import logging
import os
import socket
from typing import Any, Self

from sipe_bayes.benchmark.executors.work import ONE_THREAD, Done, Unit


class RayExecutor:
    """A cluster's CPUs.

    Args:
        address: HOST:PORT of a cluster, or None for one on this machine.
        retries: times that a unit is begun again when its node dies.
        patience: seconds for the cluster's port to answer.
        on_gpus: whether each unit gets a GPU of the cluster to itself, beside its CPU.

    Raises:
        ValueError: where there is no such cluster, or no GPU in it.
    """

    def __init__(
        self, address: str | None = None, retries: int = 5, patience: float = 5.0, on_gpus: bool = False
    ) -> None:
        if address is not None:
            _check_answers(address, patience)
        try:
            import ray
        except ImportError:
            raise ValueError("--executor ray: Ray is not installed; `pip install 'sipe-bayes[ray]'`") from None
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        self._ray = ray
        try:
            ray.init(
                address, log_to_driver=False, include_dashboard=None if address else False, logging_level=logging.ERROR
            )
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise ValueError(f"--address {address}: {error}; start a cluster with `ray start --head`") from None
        self.workers = int(ray.cluster_resources().get("GPU" if on_gpus else "CPU", 0 if on_gpus else 1))
        if not self.workers:
            ray.shutdown()
            raise ValueError("--executor ray: the cluster has no GPU; leave --device out, or start nodes that have one")
        remote = ray.remote(
            num_cpus=1, num_gpus=int(on_gpus), max_retries=retries, runtime_env={"env_vars": ONE_THREAD}
        )
        self._call = remote(_call)
        self._running: dict[Any, Unit] = {}

    def submit(self, unit: Unit) -> None:
        """See ``Executor``."""
        self._running[self._call.remote(unit)] = unit

    def next(self) -> tuple[Unit, Done]:
        """See ``Executor``."""
        reference = self._ray.wait(list(self._running), num_returns=1)[0][0]
        unit = self._running.pop(reference)
        try:
            return unit, self._ray.get(reference)
        except self._ray.exceptions.RayError as error:
            return unit, unit.gave_up(f"Ray gave it up: {str(error).strip().splitlines()[-1]}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._ray.shutdown()


def _call(unit: Unit) -> Done:
    return unit()


def _check_answers(address: str, patience: float) -> None:
    """Raises ValueError where nobody listens: Ray itself would wait for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdigit():
        raise ValueError(f"--address {address}: expected HOST:PORT, such as 10.0.0.1:6379")
    try:
        socket.create_connection((host, int(port)), patience).close()
    except OSError as error:
        raise ValueError(
            f"--address {address}: does not answer ({error}); start the cluster with `ray start --head`, or leave it "
            "out"
        ) from None
