"""The posterior of a Gaussian process over the discrepancy: how probably a theta is as good as epsilon.

With mu(theta), s(theta) the process's prediction of the (transformed) discrepancy and sigma its noise,

    p(theta) = prior(theta) Phi((epsilon - mu(theta)) / sqrt(s(theta)^2 + sigma^2)) / Z,

the probability that one more simulation at theta would have a discrepancy below epsilon, times the prior: approximate
Bayesian computation with the simulator replaced (M. U. Gutmann, J. Corander 2016, "Bayesian Optimization for
Likelihood-Free Inference of Simulator-Based Statistical Models", https://jmlr.org/papers/v17/15-017.html, equation 21).
Where few simulations have been made s is large and the posterior keeps the prior's width.

Draws and Z are those of ``posterior.ensemble``.

``mode`` is the evaluated theta of lowest discrepancy: what Bayesian optimisation answers. It need not be where p is
largest, which the prior has a part in, and where the process smooths over what was evaluated.

Deviations:

- Exact draws are impossible; ``sample`` draws with replacement from the stored chains, whose mean, covariance and
  quantiles are the posterior's.
- R-hat treats the walkers of one ensemble as chains, an optimistic diagnostic.
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np
import torch
from torch import Generator, Tensor

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.models.gaussian_process import GaussianProcess
from sipe_bayes.posterior.base import Numbers, Posterior, as_float64, as_theta
from sipe_bayes.posterior.ensemble import (
    EnsembleOptions,
    draws_on_line,
    from_line,
    log_jacobian,
    onto_line,
    sample_ensemble,
)

_OF_PROCESS = ("noise", "level", "location", "scale")
_OWN = ("epsilon", "chains", "log_normaliser", "normaliser_error", "mixing")


class SurrogatePosterior(Posterior):
    """p(theta) proportional to prior(theta) Phi((epsilon - mu) / sqrt(s^2 + sigma^2)); see the module's docstring.

    ``SurrogatePosterior.sampled`` makes draws and normaliser. Works inside ``pyro.sample``.

    Args:
        process: the Gaussian process over the transformed discrepancy.
        epsilon: the threshold on it.
        prior: a posterior with a density over the same space.
        draws: (M, N), ``chains`` equal consecutive Markov chains.
        chains: how many; 1: independent draws.
        log_normaliser: log Z.
        normaliser_error: its standard error.
        mixing: what ``posterior.ensemble`` says of the chains.
    """

    def __init__(
        self,
        process: GaussianProcess,
        epsilon: float,
        prior: Posterior,
        draws: Numbers,
        chains: int,
        log_normaliser: float,
        normaliser_error: float,
        mixing: dict[str, float] | None = None,
    ) -> None:
        super().__init__(prior.space)
        self.process, self.epsilon, self.prior = process, float(epsilon), prior
        self.draws, self.chains = as_theta("draws", draws, (None, len(prior.space))), int(chains)
        if not len(self.draws) or self.chains < 1 or len(self.draws) % self.chains:
            raise ValueError(f"chains: expected a divisor of the {len(self.draws)} draws, got {chains}; cut the chains")
        self.log_normaliser, self.normaliser_error = float(log_normaliser), float(normaliser_error)
        self.mixing = dict(mixing or {})

    @classmethod
    def sampled(
        cls,
        process: GaussianProcess,
        epsilon: float,
        prior: Posterior,
        seed: int = 0,
        options: EnsembleOptions | None = None,
    ) -> Self:
        """With draws and normaliser.

        Args:
            process: the Gaussian process over the transformed discrepancy.
            epsilon: the threshold on it.
            prior: a posterior with a density over the parameters.
            seed: of the draws.
            options: of the ensemble that makes them.
        """

        def log_density(z: FloatArray) -> FloatArray:
            points = from_line(z)
            with torch.no_grad():
                value = (prior.log_prob(points) + log_acceptance(process, epsilon, points)).numpy()
            return value + log_jacobian(z)

        random = np.random.RandomState(np.random.SeedSequence([seed, 7]).generate_state(4))
        walkers = _places(process, prior, random)
        drawn = sample_ensemble(log_density, walkers, prior, random, options or EnsembleOptions())
        draws = from_line(drawn.z.reshape(-1, drawn.z.shape[2]))
        error, chains = drawn.normaliser_error, len(drawn.z)
        return cls(process, epsilon, prior, draws, chains, drawn.log_normaliser, error, drawn.mixing)

    @property
    def best(self) -> Tensor:
        """(N,) the point whose discrepancy is the lowest evaluated."""
        return self.process.x[self.process.y.argmin()]

    def _sample(self, n: int, generator: Generator | None) -> Tensor:
        return self.draws[torch.randint(len(self.draws), (n,), generator=generator)]

    def _log_prob(self, theta: Tensor) -> Tensor:
        accepted = log_acceptance(self.process, self.epsilon, theta)
        return self.prior.log_prob(theta) + accepted - self.log_normaliser

    @property
    def _reference(self) -> Tensor:
        return self.draws

    def _mode(self) -> Tensor:
        """The best point, not the density's maximum."""
        return self.best

    def _chains(self, num_draws: int, generator: Generator | None) -> Tensor:
        if self.chains == 1:
            return super()._chains(num_draws, generator)
        return self.draws.reshape(self.chains, -1, len(self.space))

    def _state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        tensors, prior_settings = self.prior._state()
        process = self.process
        settings = {
            **{name: getattr(process, name) for name in _OF_PROCESS},
            **{name: getattr(self, name) for name in _OWN},
            "prior": {"family": type(self.prior).__name__, "settings": prior_settings},
        }
        own = {"x": process.x, "y": process.y, "lengthscale": process.lengthscale, "draws": self.draws}
        return {**own, **{f"prior.{name}": tensor for name, tensor in tensors.items()}}, settings

    @classmethod
    def _restore(cls, space: ParameterSpace, tensors: dict[str, Tensor], settings: dict[str, Any]) -> Self:
        numbers = {name: float(settings[name]) for name in _OF_PROCESS}
        x = as_theta("x", tensors["x"], (None, len(space)))
        y = as_float64("y", tensors["y"], (len(x),))
        lengthscale = as_float64("lengthscale", tensors["lengthscale"], (len(space),))
        if not len(x) or not (lengthscale > 0).all() or min(numbers["noise"], numbers["scale"]) <= 0:
            raise ValueError("process: expected points, and positive lengthscale, noise and scale")
        process = GaussianProcess(x, y, lengthscale, **numbers)
        own = {name: settings[name] for name in (*_OWN, "prior")}
        return cls(process, draws=tensors["draws"], **own)


def log_acceptance(process: GaussianProcess, epsilon: float, theta: Tensor) -> Tensor:
    """The log Phi((epsilon - mu) / sqrt(s^2 + sigma^2)) (n,) of theta (n, N)."""
    mean, sd = process.predict(theta)
    return torch.special.log_ndtr((epsilon - mean) / (sd**2 + process.noise_sd**2).sqrt())


def _places(process: GaussianProcess, prior: Posterior, random: np.random.RandomState) -> FloatArray:
    """Walkers z (W, N): half around the best evaluated points, half from the prior."""
    n = len(prior.space)
    count = max(40, 2 * n + 2)
    count += count % 2
    order = process.y.argsort(stable=True)[: count // 2]
    chosen = process.x[order[torch.arange(count // 2) % len(order)]].numpy()
    near = chosen + 0.02 * np.minimum(process.lengthscale.numpy(), 1.0) * random.standard_normal(chosen.shape)
    return np.concatenate([onto_line(near), draws_on_line(prior, count - count // 2, random)])
