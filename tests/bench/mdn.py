"""BayesSim's network against a loop over components: table of `bench.py mdn`."""

from __future__ import annotations

import statistics
import time

import torch
from torch.distributions import MultivariateNormal

from sipe_bayes.models.mixture_density import MixtureDensity
from sipe_bayes.models.training import Training, train

ROWS, N, COMPONENTS, INPUTS, BATCH = 10_000, 18, (5, 10), 136, 100  # five components: the estimator's default


def data(rows: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """``theta`` uniform on the cube (rows, 18); inputs (rows, 136): noisy, slightly nonlinear mixtures of them."""
    generator = torch.Generator().manual_seed(seed)
    theta = torch.rand(rows, N, generator=generator)
    mixing = torch.randn(N, INPUTS, generator=torch.Generator().manual_seed(99))
    return (theta @ mixing).sin() + 0.3 * torch.randn(rows, INPUTS, generator=generator), theta


def looped(network: MixtureDensity, inputs: torch.Tensor, theta: torch.Tensor) -> torch.Tensor:
    """The same log density (n,), one MultivariateNormal for each component."""
    log_weights, means, diagonal, below = network(inputs)
    rows, columns = torch.tril_indices(N, N, -1)
    terms = []
    for k in range(network.components):
        whitening = torch.eye(N).repeat(len(inputs), 1, 1)
        whitening[:, rows, columns] = below[:, k]
        whitening = whitening * diagonal[:, k].exp()[..., None]
        root = torch.linalg.solve_triangular(whitening, torch.eye(N).expand_as(whitening), upper=False)
        component = MultivariateNormal(means[:, k], scale_tril=root, validate_args=False)
        terms.append(log_weights[:, k] + component.log_prob(theta))
    return torch.stack(terms, -1).logsumexp(-1)


def _seconds(network: MixtureDensity, inputs: torch.Tensor, theta: torch.Tensor, ours: bool, steps: int) -> float:
    optimiser = torch.optim.Adam(network.parameters(), foreach=True)
    begin = time.perf_counter()
    for k in range(steps):
        rows = slice(k % 50 * BATCH, (k % 50 + 1) * BATCH)
        optimiser.zero_grad(set_to_none=True)
        value = network.log_prob(inputs[rows], theta[rows]) if ours else looped(network, inputs[rows], theta[rows])
        (-value.mean()).backward()
        optimiser.step()
    return (time.perf_counter() - begin) / steps


def table(pairs: int) -> None:
    """Steps a second of both and the time to .05 nats of the converged held-out loss."""
    inputs, theta = data(ROWS, 0)
    for components in COMPONENTS:
        _compare(pairs, components, inputs, theta)
        _time_to_converge(components, inputs, theta)


def _compare(pairs: int, components: int, inputs: torch.Tensor, theta: torch.Tensor) -> None:
    torch.manual_seed(0)
    network = MixtureDensity(INPUTS, N, components)
    network.fit_inputs(inputs, theta)
    with torch.no_grad():
        apart = (network.log_prob(inputs[:500], theta[:500]) - looped(network, inputs[:500], theta[:500])).abs().max()
    ratios, mine = [], []
    for _ in range(pairs):
        a, b = _seconds(network, inputs, theta, True, 60), _seconds(network, inputs, theta, False, 20)
        ratios.append(b / a)
        mine.append(1 / a)
    print(f"\nBayesSim's network, {ROWS:,} rows x {N} parameters, {components} components, batch {BATCH}")
    print(
        f"steps/s {statistics.median(mine):.0f}, {statistics.median(ratios):.1f} times the loop over components (bar 5)"
    )
    print(f"largest difference of a log density: {apart:.1e} nats")


def _time_to_converge(components: int, inputs: torch.Tensor, theta: torch.Tensor) -> None:
    held_inputs, held_theta = data(2000, 1)
    losses: list[tuple[float, float]] = []
    torch.manual_seed(0)
    network = MixtureDensity(INPUTS, N, components)
    network.fit_inputs(inputs, theta)
    spent, generator = 0.0, torch.Generator().manual_seed(0)
    while spent < 180 and (
        len(losses) < 16 or min(x for _, x in losses[-15:]) < min(x for _, x in losses[:-15]) - 1e-3
    ):
        begin = time.perf_counter()
        settings = Training(BATCH, epochs=1)
        train(network, lambda rows: -network.log_prob(inputs[rows], theta[rows]), ROWS, settings, generator)
        spent += time.perf_counter() - begin
        with torch.no_grad():
            losses.append((spent, float(-network.log_prob(held_inputs, held_theta).mean())))
    converged = min(x for _, x in losses)
    near = next(t for t, x in losses if x <= converged + 0.05)
    print(
        f"held-out loss within .05 nats of the converged {converged:.2f} after {near:.1f} s (bar 60), converged after "
        f"{spent:.0f} s"
    )
