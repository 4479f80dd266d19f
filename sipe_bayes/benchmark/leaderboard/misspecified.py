"""Three machines that have what their model lacks: friction under load, a delay, backlash.

A double pendulum with a motor at each joint (masses of the rods and damping of the joints unknown); the model that a
method is given is without the effect, which takes a tenth of the joint's usual force, two samples, or 3 % of what the
joint moves. Five logs of 5 s at 100 Hz, each of a machine of its own, with a second log of it held out; .5 % noise.
The intervals are to hold the truth all the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from sipe_bayes.benchmark.leaderboard.task import FROM_START, Case, Kind, Problem, Task, known_start
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood import BoundLikelihood
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.extension import extended, members, placements
from sipe_bayes.structure.machine import Machine, machine_of
from sipe_bayes.structure.registry import get_extension

_DT, _STEPS, _LOGS, _NOISE, _BUDGET = 0.01, 500, 5, 0.005, 1000
_ROD = """<body name="{body}" pos="0 0 {z}"><joint name="{joint}" axis="0 1 0" damping="0.05" armature="0.005"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.6" contype="0" conaffinity="0"/>{below}</body>"""
_XML = """<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>{rods}</worldbody>
<actuator><motor name="drive1" joint="shoulder"/><motor name="drive2" joint="elbow"/></actuator></mujoco>"""
_BODIES, _JOINTS, _TORQUES = ("upper", "lower"), ("shoulder", "elbow"), (2.0, 0.8)


@dataclass(frozen=True)
class _Planted:
    """What the machine has: the extension, and how large it is."""

    extension: str
    about: str
    share: float


_ALL = {
    "lacks_load_friction": _Planted("load_friction", "friction of a tenth of the torque", 0.1),
    "lacks_delay": _Planted("delay", "a delay of two samples", 2 * _DT),
    "lacks_backlash": _Planted("gear_backlash", "backlash of 3 % of what a joint moves", 0.03),
}


def tasks() -> list[Task]:
    """The three."""
    return [
        Task(
            name,
            Kind.WRONG,
            f"double pendulum, the model lacks {p.about}",
            _BUDGET,
            partial(_problem, name),
            heldout=True,
        )
        for name, p in _ALL.items()
    ]


def _plain() -> Simulator:
    rods = ""
    for k in (1, 0):
        rods = _ROD.format(body=_BODIES[k], joint=_JOINTS[k], z=-0.4 * k, below=rods)
    masses = [Parameter(f"{b}_mass", 0.3, 1.5, targets=(f"body:{b}.mass",)) for b in _BODIES]
    dampings = [Parameter(f"{j}_damping", 0.0, 0.3, targets=(f"joint:{j}.damping",)) for j in _JOINTS]
    channels = [f"joint:{j}.position" for j in _JOINTS]
    environment = MjcfEnvironment.build(_XML.format(rods=rods), [*masses, *dampings], ["drive1", "drive2"], channels)
    return Simulator(environment, num_threads=1)


def _problem(name: str) -> Problem:
    simulator = _plain()
    return Problem(simulator, FROM_START, tuple(_case(simulator, name, k) for k in range(_LOGS)))


def _commands(rng: np.random.Generator) -> FloatArray:
    """Torques (T, 2): sums of five sines of .2 to 2 Hz."""
    clock = np.arange(_STEPS)[:, None, None] * _DT
    tones = np.sin(2 * np.pi * rng.uniform(0.2, 2.0, (2, 5)) * clock + rng.uniform(0, 2 * np.pi, (2, 5)))
    return np.asarray(1.6 * np.array(_TORQUES) * tones.mean(-1))


def _case(simulator: Simulator, name: str, number: int) -> Case:
    rng = np.random.default_rng([5, list(_ALL).index(name), number])
    truth = rng.uniform(0.2, 0.8, len(simulator.space))
    commands = [_commands(rng) for _ in range(2)]
    start = simulator.default_state()
    quiet = simulator.rollout(truth, commands[0], start, _DT)
    seen = Trajectories.stack(Trajectory(quiet.observations[0], commands[0], _DT, channels=quiet.channels))
    windows = BoundLikelihood(FROM_START.__class__(), simulator, seen)
    machine = machine_of(windows, truth, windows.no_starts())
    engine, theta = _with_effect(simulator, machine, _ALL[name], truth, number)
    clean = [engine.rollout(theta, command, engine.default_state(), _DT).observations[0] for command in commands]
    sd = _NOISE * np.sqrt(np.mean([(x**2).mean(0) for x in clean], axis=0))
    states = np.tile(start, (_STEPS + 1, 1))
    given, held = (
        known_start(
            Trajectories.stack(
                Trajectory(x + sd * rng.standard_normal(x.shape), command, _DT, states, label, quiet.channels)
            )
        )
        for x, command, label in zip(clean, commands, (f"log {number}", f"held out {number}"), strict=True)
    )
    return Case(f"log {number}", given, truth, heldout=held)


def _with_effect(
    simulator: Simulator, machine: Machine, planted: _Planted, truth: FloatArray, number: int
) -> tuple[Simulator, FloatArray]:
    """The machine with the effect at one of its joints, and its theta."""
    assert isinstance(simulator.environment, MjcfEnvironment)
    choices = [p for p in placements(get_extension(planted.extension), machine) if len(members(p.site)) == 1]
    placed = choices[number % len(choices)]
    values = [planted.share, *(float(p.value(0.5)) for p in placed.parameters[1:])]
    if planted.extension == "gear_backlash":
        values[0] *= min(machine.joints[placed.site].position, 1.0)
    own = [float(p.normalise(v)) for p, v in zip(placed.parameters, values, strict=True)]
    engine = Simulator(extended(simulator.environment, [placed]), num_threads=1)
    return engine, np.concatenate([truth, own])
