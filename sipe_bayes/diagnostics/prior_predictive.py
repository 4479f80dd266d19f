"""Would any parameters within the bounds give such a log? Its place among logs simulated from the prior, with noise.

The log's local outlier factor among them (M. Breunig et al. 2000, https://doi.org/10.1145/342009.335388), channel by
channel. The p-value compares the log's largest with the largest of each simulation over all logs and channels, each
started as far off as noise leaves the estimate of a start, so that any alarm at all is as rare as it says (P. Westfall,
S. Young 1993, "Resampling-based multiple testing").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.findings import Code, Finding, finding
from sipe_bayes.core.options import Options, option
from sipe_bayes.core.rotations import written_near
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.likelihood.noise import Noise
from sipe_bayes.likelihood.replicas import Replicas
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.posterior import Posterior


@dataclass(frozen=True)
class PredictiveOptions(Options):
    """How the prior is simulated and a log held against it."""

    simulations: int = option(59, "with the log the largest of them has a p-value of 1/60", least=1)
    batch: int = option(10, "of them in memory at a time", least=1)
    samples: int = option(50, "of a log: more are correlated, and distances in many dimensions alike", least=1)
    neighbours: int = option(20, "of the local outlier factor, as its authors advise", least=1)


_OPTIONS = PredictiveOptions()


@dataclass(frozen=True)
class OutsidePrior:
    """Where a log lies among simulations of the prior.

    Args:
        p: of a log as far from the prior's simulations as this one.
        log: its name.
        channel: where it is farthest.
        time: s, where it is farthest.
    """

    p: float
    log: str
    channel: str
    time: float

    @property
    def alarm(self) -> bool:
        """Whether the log is outside."""
        return self.p <= THRESHOLDS.misfit

    @property
    def finding(self) -> Finding:
        """It as a finding."""
        code = Code.OUTSIDE_PRIOR if self.alarm else Code.WITHIN_PRIOR
        return finding(code, log=self.log, p=self.p, channel=self.channel, time=self.time)

    @property
    def text(self) -> str:
        """In a sentence."""
        return self.finding.text


def outside_prior(windows: Windows | Chain, prior: Posterior, noise: Noise, *, seed: int = 0) -> list[OutsidePrior]:
    """For each log its place among simulations of the prior; those that diverge are left out.

    Args:
        windows: the logs, bound to the simulator.
        prior: of the parameters.
        noise: (O,) of all channels.
        seed: of the simulations.

    Returns:
        One for each log.

    Raises:
        ValueError: where more than half of the simulations diverge.
    """
    logs, made = windows.trajectories, _predictive(windows, prior, noise, seed)
    if len(made) < _OPTIONS.simulations // 2:
        share = f"{len(made)} of {_OPTIONS.simulations}"
        raise ValueError(f"prior: {share} simulations did not diverge, half are needed; narrow the bounds")
    far = np.zeros((len(logs), len(windows.channels), 1 + len(made)))
    farthest = np.zeros((len(logs), len(windows.channels)))
    for k, log in enumerate(logs):
        for i, c in enumerate(windows.channels):
            known = np.flatnonzero(np.isfinite(log.observations[:, c]))
            if not len(known):
                continue
            kept = known[np.linspace(0, len(known) - 1, min(_OPTIONS.samples, len(known))).round().astype(int)]
            simulated = np.stack([one[k, kept, c] for one in made])
            far[k, i] = _outlier_factors(simulated, log.observations[kept, c])
            gap = np.abs(log.observations[kept, c] - simulated.mean(0)) / np.maximum(simulated.std(0), 1e-12)
            farthest[k, i] = kept[gap.argmax()] * log.dt
    largest = far[..., 1:].max((0, 1))
    outcome = []
    for k, name in enumerate(logs.names):
        i = int(far[k, :, 0].argmax())
        p = float((1 + (largest >= far[k, i, 0]).sum()) / (1 + len(made)))
        channel = windows.simulator.environment.channels[windows.channels[i]]
        outcome.append(OutsidePrior(p, name, channel, float(farthest[k, i])))
    return outcome


def _predictive(windows: Windows | Chain, prior: Posterior, noise: Noise, seed: int) -> list[FloatArray]:
    """Observations (R, T+1, O) of the logs at draws of the prior, orientations written near the logs' own."""
    replicas, rng = Replicas(windows.simulator, windows.trajectories, noise), np.random.default_rng(seed)
    thetas = prior.sample((_OPTIONS.simulations,), generator=torch.Generator().manual_seed(seed)).numpy()
    batches = np.array_split(thetas, max(1, _OPTIONS.simulations // _OPTIONS.batch))
    made = (one for batch in batches for one in replicas.many(batch, rng, estimated=True))
    rotations, seen = windows.simulator.environment.rotations, windows.trajectories.observations
    return [written_near(one.observations, seen, rotations) for one in made if one is not None]


def _outlier_factors(simulated: FloatArray, log: FloatArray) -> FloatArray:
    """Local outlier factors (1 + n,) of the log (F,) and of n simulations (n, F) among one another."""
    from sklearn.neighbors import LocalOutlierFactor

    every, sd = np.concatenate([log[None], simulated]), simulated.std(0)
    varies = sd > 1e-12
    if not varies.any():
        return np.zeros(len(every))
    factor = LocalOutlierFactor(n_neighbors=min(_OPTIONS.neighbours, len(simulated) - 1))
    return np.asarray(-factor.fit(every[:, varies] / sd[varies]).negative_outlier_factor_)
