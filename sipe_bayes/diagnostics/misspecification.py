"""Can the model explain the log? Residuals that are not noise, and a log that no parameters within the bounds would give.

**Residuals.** At the estimate, with parameters and windows' starts free to follow (linearised) and autoregressive noise, two kinds of
statistics are looked at. *Probes*: a force that the model may lack, as a change u + b phi(t) of an actuator's command with
phi = dry friction tanh(v / v0), friction under load |u| tanh(v / v0), drag v |v|, delay u(t - 1) - u(t), a spring q, a stiffening
spring q^3, an offset 1 and a gain that is not constant u |u|; v and q are the velocity and position of the joint that it drives. The
score statistic of b, all else projected out, is chi-square with one degree of freedom (C. R. Rao 1948,
https://doi.org/10.1017/S0305004100023987): the simulation answers what such a force would have done to every sample. *Whiteness*, of
each channel's whitened residuals: the sum of squared autocorrelations over lags 1, 2, 3, 5, 8, ... (G. Box, D. Pierce 1970,
https://doi.org/10.1080/01621459.1970.10481180), and the largest mean square of ten pieces of time.

The null is simulated: noise as estimated, drawn anew, estimated anew, projected alike. Each statistic's cube root is
standardised by its mean and sd over these; the largest is compared with the largest of each. So the p-value holds for
white and first-order autoregressive sensor noise, whatever the number of probes, up to the linearisation.

**Prior predictive.** Logs simulated from the prior, with noise: the log's local outlier factor among them (M. Breunig et al. 2000,
https://doi.org/10.1145/342009.335388), channel by channel, ranked among their own; Bonferroni's factor for the channels.

Deviations: a probe acts through an actuator, so what is wrong at a joint that none drives is left to whiteness, which slow
misfit passes as slow noise. A cause that is named is the one that fits best, not one that is proven.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from sipe_bayes.diagnostics.evaluate import best_starts
from sipe_bayes.likelihood import Windows
from sipe_bayes.noise import Moments, Noise, Pulls, coefficients, eliminate, estimate_noise, whiten
from sipe_bayes.posterior import Posterior
from sipe_bayes.replicas import Replicas

FloatArray = NDArray[np.float64]

SIMULATED = 199
LEVEL = 0.05
_STEP = 1e-3  # of a command's size: how far a probe is pushed
_SOFT = 0.05  # of a velocity's size, where friction turns round
_PIECES = 10
_LAGS = (1, 2, 3, 5, 8, 13, 21, 34)
_FLAT_PRECISION = 1e-6
_SAMPLES, _NEIGHBOURS, _PREDICTIVE = 50, 20, 100


@dataclass(frozen=True)
class Misfit:
    """p: of residuals as odd as these under a right model with autoregressive noise. cause: what fits them best, in words; log,
    channel, start, stop (s): where it shows most."""

    p: float
    cause: str
    log: str
    channel: str
    start: float
    stop: float

    @property
    def text(self) -> str:
        """In a sentence."""
        return (
            f"the residuals are not noise (p = {self.p:.2g}): they look like {self.cause}, most in {self.channel} of {self.log} between "
            f"{self.start:.3g} and {self.stop:.3g} s; model it, or do not trust the intervals"
        )


@dataclass(frozen=True)
class OutsidePrior:
    """p: of a log as far from the prior's simulations as this one; channel, time (s): where it is farthest."""

    p: float
    log: str
    channel: str
    time: float

    @property
    def text(self) -> str:
        """In a sentence."""
        return (
            f"log {self.log} is unlike every simulation of the prior (p = {self.p:.2g}), most in {self.channel} at {self.time:.3g} s: "
            "widen the bounds, or correct the model, units or signs"
        )


def misfit(windows: Windows, theta: FloatArray, noise: Noise, *, seed: int = 0, simulated: int = SIMULATED) -> Misfit:
    """How odd the residuals of fitted ``windows`` are at theta (N,) with the ``noise`` (C) found there. Costs a linearisation and a
    rollout for each probe."""
    return _Residuals(windows, theta, noise).misfit(np.random.default_rng(seed), simulated)


class _Residuals:
    """The log linearised at the estimate, with K probes beside the N parameters."""

    def __init__(self, windows: Windows, theta: FloatArray, noise: Noise) -> None:
        self.windows, self.noise = windows, noise
        starts = best_starts(windows, theta, noise)
        found = windows.linearise(theta, starts)
        if not found.valid:
            raise ValueError("theta: the simulation diverges at the estimate; nothing can be said of its residuals")
        self.names, effects = _probes(windows, theta, starts)
        n = windows.num_theta
        parts = (found.jacobian[..., :n], effects, found.jacobian[..., n:])
        self.residual, self.jacobian, self.starts = found.residual, np.concatenate(parts, axis=-1), starts
        self.count = n + len(self.names)
        self.coloured = bool((noise.tau > 0).any())

    def misfit(self, rng: np.random.Generator, simulated: int) -> Misfit:
        seen, detail = self.statistics(self.residual, self.noise)
        null = np.stack([self.statistics(*self.drawn(rng))[0] for _ in range(simulated)])
        middle, spread = null.mean(0), np.maximum(null.std(0), 1e-12)
        odd, largest = (seen - middle) / spread, ((null - middle) / spread).max(1)
        worst = int(odd.argmax())
        p = (1 + int((largest >= odd[worst]).sum())) / (1 + simulated)
        return self._described(p, worst, detail)

    def drawn(self, rng: np.random.Generator) -> tuple[FloatArray, Noise]:
        """A residual (W, L, C) of the noise alone, and the noise as it is then estimated."""
        drawn = np.zeros_like(self.residual)
        for c, s in enumerate(self.windows.sequences):
            a = coefficients(s.gaps, float(self.noise.tau[c]))[s.gap]
            white, flat = rng.standard_normal(len(s.index)), np.empty(len(s.index))
            scale, before = np.sqrt(1 - a**2), 0.0
            for i in range(len(flat)):
                before = flat[i] = a[i] * before + scale[i] * white[i]
            column = drawn[:, :, c].reshape(-1)
            column[s.index] = self.noise.sd[c] * flat
            drawn[:, :, c] = column.reshape(drawn.shape[:2])
        n = self.windows.num_theta
        kept = np.concatenate([self.jacobian[..., :n], self.jacobian[..., self.count :]], axis=-1)
        moments = Moments(drawn, kept, n, self.windows.sequences)
        flat_prior, none = _FLAT_PRECISION * np.eye(n), self.windows.no_starts()
        pulls = Pulls(flat_prior, np.zeros(n), self.windows.start_precision, none, np.full(n, True))
        unknown, channels = np.full(len(self.noise.sd), np.nan), self.windows.settings.noise_sd
        if channels is not None:
            unknown = np.array([np.nan if channels[c] is None else channels[c] for c in self.windows.channels], float)
        trajectories = self.windows.trajectories
        longest = float((trajectories.length * trajectories.dt).max())
        shortest = float(self.windows.dt.min())
        return drawn, estimate_noise(moments, self.noise, pulls, unknown, self.coloured, shortest, longest)

    def statistics(self, residual: FloatArray, noise: Noise) -> tuple[FloatArray, tuple[FloatArray, ...]]:
        """Cube roots of K score statistics, C sums of squared autocorrelations and C largest mean squares of a piece; and
        (residual left (W, L, C) without probes, with each probe alone (K, W, L, C), noise sd, noise tau)."""
        n, k = self.windows.num_theta, len(self.names)
        moments = Moments(residual, self.jacobian, self.count, self.windows.sequences)
        no_pull = self.windows.no_starts()
        arrow = eliminate(moments.normal(noise), self.count, self.windows.start_precision, no_pull)
        inner = arrow.precision + _FLAT_PRECISION * np.eye(self.count)
        base = np.linalg.solve(inner[:n, :n], arrow.gradient[:n])
        cross = np.linalg.solve(inner[:n, :n], inner[:n, n:])
        gradient = arrow.gradient[n:] - inner[n:, :n] @ base
        information = np.diag(inner)[n:] - np.einsum("ik,ik->k", inner[:n, n:], cross)
        usable = information > 1e-6 * np.diag(inner)[n:] + 2 * _FLAT_PRECISION
        scores = np.where(usable, gradient**2 / np.maximum(information, 1e-300), 0.0)

        def left(step: FloatArray) -> FloatArray:
            moved = self.jacobian[..., : self.count] @ step
            starts = np.einsum("wlcd,wd->wlc", self.jacobian[..., self.count :], arrow.starts(step))
            return np.where(self.windows.observed, residual - moved - starts, 0.0)

        plain = left(np.asarray(np.concatenate([base, np.zeros(k)]), np.float64))
        best = int(scores.argmax()) if k else 0
        amplitude = gradient[best] / information[best] if k and usable[best] else 0.0
        step = np.asarray(base, np.float64)
        if k:
            step = np.concatenate([step - amplitude * cross[:, best], amplitude * np.eye(k)[best]])
        white = [self._white(plain, c, noise) for c in range(len(noise.sd))]
        whiteness = [_autocorrelation(z) for z in white]
        pieces = [max(float((p**2).mean()) for p in np.array_split(z, _PIECES)) for z in white]
        return np.cbrt(np.concatenate([scores, whiteness, pieces])), (plain, left(step), noise.sd, noise.tau)

    def _white(self, residual: FloatArray, c: int, noise: Noise) -> FloatArray:
        flat = residual[:, :, c].reshape(-1)
        return whiten(flat, self.windows.sequences[c], float(noise.sd[c]), float(noise.tau[c]))

    def _described(self, p: float, worst: int, detail: tuple[FloatArray, ...]) -> Misfit:
        plain, explained, sd, tau = detail
        noise, k, channels = Noise(sd, tau), len(self.names), self.windows.fitted
        gains = [self._white(plain, c, noise) ** 2 for c in range(len(channels))]
        if worst < k:
            gains = [g - self._white(explained, c, noise) ** 2 for c, g in enumerate(gains)]
            channel, cause = int(np.argmax([g.sum() for g in gains])), self.names[worst]
        else:
            channel = (worst - k) % len(channels)
            whiteness = worst - k < len(channels)
            cause = "samples that follow one another" if whiteness else "noise that is not as large everywhere"
        index = self.windows.sequences[channel].index
        window, place = index // self.residual.shape[1], index % self.residual.shape[1]
        seconds = (self.windows.start[window] + place) * self.windows.dt[window]
        log = self.windows.log[window]
        best, where = -np.inf, (0, 0.0, 0.0)
        for piece in np.array_split(np.arange(len(index)), _PIECES * (int(log.max()) + 1)):
            if len(piece) and gains[channel][piece].sum() > best:
                best = float(gains[channel][piece].sum())
                where = (int(log[piece[0]]), float(seconds[piece[0]]), float(seconds[piece[-1]]))
        name = self.windows.trajectories.names[where[0]]
        return Misfit(p, cause, name, channels[channel], where[1], max(where[1], where[2]))


def _autocorrelation(z: FloatArray) -> float:
    z = z - z.mean()
    square = max(float(z @ z), 1e-300)
    lags = [lag for lag in _LAGS if lag < len(z) // 4]
    return float(len(z) * sum((z[lag:] @ z[:-lag] / square) ** 2 for lag in lags))


def _probes(windows: Windows, theta: FloatArray, starts: FloatArray) -> tuple[list[str], FloatArray]:
    """Names of K probes and their effects (W, L, C, K) on the predictions."""
    simulator, lanes = windows.simulator, windows.num_windows
    states = windows.states(starts)
    motion = simulator.rollout(
        np.tile(theta, (lanes, 1)), windows.actions, states, windows.dt, windows.names, goals=windows.goals
    )
    assert motion.states is not None
    plain = motion.observations[..., windows.channels]
    inside = np.arange(windows.actions.shape[1]) < windows.steps[:, None]
    names, effects = [], []
    for name, column, change in _changes(windows, motion.states[:, :-1], inside):
        moved = windows.actions.copy()
        moved[..., column] += change
        answer = simulator.rollout(
            np.tile(theta, (lanes, 1)), moved, states, windows.dt, windows.names, goals=windows.goals
        )
        effect = (answer.observations[..., windows.channels] - plain) / _STEP
        effect = np.where(windows.observed, effect, 0.0)
        if np.isfinite(effect).all() and np.abs(effect).max() > 0:
            names.append(name)
            effects.append(effect)
    shape = (*plain.shape, 0)
    return names, np.stack(effects, axis=-1) if effects else np.zeros(shape)


def _changes(windows: Windows, states: FloatArray, inside: NDArray[np.bool_]) -> list[tuple[str, int, FloatArray]]:
    """(what it stands for, column, change (W, T)) of commands, small against their size; states (W, T, S)."""
    simulator, model = windows.simulator, windows.simulator.model
    own = getattr(simulator.environment, "actuators", None)
    found: list[tuple[str, int, FloatArray]] = []
    for column in range(windows.actions.shape[-1]):
        label = own[column] if own is not None else f"actuator {column}"
        command = windows.actions[..., column]
        size = float(np.sqrt((command[inside] ** 2).mean())) or 1.0
        before = np.concatenate([command[:, :1], command[:, :-1]], axis=1)
        shapes = {
            f"a delay of {label}": before - command,
            f"an offset of {label}": np.ones_like(command),
            f"a gain of {label} that is not constant": command * np.abs(command),
        }
        joint = _joint(model, label) if own is not None else None
        if joint is not None:
            name, position, velocity = joint
            q, v = states[..., position], states[..., velocity]
            turn = np.tanh(v / (_SOFT * max(float(np.sqrt((v[inside] ** 2).mean())), 1e-9)))
            shapes |= {
                f"dry friction at {name}": turn,
                f"friction under load at {name}": np.abs(command) * turn,
                f"drag at {name}": v * np.abs(v),
                f"a spring at {name}": q,
                f"a stiffening spring at {name}": q**3,
            }
        for what, shape in shapes.items():
            scale = float(np.sqrt((shape[inside] ** 2).mean()))
            if np.isfinite(scale) and scale > 0:
                found.append((what, column, _STEP * size * shape / scale))
    return found


def _joint(model: mujoco.MjModel, actuator: str) -> tuple[str, int, int] | None:
    """Name, column of the position and of the velocity in the physics state, of the hinge or slide joint that an actuator drives."""
    index = model.actuator(actuator).id
    if int(model.actuator_trntype[index]) != int(mujoco.mjtTrn.mjTRN_JOINT):
        return None
    joint = int(model.actuator_trnid[index, 0])
    if int(model.jnt_type[joint]) not in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)):
        return None
    name = model.joint(joint).name or f"joint {joint}"
    return name, 1 + int(model.jnt_qposadr[joint]), 1 + model.nq + int(model.jnt_dofadr[joint])


def outside_prior(windows: Windows, prior: Posterior, noise: Noise, *, seed: int = 0) -> list[OutsidePrior]:
    """For each log its place among 100 simulations of the prior with ``noise`` (O channels); those that diverge are left out.
    Raises ValueError where fewer than half are left."""
    replicas, rng = Replicas(windows.simulator, windows.trajectories, noise), np.random.default_rng(seed)
    thetas = prior.sample((_PREDICTIVE,), generator=torch.Generator().manual_seed(seed)).numpy()
    made = [one for one in (replicas.make(theta, rng) for theta in thetas) if one is not None]
    if len(made) < _PREDICTIVE // 2:
        raise ValueError(
            f"prior: {len(made)} of {_PREDICTIVE} simulations did not diverge, half are needed; narrow the bounds"
        )
    found = []
    for k, log in enumerate(windows.trajectories):
        looks = []
        for c in windows.channels:
            there = np.flatnonzero(np.isfinite(log.observations[:, c]))
            kept = there[np.linspace(0, len(there) - 1, min(_SAMPLES, len(there))).round().astype(int)]
            simulated = np.stack([one.observations[k, kept, c] for one in made])
            p = _rank(simulated, log.observations[kept, c])
            gap = np.abs(log.observations[kept, c] - simulated.mean(0)) / np.maximum(simulated.std(0), 1e-12)
            looks.append((p, windows.simulator.environment.channels[c], float(kept[gap.argmax()] * log.dt)))
        p, channel, time = min(looks)
        found.append(OutsidePrior(min(1.0, p * len(looks)), log.name, channel, time))
    return found


def _rank(simulated: FloatArray, log: FloatArray) -> float:
    """Share of simulations (n, F), the log (F,) one of them, that are as far out as it is."""
    from sklearn.neighbors import LocalOutlierFactor

    every = np.concatenate([log[None], simulated])
    sd = simulated.std(0)
    varies = sd > 1e-12
    if not varies.any():
        return 1.0
    factor = LocalOutlierFactor(min(_NEIGHBOURS, len(simulated) - 1)).fit(every[:, varies] / sd[varies])
    far = -factor.negative_outlier_factor_
    return float((far >= far[0]).sum() / len(far))
