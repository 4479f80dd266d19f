"""A mixture density network: inputs to a Gaussian mixture over theta with full covariances (BayesSim's).

C. M. Bishop 1994, "Mixture Density Networks". Each component is written by its whitening matrix W_k, lower triangular
with a positive diagonal, W_k^T W_k = C_k^-1, so that

    log N(theta; m_k, C_k) = sum_i log W_k,ii - |W_k (theta - m_k)|^2 / 2 - N / 2 log(2 pi)

is one batched product over all components: no factorisation, no solve, no loop.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import scipy.stats
import torch
from torch import Tensor, nn

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.models.transitions import Standardise

Features = Literal["mlp", "random_fourier"]


class RandomFourier(nn.Module):
    """Quasi-Monte Carlo random features of a Matern-5/2 kernel: [cos(V x), sin(V x)] / sqrt(D), D = features / 2.

    A. Rahimi, B. Recht 2007, "Random Features for Large-Scale Kernel Machines". The kernel's spectral density is a
    multivariate t with 5 degrees of freedom; V are its quantiles at a scrambled Sobol sequence (BayesSim, Ramos et al.
    2019, section IV.C), divided by the median distance of the inputs that it is fitted to.

    Args:
        inputs: I, numbers of an input.
        features: 2 D, rounded down to an even number.
        seed: of the scrambling.
    """

    directions: Tensor
    length: Tensor

    def __init__(self, inputs: int, features: int, seed: int) -> None:
        super().__init__()
        sobol = scipy.stats.qmc.Sobol(inputs + 1, scramble=True, rng=np.random.default_rng(seed))
        points = sobol.random_base2(math.ceil(math.log2(max(2, features // 2))))[: features // 2]
        points = np.clip(points, 1e-9, 1 - 1e-9)
        normal = scipy.stats.norm.ppf(points[:, :-1])
        widened = normal * np.sqrt(5 / scipy.stats.chi2.ppf(points[:, -1:], 5))
        self.register_buffer("directions", torch.tensor(widened, dtype=torch.float32))
        self.register_buffer("length", torch.ones(()))

    def fit(self, x: Tensor) -> None:
        """Take the median distance of up to 500 of the inputs x (n, I) as the kernel's length."""
        distance = torch.pdist(x[:500])
        self.length.copy_(distance.median().clamp_min(1e-6))

    def forward(self, x: Tensor) -> Tensor:
        """Features (n, 2 D) of inputs (n, I)."""
        phase = x @ self.directions.T / self.length
        return torch.cat([phase.cos(), phase.sin()], -1) / math.sqrt(len(self.directions))


class MixtureDensity(nn.Module):
    """Inputs (n, I) to mixtures of K components over theta (N,).

    Args:
        inputs: I.
        n: N.
        components: K.
        features: "mlp", two hidden layers of tanh units, or "random_fourier"; a linear layer follows.
        hidden: units of each of those layers, or number of those features.
        seed: of the random features; weights come from torch's global generator.
    """

    narrowest, widest = 1e-4, 3.0  # sd of a component along its axes, in the unit cube: a point, and flat
    pick: Tensor
    gather: Tensor

    def __init__(
        self, inputs: int, n: int, components: int, features: Features = "mlp", hidden: int = 24, seed: int = 0
    ) -> None:
        super().__init__()
        self.n, self.components = n, components
        self.standardise = Standardise(inputs)
        self.features: nn.Module
        if features == "mlp":
            self.features = nn.Sequential(nn.Linear(inputs, hidden), nn.Tanh(), nn.Linear(hidden, hidden), nn.Tanh())
            width = hidden
        else:
            self.features = RandomFourier(inputs, hidden, seed)
            width = 2 * (hidden // 2)
        self.head = nn.Linear(width, components * (1 + 2 * n + n * (n - 1) // 2))
        rows, columns = torch.tril_indices(n, n, -1)
        # products with 0/1 matrices are faster than gathering and scattering
        self.register_buffer("pick", torch.eye(n)[:, columns].contiguous(), persistent=False)
        self.register_buffer("gather", torch.eye(n)[rows].contiguous(), persistent=False)

    @torch.no_grad()
    def fit_inputs(self, inputs: Tensor, theta: Tensor) -> None:
        """Standardise by inputs (n, I) and begin with means spread over theta (n, N), sds of theirs."""
        self.standardise.fit(inputs)
        if isinstance(self.features, RandomFourier):
            self.features.fit(self.standardise(inputs))
        k, n = self.components, self.n
        self.head.weight.mul_(0.1)
        bias = torch.zeros_like(self.head.bias)
        spread = theta.std(0).clamp_min(1e-3)
        offsets = 0.5 * (torch.linspace(-1, 1, k) if k > 1 else torch.zeros(1)).to(spread)[:, None] * spread
        bias[k : k + k * n] = (theta.mean(0) + offsets).reshape(-1)
        bias[k + k * n : k + 2 * k * n] = (-spread.log()).repeat(k)
        self.head.bias.copy_(bias)

    def forward(self, inputs: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The mixtures of inputs (n, I).

        Returns:
            Log weights (n, K), means (n, K, N), and of the whitening matrices the log diagonal (n, K, N) and the
            entries below it in units of their row's diagonal (n, K, N (N - 1) / 2).
        """
        k, n, batch = self.components, self.n, len(inputs)
        out = self.head(self.features(self.standardise(inputs)))
        weights, means, diagonal, below = out.split([k, k * n, k * n, k * (n * (n - 1) // 2)], dim=-1)
        diagonal = diagonal.reshape(batch, k, n).clamp(-math.log(self.widest), -math.log(self.narrowest))
        return weights.log_softmax(-1), means.reshape(batch, k, n), diagonal, below.reshape(batch, k, -1)

    def log_prob(self, inputs: Tensor, theta: Tensor) -> Tensor:
        """Log density (n,) of theta (n, N) given inputs (n, I), of the untruncated mixture."""
        log_weights, means, diagonal, below = self(inputs)
        deviation = theta[:, None] - means
        white = (deviation + (below * (deviation @ self.pick)) @ self.gather) * diagonal.exp()
        terms = log_weights + diagonal.sum(-1) - (white**2).sum(-1) / 2
        return terms.logsumexp(-1) - self.n / 2 * math.log(2 * math.pi)

    @torch.no_grad()
    def mixture(self, inputs: Tensor) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Log weights (K,), means (K, N) and covariances (K, N, N) for one input (I,)."""
        log_weights, means, diagonal, below = (x[0].double().numpy() for x in self(inputs[None]))
        whitening = np.tile(np.eye(self.n), (self.components, 1, 1))
        whitening[:, *np.tril_indices(self.n, -1)] = below
        whitening *= np.exp(diagonal)[..., None]
        root = np.linalg.inv(whitening)
        return log_weights, means, root @ root.swapaxes(-1, -2)
