r"""Parameters that differ between logs: what they share, how far they spread, what a new log would have.

A model that lacks something asks for other values in every log, each with an interval that is too narrow. Here the
parameters of log k are drawn around common ones,

.. math:: \theta_k \sim \mathcal N(\mu, \operatorname{diag}(\tau^2)), \qquad \tau_j \sim |\mathcal N(0, s^2)|,

with mu uniform on the cube, or as the prior has it, and s a share of the range, as much less as the prior knows the
parameter better than a uniform one: what was weighed weighs the same in every log. Log k enters by its optimum m_k and
information L_k, exp(-(theta_k - m_k)' L_k (theta_k - m_k) / 2), whose theta_k is integrated in closed form. With S =
diag(tau) that leaves

.. math::

    p(y_k \mid \mu, \tau) \propto |I + S L_k S|^{-1/2} e^{-(\mu - m_k)' P_k (\mu - m_k) / 2}, \qquad
    P_k = L_k - L_k S (I + S L_k S)^{-1} S L_k ,

normal in mu, so that only tau is sampled (emcee), and mu with it where hardly a mu lies in the cube. A. Gelman, "Prior
distributions for variance parameters in hierarchical models", Bayesian Analysis 1 (2006), 515-533,
https://doi.org/10.1214/06-BA117A, section 5, on the half-normal's kin.

Deviations:

- Each log's likelihood is its normal at its own optimum, but for directions of which the log says less than a uniform
  prior while its optimum lies beyond the cube: along a ridge, as of a gain and the masses that it moves, a linear model
  may have it anywhere.
- A new log's theta is restricted to the cube; those of the logs at hand are not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import emcee
import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.likelihood import UNIFORM_PRECISION, QuadraticPrior
from sipe_bayes.posterior import Particles, Posterior
from sipe_bayes.posterior.snooker import SnookerMove
from sipe_bayes.posterior.truncated_normal import interval_quantile

_FARTHEST = 40.0  # times the prior's scale: a spread beyond
_FEW = 0.02  # share of mu in the cube, below which tau is sampled together with it
_MIDDLE = 3.0  # precision around the cube's middle, by which mu is drawn and which the draws' weights take away again


@dataclass(frozen=True)
class RandomEffectsOptions(Options):
    """How the spread between logs is sampled."""

    spread: float = option(0.25, "of a value of which nothing is known between logs", "of the range", above=0)
    walkers: int = option(4, "for each parameter: emcee asks for twice as many as dimensions", least=2)
    warmup: int = option(300, "steps until the walkers have spread", "steps", least=1)
    steps: int = option(400, "steps that are kept, every tenth of them", "steps", least=10)
    tries: int = option(4, "draws of mu for each tau, of which those in the cube are kept", least=1)


@dataclass(frozen=True)
class LogEstimate:
    """One log by itself.

    Args:
        name: of the log.
        mean: (N,) in theta.
        information: (N, N) in theta.
    """

    name: str
    mean: FloatArray
    information: FloatArray

    @property
    def determined(self) -> LogEstimate:
        """Without directions of which it says less than a uniform prior, with its optimum there beyond the cube."""
        precision, axes = np.linalg.eigh(self.information)
        along = axes.T @ self.mean
        beyond = (along < np.minimum(axes, 0).sum(0)) | (along > np.maximum(axes, 0).sum(0))
        axes = axes[:, (precision > UNIFORM_PRECISION) | ~beyond]
        mean = 0.5 + axes @ (axes.T @ (self.mean - 0.5))
        return LogEstimate(self.name, mean, axes @ (axes.T @ self.information @ axes) @ axes.T)


@dataclass(frozen=True)
class RandomEffects:
    """What logs that differ have to say.

    Args:
        common: of mu, what the logs share.
        new_log: of the theta that a further log would have.
        spread: (M, N) draws of tau, which weigh as those of ``common`` do.
    """

    common: Particles
    new_log: Particles
    spread: FloatArray


def random_effects(
    logs: Sequence[LogEstimate], prior: Posterior, seed: int = 0, options: RandomEffectsOptions | None = None
) -> RandomEffects:
    """The posterior of what several logs share, and of what a further one would have.

    Args:
        logs: each by itself.
        prior: of theta.
        seed: of the draws.
        options: of the sampling.

    Raises:
        ValueError: for fewer than two logs.
    """
    if len(logs) < 2:
        raise ValueError(f"logs: expected two or more, got {len(logs)}; one log tells nothing of what differs")
    options = options or RandomEffectsOptions()
    logs = [log.determined for log in logs]
    quadratic = QuadraticPrior.of(prior)
    model = _Model(
        np.stack([log.information for log in logs]),
        np.stack([log.mean for log in logs]),
        quadratic,
        options.spread * _open(quadratic),
    )
    random = np.random.default_rng(seed)
    tau = np.repeat(model.sampled(options, random), options.tries, axis=0)
    mu = model.drawn(tau, random)
    kept = ((mu >= 0) & (mu <= 1)).all(1)
    if kept.mean() < _FEW:  # the logs ask for values beyond the bounds
        mu, tau = model.sampled_inside(options, random)
        weights = np.ones(len(mu))
    else:
        mu, tau = mu[kept], tau[kept]
        weights = np.exp(0.5 * _MIDDLE * ((mu - 0.5) ** 2).sum(1))
    further = mu + tau * interval_quantile(-mu / tau, (1 - mu) / tau, random.uniform(size=mu.shape))
    common, new_log = (Particles(theta, prior.space, weights=weights) for theta in (mu, further))
    return RandomEffects(common, new_log, tau)


def _open(prior: QuadraticPrior) -> FloatArray:
    """The prior's sds (N,) in those of a uniform one."""
    precision = prior.precision + UNIFORM_PRECISION * np.eye(len(prior.mean))
    return np.asarray(np.sqrt(UNIFORM_PRECISION * np.diag(np.linalg.inv(precision))))


@dataclass(frozen=True)
class _Model:
    """K logs: information (K, N, N) and mean (K, N); scale (N,) of tau's prior."""

    information: FloatArray
    mean: FloatArray
    prior: QuadraticPrior
    scale: FloatArray

    def shared(self, tau: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Given tau (W, N): log-likelihood (W,) without mu, precision (W, N, N) and pull (W, N) of mu."""
        n = tau.shape[-1]
        scaled = tau[:, None, :, None] * self.information  # S L
        inner = np.eye(n) + scaled * tau[:, None, None, :]
        marginal = self.information - np.swapaxes(scaled, -1, -2) @ np.linalg.solve(inner, scaled)
        marginal = 0.5 * (marginal + np.swapaxes(marginal, -1, -2))
        pulls = np.einsum("wkij,kj->wki", marginal, self.mean)
        level = -0.5 * np.linalg.slogdet(inner)[1].sum(1) - 0.5 * np.einsum("wki,ki->w", pulls, self.mean)
        return level, marginal.sum(1) + self.prior.precision, pulls.sum(1) + self.prior.precision @ self.prior.mean

    def flattened(self, tau: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """``shared`` with a weak normal around the cube's middle, so that mu can be drawn; mean (W, N), not pull."""
        level, precision, pull = self.shared(tau)
        precision, pull = precision + _MIDDLE * np.eye(tau.shape[-1]), pull + 0.5 * _MIDDLE
        mean: FloatArray = np.linalg.solve(precision, pull[..., None])[..., 0].astype(np.float64, copy=False)
        return level + 0.5 * (pull * mean).sum(1) - 0.5 * np.linalg.slogdet(precision)[1], precision, mean

    def spread_density(self, log_tau: FloatArray) -> FloatArray:
        """Of log tau (W, N), up to a constant (W,)."""
        far = self._too_far(log_tau)
        tau = np.exp(np.where(far[:, None], 0.0, log_tau))
        return np.where(far, -np.inf, self.flattened(tau)[0] + self._spread_prior(log_tau))

    def joint_density(self, both: FloatArray) -> FloatArray:
        """Of mu in the cube and log tau (W, 2 N), up to a constant (W,)."""
        mu, log_tau = np.split(both, 2, axis=1)
        outside = ((mu < 0) | (mu > 1)).any(1) | self._too_far(log_tau)
        mu, tau = np.where(outside[:, None], 0.5, mu), np.exp(np.where(outside[:, None], 0.0, log_tau))
        level, precision, pull = self.shared(tau)
        level = level + (pull * mu).sum(1) - 0.5 * np.einsum("wi,wij,wj->w", mu, precision, mu)
        return np.where(outside, -np.inf, level + self._spread_prior(log_tau))

    def _too_far(self, log_tau: FloatArray) -> BoolArray:
        """Next to no prior, and no numbers for it."""
        return np.asarray((log_tau > np.log(_FARTHEST * self.scale)).any(1))

    def _spread_prior(self, log_tau: FloatArray) -> FloatArray:
        return np.asarray((log_tau - 0.5 * np.exp(2 * np.minimum(log_tau, 300.0)) / self.scale**2).sum(1))

    def sampled(self, options: RandomEffectsOptions, random: np.random.Generator) -> FloatArray:
        """Draws of tau (M, N)."""
        n = self.mean.shape[1]
        walkers = max(options.walkers * n, 32)
        start = np.log(self.scale * random.uniform(0.02, 1.0, (walkers, n)))
        return np.exp(_walked(self.spread_density, start, options, random))

    def sampled_inside(
        self, options: RandomEffectsOptions, random: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Draws of mu in the cube (M, N) and of tau (M, N), where the logs ask for values beyond its bounds."""
        walkers = max(2 * options.walkers * self.mean.shape[1], 128)
        near = np.clip(self.mean.mean(0), 0.02, 0.98)
        apart = np.clip(np.sqrt(((self.mean - near) ** 2).mean(0)), 1e-6, self.scale * _FARTHEST / 4)
        tau = apart * random.uniform(0.5, 2.0, (walkers, len(near)))
        mu = near + apart / np.sqrt(len(self.mean)) * random.standard_normal(tau.shape)
        start = np.concatenate([np.clip(mu, 0.001, 0.999), np.log(tau)], 1)
        mu, log_tau = np.split(_walked(self.joint_density, start, options, random), 2, axis=1)
        return mu, np.exp(log_tau)

    def drawn(self, tau: FloatArray, random: np.random.Generator) -> FloatArray:
        """For each tau (M, N) a mu (M, N), in the cube or not."""
        _, precision, mean = self.flattened(tau)
        root = np.linalg.cholesky(np.linalg.inv(precision))
        return np.asarray(mean + (root @ random.standard_normal((*tau.shape, 1)))[..., 0])


def _walked(
    density: Callable[[FloatArray], FloatArray],
    start: FloatArray,
    options: RandomEffectsOptions,
    random: np.random.Generator,
) -> FloatArray:
    """Draws (M, D) of a density of (W, D) with values (W,); walkers begin at ``start`` (W, D)."""
    seed, (walkers, size) = int(random.integers(2**32)), start.shape
    state = emcee.State(start, random_state=np.random.RandomState(seed).get_state())
    moves = [(emcee.moves.DEMove(), 0.8), (SnookerMove(), 0.2)]
    sampler = emcee.EnsembleSampler(walkers, size, density, vectorize=True, moves=moves)
    # of the walkers' steps, times the cube of the dimensions: 30 of them take some seconds
    share = min(1.0, 3e8 / (walkers * size**3 * (options.warmup + options.steps)))
    warmup, steps = math.ceil(share * options.warmup), max(math.ceil(share * options.steps), 10)
    sampler.run_mcmc(state, warmup + steps)
    chain: FloatArray = sampler.get_chain(discard=warmup, thin=10, flat=True)
    return chain
