"""How long a search over structures takes: table of `bench.py discover`.

The real pendulum as its example has it, and three made-up logs of 10 s at 500 Hz of a double pendulum with a motor at
each joint, mass and damping of both rods unknown, friction that grows with the load at the elbow left out.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from sipe_bayes.calibration.problem import Problem
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood import Segments
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure import Structures, discover

ROD = """<body name="{n}" pos="0 0 {z}"><joint name="{j}" axis="0 1 0" damping="0.05" armature="0.005"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.6" contype="0" conaffinity="0"/>{rest}</body>"""
DOUBLE = (
    '<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>'
    + ROD.format(n="upper", z=0, j="shoulder", rest=ROD.format(n="lower", z=-0.4, j="elbow", rest=""))
    + '</worldbody><actuator><motor name="drive1" joint="shoulder"/><motor name="drive2" joint="elbow"/></actuator>'
    "</mujoco>"
)
LOGS, STEPS, DT = 3, 5000, 0.002


def double(*extra: Parameter) -> Simulator:
    """The double pendulum."""
    unknown = [
        Parameter(f"{what}_{name}", low, high, targets=(target,))
        for body, joint in (("upper", "shoulder"), ("lower", "elbow"))
        for what, name, low, high, target in (
            ("mass", body, 0.3, 1.5, f"body:{body}.mass"),
            ("damping", joint, 0.0, 0.3, f"joint:{joint}.damping"),
        )
    ]
    channels = ["joint:shoulder.position", "joint:elbow.position"]
    return Simulator(MjcfEnvironment.build(DOUBLE, [*unknown, *extra], ["drive1", "drive2"], channels))


def logs() -> Trajectories:
    """Three of them, with load friction of 10 % at the elbow."""
    simulator = double(Parameter("share", 0.0, 0.5, targets=("joint:elbow.load_friction",)))
    values, clock, recorded = np.array([0.6, 0.05, 0.7, 0.06, 0.1]), np.arange(STEPS) * DT, []
    for k in range(LOGS):
        rng = np.random.default_rng(k)
        tones = np.sin(2 * np.pi * rng.uniform(0.2, 1.5, (2, 5, 1)) * clock + rng.uniform(0, 2 * np.pi, (2, 5, 1)))
        actions = (np.array([[3.0], [1.2]]) * tones.mean(1)).T
        motion = simulator.rollout(simulator.space.normalise(values), actions, simulator.default_state(), dt=DT)
        noisy = motion.observations[0] + rng.normal(0, 0.002, motion.observations[0].shape)
        recorded.append(Trajectory(noisy, actions, DT, name=f"log{k}", channels=simulator.environment.channels))
    return Trajectories.stack(recorded)


def table(pendulum: Problem) -> None:
    """Seconds, rollouts and what is found; a single run each."""
    print("\nSearches over structures, all cores, one run each")
    print(f"{'machine':<44}{'s':>6}{'rollouts':>10}  found")
    made_up = logs()
    real = pendulum.simulator, pendulum.train
    _row(
        "real pendulum (bar 180 s)",
        lambda: discover(*real, holdout=pendulum.holdout, prior=pendulum.prior, likelihood=pendulum.segments),
    )
    _row("two joints, 3 logs of 10 s at 500 Hz (900 s)", lambda: discover(double(), made_up, likelihood=Segments(1.0)))


def _row(name: str, search: Callable[[], Structures]) -> None:
    begin = time.monotonic()
    structures = search()
    labels = ", ".join(structures.best.labels) or "nothing"
    print(f"{name:<44}{time.monotonic() - begin:>6.0f}{structures.rollouts:>10}  {labels}", flush=True)
