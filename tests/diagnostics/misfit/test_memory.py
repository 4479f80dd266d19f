"""Samples that remember: how many tell as much as one of their own, and what the scatter of estimates says of it."""

from __future__ import annotations

import copy
import functools

import numpy as np
import pytest

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.diagnostics.misfit.library_discrepancy import library_discrepancy
from sipe_bayes.diagnostics.misfit.probed_logs import ProbedLogs
from sipe_bayes.likelihood import Noise, Segments, bind
from sipe_bayes.posterior import GaussianMixture
from tests.problems.pendulums import log, pendulum

SD = 0.01


@functools.cache
def linearised() -> ProbedLogs:
    """Two logs whose fit takes noise for white."""
    theta = pendulum().space.normalise(np.array([0.6, 0.08]))
    logs = Trajectories.stack([log(pendulum(), [0.6, 0.08], number, name=str(number)) for number in (2, 3)])
    return ProbedLogs(bind(Segments(2.0), pendulum(), logs), theta, Noise(np.array([SD]), np.zeros(1)))


def probed(memory: float, seed: int) -> ProbedLogs:
    """The same where what the fit leaves is AR(1), its autocorrelation time ``memory``."""
    out = copy.copy(linearised())
    out.__dict__.pop("arrow")  # of the logs' own residual
    rho, random = (memory - 1) / (memory + 1), np.random.default_rng(seed)
    flat = random.standard_normal(out.residual.size)
    for i in range(1, len(flat)):
        flat[i] = rho * flat[i - 1] + np.sqrt(1 - rho**2) * flat[i]
    out.residual = np.where(out.windows.observed, SD * flat.reshape(out.residual.shape), 0.0)
    return out


def scatter(memory: float, seeds: range) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sd (N,) of estimates, what white noise says it is, and what is said with the samples discounted."""
    steps, plain, discounted = [], [], []
    for seed in seeds:
        logs = probed(memory, seed)
        steps.append(logs.seen.step[: len(logs.theta)])
        plain.append(np.sqrt(logs.seen.variance))
        discounted.append(np.sqrt(logs.discounted.seen.variance))
    return np.std(steps, axis=0), np.mean(plain, axis=0), np.mean(discounted, axis=0)


@pytest.mark.parametrize("memory", [1.0, 15.0])
def test_sds_are_the_scatter_whether_samples_remember_or_not(memory: float) -> None:
    """30 draws tell an sd to 13 %: three of that, and a tenth for frequencies at which parameters are told."""
    seen, plain, discounted = scatter(memory, range(30))
    print(seen / plain, seen / discounted)
    assert (seen / discounted < 1.5).all()
    assert (seen / discounted > 0.6).all()
    assert (seen / plain > 2.5).all() if memory > 1 else (seen / plain < 1.3).all()


def test_a_posterior_is_stretched_as_its_samples_remember() -> None:
    for memory, least, most in ((1.0, 1.0, 1.25), (15.0, 2.5, 6.0)):
        logs = probed(memory, 1)
        one = library_discrepancy(logs)
        assert one is not None
        print(memory, logs.memory, one.stretch)
        assert (one.stretch >= least).all()
        assert (one.stretch < most).all()
        fitted = GaussianMixture(np.zeros(1), logs.theta[None], np.diag(logs.seen.variance)[None], pendulum().space)
        wide = one.widened(fitted, 0)
        assert (wide.stddev.numpy() > 0.95 * one.stretch * fitted.stddev.numpy()).all()


def test_residuals_of_nothing_remember_nothing() -> None:
    logs = probed(15.0, 1)
    assert logs.memory_of(np.zeros_like(logs.residual), logs.noise).tolist() == [1.0]
