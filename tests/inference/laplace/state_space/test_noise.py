"""Noise of a chain of states: raised where rounding asks for it, inferred, and what it says of the model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sipe_bayes.core.findings import Code, Severity
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.inference.laplace import estimator
from sipe_bayes.inference.laplace.estimator import Laplace
from sipe_bayes.inference.laplace.state_space.noise import NoisePosterior, excess, first_noise, infer_noise
from sipe_bayes.inference.laplace.state_space.options import ChainTuning, NoiseTuning
from sipe_bayes.inference.laplace.state_space.smoother import ChainPoint, smooth, solvable
from sipe_bayes.likelihood.binding import bind
from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior
from sipe_bayes.likelihood.settings import StateSpace
from sipe_bayes.likelihood.state_space.differences import linearise
from sipe_bayes.likelihood.state_space.linearisation import ChainNoise, eliminate_states
from sipe_bayes.likelihood.state_space.process_noise import process_noise_findings
from tests.problems.hung import hung, hung_log
from tests.problems.pendulums import log as pendulum_log
from tests.problems.pendulums import pendulum
from tests.problems.springs import MADE_WITH, spring, spring_logs


def test_noise_that_rounding_cannot_bear_is_raised() -> None:
    """``solvable`` returns the least process noise of a few that the equations can be solved with; no other changes."""
    chain = bind(StateSpace(), hung(), Trajectories.stack(hung_log(np.array([0.4]), 0)))
    linear = linearise(chain, np.array([0.4]), chain.reference)
    assert linear is not None
    fair = ChainNoise(np.array([0.01]), np.full(4, 1e-4))
    assert solvable(linear, fair) is fair
    never = ChainNoise(np.array([0.01]), np.full(4, 1e-14))
    with pytest.raises(np.linalg.LinAlgError):
        eliminate_states(linear, never)
    raised = solvable(linear, never)
    assert raised.sd is never.sd
    assert (raised.process > never.process).all()
    with pytest.raises(np.linalg.LinAlgError):
        eliminate_states(linear, ChainNoise(raised.sd, raised.process / 3))


def test_what_no_noise_makes_solvable_is_an_error() -> None:
    """Where a block is negative, whatever the noise, raising it would go on for ever."""
    chain = bind(StateSpace(), hung(), Trajectories.stack(hung_log(np.array([0.4]), 0)))
    linear = linearise(chain, np.array([0.4]), chain.reference)
    assert linear is not None
    negative = replace(linear, precision=np.full_like(linear.precision, -1e12))
    with pytest.raises(np.linalg.LinAlgError):
        solvable(negative, ChainNoise(np.array([0.01]), np.full(4, 1e-4)))


def test_noise_is_held_against_the_scatter_of_its_channel() -> None:
    """One of white noise, within a third; ten where a wave is taken for noise; none of one that was given."""
    rng, clean = np.random.default_rng(0), np.zeros((200, 1))
    noisy = Trajectory(clean + 0.02 * rng.standard_normal(clean.shape), np.zeros((199, 1)), 0.02)
    chain = bind(StateSpace(), spring(), Trajectories.stack(noisy))
    assert excess(chain, np.array([0.02]))[0] == pytest.approx(1.0, rel=0.33)
    assert excess(chain, np.array([0.2]))[0] == pytest.approx(10.0, rel=0.33)
    given = bind(StateSpace(noise_sd=(0.02,)), spring(), Trajectories.stack(noisy))
    assert excess(given, np.array([0.2]))[0] == 0.0


def test_a_channel_that_mostly_rests_scatters_by_its_steps() -> None:
    """An encoder that counts now and then has no median step; a count's error is even over one count."""
    counts = np.floor(np.arange(200) / 25.0)[:, None] / 100
    chain = bind(StateSpace(), spring(), Trajectories.stack(Trajectory(counts, np.zeros((199, 1)), 0.02)))
    assert excess(chain, np.array([0.01 / np.sqrt(12)]))[0] == pytest.approx(1.0)


def test_a_fit_that_takes_much_else_for_noise_is_blocked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the noise is four times the scatter, and not where it is the scatter."""
    logs = spring_logs()

    def codes() -> set[Code]:
        fit = Laplace(spring(), likelihood=StateSpace(), restarts=1, candidates=0)
        fit.fit(logs)
        return {one.code for one in fit.findings}

    assert Code.NOISE_EXCEEDS_SCATTER not in codes()
    monkeypatch.setattr(estimator, "excess", lambda chain, sd: 4.0 * excess(chain, sd))
    assert Code.NOISE_EXCEEDS_SCATTER in codes()


def test_given_noise_is_kept_and_process_noise_shrinks_where_the_model_is_right() -> None:
    """Without process noise in the log the inferred one falls to less than a tenth of the measurement's effect."""
    simulator = pendulum()
    log = pendulum_log(simulator, [0.6, 0.1], 3, steps=120, sd=0.01)
    chain = bind(StateSpace(noise_sd=(0.01,)), simulator, Trajectories.stack(log))
    theta = simulator.space.normalise(np.array([0.6, 0.1]))
    linear = linearise(chain, theta, chain.reference)
    assert linear is not None
    movement, states = chain.movement(chain.reference), chain.reference
    noise, tuning = first_noise(chain, linear, movement, NoiseTuning()), ChainTuning()
    flat = QuadraticPrior(np.full(2, 0.5), np.zeros((2, 2)))
    assert noise.sd[0] == 0.01
    for _ in range(6):
        linear = linearise(chain, theta, states)
        assert linear is not None
        noise, _ = infer_noise(NoisePosterior(chain, linear, noise, flat, theta, movement, tuning.noise))
        point, _ = smooth(chain, linear, noise, flat, ChainPoint(theta, states), 1e-4, 1e-3, tuning)
        theta, states = point.theta, point.states
    assert noise.sd[0] == 0.01
    print("process noise", noise.process)
    assert noise.process[0] < 1e-3


def test_process_noise_says_where_the_model_lacks_something() -> None:
    """A pendulum whose pivot sways, which the model does not know, and one whose does not."""
    findings = {}
    for name, share in (("right", 0.0), ("wrong", 0.1)):
        simulator = pendulum()
        log = pendulum_log(simulator, [0.6, 0.05], 3, steps=200)
        log = replace(log, observations=log.observations + share * np.sin(np.arange(201)[:, None] * 0.4))
        estimator = Laplace(simulator, likelihood=StateSpace(), restarts=1, candidates=0)
        estimator.fit(log)
        chain = bind(StateSpace(), simulator, Trajectories.stack(log))
        noise = (np.array(estimator.diagnostics[k]) for k in ("process_noise", "movement"))
        findings[name] = process_noise_findings(chain, *noise)
    print(findings)
    assert [item.code for item in findings["right"]] == [Code.PROCESS_NOISE]
    assert [item.code for item in findings["wrong"]] == [Code.PROCESS_NOISE]
    assert [findings[name][0].severity for name in ("right", "wrong")] == [Severity.NOTE, Severity.CAUTION]
    assert "of hinge" in findings["wrong"][0].text


def test_freedom_is_what_dense_algebra_says() -> None:
    """The trace of the measurements' hat matrix, all states and theta in one dense system."""
    simulator = spring()
    chain = bind(StateSpace(), simulator, Trajectories.stack(spring_logs(steps=20)))
    theta, tuning = np.array([0.4]), NoiseTuning()
    linear = linearise(chain, theta, chain.reference)
    assert linear is not None
    prior = QuadraticPrior(np.full(1, 0.5), np.full((1, 1), 12.0))
    given = NoisePosterior(chain, linear, MADE_WITH, prior, theta, chain.movement(chain.reference), tuning)
    (count, d), n = linear.offset.shape, 1
    measured = np.zeros((count, d * count + n))
    rows = [np.sqrt(np.diag(linear.precision.ravel())) @ np.eye(d * count, d * count + n)]
    for k in range(count):
        measured[k, d * k : d * k + d] = linear.measurement[k, 0] / MADE_WITH.sd
        measured[k] *= linear.observed[k, 0]
    for k in np.flatnonzero(linear.linked):
        jump = np.zeros((d, d * count + n))
        jump[:, d * (k + 1) : d * (k + 2)] = np.eye(d)
        jump[:, d * k : d * (k + 1)] = -linear.transition[k]
        jump[:, -n:] = -linear.transition_theta[k]
        rows.append(jump / MADE_WITH.process[:, None])
    every = np.concatenate([measured, *rows])
    normal = every.T @ every
    normal[-n:, -n:] += given.hold.precision
    expected = np.trace(measured @ np.linalg.solve(normal, measured.T))
    print(given.freedom, expected)
    assert given.freedom == pytest.approx(expected, rel=1e-6)
