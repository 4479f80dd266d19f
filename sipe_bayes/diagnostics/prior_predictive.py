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
from sipe_bayes.core.findings import Code, Finding, Severity, finding, p_text
from sipe_bayes.core.rotations import written_near
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.likelihood import BoundLikelihood, Noise, Replicas
from sipe_bayes.posterior import Posterior

SIMULATIONS = 39  # with the log the largest of them has a p-value of 1/40
STEPS = 2000  # control steps of windows spread evenly over long logs


@dataclass(frozen=True)
class OutsidePrior:
    """Where a log lies among simulations of the prior, and the channel and time, in s, where it is farthest.

    ``p`` is that of a log as far from them as this one, at least ``floor``; ``followed``: whether the calibrated model
    follows the log all the same.
    """

    p: float
    log: str
    channel: str
    time: float
    followed: bool = False
    floor: float = 0.0

    @property
    def alarm(self) -> bool:
        """Whether the log is outside."""
        return self.p <= THRESHOLDS.misfit

    @property
    def finding(self) -> Finding:
        """The diagnostic; a caution where the calibrated model follows."""
        severity, remedy = Severity.BLOCKING, "widen the bounds, or correct the model, units or signs"
        if self.followed:
            severity, remedy = Severity.CAUTION, "the calibrated model follows it all the same"
        values = {**vars(self), "p": p_text(self.p, self.floor), "remedy": remedy}
        return finding(Code.OUTSIDE_PRIOR, severity=severity, **values)


def outside_prior(
    windows: BoundLikelihood, prior: Posterior, noise: Noise, *, seed: int = 0, followed: bool = False
) -> list[OutsidePrior]:
    """For each log its place among simulations of the prior with ``noise`` (O,) of all channels.

    By windows: commands of a controller, replayed over a whole log, drive every model but the true one away, and the
    log would be outside by staying. ``followed`` see ``OutsidePrior``.

    Raises:
        ValueError: where more than half of the simulations diverge; those that do are left out.
    """
    chosen = windows.spread_over(STEPS, every_log=True)
    ends = zip(windows.log[chosen], windows.start[chosen], (windows.start + windows.steps)[chosen], strict=True)
    logs = Trajectories.stack([windows.trajectories[int(log)].slice(int(a), int(b)) for log, a, b in ends])
    replicas, rng = Replicas(windows.simulator, logs, noise), np.random.default_rng(seed)
    thetas = prior.sample((SIMULATIONS,), generator=torch.Generator().manual_seed(seed)).numpy()
    batches = np.array_split(thetas, SIMULATIONS // 10)  # so many are in memory at a time
    replayed = (one for batch in batches for one in replicas.many(batch, rng, estimated=True))
    rotations = windows.simulator.environment.rotations
    made = [written_near(one.observations, logs.observations, rotations) for one in replayed if one is not None]
    if len(made) < SIMULATIONS // 2:
        did = f"{len(made)} of {SIMULATIONS} simulations did not diverge"
        raise ValueError(f"prior: {did}, half are needed; narrow the bounds")
    far = np.zeros((len(logs), len(windows.channels), 1 + len(made)))
    farthest = np.zeros((len(logs), len(windows.channels)))
    for k, log in enumerate(logs):
        for i, c in enumerate(windows.channels):
            known = np.flatnonzero(np.isfinite(log.observations[:, c]))
            if not len(known):
                continue
            # more samples are correlated, and distances in many dimensions alike
            kept = known[np.linspace(0, len(known) - 1, min(50, len(known))).round().astype(int)]
            simulated = np.stack([one[k, kept, c] for one in made])
            # a distance below it counts as none: what smoothing does to a start is more than a quiet sensor's noise
            least = 0.02 * float(windows.spread[i])
            far[k, i], scale = outlier_factors(simulated, log.observations[kept, c], least)
            gap = np.abs(log.observations[kept, c] - simulated.mean(0)) / np.maximum(scale, 1e-12)
            farthest[k, i] = kept[gap.argmax()] * log.dt
    largest = far[..., 1:].max((0, 1))
    outcome, floor = [], 1 / (1 + len(made))
    for number, name in enumerate(windows.trajectories.names):
        mine = np.flatnonzero(windows.log[chosen] == number)
        if len(mine):
            place, worst = np.unravel_index(far[mine, :, 0].argmax(), (len(mine), far.shape[1]))
            window = mine[place]
            p = float((1 + (largest >= far[window, worst, 0]).sum()) * floor)
            when = float(windows.start[chosen[window]] * windows.dt[chosen[window]] + farthest[window, worst])
            outcome.append(OutsidePrior(p, name, windows.fitted[worst], when, followed, floor))
    return outcome


def follows(windows: BoundLikelihood, predicted: FloatArray) -> bool:
    """Whether predictions (W, L, C) bend as the logs do, in every channel: with a wrong unit or sign they do not.

    What a straight line in time, as of a start that is slightly off, leaves of the median window is compared with what
    it leaves of the difference; where a channel rests in most windows, of those in which it moves.
    """
    for c in range(windows.observed.shape[2]):
        pairs = []
        for measured, simulated, known in zip(windows.measured, predicted, windows.observed[..., c], strict=True):
            if known.sum() > 5:
                time, own = np.flatnonzero(known).astype(float), measured[known, c]
                line = np.linalg.qr(np.stack([np.ones_like(time), time], axis=1))[0]
                both = np.stack([own - simulated[known, c], own])
                pairs.append(np.linalg.norm(both - both @ line @ line.T, axis=1))
        if not pairs:
            continue
        bends = np.array(pairs)
        moving = bends[:, 1] >= 0.1 * bends[:, 1].max()  # of what rests noise alone is left
        medians = (np.median(some, axis=0) for some in (bends, bends[moving]))
        if not any(left < THRESHOLDS.followed * whole for left, whole in medians):
            return False
    return True


def outlier_factors(simulated: FloatArray, log: FloatArray, least: float) -> tuple[FloatArray, FloatArray]:
    """Local outlier factors (1 + n,) of the log (F,) and of n simulations (n, F) among one another, and scales (F,).

    Scales are sds over all, the log among them, so that under the null each is as likely to be the farthest; at least
    ``least``. Nothing is told where the simulations do not vary.
    """
    from sklearn.neighbors import LocalOutlierFactor

    every, varies = np.concatenate([log[None], simulated]), simulated.std(0) > 1e-12
    scale = np.maximum(every.std(0), least)
    if not varies.any():
        return np.zeros(len(every)), scale
    neighbours = min(20, len(simulated) - 1)  # as its authors advise
    fitted = LocalOutlierFactor(n_neighbors=neighbours).fit(every[:, varies] / scale[varies])
    return np.asarray(-fitted.negative_outlier_factor_), scale
