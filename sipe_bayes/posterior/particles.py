"""A weighted set of points: what particle methods and Markov chains return.

With weights w_m that sum to one, the mean is sum_m w_m theta_m and the covariance sum_m w_m (theta_m - mean)
(theta_m - mean)^T, the moments of the discrete distribution itself. Its quantiles interpolate linearly
between the sorted points at the midpoints of their steps in the cumulative weight. ``smoothed`` puts one
Gaussian on each point; "scott" is D. W. Scott's rule for a product kernel ("Multivariate Density Estimation",
1992, section 6.3), h_j = sd_j M_eff^(-1 / (N + 4)) with the effective number of points M_eff = 1 / sum_m
w_m^2.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Generator, Tensor

from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.posterior.base import Numbers, Posterior, as_float64, as_theta, check_bandwidth
from sipe_bayes.posterior.mixture import GaussianMixture

_STATS = "sample_stats."


class Particles(Posterior):
    """Weighted points. No density: ``log_prob`` raises.

    Args:
        theta: (M, N).
        space: of the N parameters.
        weights: (M,), equal if not given.
        chains: the rows are this many equal consecutive Markov chains; their weights must be equal.
        best: (N,), the point of highest density that the method found, which is then the ``mode``. Without it, ``mode``
            is the row closest to the weighted mean in the metric of the covariance.
        sample_stats: what the sampler knows of each row, (M,) by ArviZ's names (``lp``, ``acceptance_rate``), for
            ``to_inference_data``; with chains only.
    """

    has_density: ClassVar[bool] = False
    most_kernels: ClassVar[int] = 500  # of a smoothed set of points: a density of more takes seconds

    def __init__(
        self,
        theta: Numbers,
        space: ParameterSpace,
        weights: Numbers | None = None,
        chains: int | None = None,
        best: Numbers | None = None,
        sample_stats: Mapping[str, Numbers] | None = None,
    ) -> None:
        super().__init__(space)
        self.theta = as_theta("theta", theta, (None, len(space)))
        rows = len(self.theta)
        if rows == 0:
            raise ValueError(f"theta: expected at least one row, got shape {tuple(self.theta.shape)}")
        self.weights = _normalised(weights, rows)
        self.best = None if best is None else as_theta("best", best, (len(space),))
        self.chains = chains
        self.sample_stats = {k: as_float64(f"sample_stats {k}", v, (rows,)) for k, v in (sample_stats or {}).items()}
        if self.sample_stats and chains is None:
            raise ValueError("sample_stats: expected chains, which they are of, got none; give chains")
        if chains is not None and (chains < 1 or rows % chains):
            raise ValueError(
                f"chains: expected a divisor of the {rows} rows, got {chains}; cut the chains to one length"
            )
        if chains is not None and self.weights.max() - self.weights.min() > 1e-12:
            raise ValueError("chains: expected equal weights, got unequal ones; leave chains or weights out")

    @property
    def effective_size(self) -> float:
        """The number of equally weighted points with the same sum of squared weights."""
        return float(1 / (self.weights**2).sum())

    def smoothed(self, bandwidth: float | str = "scott") -> GaussianMixture:
        """A Gaussian mixture on the points; of more than 500, on 500 picked evenly along the cumulative weight.

        Args:
            bandwidth: kernel sd in theta units, or "scott".

        Raises:
            ValueError: when "scott" meets a constant column.
        """
        if bandwidth == "scott":
            sd = self.stddev * self.effective_size ** (-1 / (len(self.space) + 4))
            if (sd <= 0).any():
                raise ValueError('bandwidth: "scott" needs spread in every parameter, got none; give a number')
        else:
            sd = torch.full((len(self.space),), check_bandwidth(bandwidth), dtype=torch.float64)
        centres, weights = self._kernels()
        covariances = torch.diag(sd**2).expand(len(centres), -1, -1)
        return GaussianMixture(weights.log(), centres, covariances, self.space)

    def _kernels(self) -> tuple[Tensor, Tensor]:
        used = self.weights > 0
        most = self.most_kernels
        if used.sum() <= most:
            return self.theta[used], self.weights[used]
        levels = (torch.arange(most, dtype=torch.float64) + 0.5) / most
        rows = torch.searchsorted(self.weights.cumsum(0), levels).clamp_max(len(self.theta) - 1)
        return self.theta[rows], torch.full((most,), 1 / most, dtype=torch.float64)

    def marginal(self, names: Iterable[str]) -> Particles:
        """The same points in fewer parameters; weights and chains stay, ``best`` of the whole does not."""
        columns, space = self._columns(names)
        return Particles(self.theta[:, columns], space, self.weights, self.chains)

    def _sample(self, n: int, generator: Generator | None) -> Tensor:
        if n == 0:
            return self.theta[:0]
        return self.theta[torch.multinomial(self.weights, n, replacement=True, generator=generator)]

    def _moments(self) -> tuple[Tensor, Tensor]:
        mean = self.weights @ self.theta
        deviation = self.theta - mean
        return mean, deviation.T @ (self.weights[:, None] * deviation)

    def _quantile(self, q: Tensor) -> Tensor:
        used = self.weights > 0
        theta, order = self.theta[used].sort(0)
        weights = self.weights[used][order]
        middle = weights.cumsum(0) - weights / 2
        columns = [np.interp(q, middle[:, j], theta[:, j]) for j in range(len(self.space))]
        return torch.from_numpy(np.stack(columns, -1))

    def _mode(self) -> Tensor:
        if self.best is not None:
            return self.best
        mean, covariance = self._cached_moments
        deviation = self.theta - mean
        distance = ((deviation @ torch.linalg.pinv(covariance, hermitian=True)) * deviation).sum(-1)
        return self.theta[torch.where(self.weights > 0, distance, torch.inf).argmin()]

    def _chains(self, num_draws: int, generator: Generator | None) -> Tensor:
        if self.chains is None:
            return super()._chains(num_draws, generator)
        return self.theta.reshape(self.chains, -1, len(self.space))

    def _sample_stats(self) -> dict[str, Tensor]:
        return {name: x.reshape(self.chains or 1, -1) for name, x in self.sample_stats.items()}

    def _state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        tensors = {"theta": self.theta, "weights": self.weights}
        if self.best is not None:
            tensors["best"] = self.best
        tensors.update({_STATS + name: x for name, x in self.sample_stats.items()})
        return tensors, {"chains": self.chains}

    @classmethod
    def _restore(cls, space: ParameterSpace, tensors: dict[str, Tensor], settings: dict[str, Any]) -> Self:
        stats = {name.removeprefix(_STATS): x for name, x in tensors.items() if name.startswith(_STATS)}
        return cls(tensors["theta"], space, tensors["weights"], settings["chains"], tensors.get("best"), stats)


Posterior.of_draws = Particles


def _normalised(weights: Numbers | None, rows: int) -> Tensor:
    if weights is None:
        return torch.full((rows,), 1 / rows, dtype=torch.float64)
    weights = as_float64("weights", weights, (rows,))
    total = weights.sum()
    if (weights < 0).any() or not total > 0:
        raise ValueError("weights: expected non-negative numbers with a positive sum; exponentiate log weights first")
    # weights read back from disk sum to one already and must stay the same to the last bit
    return weights if (total - 1).abs() < 1e-12 else weights / total
