"""Do intervals hold what a machine has, though a simulator takes steps and a machine none?

Five machines: a servo at its limit that follows jumps, with dry friction and a delay; and, which nothing was tuned on,
those of ``late_sensors.py`` without their late sensors. Their models take steps of 2 ms, or of 5 ms; their logs are
those of simulations in steps of 0.2 ms, or, for comparison, in the model's own steps. Values are uniform in the middle
70 % of their ranges, delays in all of theirs; 5 s at 50 Hz from rest (the servo: 3 s at 100 Hz).

    python examples/studies/physics_steps.py      # half an hour of a core; --logs 4 for a look

Coverage is that of 90 % intervals, pooled over parameters: plain ones of ``laplace``, and those with what the model
lacks or may lack, which `sipe calibrate` shows first. z is the error in sds of the plain one, a silent miss a fit
with one beyond five and no blocking finding; ``wider`` the median ratio of their widths, ``alarm`` in how many logs the
residuals are no noise, ``named`` in how many of those the physics step is named. Results: results/physics_steps.json
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path

import mujoco
import numpy as np
from late_sensors import MACHINES, MODELS, Machine

import sipe_bayes as sipe
from sipe_bayes.benchmark.measurement import source
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.files import write_text
from sipe_bayes.core.findings import Severity
from sipe_bayes.core.parameters import Parameter
from sipe_bayes.diagnostics.misfit import misfit
from sipe_bayes.envs.channels import Channel
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.laplace import Laplace
from sipe_bayes.likelihood import Noise, QuadraticPrior, bind
from sipe_bayes.structure.augmented import AugmentedModel
from sipe_bayes.structure.discrepancy import find_discrepancy
from sipe_bayes.structure.extension import WORLD
from sipe_bayes.structure.registry import get_extension
from sipe_bayes.structure.tolerances import Tolerances

RESULTS = Path(__file__).parent / "results" / "physics_steps.json"
FINE, STEPS = 2e-4, (0.002, 0.005)  # seconds
SERVO = Machine(
    {"joint:knee.position": 0.002},
    (),
    {"servo": 0.6},
    (
        ("kp", 8.0, 40.0, ("actuator:servo.kp",)),
        ("friction", 0.0, 0.3, ("joint:knee.frictionloss",)),
        ("damping", 0.0, 0.1, ("joint:knee.damping",)),
        ("delay", 0.0, 0.06, ("actuator:servo.delay",)),
    ),
)
ALL = {"servo": SERVO, **MACHINES}


@dataclass(frozen=True)
class Seen:
    """What one log showed.

    Args:
        z: (N,) errors in sds of the plain posterior.
        plain: (N,) whether its intervals hold.
        further: (N,) whether those with what the model lacks do.
        wider: (N,) their widths over the plain ones'.
        alarm: whether the residuals are no noise.
        named: whether the physics step is named then.
        blocked: whether a finding of the fit blocks.
    """

    z: FloatArray
    plain: FloatArray
    further: FloatArray
    wider: FloatArray
    alarm: bool
    named: bool
    blocked: bool


def _timestep(spec: mujoco.MjSpec, seconds: float) -> None:
    spec.option.timestep = seconds


def simulator_of(name: str, timestep: float) -> sipe.Simulator:
    """The machine in steps of so many seconds."""
    machine = ALL[name]
    unknown = [Parameter(name, low, high, targets=targets) for name, low, high, targets in machine.unknown]
    channels, path = [Channel(target, target) for target in machine.channels], str(MODELS / f"{name}.xml")
    edits = [partial(_timestep, seconds=timestep)]
    return sipe.Simulator(MjcfEnvironment.build(path, unknown, list(machine.amplitudes), channels, edits), 1)


def commands(name: str, rng: np.random.Generator) -> tuple[FloatArray, float]:
    """(T, A), and seconds from one to the next: jumps of the servo, else sums of sines."""
    amplitudes = np.array(list(ALL[name].amplitudes.values()))
    if name == "servo":
        times = 0.01 * np.arange(300)
        jumps = np.sign(np.sin(2 * np.pi * 0.7 * times))[:, None]
        return rng.uniform(0.5, 1.5) * amplitudes * jumps, 0.01
    frequency, phase = rng.uniform(0.2, 2.0, (4, len(amplitudes))), rng.uniform(0, 2 * np.pi, (4, 1))
    return np.sin(2 * np.pi * frequency * 0.02 * np.arange(250)[:, None, None] + phase).mean(1) * amplitudes, 0.02


def one_log(name: str, timestep: float, of_machine: float, seed: int) -> Seen:
    """A log in steps ``of_machine`` seconds long, fitted by a model in others."""
    rng, simulator, truthful = np.random.default_rng([seed, 11]), simulator_of(name, timestep), simulator_of(name, FINE)
    theta = rng.uniform(0.15, 0.85, len(simulator.space))
    if name == "servo":
        theta[-1] = rng.uniform()
    actions, dt = commands(name, rng)
    many = round(dt / of_machine)
    fine = (truthful if of_machine == FINE else simulator).rollout(
        theta, np.repeat(actions, many, axis=0), simulator_of(name, of_machine).default_state(), dt=of_machine
    )
    sd = [
        next(sd for target, sd in ALL[name].channels.items() if channel.startswith(target))
        for channel in simulator.environment.channels
    ]
    clean = fine[0].observations[::many]
    log = sipe.Trajectory(clean + rng.standard_normal(clean.shape) * sd, actions, dt)
    method = Laplace(simulator, likelihood=sipe.Segments(), seed=seed)
    posterior = method.fit(log)
    logs = sipe.Trajectories.stack([log])
    windows, here = bind(method.likelihood, simulator, logs), posterior.mode.numpy()
    noise = Noise(*(np.array(method.diagnostics[key]) for key in ("noise_sd", "noise_tau")))
    own = QuadraticPrior.of(method.prior)
    logs_there = AugmentedModel(windows, here, noise, method.result.starts_at(here), own)
    found = find_discrepancy(logs_there, Tolerances(physics_step=1.0))
    looks, further = misfit(found, posterior.stddev.numpy(), seed), found.draw(posterior, seed)
    ends = [np.asarray(one.quantile([0.05, 0.95]).numpy()) for one in (posterior, further)]
    held = [(low <= theta) & (theta <= high) for low, high in ends]
    widths = [high - low for low, high in ends]
    z = (posterior.mean.numpy() - theta) / posterior.stddev.numpy()
    named = looks.alarm and get_extension("physics_step").sentence(WORLD) in looks.cause
    blocked = any(item.severity is Severity.BLOCKING for item in method.findings)
    return Seen(z, held[0], held[1], widths[1] / widths[0], looks.alarm, named, blocked)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machines", nargs="+", default=list(ALL), choices=list(ALL))
    parser.add_argument("--logs", type=int, default=15)
    given = parser.parse_args()
    cells = {}
    for name in given.machines:
        for timestep in STEPS:
            for of_machine in (FINE, timestep):
                seen = [one_log(name, timestep, of_machine, seed) for seed in range(500, 500 + given.logs)]
                label = f"{name}, steps of {1e3 * timestep:g} ms, log in steps of {1e3 * of_machine:g} ms"
                cells[label] = cell = {
                    "logs": given.logs,
                    "plain": round(float(np.mean([one.plain for one in seen])), 3),
                    "with_what_is_lacking": round(float(np.mean([one.further for one in seen])), 3),
                    "wider": round(float(np.median([one.wider for one in seen])), 2),
                    "rms_z": np.sqrt(np.mean([one.z**2 for one in seen], axis=0)).round(1).tolist(),
                    "silent_misses": sum(bool((np.abs(one.z) > 5).any()) and not one.blocked for one in seen),
                    "blocked": sum(one.blocked for one in seen),
                    "alarm": sum(one.alarm for one in seen),
                    "named": sum(one.named for one in seen),
                }
                print(label, json.dumps(cell), flush=True)
    machines = "" if given.machines == list(ALL) else f" --machines {' '.join(given.machines)}"
    table = {
        "command": f"python examples/studies/physics_steps.py{machines}" + f" --logs {given.logs}" * (given.logs != 15),
        "source": source(),
        "versions": {p: version(p) for p in ("mujoco", "numpy", "scipy")},
        "cells": cells,
    }
    write_text(RESULTS, json.dumps(table, indent=2) + "\n")


if __name__ == "__main__":
    main()
