"""Evidence and held-out score against exact integrals of linear-Gaussian structures, and against draws."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.integrate
import scipy.stats
import torch

from sipe_bayes.core.arrays import BoolArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.laplace import Laplace
from sipe_bayes.likelihood import Noise, QuadraticPrior, Segments
from sipe_bayes.likelihood.restricted import marginal
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.posterior import prior as default_prior
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.scores import Scores, _Linear, scores
from tests.problems.pendulums import log, pendulum

XML = """<mujoco><option timestep="0.02" gravity="0 0 0"/><worldbody>
<body><joint name="rail" type="slide" axis="1 0 0"/><geom size="0.1" mass="1"/></body></worldbody>
<actuator><motor name="drive" joint="rail"/></actuator></mujoco>"""
OFFSET = Parameter("offset", -1.0, 1.0, targets=("actuator:drive.offset",))
WIND = Parameter("gravity", -1.0, 1.0, targets=("option.gravity_x",), prior_mean=0.1, prior_sd=0.2)
SD, DT, STEPS = 0.05, 0.02, 60


def bound(parameters: list[Parameter], rho: float, logs: int = 1) -> Windows:
    """Logs of a free mass under a small force, positions measured: the motion is linear in forces and start."""
    environment = MjcfEnvironment.build(XML, parameters, ["drive"], ["joint:rail.position"])
    simulator, rng = Simulator(environment, num_threads=1), np.random.default_rng(3)
    recorded = []
    for k in range(logs):
        clock = np.arange(STEPS + 1) * DT
        noise = rng.standard_normal(STEPS + 1)
        for t in range(1, len(noise)):
            noise[t] = rho * noise[t - 1] + np.sqrt(1 - rho**2) * noise[t]
        measured = 0.15 * clock**2 + SD * noise
        recorded.append(Trajectory(measured[:, None], np.zeros((STEPS, 1)), DT, name=f"log {k}"))
    return Windows(Segments(0.4, "ar1"), simulator, Trajectories.stack(recorded))


def exact(windows: Windows, rho: float, keep: BoolArray | None = None) -> float:
    """Log p of the samples in windows that are kept, theta and starts integrated out of the dense model."""
    keep = np.ones(windows.num_windows, bool) if keep is None else keep
    n, at = windows.num_theta, np.full(windows.num_theta, 0.5)
    lin = windows.linearise(at, windows.no_starts())
    chosen = (windows.observed[..., 0] & keep[:, None]).ravel()
    rows, owner = np.flatnonzero(chosen), np.repeat(np.arange(windows.num_windows), windows.observed.shape[1])
    jacobian = lin.jacobian[:, :, 0].reshape(-1, lin.jacobian.shape[-1])[rows]
    starts = np.zeros((len(rows), windows.num_windows * windows.num_start))
    for row, w in enumerate(owner[rows]):
        starts[row, w * windows.num_start : (w + 1) * windows.num_start] = jacobian[row, n:]
    time = np.concatenate([np.arange(s, s + windows.observed.shape[1]) for s in windows.start])[rows]
    logs = windows.log[owner[rows]]
    lag = np.abs(time[:, None] - time)
    covariance = SD**2 * np.where(logs[:, None] == logs, rho**lag if rho else (lag == 0) * 1.0, 0.0)
    sd = np.tile(windows.start_precision**-0.5, windows.num_windows)
    covariance += starts @ np.diag(sd**2) @ starts.T
    normal = scipy.stats.multivariate_normal(np.zeros(len(rows)), covariance)
    residual = lin.residual[:, :, 0].ravel()[rows]
    prior = default_prior(windows.simulator.space)

    def density(*theta: float) -> float:
        point = np.array(theta)
        log_prior = float(prior.log_prob(torch.from_numpy(point)))
        return float(np.exp(normal.logpdf(residual - jacobian[:, :n] @ (point - at)) - level + log_prior))

    level = max(
        normal.logpdf(residual - jacobian[:, :n] @ (np.array(p) - at))
        for p in np.stack(np.meshgrid(*[np.linspace(0, 1, 41)] * n), -1).reshape(-1, n)
    )
    grid = np.linspace(0, 1, 161)
    values = np.array([density(*p) for p in np.stack(np.meshgrid(*[grid] * n, indexing="ij"), -1).reshape(-1, n)])
    for _ in range(n):
        values = scipy.integrate.simpson(values.reshape(-1, len(grid)), x=grid, axis=-1)
    return level + float(np.log(values.item()))


def ours(windows: Windows, rho: float) -> tuple[float, float]:
    """Both scores at the optimum."""
    both = at_optimum(windows, rho)
    return both.evidence, float(both.pieces.density.sum())


def at_optimum(windows: Windows, rho: float) -> Scores:
    """Scores where one step of the linear model leads."""
    noise = Noise(np.array([SD]), np.array([-DT / np.log(rho) if rho else 0.0]))
    prior = QuadraticPrior.of(default_prior(windows.simulator.space))
    theta, starts = np.full(windows.num_theta, 0.4), windows.no_starts()
    normal = windows.moments(windows.linearise(theta, starts)).normal(noise)
    move, own = _Linear(windows, theta, starts, prior).step(normal)
    return scores(windows, theta + move, starts + own, noise, prior)


@pytest.mark.parametrize("rho", [0.0, 0.7])
@pytest.mark.parametrize("parameters", [[OFFSET], [WIND], [OFFSET, WIND]])
def test_the_evidence_of_a_linear_structure_is_exact(parameters: list[Parameter], rho: float) -> None:
    """To what the flat normal of open directions (sd ten cubes) leaves."""
    windows = bound(parameters, rho)
    expected, (got, _) = exact(windows, rho), ours(windows, rho)
    print(expected, got)
    assert got == pytest.approx(expected, abs=0.02)


def test_a_gain_that_was_not_taken_does_not_count() -> None:
    """Of a linear model: half the move times the precision, which slopes promise where the search has not ended."""
    windows = bound([OFFSET], 0.0)
    ends, noise = at_optimum(windows, 0.0), Noise(np.array([SD]), np.zeros(1))
    prior = QuadraticPrior.of(default_prior(windows.simulator.space))
    early = scores(windows, np.full(1, 0.4), windows.no_starts(), noise, prior)
    print(ends.evidence, early.evidence)
    assert early.evidence < ends.evidence - 100


@pytest.mark.parametrize("logs", [1, 2])
def test_held_out_pieces_are_foretold_as_by_refitting(logs: int) -> None:
    """White noise, so that no sample is tied to one across a piece's edge; each window is a piece."""
    windows = bound([OFFSET], 0.0, logs)
    assert windows.num_windows == 3 * logs
    owner = np.arange(windows.num_windows)
    whole = exact(windows, 0.0)
    expected = sum(whole - exact(windows, 0.0, owner != k) for k in np.unique(owner))
    got = ours(windows, 0.0)[1]
    print(expected, got)
    assert got == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize("rho", [0.0, 0.3, 0.9])
def test_what_pieces_are_given_does_not_depend_on_how_noise_follows_itself(rho: float) -> None:
    """Of white noise, told to be coloured: a piece never knows the sample behind its end."""
    windows = bound([OFFSET], 0.0)
    both = at_optimum(windows, rho)
    print(both.pieces.density.sum() - both.evidence)
    assert both.pieces.density.sum() - both.evidence == pytest.approx(-0.1, abs=0.3)  # 2 nats and more if it knew it


def test_importance_sampling_gives_the_evidence_of_a_pendulum_with_friction() -> None:
    """400 draws about the optimum, starts integrated out: what is not normal, friction's kink, is half a nat."""
    simulator = pendulum(Parameter("friction", 0.0, 0.3, targets=("joint:hinge.frictionloss",)))
    recorded = Trajectories.stack([log(simulator, [0.6, 0.08, 0.05], 1, steps=200)])
    prior, likelihood = default_prior(simulator.space), Segments(0.5, "ar1")
    laplace = Laplace(simulator, likelihood=likelihood, seed=0)
    laplace.fit(recorded)
    best = laplace.result
    assert best is not None
    windows, noise = Windows(likelihood, simulator, recorded), best.noise
    got = scores(windows, best.theta, best.starts, noise, QuadraticPrior.of(prior)).evidence
    normal = scipy.stats.multivariate_normal(best.mean, 1.5 * best.covariance)
    draws = normal.rvs(400, random_state=0)
    inside = ((draws >= 0) & (draws <= 1)).all(1)
    counts = sum(len(s.index) for s in windows.sequences)
    constant = -0.5 * counts * np.log(2 * np.pi) + 0.5 * windows.num_windows * np.log(windows.start_precision).sum()
    levels = np.full(len(draws), -np.inf)
    for k in np.flatnonzero(inside):
        lin = windows.linearise(draws[k], best.starts, with_theta=False)
        levels[k] = marginal(windows.moments(lin), noise, best.starts, windows.start_precision)[0] + constant
    weights = levels - normal.logpdf(draws)
    shares = np.exp(weights - weights.max())
    expected = weights.max() + np.log(shares.mean())
    error = shares.std() / shares.mean() / np.sqrt(len(shares))
    print(expected, error, got)
    assert error < 0.1
    assert got == pytest.approx(expected, abs=0.5 + 3 * error)
