"""A normalising flow over the unit cube, given what was observed. What NPE returns.

With the standard normal distribution function Phi, z_j = Phi^-1(theta_j) maps the cube onto R^N, and u = (z - m) / s
standardises it. A neural spline flow q(u | c), given the context c of the observation, then has the density

    p(theta) = q(u | c) prod_j 1 / (s_j phi(z_j)),

whose support is exactly the cube: nothing leaks out and no draw is rejected. Under this map a flow that does nothing is
the uniform distribution (with m = 0, s = 1), and a posterior cut off by a bound keeps a normal tail, where the logit's
would be logistic. theta closer than 1e-6 to a bound has the density of the point 1e-6 away from it.

C. Durkan et al. 2019, "Neural Spline Flows" (https://arxiv.org/abs/1906.04032); zuko's implementation. Fully
autoregressive up to eight parameters; of more, coupling layers, because drawing takes one pass for each parameter
otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Generator, Tensor

from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.posterior.base import Numbers, Posterior, as_float64

if TYPE_CHECKING:
    import zuko

MARGIN = 1e-6  # theta closer to a bound has the density of the point that far from it: z stays finite
_AUTOREGRESSIVE = 8  # parameters up to which every layer is fully autoregressive


def spline_flow(features: int, context: int, transforms: int, hidden: int, bins: int) -> zuko.flows.NSF:
    """A neural spline flow of zuko's, float32, with random weights.

    Args:
        features: of u.
        context: numbers that it is conditioned on.
        transforms: one after the other.
        hidden: units of each of two layers.
        bins: of the splines.
    """
    from zuko.flows import NSF

    settings: dict[str, Any] = {"transforms": transforms, "hidden_features": (hidden, hidden)}
    if features > 1:  # zuko takes neither for one parameter
        settings |= {"passes": features if features <= _AUTOREGRESSIVE else 2, "residual": True}
    return NSF(features, context, bins, **settings)


def to_line(theta: Tensor) -> Tensor:
    """The z = Phi^-1(theta) of theta kept 1e-6 away from the bounds."""
    return torch.special.ndtri(theta.clamp(MARGIN, 1 - MARGIN))


def to_cube(z: Tensor) -> Tensor:
    """The theta = Phi(z) of z."""
    return torch.special.ndtr(z)


class Flow(Posterior):
    """A trained spline flow, given what was observed. Works inside ``pyro.sample``.

    Args:
        weights: as ``spline_flow(...).state_dict()``, float32 as trained; the flow computes in float64.
        context: of what was observed (D,).
        mean: of z (N,), which standardises it.
        sd: of z (N,).
        space: of the parameters.
        transforms: of the flow, as are ``hidden`` and ``bins``; see ``spline_flow``.
        hidden: units of each of two layers.
        bins: of the splines.
    """

    coefficients_at_once: ClassVar[int] = 2**22  # of splines, in memory
    mode_starts: ClassVar[int] = 4  # draws that are climbed from

    def __init__(
        self,
        weights: Mapping[str, Tensor],
        context: Numbers,
        mean: Numbers,
        sd: Numbers,
        space: ParameterSpace,
        *,
        transforms: int,
        hidden: int,
        bins: int,
    ) -> None:
        super().__init__(space)
        n = len(space)
        self.context = as_float64("context", context, (None,))
        self.line_mean, self.line_sd = as_float64("mean", mean, (n,)), as_float64("sd", sd, (n,))
        if not (self.line_sd > 0).all():
            raise ValueError(
                f"sd: expected positive numbers, got {self.line_sd.tolist()}; simulate more than one theta"
            )
        self.architecture = {"transforms": int(transforms), "hidden": int(hidden), "bins": int(bins)}
        self.weights = {key: value.detach().clone() for key, value in weights.items()}
        # each transform has weights of its own between the hidden layers, and from the last to the splines
        least = int(transforms) * int(hidden) * (int(hidden) + int(bins))
        numbers = sum(value.numel() for value in self.weights.values())
        if min(int(transforms), int(hidden), int(bins)) < 1 or least > numbers:
            raise ValueError(f"weights: expected those of the flow {self.architecture}, got {numbers} numbers")
        with torch.random.fork_rng(devices=[]):
            net = spline_flow(n, len(self.context), **self.architecture)
        try:
            net.load_state_dict(self.weights)
        except RuntimeError as error:
            raise ValueError(f"weights: expected those of the flow {self.architecture}, got others ({error})") from None
        self._net = net.double().eval().requires_grad_(False)
        self._chunk = max(64, self.coefficients_at_once // (n * 3 * self.architecture["bins"]))

    def _given(self) -> Any:
        return self._net(self.context)

    def _sample(self, n: int, generator: Generator | None) -> Tensor:
        noise = torch.randn(n, len(self.space), dtype=torch.float64, generator=generator)
        transform = self._given().transform
        u = [transform.inv(part) for part in noise.split(self._chunk)]
        return to_cube(self.line_mean + self.line_sd * torch.cat(u)).clamp(0.0, 1.0)

    def _log_prob(self, theta: Tensor) -> Tensor:
        given = self._given()
        return torch.cat([self._log_density(given, part) for part in theta.split(self._chunk)])

    def _log_density(self, given: Any, theta: Tensor) -> Tensor:
        z = to_line(theta)
        slope = (z**2 / 2 + math.log(2 * math.pi) / 2 - self.line_sd.log()).sum(-1)
        value: Tensor = given.log_prob((z - self.line_mean) / self.line_sd) + slope
        return value

    def _mode(self) -> Tensor:
        """The best of the reference draws, climbed from with bounds by L-BFGS-B."""
        density = self._log_prob(self._reference)
        best = density.topk(min(self.mode_starts, len(density))).indices
        starts = self._reference[best]
        candidates = torch.cat([starts, torch.stack([self._climb(start) for start in starts])])
        return candidates[self._log_prob(candidates).argmax()]

    def _climb(self, start: Tensor) -> Tensor:
        def objective(point: np.ndarray) -> tuple[float, np.ndarray]:
            theta = torch.tensor(point, dtype=torch.float64, requires_grad=True)
            with torch.enable_grad():
                value = -self._log_prob(theta[None])[0]
                value.backward()
            return float(value), np.zeros_like(point) if theta.grad is None else theta.grad.numpy()

        bounds = [(MARGIN, 1 - MARGIN)] * len(self.space)
        end = minimize(objective, start.numpy(), jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 50})
        return torch.from_numpy(np.clip(end.x, 0.0, 1.0))

    def _state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        tensors = {"context": self.context, "mean": self.line_mean, "sd": self.line_sd}
        return {**tensors, **{f"net.{key}": value for key, value in self.weights.items()}}, dict(self.architecture)

    @classmethod
    def _restore(cls, space: ParameterSpace, tensors: dict[str, Tensor], settings: dict[str, Any]) -> Self:
        weights = {key.removeprefix("net."): value for key, value in tensors.items() if key.startswith("net.")}
        return cls(weights, tensors["context"], tensors["mean"], tensors["sd"], space, **settings)
