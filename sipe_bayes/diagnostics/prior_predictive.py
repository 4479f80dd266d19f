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
from sipe_bayes.core.findings import Code, Finding, finding, p_text
from sipe_bayes.core.options import Options, option
from sipe_bayes.core.rotations import written_near
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.likelihood import BoundLikelihood, Noise, Replicas
from sipe_bayes.posterior import Posterior


@dataclass(frozen=True)
class PredictiveOptions(Options):
    """How the prior is simulated and a log held against it."""

    simulations: int = option(39, "with the log the largest of them has a p-value of 1/40", least=1)
    steps: int = option(2000, "of windows spread evenly over long logs", "control steps", least=1)
    batch: int = option(10, "of them in memory at a time", least=1)
    least: float = option(
        0.02,
        "a distance that counts as none: what smoothing does to a start is more than a quiet sensor's noise",
        "of a channel's spread",
        least=0,
    )
    samples: int = option(50, "of a log: more are correlated, and distances in many dimensions alike", least=1)
    fewest: int = option(5, "samples of a window from which its bends are told", least=3)
    moving: float = option(0.1, "of the window that bends most: less is rest", least=0, most=1)
    neighbours: int = option(20, "of the local outlier factor, as its authors advise", least=1)


PREDICTIVE = PredictiveOptions()


@dataclass(frozen=True)
class OutsidePrior:
    """Where a log lies among simulations of the prior.

    Args:
        p: of a log as far from the prior's simulations as this one.
        log: its name.
        channel: where it is farthest.
        time: s, where it is farthest.
        followed: whether the calibrated model follows the log all the same, but for what it is named to lack.
        floor: the least p that the simulations can give.
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
        """It as a finding."""
        outside = Code.OUTSIDE_PRIOR_FOLLOWED if self.followed else Code.OUTSIDE_PRIOR
        code = outside if self.alarm else Code.WITHIN_PRIOR
        return finding(code, log=self.log, p=p_text(self.p, self.floor), channel=self.channel, time=self.time)

    @property
    def text(self) -> str:
        """In a sentence."""
        return self.finding.text


def outside_prior(
    windows: BoundLikelihood, prior: Posterior, noise: Noise, *, seed: int = 0, followed: bool = False
) -> list[OutsidePrior]:
    """For each log its place among simulations of the prior; those that diverge are left out.

    It is looked at in windows: commands of a controller, replayed over a whole log, drive every model but the true one
    away, and the log would be outside by staying.

    Args:
        windows: the logs, bound to the simulator.
        prior: of the parameters.
        noise: (O,) of all channels.
        seed: of the simulations.
        followed: whether the calibrated model follows the logs all the same.

    Returns:
        One for each log.

    Raises:
        ValueError: where more than half of the simulations diverge.
    """
    chosen = windows.spread_over(PREDICTIVE.steps, every_log=True)
    logs = Trajectories.stack([_piece(windows, int(w)) for w in chosen])
    made = _predictive(windows, logs, prior, noise, seed)
    if len(made) < PREDICTIVE.simulations // 2:
        share = f"{len(made)} of {PREDICTIVE.simulations}"
        raise ValueError(f"prior: {share} simulations did not diverge, half are needed; narrow the bounds")
    far = np.zeros((len(logs), len(windows.channels), 1 + len(made)))
    farthest = np.zeros((len(logs), len(windows.channels)))
    for k, log in enumerate(logs):
        for i, c in enumerate(windows.channels):
            known = np.flatnonzero(np.isfinite(log.observations[:, c]))
            if not len(known):
                continue
            kept = known[np.linspace(0, len(known) - 1, min(PREDICTIVE.samples, len(known))).round().astype(int)]
            simulated = np.stack([one[k, kept, c] for one in made])
            least = PREDICTIVE.least * float(windows.spread[i])
            far[k, i], scale = outlier_factors(simulated, log.observations[kept, c], least)
            gap = np.abs(log.observations[kept, c] - simulated.mean(0)) / np.maximum(scale, 1e-12)
            farthest[k, i] = kept[gap.argmax()] * log.dt
    largest = far[..., 1:].max((0, 1))
    outcome = []
    for number, name in enumerate(windows.trajectories.names):
        mine = np.flatnonzero(windows.log[chosen] == number)
        if not len(mine):
            continue
        k, i = (int(x) for x in np.unravel_index(far[mine, :, 0].argmax(), (len(mine), far.shape[1])))
        k = int(mine[k])
        p = float((1 + (largest >= far[k, i, 0]).sum()) / (1 + len(made)))
        channel = windows.simulator.environment.channels[windows.channels[i]]
        begin = float(windows.start[chosen[k]] * windows.dt[chosen[k]])
        when = begin + float(farthest[k, i])
        outcome.append(OutsidePrior(p, name, channel, when, followed, floor=1 / (1 + len(made))))
    return outcome


def follows(windows: BoundLikelihood, predicted: FloatArray) -> bool:
    """Whether simulations bend as the logs do, in every channel: with a wrong unit or sign they do not.

    What a straight line in time leaves of the median window is compared with what it leaves of the difference: a start
    that is slightly off leaves such a line. A channel may rest in most windows, as what is only pushed now and then:
    those in which it moves may speak for it, too.

    Args:
        windows: of the logs.
        predicted: (W, L, C).
    """
    for c in range(windows.observed.shape[2]):
        pairs = []
        for w, known in enumerate(windows.observed[..., c]):
            if known.sum() > PREDICTIVE.fewest:
                time = np.flatnonzero(known).astype(float)
                line = np.linalg.qr(np.stack([np.ones_like(time), time], axis=1))[0]
                both = np.stack([windows.measured[w, known, c] - predicted[w, known, c], windows.measured[w, known, c]])
                pairs.append(np.linalg.norm(both - both @ line @ line.T, axis=1))
        if not pairs:
            continue
        bends = np.array(pairs)
        moving = bends[:, 1] >= PREDICTIVE.moving * bends[:, 1].max()  # of what rests noise alone is left
        medians = (np.median(some, axis=0) for some in (bends, bends[moving]))
        if not any(left < THRESHOLDS.followed * whole for left, whole in medians):
            return False
    return True


def _piece(windows: BoundLikelihood, number: int) -> Trajectory:
    """A window as a log of its own."""
    log, start = int(windows.log[number]), int(windows.start[number])
    whole, stop = windows.trajectories[log], start + int(windows.steps[number])
    states = None if whole.states is None else whole.states[start : stop + 1]
    observations, actions = whole.observations[start : stop + 1], whole.actions[start:stop]
    return Trajectory(observations, actions, whole.dt, states, whole.name, whole.channels)


def _predictive(
    windows: BoundLikelihood, logs: Trajectories, prior: Posterior, noise: Noise, seed: int
) -> list[FloatArray]:
    """Observations (R, T+1, O) of the logs at draws of the prior, orientations written near the logs' own."""
    replicas, rng = Replicas(windows.simulator, logs, noise), np.random.default_rng(seed)
    thetas = prior.sample((PREDICTIVE.simulations,), generator=torch.Generator().manual_seed(seed)).numpy()
    batches = np.array_split(thetas, max(1, PREDICTIVE.simulations // PREDICTIVE.batch))
    made = (one for batch in batches for one in replicas.many(batch, rng, estimated=True))
    rotations, seen = windows.simulator.environment.rotations, logs.observations
    return [written_near(one.observations, seen, rotations) for one in made if one is not None]


def outlier_factors(simulated: FloatArray, log: FloatArray, least: float) -> tuple[FloatArray, FloatArray]:
    """Local outlier factors (1 + n,) of the log (F,) and of n simulations (n, F) among one another, and scales (F,).

    A sample's scale is the sd over all of them, the log among them, so that under the null each is as likely to be the
    farthest; at least ``least``. Nothing is told where the simulations do not vary.
    """
    every, varies = np.concatenate([log[None], simulated]), simulated.std(0) > 1e-12
    scale = np.maximum(every.std(0), least)
    if not varies.any():
        return np.zeros(len(every)), scale
    points = every[:, varies] / scale[varies]
    apart = np.sqrt(((points[:, None] - points) ** 2).sum(-1))
    np.fill_diagonal(apart, np.inf)
    near = np.argsort(apart, axis=1)[:, : min(PREDICTIVE.neighbours, len(simulated) - 1)]
    ways = np.take_along_axis(apart, near, axis=1)
    # how densely the neighbourhood is filled, a way counted as no shorter than the neighbour's own to its k-th
    density = 1 / (np.maximum(ways, ways[near, -1]).mean(1) + 1e-10)
    return np.asarray(density[near].mean(1) / density), scale
