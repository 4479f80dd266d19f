"""How far the GPU's float32 and the processor's float64 agree, on every task of the registry and through estimators.

`task`: random theta, commands and starts; the error (median and largest of the rollouts) in what a channel varies by
after 1, 10 and 50 control steps, and for how many steps the two agree to 1 % of that. The humanoid has Newton's solver
in place of PGS, on both sides. `target`: an arm of MJCF over a floor with a box, on which one target after the other
goes from its lower bound to its upper one: the largest error over 12 steps of 4 ms, and how far the target moves what
is observed, on both, in the same unit. `fit`: npe on Pendulum and cem on HalfCheetahLinks with either engine, over
several seeds, whose spread is the Monte Carlo error.

    python examples/studies/gpu_agreement.py task            # Warp's processor device; compiling takes 1 minute a task
    python examples/studies/gpu_agreement.py target
    python examples/studies/gpu_agreement.py fit
    python examples/studies/gpu_agreement.py task --device cuda

Results are kept for each device and row, and an interrupted study goes on.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import sipe_bayes as sipe
from sipe_bayes.core.files import write_text
from sipe_bayes.envs.registry import TASKS
from sipe_bayes.simulation.audit import spread

HERE = Path(__file__).parent
STEPS, KEPT = 50, (1, 10, 50)
FITS = {
    "npe Pendulum": ("Pendulum", "npe", {"budget": 1000}),
    "cem HalfCheetahLinks": ("HalfCheetahLinks", "cem", {"budget": 400}),
}


ARM = """<mujoco><option timestep="0.004" integrator="implicitfast" cone="elliptic"/><worldbody>
 <geom name="floor" type="plane" size="3 3 .1"/>
 <body name="upper" pos="0 0 .6"><joint name="shoulder" axis="0 1 0" damping="0.1" range="-1 1" limited="true"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass=".5"/>
  <body name="lower" pos=".3 0 0"><joint name="elbow" axis="0 1 0"/>
   <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass=".3"/></body></body>
 <body name="box" pos=".3 0 .1"><freejoint/><geom name="box" type="box" size=".1 .1 .1" mass=".4"/></body></worldbody>
 <actuator><motor name="motor" joint="shoulder"/><position name="servo" joint="elbow" kp="5" kv=".2"/>
  <dcmotor name="drive" joint="shoulder" resistance="2" motorconst=".3"/></actuator>
 <sensor><framelinvel name="box" objtype="body" objname="box"/></sensor></mujoco>"""
SEEN = (*(f"joint:{j}.{q}" for j in ("shoulder", "elbow") for q in ("position", "velocity")), "sensor:box[0]")
TARGETS = {
    **{f"joint:{j}.{a}": (0.0, 0.3) for j in ("shoulder", "elbow") for a in ("damping", "frictionloss", "armature")},
    **{f"joint:elbow.{a}": (0.0, 0.3) for a in ("damping_quadratic", "damping_cubic")},
    **{f"joint:shoulder.{a}": (0.0, 5.0) for a in ("stiffness", "stiffness_quadratic", "stiffness_cubic")},
    "body:upper.mass": (0.2, 1.0),
    "body:lower.com_x": (0.1, 0.2),
    "body:lower.inertia_yy": (0.0029, 0.00305),
    "actuator:motor.gear": (0.5, 2.0),
    "actuator:motor.delay": (0.0, 0.03),
    "actuator:motor.force_limit": (0.2, 2.0),
    "actuator:motor.command_limit": (0.2, 2.0),
    "actuator:motor.offset": (-0.5, 0.5),
    "actuator:servo.kp": (1.0, 8.0),
    "actuator:servo.kv": (0.0, 0.5),
    "actuator:drive.resistance": (1.0, 4.0),
    "actuator:drive.motor_constant": (0.1, 0.5),
    "geom:box.friction": (0.05, 1.2),
    "geom:box.solref_timeconst": (0.01, 0.05),
    "geom:box.solimp_dmax": (0.9, 0.99),
    "option.gravity_x": (-2.0, 2.0),
    "option.density": (0.0, 200.0),
    "option.viscosity": (0.0, 1.0),
    "option.impratio": (1.0, 20.0),
}


def target(spec: str, device: str, batch: int) -> dict[str, Any]:
    name = spec.replace(":", "_").replace(".", "_")
    unknown = sipe.Parameter(name, *TARGETS[spec], targets=(spec,))
    environment = sipe.MjcfEnvironment.build(ARM, [unknown], ("motor", "servo", "drive"), SEEN)
    try:
        simulator = sipe.Simulator(environment, 1, device)
    except ValueError as error:
        return {"refused": str(error)}
    rng, model = np.random.default_rng(0), simulator.model
    start = simulator.default_state()
    start[1 + model.nq : 1 + model.nq + model.nv] = rng.normal(0, 0.5, model.nv)
    start[1 + model.nq + 2 : 1 + model.nq + 5] = 1.0, 0.0, 0.0  # the box slides
    theta, actions = np.linspace(0, 1, 5)[:, None], rng.normal(0, 1, (1, 12, 3))
    single, double = (s.rollout(theta, actions, start) for s in (simulator, simulator.on_processor))
    unit = spread(double.observations, double.valid)
    return {
        "error": float((np.abs(single.observations - double.observations) / unit).max()),
        "moves": [float((np.ptp(run.observations, axis=0) / unit).max()) for run in (single, double)],
        "valid": bool(single.valid.all() and double.valid.all()),
    }


def newton(task: Any) -> Any:
    """A task whose model is solved by Newton's method."""
    kind = type(task)

    def compiled(self: Any) -> mujoco.MjModel:
        model = kind.compile(self)
        model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
        return model

    made = type(f"Newton{kind.__name__}", (kind,), {"compile": compiled})
    return made(**{f.name: getattr(task, f.name) for f in fields(task)})


def agreement(name: str, device: str, batch: int) -> dict[str, Any]:
    task = sipe.make_task(name)
    task = newton(task) if name.startswith("Humanoid") else task
    try:
        simulator = sipe.Simulator(task, 1, device=device)
    except ValueError as error:
        return {"refused": str(error)}
    rng = np.random.default_rng(0)
    theta = rng.random((batch, len(task.space)))
    actions = rng.uniform(task.action_low, task.action_high, (batch, STEPS, task.num_actions))
    starts, goals = task.initial_states(rng, batch)
    single = simulator.rollout(theta, actions, starts, goals=goals)
    again = simulator.rollout(theta, actions, starts, goals=goals)
    double = simulator.on_processor.rollout(theta, actions, starts, goals=goals)
    error = (np.abs(single.observations - double.observations) / spread(double.observations, double.valid)).max(2)
    apart = ~(error <= 0.01)
    agreed = np.where(apart.any(1), apart.argmax(1) - 1, STEPS)
    return {
        "rollouts": batch,
        "error": {str(k): [float(np.median(error[:, k])), float(error[:, k].max())] for k in KEPT},
        "agreed_steps": {"least": int(agreed.min()), "median": float(np.median(agreed)), "of": STEPS},
        "step_s": simulator.dt,
        "valid": [int(run.valid[:, -1].sum()) for run in (single, double)],
        "same_twice": bool(np.array_equal(single.observations, again.observations, equal_nan=True)),
    }


def fitted(name: str, device: str, seeds: int) -> dict[str, Any]:
    task, method, settings = FITS[name]
    engines = {"cpu": sipe.Simulator(sipe.make_task(task), 1), device: sipe.Simulator(sipe.make_task(task), 1, device)}
    log = sipe.demonstrations(engines["cpu"], count=1, steps=30, seed=0)
    means: dict[str, list[list[float]]] = {engine: [] for engine in engines}
    sds: dict[str, list[list[float]]] = {engine: [] for engine in engines}
    texts: list[str] = []
    for engine, simulator in engines.items():
        for seed in range(seeds):
            estimator = sipe.get_estimator(simulator, method, seed=seed, **settings)
            posterior = estimator.fit(log)
            means[engine].append(posterior.mean.tolist())
            sds[engine].append(posterior.stddev.tolist())
            texts += [f.text for f in estimator.findings if "float" in f.code.name.lower()]
    one, two = (np.array(m) for m in means.values())
    error = np.sqrt((one.var(0, ddof=1) + two.var(0, ddof=1)) / seeds)
    return {
        "seeds": seeds,
        "mean": {engine: np.mean(m, 0).tolist() for engine, m in means.items()},
        "sd": {engine: np.mean(s, 0).tolist() for engine, s in sds.items()},
        "difference_in_standard_errors": (np.abs(one.mean(0) - two.mean(0)) / np.maximum(error, 1e-12)).tolist(),
        "difference_of_one_seed": float(np.abs(one - two).max()),
        "findings": sorted(set(texts)),
    }


ROWS = {"task": (TASKS, agreement, "batch"), "target": (TARGETS, target, "batch"), "fit": (FITS, fitted, "seeds")}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", nargs="*", metavar=f"[{' | '.join(ROWS)}]", help="default all")
    parser.add_argument("--device", default="warp:cpu")
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--only", nargs="*", default=None)
    given = parser.parse_args()
    path = HERE / "results" / "gpu_agreement.json"
    kept = json.loads(path.read_text()) if path.exists() else {}
    here = kept.setdefault(given.device, {"versions": {p: version(p) for p in ("mujoco", "mujoco-warp", "warp-lang")}})
    for what in given.what or ROWS:
        if what not in ROWS:
            parser.error(f"{what}: expected some of {', '.join(ROWS)}")
        rows = here.setdefault(what, {})
        names, row, size = ROWS[what]
        for name in given.only or names:
            if name in rows:
                continue
            rows[name] = row(name, given.device, vars(given)[size])
            print(name, json.dumps(rows[name]), flush=True)
            write_text(path, json.dumps(kept, indent=1) + "\n")


if __name__ == "__main__":
    main()
