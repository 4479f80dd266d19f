"""The base class of every posterior: a Pyro distribution over theta in [0, 1]^N that knows its parameters."""

from __future__ import annotations

import copy
import os
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Generator, Tensor
from torch.distributions import constraints

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.html import html_table
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.core.validation import at_least, whole
from sipe_bayes.posterior.drawn import Drawn
from sipe_bayes.posterior.storage import Header, draws_by_name, netcdf, ready_arviz, write_pair

if TYPE_CHECKING:
    import arviz

    # Pyro has no types: as an unknown base it would make every unknown attribute of a posterior one of type Any
    from torch.distributions import Distribution as TorchDistribution
else:
    from pyro.distributions import TorchDistribution

Numbers = ArrayLike | Tensor
"""A number or an array of numbers of any kind."""
_ROUNDING = 1e-6  # theta that far outside the cube was rounded, and is clipped
_POINT = 1e-12  # range of draws below which they are one point


class NoDensityError(RuntimeError):
    """Raised by ``log_prob`` of a posterior that is a set of points and has no density."""


def as_float64(name: str, value: Numbers, shape: Sequence[int | None]) -> Tensor:
    """``value`` as a finite float64 tensor.

    Args:
        name: of the argument, for the message.
        value: what was given.
        shape: that it has to have; None stands for any length.

    Raises:
        ValueError: for another shape, or for what is not finite numbers.
    """
    try:
        array = value if isinstance(value, Tensor) else np.asarray(value, dtype=np.float64)
        tensor = torch.as_tensor(array, dtype=torch.float64).detach()
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{name}: expected an array of numbers, got {type(value).__name__} ({error})") from error
    as_wanted = (want in (None, got) for want, got in zip(shape, tensor.shape, strict=False))
    if tensor.ndim != len(shape) or not all(as_wanted):
        wanted = ", ".join("any" if n is None else str(n) for n in shape)
        raise ValueError(f"{name}: expected shape ({wanted}), got {tuple(tensor.shape)}; reshape it")
    if not torch.isfinite(tensor).all():
        raise ValueError(f"{name}: expected finite numbers, got NaN or infinity; drop those rows")
    return tensor


def as_theta(name: str, value: Numbers, shape: Sequence[int | None]) -> Tensor:
    """``as_float64`` within the unit cube; what rounding (1e-6) put outside is clipped, the rest refused."""
    theta = as_float64(name, value, shape)
    if theta.numel() and (theta.min() < -_ROUNDING or theta.max() > 1 + _ROUNDING):
        raise ValueError(
            f"{name}: expected theta in [0, 1], got [{theta.min():.4g}, {theta.max():.4g}]; "
            "normalise values with space.normalise and clip to the cube"
        )
    return theta.clamp(0.0, 1.0)


def check_bandwidth(bandwidth: object) -> float:
    """``bandwidth`` as a positive float."""
    if isinstance(bandwidth, (int, float)) and 0 < bandwidth < float("inf"):
        return float(bandwidth)
    raise ValueError(f"bandwidth: expected a positive number in theta units, got {bandwidth!r}; try 0.02")


class DrawsFamily(Protocol):
    """Makes a posterior of draws (n, N)."""

    def __call__(self, draws: Tensor, space: ParameterSpace, /) -> Posterior:
        """The posterior."""
        ...


class Posterior(Drawn, TorchDistribution):
    """A distribution over theta (N,) in the unit cube, with the ``space`` of its N parameters.

    Everything is float64. ``mean``, ``stddev``, ``variance`` (N,), ``covariance`` (N, N) and ``mode`` (N,)
    are properties; ``sample``, ``log_prob``, ``quantile``, ``values``, ``marginal``, ``save`` are methods.
    Families with ``has_density`` work inside ``pyro.sample``: GaussianMixture, IndependentPrior, and those of
    other files that do not say otherwise. Dirac and Particles draw, but their ``log_prob`` raises
    NoDensityError.

    **Adding a family** takes one file and its class in ``registry.FAMILIES``. The base class owns batches,
    dtypes, seeds, shape checks and files; a subclass writes its own mathematics on plain (n, N) tensors:

    - ``_sample(n, generator) -> (n, N)``: exact draws, random numbers from ``generator`` alone.
    - ``_log_prob(theta (n, N)) -> (n,)``: normalised log density of points inside the cube.
    - ``_state() -> (tensors, settings)`` and ``_restore(space, tensors, settings)``: what goes to disk and
      back; settings are plain JSON numbers and strings. A posterior in them is an entry ``name: {"family",
      "settings"}`` with tensors ``name.*``; ``_restore`` gets it as a posterior.

    and, where it knows better than 20,000 fixed-seed draws, ``_moments() -> (mean, covariance)``,
    ``_quantile(q (Q,)) -> (Q, N)``, ``_mode() -> (N,)``, ``marginal(names)``. The simplest one::

        class Uniform(Posterior):
            def _sample(self, n, generator):
                return torch.rand(n, len(self.space), dtype=torch.float64, generator=generator)

            def _log_prob(self, theta):
                return theta.new_zeros(len(theta))

            def _state(self):
                return {}, {}

            @classmethod
            def _restore(cls, space, tensors, settings):
                return cls(space)
    """

    of_draws: ClassVar[DrawsFamily]
    """The family that stands for draws (n, N) of any other: ``posterior.particles`` puts its own here."""
    arg_constraints: ClassVar[dict[str, Any]] = {}
    support = constraints.independent(constraints.unit_interval, 1)
    has_rsample = False
    has_density: ClassVar[bool] = True
    reference_draws: ClassVar[int] = 20_000  # of moments, quantiles and mode where a family knows no better: 1 % of sd
    marginal_draws: ClassVar[int] = 8_000  # of marginals and wider ones, which are kept

    def __init__(self, space: ParameterSpace) -> None:
        if not isinstance(space, ParameterSpace):
            raise TypeError(f"space: expected a ParameterSpace, got {type(space).__name__}")
        self.space = space
        super().__init__(torch.Size(), torch.Size([len(space)]), validate_args=False)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(self.space.names)})"

    def _repr_html_(self) -> str:
        low, middle, high = (self.space.values(q) for q in self.quantile([0.05, 0.5, 0.95]).numpy())
        ends = zip(self.space, middle, low, high, strict=True)
        rows = [(p.name, f"{m:.4g}", f"{a:.4g} to {b:.4g}", p.unit) for p, m, a, b in ends]
        return html_table(type(self).__name__, ("parameter", "median", "90 % interval", "unit"), rows)

    # What a family writes.

    def _sample(self, n: int, generator: Generator | None) -> Tensor:
        raise NotImplementedError(f"{type(self).__name__} must define _sample(n, generator) -> (n, N)")

    def _log_prob(self, theta: Tensor) -> Tensor:
        raise NotImplementedError(f"{type(self).__name__} must define _log_prob(theta (n, N)) -> (n,)")

    def _state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        raise NotImplementedError(f"{type(self).__name__} must define _state() -> (tensors, settings)")

    @classmethod
    def _restore(cls, space: ParameterSpace, tensors: dict[str, Tensor], settings: dict[str, Any]) -> Self:
        raise NotImplementedError(f"{cls.__name__} must define _restore(space, tensors, settings)")

    def _moments(self) -> tuple[Tensor, Tensor]:
        return self._reference.mean(0), torch.atleast_2d(torch.cov(self._reference.T))

    def _quantile(self, q: Tensor) -> Tensor:
        return torch.quantile(self._reference, q, dim=0)

    def _mode(self) -> Tensor:
        return self._reference[self._log_prob(self._reference).argmax()]

    def _chains(self, num_draws: int, generator: Generator | None) -> Tensor:
        return self._sample(num_draws, generator)[None]

    def _sample_stats(self) -> dict[str, Tensor]:
        """What a sampler knows of each draw of ``_chains``: (chain, draw) by ArviZ's names."""
        return {}

    # What the base class owns.

    @cached_property
    def _reference(self) -> Tensor:
        return self._fixed_draws(self.reference_draws)

    @cached_property
    def _cached_moments(self) -> tuple[Tensor, Tensor]:
        with torch.no_grad():
            return self._moments()

    @cached_property
    def _cached_mode(self) -> Tensor:
        with torch.no_grad():
            return self._mode()

    def _fixed_draws(self, n: int) -> Tensor:
        """Draws (n, N) that are the same each time."""
        with torch.no_grad():
            return self._sample(n, Generator().manual_seed(0))

    def _expanded(self, value: Tensor) -> Tensor:
        return value.expand(*self.batch_shape, *value.shape)

    def expand(self, batch_shape: Sequence[int], _instance: object = None) -> Self:
        """Independent copies in ``batch_shape``, as Pyro's plates ask for."""
        new = copy.copy(self)
        new._batch_shape = torch.Size(np.broadcast_shapes(self.batch_shape, tuple(batch_shape)))
        return new

    def sample(self, sample_shape: Sequence[int] = (), generator: Generator | None = None) -> Tensor:
        """Exact draws.

        Args:
            sample_shape: how many, such as ``(1000,)``.
            generator: of random numbers, default torch's global one.

        Returns:
            theta ``(*sample_shape, *batch_shape, N)``.
        """
        try:
            shape = torch.Size(whole("sample_shape", size, 0) for size in sample_shape) + self.batch_shape
        except TypeError:
            raise ValueError(f"sample_shape: expected sizes such as (1000,), got {sample_shape!r}") from None
        with torch.no_grad():
            return self._sample(shape.numel(), generator).reshape(*shape, len(self.space))

    def log_prob(self, theta: Numbers) -> Tensor:
        """Log density.

        Args:
            theta: (..., N).

        Returns:
            (...), -inf outside the cube.

        Raises:
            NoDensityError: where there is none.
            ValueError: for another shape.
        """
        if not self.has_density:
            raise NoDensityError(f"{type(self).__name__} has no density; use .smoothed(bandwidth), a GaussianMixture")
        theta = torch.as_tensor(theta, dtype=torch.float64)
        if theta.ndim == 0 or theta.shape[-1] != len(self.space):
            raise ValueError(f"theta: expected shape (..., {len(self.space)}), got {tuple(theta.shape)}; reshape it")
        flat = theta.reshape(-1, len(self.space))
        inside = ((flat >= 0) & (flat <= 1)).all(-1)
        result = torch.full((len(flat),), -torch.inf, dtype=torch.float64)
        if inside.any():
            result = result.masked_scatter(inside, self._log_prob(flat[inside]))
        result = result.reshape(theta.shape[:-1])
        return result.expand(np.broadcast_shapes(result.shape, self.batch_shape))

    @property
    def mean(self) -> Tensor:
        """Mean of theta (N,)."""
        return self._expanded(self._cached_moments[0])

    @property
    def covariance(self) -> Tensor:
        """Covariance of theta (N, N)."""
        return self._expanded(self._cached_moments[1])

    @property
    def variance(self) -> Tensor:
        """Variance of each theta (N,)."""
        return self._expanded(self._cached_moments[1].diagonal().clamp_min(0.0))

    @property
    def stddev(self) -> Tensor:
        """Standard deviation of each theta (N,)."""
        return self.variance.sqrt()

    @property
    def mode(self) -> Tensor:
        """The most probable theta (N,); of a search, the best that it evaluated."""
        return self._expanded(self._cached_mode)

    def gaussian_moments(self) -> tuple[Tensor, Tensor]:
        """The Gaussian which, restricted to the cube, stands for this posterior where it becomes a prior.

        Returns:
            Mean (N,) and covariance (N, N); moment-matched unless the family says it is exact.
        """
        return self._cached_moments

    def quantile(self, q: Numbers) -> Tensor:
        """Quantiles of each parameter's marginal.

        Args:
            q: a level in [0, 1], or several (Q,).

        Returns:
            (N,) for one level, (Q, N) for several.
        """
        try:
            levels = torch.as_tensor(q, dtype=torch.float64)
        except (TypeError, ValueError, RuntimeError):
            raise ValueError(f"q: expected a number or a vector of numbers in [0, 1], got {q!r}") from None
        if levels.ndim > 1 or not ((levels >= 0) & (levels <= 1)).all():
            raise ValueError(f"q: expected a number or a vector of numbers in [0, 1], got {q!r}")
        with torch.no_grad():
            result = self._quantile(levels.reshape(-1))
        return result[0] if levels.ndim == 0 else result

    def _columns(self, names: Iterable[str]) -> tuple[list[int], ParameterSpace]:
        if isinstance(names, str):
            raise TypeError(f"names: expected a list of parameter names, got the string {names!r}; write [{names!r}]")
        names = list(names)
        return [self.space.index(n) for n in names], self.space.subset(names)

    def marginal(self, names: Iterable[str]) -> Posterior:
        """The posterior of some parameters, in the order given: here Particles of 8,000 fixed-seed draws."""
        columns, space = self._columns(names)
        return self.of_draws(self._fixed_draws(self.marginal_draws)[:, columns], space)

    def wider(self, factor: float) -> Posterior:
        """This posterior spread further about its mean, for cautious domain randomisation.

        Args:
            factor: of the spread, at least 1.

        Returns:
            Particles of 8,000 fixed-seed draws, reflected where they would leave the cube.

        Raises:
            ValueError: for a factor below 1, and for a point, which has no spread.
        """
        factor = at_least("factor", factor, 1.0)
        draws = self._fixed_draws(self.marginal_draws)
        if float(np.ptp(draws.numpy(), axis=0).max()) < _POINT:
            raise ValueError("wider: expected a posterior with spread, got a point; take .smoothed(bandwidth)")
        centre = draws.mean(0)
        return self.of_draws(1 - (1 - (centre + factor * (draws - centre)) % 2).abs(), self.space)

    def values(self, n: int, generator: Generator | None = None) -> FloatArray:
        """Draws (n, N) in physical units."""
        n = whole("n", n, 0)
        with torch.no_grad():
            return self.space.values(self._sample(n, generator).numpy())

    def to_inference_data(
        self,
        num_draws: int = 2000,
        generator: Generator | None = None,
        *,
        prior: Posterior | None = None,
        observed_data: Mapping[str, ArrayLike] | None = None,
        posterior_predictive: Mapping[str, ArrayLike] | None = None,
        log_likelihood: Mapping[str, ArrayLike] | None = None,
    ) -> arviz.InferenceData:
        """ArviZ InferenceData: a variable (chain, draw) for each parameter, in physical units, and what else is given.

        Args:
            num_draws: in one chain; posteriors that came as chains keep all of their draws, with what the sampler knows
                of each as sample_stats.
            generator: of the draws.
            prior: ``num_draws`` draws of it are added.
            observed_data: arrays by name.
            posterior_predictive: arrays (chain, draw, ...) by name, simulated at ``data.posterior``.
            log_likelihood: arrays (chain, draw, ...) by name, at ``data.posterior``.

        Raises:
            ValueError: for other shapes, or a prior over other parameters.
        """
        arviz = ready_arviz()
        if prior is not None and prior.space.names != self.space.names:
            raise ValueError(f"prior: expected one over {list(self.space.names)}, got {list(prior.space.names)}")
        theta = self._chains(num_draws, generator)
        before = None if prior is None else prior._sample(num_draws, generator)[None]
        data = arviz.from_dict(
            posterior=self._by_name(theta),
            prior=None if before is None else self._by_name(before),
            observed_data={name: np.asarray(x) for name, x in (observed_data or {}).items()} or None,
            posterior_predictive=draws_by_name("posterior_predictive", posterior_predictive, theta) or None,
            log_likelihood=draws_by_name("log_likelihood", log_likelihood, theta) or None,
            sample_stats={name: x.numpy() for name, x in self._sample_stats().items()} or None,
        )
        for group in (data.posterior, *([] if before is None else [data.prior])):
            for parameter in self.space:
                group[parameter.name].attrs.update(units=parameter.unit, description=parameter.description)
        return data

    def netcdf(self, generator: Generator | None = None) -> bytes:
        """The file of ``to_inference_data``, which ``arviz.from_netcdf`` reads."""
        draws = self._by_name(self._chains(2000, generator))
        return netcdf({"posterior": draws, "sample_stats": self._sample_stats()}, self.space)

    def _by_name(self, theta: Tensor) -> dict[str, NDArray[Any]]:
        """Values (chain, draw) of theta (chain, draw, N) by parameter."""
        values = self.space.values(theta.numpy())
        return {name: values[..., j] for j, name in enumerate(self.space.names)}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write ``<path>.safetensors`` and ``<path>.json``; ``load_posterior(path)`` reads them back."""
        tensors, settings = self._state()
        write_pair(path, Header(family=type(self).__name__, space=self.space.to_dict(), settings=settings), tensors)
