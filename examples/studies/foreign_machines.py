"""Two machines that MuJoCo did not simulate: do the wider intervals hold what was weighed, before and after discover?

Both are integrated here in steps of 0.1 ms, with physics that their models lack, and logged as machines are; masses,
frictions and motor constants are drawn anew for each seed, up to a fifth off what the drawing says.

- axis: a belt that a motor with a gear pulls. Dry friction of its own in each direction, more of it at rest (Stribeck),
  a cable that pulls, an amplifier with an offset, counts of an encoder that come two samples late, a rotor a tenth off.
  Four logs of ten seconds at 500 Hz; in one 3 kg were bolted on, which is what ``added`` says; two held out.
- crane: a cart on a rail, and a pendulum below it. A drive with a dead zone and back-EMF, wheels whose friction
  grows with their load and is another one backwards, a rail half a degree off level, a pivot with dry friction and a
  drag that grows with the square, commands 8 ms late, an encoder with a zero error. Four logs of 16 s at 100 Hz, two
  held out. The bob was weighed.

    python examples/studies/foreign_machines.py --seeds 0 1                  # a quarter of an hour for each and more
    python examples/studies/foreign_machines.py --seeds 1 3 --no-discover    # four minutes for each machine and seed

Fits are kept one by one in runs/foreign_machines.jsonl. Results: results/foreign_machines.json
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from _kept import ensure, fits

import sipe_bayes as sipe
from sipe_bayes.benchmark.measurement import source
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.files import write_text

RESULTS = Path(__file__).parent / "results" / "foreign_machines.json"
KEPT = Path(__file__).parent / "runs" / "foreign_machines.jsonl"
STEP = 1e-4
GRAVITY = 9.81
AXIS = """<mujoco><option timestep="0.001" integrator="implicitfast"/><worldbody><body name="carriage">
<joint name="axis" type="slide" axis="1 0 0" damping="20" frictionloss="10" armature="1.9"/>
<geom type="box" size=".08 .06 .03" mass="4"/></body></worldbody>
<actuator><motor name="motor" joint="axis" gear="16"/></actuator></mujoco>"""
CRANE = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body name="cart">
<joint name="rail" type="slide" axis="1 0 0" damping="1" frictionloss=".5"/>
<geom type="box" size=".1 .06 .04" mass="2"/>
<body name="pendulum"><joint name="pivot" axis="0 -1 0" damping=".001"/>
<geom type="capsule" fromto="0 0 0 0 0 -.6" size=".006" mass=".21"/>
<body name="bob" pos="0 0 -.6"><geom type="sphere" size=".03" mass="{bob}"/></body></body></body></worldbody>
<actuator><motor name="drive" joint="rail"/></actuator></mujoco>"""
HEAD = """model = "model.xml"
window = {window}
[columns]
time = {{column = "t", unit = "s"}}
[[commands]]
actuator = "{actuator}"
column = "u"
unit = "1"
"""


def drawn(rng: np.random.Generator, value: float, share: float = 0.2) -> float:
    return value * float(rng.uniform(1 - share, 1 + share))


def held(force: float, speed: float, friction: float, mass: float) -> float:
    """The speed a step later of a mass under a force and dry friction."""
    free = speed + STEP * force / mass
    most = STEP * friction / mass
    return free - max(-most, min(most, free))


def axis(seed: int, folder: Path) -> tuple[str, dict[str, float]]:
    """Logs of an axis, its configuration and what is true."""
    rng = np.random.default_rng(seed)
    mass, rotor, gain = drawn(rng, 4.0), drawn(rng, 1.9, 0.1), drawn(rng, 16.0)
    viscous, forward, backward = drawn(rng, 30.0), drawn(rng, 13.0), drawn(rng, 11.0)
    cable, offset = drawn(rng, 6.0), 0.06
    count = 0.1 / (3 * 4096)

    def flown(wanted: Callable[[float], float], seconds: float, load: float) -> FloatArray:
        x, v, current, total, rows = wanted(0.0), 0.0, 0.0, 0.0, []
        seen = [round(x / count) * count] * 4
        for k in range(round(seconds * 500)):
            t = k / 500
            seen.append(round(x / count) * count)
            error, rate = wanted(t) - seen[-1], (wanted(t + 1e-3) - wanted(t - 1e-3)) / 2e-3
            total = max(-2.0, min(2.0, total + error * 1.8))
            command = max(-8.0, min(8.0, 120 * error + 3.2 * (rate - (seen[-1] - seen[-2]) * 500) + total))
            rows.append((t, seen[-3], command + float(rng.normal(0, 0.02))))
            for _ in range(20):
                current += STEP / 8e-4 * (command - offset - current)
                dry = (forward if v > 0 else backward) * (1 + 0.45 * math.exp(-((v / 0.02) ** 2)))
                force = gain * current - viscous * v - cable * (x - 0.55)
                v = held(force, v, dry, mass + rotor + load)
                x += STEP * v
        return np.array(rows)

    def waves(start: float) -> Callable[[float], float]:
        phase, speed = rng.uniform(0, 6, 3), rng.uniform(0.85, 1.15, 3) * [0.4, 1.2, 2.9]
        sizes = np.array([0.1, 0.035, 0.012])

        def wanted(t: float) -> float:
            grown = min(max(t / 0.8, 0.0), 1.0) ** 2
            return 0.27 + grown * float(sizes @ np.sin(2 * np.pi * speed * t + phase)) + start

        return wanted

    logs = {"one": 0.0, "two": 0.0, "three": 0.0, "loaded": 3.0, "held_one": 0.0, "held_two": 0.0}
    tables = {name: (flown(waves(0.02 * k), 10.0, load), load) for k, (name, load) in enumerate(logs.items())}
    config = HEAD.format(window=0.3, actuator="motor") + written(folder, AXIS, tables, ["x"], "body:carriage.mass")
    config += measured("x", "joint:axis.position", "m")
    config += asked("delay", "actuator:motor.delay", 0.0, 0.02) + asked("carriage_mass", "body:carriage.mass", 1, 12)
    config += asked("motor_gain", "actuator:motor.gain", 0.3, 3.0)
    config += asked("damping", "joint:axis.damping", 0, 80) + asked("friction", "joint:axis.frictionloss", 0, 54)
    truth = {"carriage_mass": mass, "motor_gain": gain / 16, "damping": viscous, "friction": (forward + backward) / 2}
    return config, truth


def crane(seed: int, folder: Path) -> tuple[str, dict[str, float]]:
    """Logs of a crane, its configuration and what is true; the cart's mass is with the drum's inertia."""
    rng = np.random.default_rng(seed)
    cart, bob, gain, dead = drawn(rng, 2.4), drawn(rng, 0.5), drawn(rng, 0.95, 0.1), drawn(rng, 0.6)
    emf, load, tilt, pivot = drawn(rng, 4.0), drawn(rng, 0.022), math.radians(0.5), 0.004
    whole, moment = 0.21 + bob, 0.21 * 0.3 + bob * 0.6
    inertia, along, down = 0.21 * 0.12 + bob * 0.36, GRAVITY * math.sin(tilt), GRAVITY * math.cos(tilt)

    def flown(commands: Callable[[float, float], float], seconds: float, angle: float) -> FloatArray:
        x, v, q, w, before, normal, rows = 0.0, 0.0, angle, 0.0, 0.0, (cart + whole) * down, []
        for k in range(round(seconds * 100)):
            now = round(max(-15.0, min(15.0, commands(k / 100, x))), 2)
            seen = round((x + float(rng.normal(0, 4e-5))) / 5e-5) * 5e-5
            turn = math.radians(0.18)
            rows.append((k / 100, seen, round((q + 0.03) / turn) * turn, now))
            for j in range(100):
                u = before if j * STEP < 0.008 else now
                force = gain * (u - math.copysign(dead, u) if abs(u) > dead else 0.0) - emf * v
                cosine, sine = math.cos(q), math.sin(q)
                a, b = cart + whole, moment * cosine
                push = force + moment * sine * w * w + a * along
                turned = -moment * sine * down + moment * along * cosine - 0.0012 * w * abs(w)
                det = a * inertia - b * b
                free = v + STEP * (inertia * push - b * turned) / det
                most = STEP * (0.3 + load * (0.8 if free > 0 else 1.2) * max(normal, 0.0)) * inertia / det
                slowed = free - max(-most, min(most, free))
                spun = w + STEP * (a * turned - b * push) / det + b / inertia * (free - slowed)
                most = STEP * pivot * a / det
                spun -= max(-most, min(most, spun))
                gained, v, w = (spun - w) / STEP, slowed, spun
                x, q = x + STEP * v, q + STEP * w
                normal = a * down + moment * (math.sin(q) * gained + math.cos(q) * w * w)
            before = now
        return np.array(rows)

    def waves() -> Callable[[float, float], float]:
        phase, speed = rng.uniform(0, 6, 3), rng.uniform(0.85, 1.15, 3) * [0.22, 0.58, 1.4]
        return lambda t, x: float(np.array([4.0, 4.5, 2.5]) @ np.sin(2 * np.pi * speed * t + phase)) - 6 * x - 0.5

    tables = {name: (flown(waves(), 16.0, 0.0), 0.0) for name in ("one", "two", "three", "held_one", "held_two")}
    tables["swinging"] = (flown(lambda t, x: 0.0, 16.0, 0.7), 0.0)
    model = CRANE.format(bob=bob)
    config = HEAD.format(window=0.56, actuator="drive") + written(folder, model, tables, ["x", "q"], "")
    config += measured("x", "joint:rail.position", "m") + measured("q", "joint:pivot.position", "rad")
    config += asked("delay", "actuator:drive.delay", 0.0, 0.04) + asked("cart_mass", "body:cart.mass", 0.5, 8)
    config += asked("drive_gain", "actuator:drive.gain", 0.3, 3.0) + asked("damping", "joint:rail.damping", 0, 12)
    config += asked("friction", "joint:rail.frictionloss", 0, 4)
    config += asked("pivot_friction", "joint:pivot.frictionloss", 0, 0.5) + asked("zero", "sensor:q.bias", -0.2, 0.2)
    friction = 0.3 + load * (cart + whole) * down
    truth = {"delay": 0.008, "cart_mass": cart, "drive_gain": gain, "damping": emf, "friction": friction}
    return config, truth | {"pivot_friction": pivot}


def written(
    folder: Path, model: str, tables: dict[str, tuple[FloatArray, float]], columns: Sequence[str], loaded: str
) -> str:
    """The model and the logs in files, and the configuration's tables of the logs."""
    (folder / "model.xml").write_text(model)
    lines = ""
    for name, (rows, load) in tables.items():
        pd.DataFrame(rows, columns=["t", *columns, "u"]).to_csv(folder / f"{name}.csv", index=False)
        use = "holdout" if name.startswith("held") else "train"
        lines += f'[[logs]]\nfile = "{name}.csv"\nuse = "{use}"\n'
        lines += f'added = {{"{loaded}" = {load}}}\n' if load else ""
    return lines


def measured(column: str, target: str, unit: str) -> str:
    return f'[[measurements]]\ncolumn = "{column}"\ntarget = "{target}"\nunit = "{unit}"\n'


def asked(name: str, target: str, low: float, high: float) -> str:
    return f'[[parameters]]\nname = "{name}"\ntarget = "{target}"\nbounds = [{float(low)}, {float(high)}]\n'


MACHINES: dict[str, Callable[[int, Path], tuple[str, dict[str, float]]]] = {"axis": axis, "crane": crane}


def one_machine(machine: str, seed: int, discover: bool) -> dict[str, Any]:
    """What a user would do, and where the truth lies."""
    from sipe_bayes.calibration.discover import run_discovery

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config, truth = MACHINES[machine](seed, folder)
        (folder / "machine.toml").write_text(config)
        begin = time.process_time()
        result = sipe.calibrate(sipe.prepare(folder / "machine.toml", 1))
        row: dict[str, Any] = {
            "machine": machine,
            "seed": seed,
            "command": f"python examples/studies/foreign_machines.py --seeds {seed} {seed + 1}"
            + " --no-discover" * (not discover),
            "truth": {name: round(value, 5) for name, value in truth.items()},
            "calibrated": intervals(result.parameters, truth),
            "blocking": [f.code.name for f in result.findings if f.severity.value == "blocking"],
            "looks_like": result.misfit.cause if result.misfit else None,
            "times_smaller": round(result.comparison.ratio, 2) if result.comparison else None,
            "seconds": round(time.process_time() - begin, 1),
        }
        if discover:
            found = run_discovery(folder / "machine.toml", folder / "out", num_threads=1)
            row |= {
                "discovered": intervals(found.parameters, truth),
                "pieces": [piece.label for piece in found.kept],
                "settled": found.settled,
                "seconds_in_all": round(time.process_time() - begin, 1),
            }
    return row


def intervals(parameters: Any, truth: dict[str, float]) -> dict[str, Any]:
    """Of each value: the plain and the wider interval, and which of them hold the truth."""
    rows = {}
    for one in parameters:
        if one.name in truth:
            plain = [one.q05, one.q95]
            wider = list(one.further) if one.further is not None else plain
            holds = [low <= truth[one.name] <= high for low, high in (plain, wider)]
            digits = [[float(f"{end:.4g}") for end in ends] for ends in (plain, wider)]
            rows[one.name] = {"plain": digits[0], "wider": digits[1], "plain_holds": holds[0], "wider_holds": holds[1]}
    return rows


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """How many intervals hold, before discover and after it."""
    out: dict[str, Any] = {}
    for machine in MACHINES:
        own = [row for row in rows if row["machine"] == machine]
        for stage in ("calibrated", "discovered"):
            values = [value for row in own for value in row.get(stage, {}).values()]
            if values:
                held = {kind: sum(value[f"{kind}_holds"] for value in values) for kind in ("plain", "wider")}
                out[f"{machine}, {stage}"] = {"values": len(values), **held}
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machine", nargs="*", default=list(MACHINES), choices=list(MACHINES))
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 1), metavar=("FIRST", "END"))
    parser.add_argument("--no-discover", action="store_true")
    given = parser.parse_args()
    for machine in given.machine:
        for seed in range(*given.seeds):
            made = partial(one_machine, machine, seed, not given.no_discover)
            ensure(KEPT, {"machine": machine, "seed": seed}, made)
    rows = sorted(fits(KEPT), key=lambda row: (row["machine"], row["seed"]))
    table = {
        "commands": sorted({row["command"] for row in rows}),
        "source": source(),
        "versions": {p: version(p) for p in ("mujoco", "numpy", "scipy")},
        "hold": summary(rows),
        "machines": rows,
    }
    write_text(RESULTS, json.dumps(table, indent=2) + "\n")
    print(json.dumps(table["hold"], indent=2))


if __name__ == "__main__":
    main()
