"""`laplace` on StateSpace against SMC^2, a judge that linearises nothing: C2ST between the draws of both.

A linear spring, a pendulum, a ball that bounces off a floor and a finger that pushes a puck on a rail; truths uniform
in [0.2, 0.8]^N, 40 control steps, known commands, white noise of the measurements and process noise in every step. Both
see the noise that `laplace` estimated, so what is compared is theta's posterior given it: the linearised states against
bootstrap filters (tests/problems/particle_judge.py). 0.5 is perfect, the bar 0.55; "c2st_same" is that of as many draws
of the same posterior, which says how much one C2ST scatters. On the spring, "exact" compares both with a grid of Kalman
filters.

    python examples/studies/particles.py --seeds 0 2                    # minutes of a core for each log
    python examples/studies/particles.py --select pusher --seeds 0 8

Rows are kept in runs/particles and an interrupted study goes on; each run writes the summary of all there are.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _c2st import c2st
from _kept import ensure, fits

import sipe_bayes as sipe
from sipe_bayes.core.files import write_text
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.laplace.state_space.state import ChainOptimum
from sipe_bayes.inference.laplace.strategy import mixture
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.posterior import Particles, Posterior
from sipe_bayes.simulation.tangents import moved

HERE = Path(__file__).parent
RUNS = HERE / "runs" / "particles"
sys.path.insert(0, str(HERE.parents[1]))
DT, STEPS, THETAS = 0.02, 40, 128
TIMES, MOST = 4, 24  # moves of each of the judge's draws in the end, and steps until then at most

MODELS: dict[str, tuple[str, list[str], list[Parameter], float]] = {
    # body, joints, unknowns, size of the command
    "spring": (
        '<body><joint name="x" type="slide" axis="1 0 0" damping="0.7" stiffness="10"/>'
        '<geom size="0.1" mass="2" contype="0" conaffinity="0"/></body>',
        ["x"],
        [Parameter("stiffness", 5.0, 25.0, targets=("joint:x.stiffness",))],
        4.0,
    ),
    "pendulum": (
        '<body name="pole"><joint name="hinge" type="hinge" axis="0 1 0" damping="0.1"/>'
        '<geom type="capsule" fromto="0 0 0 0 0 -.5" size=".03" mass="1" contype="0" conaffinity="0"/></body>',
        ["hinge"],
        [
            Parameter("mass", 0.5, 2.0, targets=("body:pole.mass",)),
            Parameter("damping", 0.02, 0.5, targets=("joint:hinge.damping",)),
        ],
        1.5,
    ),
    "ball": (
        '<geom type="plane" size="1 1 .1" solref="-3000 -2"/><body name="ball" pos="0 0 .2">'
        '<joint name="z" type="slide" axis="0 0 1" damping="0.2" stiffness="20"/>'
        '<geom size=".1" mass="1" solref="-3000 -2"/></body>',
        ["z"],
        [
            Parameter("mass", 0.5, 2.0, targets=("body:ball.mass",)),
            Parameter("stiffness", 5.0, 40.0, targets=("joint:z.stiffness",)),
        ],
        6.0,
    ),
    "pusher": (
        '<body name="finger" pos="-.12 0 0"><joint name="finger" type="slide" axis="1 0 0" damping="3"/>'
        '<geom size=".05" mass=".4"/></body><body name="puck"><joint name="puck" type="slide" axis="1 0 0" '
        'damping="1"/><geom size=".05" mass=".5"/></body>',
        ["finger", "puck"],
        [
            Parameter("puck_mass", 0.2, 1.0, targets=("body:puck.mass",)),
            Parameter("finger_damping", 1.0, 6.0, targets=("joint:finger.damping",)),
        ],
        5.0,
    ),
}
POSITION, VELOCITY = 0.004, 0.04  # sds of the measurements
JUMPS = (0.001, 0.04)  # of the process noise: positions, velocities


def logged(name: str, seed: int, share: float = 1.0) -> tuple[sipe.Simulator, np.ndarray, sipe.Trajectory]:
    """The simulator, a truth and its log with process noise, of which ``share`` is left."""
    body, joints, unknown, size = MODELS[name]
    xml = (
        f'<mujoco><option timestep="0.01"/><worldbody>{body}</worldbody>'
        f'<actuator><motor name="push" joint="{joints[0]}"/></actuator></mujoco>'
    )
    channels = [f"joint:{j}.{what}" for what in ("position", "velocity") for j in joints]
    simulator = sipe.Simulator(sipe.MjcfEnvironment.build(xml, unknown, ["push"], channels), num_threads=1)
    rng = np.random.default_rng([seed, 11])
    theta, count = rng.uniform(0.2, 0.8, len(unknown)), len(joints)
    phase = rng.uniform(0, 2 * np.pi, 2)
    times = DT * np.arange(STEPS)
    actions = size * (0.6 * np.sin(7 * times + phase[0]) + 0.4 * np.sin(15 * times + phase[1]))[:, None]
    state, seen = simulator.default_state()[None], []
    jumps, noise = np.repeat(JUMPS, count), np.repeat((POSITION, VELOCITY), count)
    for action in actions:
        (piece,) = simulator.rollout(theta, action[None], state[0], dt=DT)
        assert piece.states is not None
        seen.append(piece.observations[0])
        state = moved(simulator.model, piece.states[1:2], (share * jumps * rng.standard_normal(2 * count))[None])
    (piece,) = simulator.rollout(theta, actions[-1:], state[0], dt=DT)
    observations = np.stack([*seen, piece.observations[0]])
    return (
        simulator,
        theta,
        sipe.Trajectory(observations + noise * rng.standard_normal(observations.shape), actions, DT),
    )


def one_row(name: str, seed: int) -> dict[str, Any]:
    """Both posteriors of one log."""
    from tests.problems.particle_judge import ChainModel, enough_particles, judge

    simulator, truth, log = logged(name, seed)
    estimator = sipe.get_estimator(simulator, "laplace", likelihood=sipe.StateSpace(), seed=seed)
    estimator.fit(log)
    assert estimator.state is not None
    optimum = max(estimator.state.search.optima, key=lambda one: one.evidence)
    assert isinstance(optimum, ChainOptimum)
    posterior = mixture([optimum.as_linearised], simulator.space)
    chain = estimator.bound(Trajectories.stack([log]))
    chain.budget = np.inf
    begin = time.process_time()
    model, rng = ChainModel(chain, optimum.noise), np.random.default_rng(seed)
    particles = enough_particles(model, optimum.theta, rng)
    result = judge(model, len(truth), THETAS, particles, rng, TIMES, MOST)
    draws = np.unique(result.theta, axis=0)  # a repeated draw gives itself away
    mean, sd = posterior.mean.numpy(), posterior.stddev.numpy()
    generator = torch.Generator().manual_seed(1000 + seed)  # other draws than c2st's own
    row = {
        "model": name,
        "seed": seed,
        "c2st": c2st(posterior, draws),
        "c2st_same": c2st(posterior, posterior.sample((len(draws),), generator).numpy()),
        "mean_off": ((mean - draws.mean(0)) / draws.std(0)).round(3).tolist(),
        "sd_ratio": (sd / draws.std(0)).round(3).tolist(),
        "z": ((mean - truth) / sd).round(2).tolist(),
        "judge_z": ((draws.mean(0) - truth) / draws.std(0)).round(2).tolist(),
        "particles": particles,
        "draws": len(draws),
        "moved": result.moved,
        "accepted": round(result.accepted, 3),
        "blocking": [str(f.code) for f in estimator.findings.blocking],
        "pareto_k": estimator.diagnostics["pareto_k"],
        "processor_seconds_of_the_judge": round(time.process_time() - begin, 1),
    }
    return row | (exact_row(posterior, draws, chain, optimum) if name == "spring" else {})


def exact_row(posterior: Posterior, draws: np.ndarray, chain: Chain, optimum: ChainOptimum) -> dict[str, float]:
    """C2ST of both against draws of a grid of Kalman filters."""
    grid = np.linspace(0, 1, 2001)
    value = np.array([kalman(5.0 + 20.0 * t, chain, optimum.sd, optimum.process) for t in grid])
    weight = np.exp(value - value.max())
    rng = np.random.default_rng(0)
    exact = rng.choice(grid, len(draws), p=weight / weight.sum()) + rng.uniform(-2.5e-4, 2.5e-4, len(draws))
    exact = np.clip(exact, 0, 1)[:, None]
    return {"c2st_exact": c2st(posterior, exact), "judge_exact": c2st(Particles(draws, space=posterior.space), exact)}


def kalman(stiffness: float, chain: Chain, sd: np.ndarray, process: np.ndarray) -> float:
    """Log p(log | stiffness) of the spring, position and velocity measured, by a plain Kalman filter."""
    from tests.problems.springs import spring_step

    transition, push = spring_step(stiffness)
    mean, covariance, total = chain.reference[0, 1:3], np.diag(1 / chain.prior_precision[0]), 0.0
    for k, seen in enumerate(chain.measured):
        variance = covariance + np.diag(sd**2)
        gap, gain = seen - mean, np.linalg.solve(variance, covariance).T
        total -= 0.5 * (np.linalg.slogdet(variance)[1] + gap @ np.linalg.solve(variance, gap))
        mean, covariance = mean + gain @ gap, covariance - gain @ covariance
        mean = transition @ mean + push * chain.actions[k, 0, 0]
        covariance = transition @ covariance @ transition.T + np.diag(process**2)
    return total


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Of one model."""
    values = np.array([r["c2st"] for r in rows])
    out = {
        "logs": len(rows),
        "fewest_draws": min(r["draws"] for r in rows),
        "particles": sorted({r["particles"] for r in rows}),
        "c2st": round(float(values.mean()), 3),
        "standard_error": round(float(values.std(ddof=1) / np.sqrt(len(rows))), 3) if len(rows) > 1 else None,
        "worst": round(float(values.max()), 3),
        "largest_mean_off": float(max(np.abs(r["mean_off"]).max() for r in rows)),
        "sd_ratio": [float(f([x for r in rows for x in r["sd_ratio"]]).round(3)) for f in (np.min, np.median, np.max)],
        "fits_with_blocking": sum(bool(r["blocking"]) for r in rows),
        "processor_seconds_of_the_judge": float(np.median([r["processor_seconds_of_the_judge"] for r in rows])),
    }
    if "judge_exact" in rows[0]:
        out["exact"] = {k: round(float(np.mean([r[k] for r in rows])), 3) for k in ("c2st_exact", "judge_exact")}
    return out


def main() -> None:
    names = list(MODELS)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--select", nargs="*", default=names, choices=names)
    parser.add_argument("--seeds", type=int, nargs=2, metavar=("FIRST", "END"), default=[0, 4])
    given = parser.parse_args()
    file = RUNS / "rows.jsonl"
    for seed in range(*given.seeds):
        for name in given.select:
            ensure(file, {"model": name, "seed": seed}, partial(one_row, name, seed))
    rows = fits(file)
    table = {
        "command": "python examples/studies/particles.py --seeds 0 N, for the logs of each model",
        "thetas": THETAS,
        "moves": TIMES,
        "versions": {p: version(p) for p in ("mujoco", "numpy", "sbi")},
        "models": {name: summary(mine) for name in names if (mine := [r for r in rows if r["model"] == name])},
    }
    write_text(HERE / "results" / "particles.json", json.dumps(table, indent=2) + "\n")


if __name__ == "__main__":
    main()
