"""The posterior of a Gaussian process over the discrepancy: how probably a theta is as good as epsilon.

With mu(theta), s(theta) the process's prediction of the (transformed) discrepancy and sigma its noise,

    p(theta) = prior(theta) Phi((epsilon - mu(theta)) / sqrt(s(theta)^2 + sigma^2)) / Z,

the probability that one more simulation at theta would have a discrepancy below epsilon, times the prior: approximate
Bayesian computation with the simulator replaced (M. U. Gutmann, J. Corander 2016, "Bayesian Optimization for
Likelihood-Free Inference of Simulator-Based Statistical Models", https://jmlr.org/papers/v17/15-017.html, equation 21).
Where few simulations have been made s is large and the posterior keeps the prior's width.

Draws are those of an emcee ensemble (D. Foreman-Mackey et al. 2013, "emcee: The MCMC Hammer", https://arxiv.org/abs/1202.3665)
over z with theta = Phi(z), which has no walls and in which the uniform prior is the standard normal: differential evolution
(C. J. F. ter Braak, J. A. Vrugt 2008) and stretches during the warm-up; then also independent proposals from the defensive mixture

    q = 0.2 prior + 0.4 N(m, C) + 0.4 kernels on warm-up draws,

with m and C the draws' moments, in z. Z is estimated by importance sampling from q, with the standard error
``normaliser_error`` of log Z; where its weights are even enough they also redraw the walkers and q's centres, so that none stays
behind in a far corner.

``mode`` is the evaluated theta of lowest discrepancy: what Bayesian optimisation answers. It need not be where p is largest, which
the prior has a part in, and where the process smooths over what was evaluated.

Deviations: exact draws are impossible; ``sample`` draws with replacement from the stored chains, whose mean, covariance and
quantiles are the posterior's. R-hat treats the walkers of one ensemble as chains, an optimistic diagnostic.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any, ClassVar, Self

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri
from torch import Generator, Tensor

from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.models.gaussian_process import GaussianProcess
from sipe_bayes.posterior.base import Posterior, as_theta

FloatArray = NDArray[np.float64]
_LOG_2PI = math.log(2 * math.pi)
_EDGE = 1e-12  # theta is kept this far inside the cube where it becomes z

WARM_UP, BLOCK, MOST_STEPS = 400, 400, 2400  # steps of the ensemble; between checks of its mixing; in all
MIXED_RHAT, EFFECTIVE = 1.02, 2000.0  # when it stops
_DRAWS = 8000  # at most kept
_IMPORTANCE = 20_000  # draws for the normaliser
_KERNELS = 200
_TRUSTED = 0.05  # of the importance weights' draws are effective: then they place the walkers
_SHARES = (0.2, 0.4, 0.4)  # of prior, one Gaussian, kernels


class SurrogatePosterior(Posterior):
    """p(theta) proportional to prior(theta) Phi((epsilon - mu) / sqrt(s^2 + sigma^2)); see the module's docstring.

    process: the Gaussian process over the transformed discrepancy. epsilon: the threshold on it. prior: a posterior with a
    density over the same space. draws (M, N): ``chains`` equal consecutive Markov chains, or 1: independent draws. log_normaliser: log Z, and
    normaliser_error its standard error. ``SurrogatePosterior.sampled`` makes draws and normaliser. Works inside
    ``pyro.sample``.
    """

    has_density: ClassVar[bool] = True

    def __init__(
        self,
        process: GaussianProcess,
        epsilon: float,
        prior: Posterior,
        draws: Any,
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
        effective: float = EFFECTIVE,
        most_steps: int = MOST_STEPS,
    ) -> Self:
        """With draws and normaliser, until ``effective`` draws are reached or ``most_steps`` taken."""

        def log_density(z: FloatArray) -> FloatArray:
            points = _theta(z)
            with torch.no_grad():
                value = (prior._log_prob(points) + log_acceptance(process, epsilon, points)).numpy()
            return value + _log_jacobian(z)

        random = np.random.RandomState(np.random.SeedSequence([seed, 7]).generate_state(4))
        walkers = _places(process, prior, random)
        warm_up = min(WARM_UP, most_steps // 2)
        warm, state = _run(log_density, walkers, None, warm_up, random)
        points = warm[warm_up // 2 :].reshape(-1, len(prior.space))
        for count in (_IMPORTANCE // 4, _IMPORTANCE):
            proposal = _Mixture(points, prior, random)
            log_normaliser, error, drawn = _importance(log_density, proposal, count, random)
            if drawn is not None:
                points, state = drawn, drawn[: len(walkers)]
        chain, mixing = np.empty((0, *walkers.shape)), {"rhat": math.inf, "ess": 0.0}
        while len(chain) + warm_up < most_steps and not _mixed(mixing, effective):
            steps = min(BLOCK, most_steps - warm_up - len(chain))
            more, state = _run(log_density, state, proposal, steps, random)
            chain = np.concatenate([chain, more])
            mixing = _mixing(chain)
        thin = max(1, math.ceil(chain.shape[0] * chain.shape[1] / _DRAWS))
        kept = np.swapaxes(chain[::-thin][::-1], 0, 1)
        draws = _theta(kept.reshape(-1, kept.shape[2]))
        return cls(process, epsilon, prior, draws, len(kept), log_normaliser, error, mixing)

    @property
    def best(self) -> Tensor:
        """(N,) the point whose discrepancy is the lowest evaluated."""
        return self.process.x[self.process.y.argmin()]

    def _sample(self, n: int, generator: Generator | None) -> Tensor:
        return self.draws[torch.randint(len(self.draws), (n,), generator=generator)]

    def _log_prob(self, theta: Tensor) -> Tensor:
        return self.prior._log_prob(theta) + self._log_acceptance(theta) - self.log_normaliser

    def _log_acceptance(self, theta: Tensor) -> Tensor:
        return log_acceptance(self.process, self.epsilon, theta)

    def _moments(self) -> tuple[Tensor, Tensor]:
        return self.draws.mean(0), torch.atleast_2d(torch.cov(self.draws.T))

    def _quantile(self, q: Tensor) -> Tensor:
        return torch.quantile(self.draws, q, dim=0)

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
            **{name: getattr(process, name) for name in ("noise", "level", "location", "scale")},
            **{
                name: getattr(self, name)
                for name in ("epsilon", "chains", "log_normaliser", "normaliser_error", "mixing")
            },
            "prior": {"family": type(self.prior).__name__, "settings": prior_settings},
        }
        own = {"x": process.x, "y": process.y, "lengthscale": process.lengthscale, "draws": self.draws}
        return {**own, **{f"prior.{name}": tensor for name, tensor in tensors.items()}}, settings

    @classmethod
    def _restore(cls, space: ParameterSpace, tensors: dict[str, Tensor], settings: dict[str, Any]) -> Self:
        from sipe_bayes.posterior.registry import get_family

        stored = {name[6:]: tensor for name, tensor in tensors.items() if name.startswith("prior.")}
        prior = get_family(settings["prior"]["family"])._restore(space, stored, settings["prior"]["settings"])
        numbers = {name: float(settings[name]) for name in ("noise", "level", "location", "scale")}
        process = GaussianProcess(tensors["x"], tensors["y"], tensors["lengthscale"], **numbers)
        names = ("epsilon", "chains", "log_normaliser", "normaliser_error", "mixing")
        return cls(process, prior=prior, draws=tensors["draws"], **{name: settings[name] for name in names})


def log_acceptance(process: GaussianProcess, epsilon: float, theta: Tensor) -> Tensor:
    """log Phi((epsilon - mu) / sqrt(s^2 + sigma^2)) (n,) of theta (n, N)."""
    mean, sd = process.predict(theta)
    return torch.special.log_ndtr((epsilon - mean) / (sd**2 + process.noise_sd**2).sqrt())


def _theta(z: FloatArray) -> Tensor:
    return torch.from_numpy(ndtr(z))


def _log_jacobian(z: FloatArray) -> FloatArray:
    """log |d theta / d z| (n,) of z (n, N)."""
    return -0.5 * (z**2).sum(1) - z.shape[1] / 2 * _LOG_2PI


def _places(process: GaussianProcess, prior: Posterior, random: np.random.RandomState) -> FloatArray:
    """Walkers z (W, N): half around the best evaluated points, half from the prior."""
    n = len(prior.space)
    count = max(40, 2 * n + 2)
    count += count % 2
    order = process.y.argsort(stable=True)[: count // 2]
    chosen = process.x[order[torch.arange(count // 2) % len(order)]].numpy()
    near = chosen + 0.02 * np.minimum(process.lengthscale.numpy(), 1.0) * random.standard_normal(chosen.shape)
    return np.concatenate([_z(near), _prior_draws(prior, count - count // 2, random)])


def _z(theta: FloatArray) -> FloatArray:
    return np.asarray(ndtri(np.clip(theta, _EDGE, 1 - _EDGE)))


def _prior_draws(prior: Posterior, count: int, random: np.random.RandomState) -> FloatArray:
    """z (count, N)."""
    return _z(prior.sample((count,), generator=Generator().manual_seed(int(random.randint(2**31)))).numpy())


def _run(
    log_density: Callable[[FloatArray], FloatArray],
    begin: Any,
    proposal: _Mixture | None,
    steps: int,
    random: np.random.RandomState,
) -> tuple[FloatArray, Any]:
    """Chain (steps, W, N) and the ensemble's last state, from walkers (W, N) or a state."""
    import emcee

    moves = [(emcee.moves.DEMove(), 0.6), (emcee.moves.DESnookerMove(), 0.1), (emcee.moves.StretchMove(), 0.3)]
    if proposal is not None:
        moves = [(move, share / 2) for move, share in moves] + [(emcee.moves.MHMove(proposal), 0.5)]
    state = emcee.State(getattr(begin, "coords", begin), random_state=random.get_state())
    sampler = emcee.EnsembleSampler(*state.coords.shape, log_density, vectorize=True, moves=moves)
    end = sampler.run_mcmc(state, steps, skip_initial_state_check=True, progress=False)
    random.set_state(end.random_state)
    return sampler.get_chain(), end


class _Mixture:
    """The defensive mixture q: draws, log density, and a Metropolis-Hastings move of emcee."""

    def __init__(self, warm: FloatArray, prior: Posterior, random: np.random.RandomState) -> None:
        self.prior, n = prior, warm.shape[1]
        self.mean, self.factor = warm.mean(0), _factor(warm)
        self.centres = warm[random.randint(len(warm), size=_KERNELS)]
        self.kernel = max(len(warm) ** (-1 / (n + 4)), 0.1) * _factor(_core(warm))

    def _normal(self, count: int, factor: FloatArray, random: np.random.RandomState) -> FloatArray:
        return random.standard_normal((count, len(self.mean))) @ factor.T

    def draw(self, count: int, random: np.random.RandomState) -> FloatArray:
        """z (count, N)."""
        kind = random.choice(3, size=count, p=_SHARES)
        normal = self.mean + self._normal(count, self.factor, random)
        kernels = self.centres[random.randint(len(self.centres), size=count)] + self._normal(count, self.kernel, random)
        return np.where(
            (kind == 0)[:, None],
            _prior_draws(self.prior, count, random),
            np.where((kind == 1)[:, None], normal, kernels),
        )

    def log_density(self, z: FloatArray) -> FloatArray:
        """(n,) of z (n, N)."""
        half = z.shape[1] / 2 * _LOG_2PI
        white = np.linalg.solve(self.factor, (z - self.mean).T)
        normal = -0.5 * (white**2).sum(0) - np.log(np.diag(self.factor)).sum() - half
        points, centres = (np.linalg.solve(self.kernel, (a - self.mean).T).T for a in (z, self.centres))
        far = (points**2).sum(1)[:, None] + (centres**2).sum(1) - 2 * points @ centres.T
        kernels = np.logaddexp.reduce(-0.5 * np.maximum(far, 0), axis=1) - math.log(len(centres))
        kernels -= np.log(np.diag(self.kernel)).sum() + half
        with torch.no_grad():
            prior = self.prior._log_prob(_theta(z)).numpy() + _log_jacobian(z)
        parts = [prior, normal, kernels]
        return np.asarray(
            np.logaddexp.reduce([p + np.log(share) for p, share in zip(parts, _SHARES, strict=True)], axis=0)
        )

    def __call__(self, walkers: FloatArray, random: np.random.RandomState) -> tuple[FloatArray, FloatArray]:
        proposed = self.draw(len(walkers), random)
        return proposed, self.log_density(walkers) - self.log_density(proposed)


def _factor(z: FloatArray) -> FloatArray:
    covariance = np.atleast_2d(np.cov(z.T))
    return np.linalg.cholesky(
        covariance + (1e-12 + 1e-9 * np.trace(covariance) / len(covariance)) * np.eye(len(covariance))
    )


def _core(z: FloatArray) -> FloatArray:
    """The half of z (n, N) that lies closest together: kernels as wide as far tails would miss a narrow peak."""
    kept = z
    for _ in range(3):
        white = np.linalg.solve(_factor(kept), (z - np.median(kept, axis=0)).T)
        square = (white**2).sum(0)
        kept = z[square <= np.median(square)]
    return kept


def _importance(
    log_density: Callable[[FloatArray], FloatArray], proposal: _Mixture, count: int, random: np.random.RandomState
) -> tuple[float, float, FloatArray | None]:
    """log Z by importance sampling, its standard error, and z (count, N) drawn by the weights; None where a few points
    have all the weight."""
    z = proposal.draw(count, random)
    log_weight = log_density(z) - proposal.log_density(z)
    top = log_weight.max()
    weight = np.exp(log_weight - top)
    mean, error = weight.mean(), weight.std() / weight.mean() / math.sqrt(count)
    effective = weight.sum() ** 2 / (weight**2).sum()
    drawn = z[random.choice(count, size=count, p=weight / weight.sum())] if effective > _TRUSTED * count else None
    return float(top + np.log(mean)), float(error), drawn


def _mixing(chain: FloatArray) -> dict[str, float]:
    """Worst R-hat and autocorrelation time over the parameters, and effective draws, of a chain (steps, W, N)."""
    import arviz
    import emcee

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rhat = max(float(arviz.rhat(chain[:, :, j].T)) for j in range(chain.shape[2]))
        time = emcee.autocorr.integrated_time(chain, quiet=True, tol=0, has_walkers=True)
    steps, walkers = chain.shape[:2]
    tau = max(1.0, float(np.nanmax(time))) if np.isfinite(time).any() else float(steps)
    ess = steps * walkers / tau if steps >= 10 * tau else min(steps * walkers / tau, 10.0 * walkers)
    moved = float((np.diff(chain, axis=0) != 0).any(2).mean())
    return {"rhat": rhat, "ess": ess, "autocorrelation_steps": tau, "acceptance": moved, "steps": float(steps)}


def _mixed(mixing: dict[str, float], effective: float) -> bool:
    return mixing["rhat"] <= MIXED_RHAT and mixing["ess"] >= effective
