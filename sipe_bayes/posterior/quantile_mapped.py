"""A posterior whose parameters are each moved by an increasing map: what mends the widths of another one.

With z_j = Phi^-1(theta_j) and increasing maps g_j, z'_j = g_j(z_j) has the density

    p'(theta') = p(theta) prod_j phi(z_j) / (phi(z'_j) g_j'(z_j)),

and as each map keeps the order, dependencies between parameters remain (D. Maraun 2013, "Bias Correction, Quantile
Mapping, and Downscaling", https://doi.org/10.1175/JCLI-D-12-00821.1, on such maps). They are piecewise linear, beyond
their ends as steep as from their middle to there.
"""

from __future__ import annotations

from typing import Any, Self

import torch
from torch import Generator, Tensor

from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.posterior.base import Numbers, Posterior, as_float64
from sipe_bayes.posterior.flow import to_cube, to_line


class QuantileMapped(Posterior):
    """Another posterior, mapped.

    Args:
        base: it has a density.
        before: (K, N) points in z, strictly increasing, for each parameter.
        after: (K, N), where they go, strictly increasing too.
    """

    def __init__(self, base: Posterior, before: Numbers, after: Numbers) -> None:
        super().__init__(base.space)
        if not base.has_density:
            raise ValueError(f"base: expected a posterior with a density, got {type(base).__name__}; map its draws")
        self.base = base
        self.before = as_float64("before", before, (None, len(base.space)))
        self.after = as_float64("after", after, (len(self.before), len(base.space)))
        for name, points in (("before", self.before), ("after", self.after)):
            if len(points) < 2 or not (points.diff(dim=0) > 0).all():
                raise ValueError(f"{name}: expected two or more rows, strictly increasing; leave equal ones out")

    def _sample(self, n: int, generator: Generator | None) -> Tensor:
        return mapped(self.base._sample(n, generator), self.before, self.after)

    def _log_prob(self, theta: Tensor) -> Tensor:
        z = to_line(theta)
        original, log_slope = increasing(z, self.after, self.before)
        own = self.base.log_prob(to_cube(original).clamp(0.0, 1.0))
        return own + (log_slope + (z**2 - original**2) / 2).sum(-1)

    def _mode(self) -> Tensor:
        """The best of the base's, moved, and of the reference draws."""
        moved = mapped(self.base.mode[None], self.before, self.after)
        candidates = torch.cat([moved, self._reference])
        return candidates[self._log_prob(candidates).argmax()]

    def _state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        own, plain = self.base._state()
        tensors = {"before": self.before, "after": self.after, **{f"base.{name}": x for name, x in own.items()}}
        return tensors, {"base": {"family": type(self.base).__name__, "settings": plain}}

    @classmethod
    def _restore(cls, space: ParameterSpace, tensors: dict[str, Tensor], settings: dict[str, Any]) -> Self:
        return cls(settings["base"], tensors["before"], tensors["after"])


def mapped(theta: Tensor, before: Tensor, after: Tensor) -> Tensor:
    """Theta (n, N), moved as points (K, N) in z are."""
    return to_cube(increasing(to_line(theta), before, after)[0]).clamp(0.0, 1.0)


def increasing(z: Tensor, before: Tensor, after: Tensor) -> tuple[Tensor, Tensor]:
    """Where the piecewise linear maps of points (K, N) take z (n, N), and the logarithm of their slope there (n, N)."""
    end, middle = len(before) - 1, len(before) // 2
    right = torch.searchsorted(before.T.contiguous(), z.T.contiguous()).T.clamp(0, end + 1)
    first, last = right == 0, right == end + 1
    # the two points that a line goes through: neighbours, or the middle and an end
    low = torch.where(first, 0, torch.where(last, middle, right - 1))
    high = torch.where(first, middle, torch.where(last, end, right))
    x, y = before.gather(0, low), after.gather(0, low)
    slope = (after.gather(0, high) - y) / (before.gather(0, high) - x)
    return y + slope * (z - x), slope.log()
