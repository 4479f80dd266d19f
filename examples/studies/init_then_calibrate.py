"""Is what `sipe init` writes good enough to be calibrated unedited? Twelve machines of which the truth is known.

Each machine is simulated with other masses, friction, gains, rotor inertia, delay and zeros than its MJCF has, in
finer steps than the MJCF's, and logged as its users log it: rates from 20 Hz to 1 kHz, counts and digits of encoders,
degrees, rpm and percent, names as their programs write them. Two logs for training and a third that is held out:
`sipe init model.xml one two three --yes`, which holds out the last, then `sipe calibrate` on its file as it stands.
Both run as commands, with their time taken. What is compared:

- held-out errors with those of the nominal model;
- printed 90 % intervals (discrepancy-aware where there are any) with the truth, and with what is equivalent to it;
- the reading of each column with how it was written;
- the numbers that stay fixed with their truth.

Parameters that stay fixed may change what the others have to be: the damping of a joint is a part of its servo's
velocity gain, forces that no log knows are relative to the masses. ``equivalent`` holds the values with which a model
of the machine accelerates, and pushes where forces are logged, as the machine does within 5 % (RMS), though such
dampings are nominal, and what the file
of `sipe init` leaves out for it "shows as" others or is what forces are relative to. Where there are no such values,
it is the truth, but for the error of such a damping in the velocity gain.

    python examples/studies/init_then_calibrate.py                       # all machines: ten minutes of one core
    python examples/studies/init_then_calibrate.py --machines conveyor --seed 1
    python examples/studies/init_then_calibrate.py --judge               # compares kept fits with the truth again

Machines are kept one by one in runs/init_then_calibrate.jsonl, their files in runs/init_then_calibrate.
Results: results/init_then_calibrate.json
"""

from __future__ import annotations

import argparse
import copy
import json
import os
import re
import resource
import shutil
import subprocess
import sys
import time
import tomllib
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pandas as pd
from _kept import ensure, fits

import sipe_bayes as sipe
from sipe_bayes.benchmark.measurement import source
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.files import write_text
from sipe_bayes.core.units import find_unit
from sipe_bayes.envs.targets import bind

RESULTS = Path(__file__).parent / "results" / "init_then_calibrate.json"
KEPT = Path(__file__).parent / "runs" / "init_then_calibrate.jsonl"
FOLDERS = Path(__file__).parent / "runs" / "init_then_calibrate"
LOGS = ("one", "two", "three")  # the last is held out
FIRST = 1.0  # s, before the log begins
FINE = 5e-4  # s, at most: a step of the simulated machine
_SAMPLES, _STEPS, _SLOPE, _EXACT = 400, 6, 1e-4, 0.05  # of what is equivalent
LIMIT = 1800  # s, after which a command is ended
NOT_CONVERGED = ("search_unsettled", "budget_ended", "budget_too_small", "time_limit")

Held = Callable[[mujoco.MjModel, mujoco.MjData, FloatArray], FloatArray]


@dataclass(frozen=True)
class Column:
    """How a quantity is written: names of a vector have blanks between.

    Args:
        name: of the column.
        target: that it holds, as configurations name it; "load:NAME" is the torque of an actuator, "" a distractor.
        unit: of its numbers.
        sign: -1 where it counts the other way.
        zero: what it says where the model has 0.
        noise: its sd, SI.
        step: of its last digit, in its unit.
        counts: numbers for each unit.
    """

    name: str
    target: str
    unit: str = "rad"
    sign: int = 1
    zero: float = 0.0
    noise: float = 0.0
    step: float = 0.0
    counts: float = 1.0


@dataclass(frozen=True)
class Machine:
    """A machine as its user has it, and what of it is otherwise.

    Args:
        xml: MJCF with names in braces.
        numbers: of these names: nominal value, and times which the true one is drawn from, or where the nominal value
            is 0 the true values themselves.
        columns: of its logs.
        rate: of the rows, Hz.
        seconds: of each log.
        waves: sizes of the commands or goals, around ``mid``.
        delay: of the commands, s.
        held: commands of a controller that is given goals; else the goals are the commands.
        starts: positions at the start of each log; the same ones, where there is one.
        steps: whether goals are ramps from pose to pose, and not sums of waves.
        clock: name and unit of its column.
        suffix: of its logs.
    """

    xml: str
    numbers: Mapping[str, tuple[float, float, float]]
    columns: Sequence[Column]
    rate: float
    seconds: float
    waves: Sequence[float] = ()
    mid: Sequence[float] = ()
    pace: float = 1.0
    delay: float = 0.0
    held: Held | None = None
    starts: Sequence[Sequence[float]] = ((),)
    steps: bool = False
    clock: tuple[str, str] = ("time", "s")
    suffix: str = "csv"

    def true_numbers(self, rng: np.random.Generator) -> dict[str, float]:
        """Numbers of the machine that is logged."""
        return {n: (own or 1.0) * float(rng.uniform(low, high)) for n, (own, low, high) in self.numbers.items()}

    def nominal(self) -> dict[str, float]:
        """Numbers of the MJCF that its user has."""
        return {name: own for name, (own, _, _) in self.numbers.items()}

    def compiled(self, numbers: Mapping[str, float]) -> mujoco.MjModel:
        """The model with these numbers."""
        return mujoco.MjModel.from_xml_string(self.xml.format(**numbers))


def of(pattern: str, quantity: str, joints: str, unit: str = "rad", signs: str = "", **rest: float) -> list[Column]:
    """A column of each joint; in the pattern {j} is its name, {i} its number from 1, {k} from 0."""
    out = []
    for k, joint in enumerate(joints.split()):
        kind = "actuator:" if quantity == "command" else "load:" if quantity == "load" else "joint:"
        target = f"{kind}{joint}" + f".{quantity}" * (kind == "joint:")
        sign = -1 if signs[k : k + 1] == "-" else 1
        out.append(Column(pattern.format(j=joint, i=k + 1, k=k), target, unit, sign, **rest))
    return out


def goals(machine: Machine, rng: np.random.Generator) -> Callable[[float], FloatArray]:
    """Commands or goals (A,) at a time: sums of four waves, or ramps between poses with rests."""
    count, sizes = len(machine.waves), np.array(machine.waves)
    mid = np.array(machine.mid) if len(machine.mid) else np.zeros(count)
    if machine.steps:
        knots = np.arange(0.0, machine.seconds + FIRST + 2, 0.4 / machine.pace)
        poses = np.repeat(rng.uniform(-1, 1, (len(knots) // 2 + 1, count)), 2, axis=0)[: len(knots)]
        return lambda t: mid + sizes * np.array([np.interp(t, knots, own) for own in poses.T])
    speeds, phases = machine.pace * rng.uniform(0.12, 1.1, (4, count)), rng.uniform(0, 2 * np.pi, (4, count))
    return lambda t: mid + sizes * 0.5 * np.sin(2 * np.pi * speeds * t + phases).sum(axis=0)


def logged(
    machine: Machine, numbers: Mapping[str, float], log: int, rng: np.random.Generator
) -> tuple[pd.DataFrame, dict[str, FloatArray]]:
    """One log as it is written, and some of its states."""
    model, wanted, states = machine.compiled(numbers), goals(machine, rng), list[tuple[FloatArray, ...]]()
    per = int(np.ceil(1 / machine.rate / FINE - 1e-9))
    model.opt.timestep = 1 / machine.rate / per
    data, seen, sent = mujoco.MjData(model), list[dict[str, FloatArray]](), list[FloatArray]()
    start = machine.starts[log % len(machine.starts)]
    data.qpos[: len(start)] = start
    before = round(FIRST * machine.rate) if model.nu else 0
    for k in range(before + round(machine.seconds * machine.rate)):
        now = wanted(k / machine.rate) if model.nu else np.zeros(0)
        mujoco.mj_forward(model, data)
        sent.append(machine.held(model, data, now) if machine.held else now)
        seen.append(quantities(model, data, sent[-1]))
        for j in range(per):
            late = (k * per + j) * model.opt.timestep - machine.delay
            data.ctrl[:] = sent[max(0, int(np.floor(late * machine.rate + 1e-9)))]
            if j == 0:
                states.append(tuple(x.copy() for x in (data.qpos, data.qvel, data.act, data.ctrl)))
            mujoco.mj_step(model, data)
    if not np.isfinite(data.qpos).all():
        raise SystemExit("a simulated machine diverged")
    some = [states[k] for k in np.unique(np.linspace(0, len(states) - 1, _SAMPLES).astype(int))]
    samples = dict(zip(("qpos", "qvel", "act", "ctrl"), map(np.array, zip(*some, strict=True)), strict=True))
    return table(machine, seen[before:], rng), samples


def quantities(model: mujoco.MjModel, data: mujoco.MjData, sent: FloatArray) -> dict[str, FloatArray]:
    """What can be measured at this moment, SI, by target."""
    out: dict[str, FloatArray] = {}
    for a in range(model.nu):
        name = model.actuator(a).name
        out |= {f"actuator:{name}": sent[a : a + 1], f"load:{name}": data.actuator_force[a : a + 1].copy()}
    for j in range(model.njnt):
        name, at, dof = f"joint:{model.joint(j).name}", model.jnt_qposadr[j], model.jnt_dofadr[j]
        out |= {f"{name}.position": data.qpos[at : at + 1].copy(), f"{name}.velocity": data.qvel[dof : dof + 1].copy()}
        out[f"{name}.force"] = data.qfrc_actuator[dof : dof + 1].copy()
    for b in range(1, model.nbody):
        name = f"body:{model.body(b).name}"
        out |= {f"{name}.position": data.xpos[b].copy(), f"{name}.orientation": data.xquat[b].copy()}
    out |= {f"sensor:{model.sensor(s).name}": data.sensor(s).data.copy() for s in range(model.nsensor)}
    return out


def table(machine: Machine, seen: Sequence[Mapping[str, FloatArray]], rng: np.random.Generator) -> pd.DataFrame:
    """Columns as the user's program writes them."""
    out: dict[str, FloatArray] = {}
    time_s = np.arange(len(seen)) / machine.rate
    word, unit = machine.clock
    stamps = time_s / find_unit(unit).factor
    out[word] = np.round(stamps + 52_000).astype(np.int64) if unit in ("ms", "us", "ns") else np.round(stamps, 6)
    for column in machine.columns:
        names = column.name.split()
        if column.target:
            values = np.array([row[column.target] for row in seen])
        else:
            values = np.zeros((len(seen), len(names))) + 0.2 * np.sin(time_s)[:, None]
        values = values + column.noise * rng.standard_normal(values.shape)
        values = column.sign * values / find_unit(column.unit).factor * column.counts + column.zero
        values = np.round(values / column.step) * column.step if column.step else values
        out |= dict(zip(names, values.T, strict=True))
    return pd.DataFrame(out)


def generator(name: str, seed: int) -> np.random.Generator:
    """Of which the first numbers are the machine's."""
    return np.random.default_rng([zlib.crc32(name.encode()), seed])


def prepared(name: str, seed: int) -> Path:
    """The folder of a machine with its model and logs."""
    machine, rng = MACHINES[name], generator(name, seed)
    folder = FOLDERS / f"{name}-{seed}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    numbers = machine.true_numbers(rng)
    (folder / "model.xml").write_text(machine.xml.format(**machine.nominal()))
    for k, log in enumerate(LOGS):
        rows, samples = logged(machine, numbers, k, rng)
        np.savez(folder / "samples.npz", **samples)
        if machine.suffix == "csv":
            rows.to_csv(folder / f"{log}.csv", index=False, float_format="%.7g")
        else:
            np.savez(folder / f"{log}.npz", **{column: rows[column].to_numpy() for column in rows})
    return folder


def command(folder: Path, *arguments: str) -> dict[str, Any]:
    """Run `sipe` in a folder: exit code, seconds of the processor and of the clock."""
    begin, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    told = folder / f"{arguments[0]}.txt"
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MUJOCO_GL": "disabled"}
    with told.open("w") as out:
        words = [sys.executable, "-c", "from sipe_bayes.cli.app import main; main()", *arguments]
        try:
            code = subprocess.run(words, cwd=folder, env=environment, stdout=out, stderr=out, timeout=LIMIT).returncode
        except subprocess.TimeoutExpired:
            code = -1
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"code": code, "cpu": round(spent, 1), "wall": round(time.monotonic() - begin, 1)}


def misread(machine: Machine, written: Mapping[str, Any]) -> list[str]:
    """Columns that the configuration reads otherwise than they were written, but for velocities that it leaves."""
    rows = {(f"actuator:{c['actuator']}", c["column"]): c for c in written.get("commands", [])}
    for row in written.get("measurements", []):
        names = row["column"] if "column" in row else " ".join(row["columns"])
        rows[row["target"], names] = row
    out = []
    for column in machine.columns:
        if not column.target or column.target.startswith("load:"):
            continue
        row = rows.get((column.target, column.name))
        if row is None:
            if not column.target.endswith((".velocity", ".force")):
                others = [f"{target} of {names}" for target, names in rows if column.target == target]
                out.append(f"{column.name}: {column.target} is not read from it, but {others or 'from nothing'}")
            continue
        scale = find_unit(row.get("unit", "1")).factor * row.get("factor", 1.0) * row.get("sign", 1)
        true = find_unit(column.unit).factor / column.counts * column.sign
        if scale * true < 0:
            out.append(f"{column.name}: sign {row.get('sign', 1)}")
        if not 0.98 < abs(scale / true) < 1.02:
            out.append(f"{column.name}: {abs(scale):.4g} SI for each, not {abs(true):.4g}")
    return out


def true_value(target: str, machine: Machine, true: mujoco.MjModel, written: Mapping[str, Any]) -> float | None:
    """The true value of a target; None of what was not looked up."""
    if target.endswith(".delay"):
        return machine.delay
    if target.startswith("sensor:"):
        name = target.removeprefix("sensor:").removesuffix(".bias")
        column = next((c for c in machine.columns if c.name == name), None)
        row = next((r for r in written["measurements"] if r.get("column") == name), None)
        if column is None or row is None or not target.endswith(".bias"):
            return None
        scale = find_unit(row["unit"]).factor * row.get("factor", 1.0) * row.get("sign", 1)
        return float(scale * (column.zero - row.get("zero", 0.0)))
    return float(bind(true, target).value)


@dataclass
class Free:
    """A free parameter: its targets with their multipliers, its bounds, and its truth, the least and the most."""

    name: str
    targets: Mapping[str, float]
    bounds: tuple[float, float]
    truth: tuple[float, float] | None
    equivalent: float | None = None

    @property
    def dynamic(self) -> bool:
        """Whether accelerations show it."""
        return not any(t.endswith((".delay", ".lag")) or t.startswith("sensor:") for t in self.targets)

    @property
    def slowed_joint(self) -> str:
        """The joint whose damping is a part of this velocity gain; actuators are called as their joints, or one is."""
        kind, _, rest = next(iter(self.targets)).partition(":")
        owner, _, word = rest.rpartition(".")
        gain = kind == "actuator" and word in ("kv", "bias_velocity") and len(self.targets) == 1
        return {"valve": "cylinder", "motor": "roller"}.get(owner, owner) if gain else ""


def free_parameters(folder: Path, machine: Machine, true: mujoco.MjModel) -> list[Free]:
    """The parameters of a configuration, with what is true of them."""
    written = tomllib.loads((folder / "calibrate.toml").read_text())
    environment, out = sipe.prepare(folder / "calibrate.toml", 1).environment, []
    for own in environment.parameters:
        times = environment.multipliers(own)
        values = [(true_value(t, machine, true, written), times[t]) for t in own.targets]
        known = [value / factor for value, factor in values if value is not None]
        bounds = next(p for p in environment.space if p.name == own.name)
        truth = (min(known), max(known)) if known else None
        out.append(Free(own.name, times, (float(bounds.low), float(bounds.high)), truth))
    return out


def find_equivalent(folder: Path, machine: Machine, numbers: Mapping[str, float], free: Sequence[Free]) -> float:
    """Set what is equivalent; the share of accelerations and measured forces that is left then.

    Gauss-Newton steps on the accelerations at samples of the first log, from the truth, of least length.
    """
    true, nominal = machine.compiled(numbers), machine.nominal()
    text = (folder / "calibrate.toml").read_text()
    said = re.findall(r'# left out: (?:no force is known|shows as)[^\[]*\[\[.*\n# name.*\n# target = "(.*)"', text)
    beside = {f"d_{joint}" for one in free if (joint := one.slowed_joint)} | set(changing(machine, numbers, said))
    base = machine.compiled({**numbers, **{name: nominal[name] for name in beside}})
    moving = [f for f in free if f.dynamic and f.truth]
    for one in free:
        one.equivalent = None if one.truth is None else sum(one.truth) / 2 + _damping_beside(one, free, base, true)
    samples = np.load(folder / "samples.npz")
    forces = '.force"' in text  # that are measured
    wanted = motions(true, samples, forces)
    usual = np.sqrt(np.mean(wanted**2, axis=0)) + 1e-9
    truth = np.array([one.equivalent for one in moving], float)
    sizes = np.array(
        [max(abs(x), 0.01 * (one.bounds[1] - one.bounds[0])) for x, one in zip(truth, moving, strict=True)]
    )

    def missed(values: FloatArray) -> FloatArray:
        model = written_into(base, moving, values)
        return np.asarray(((motions(model, samples, forces) - wanted) / usual).ravel())

    now = truth.copy()
    for _ in range(_STEPS):
        here = missed(now)
        slopes = np.stack([(missed(now + h) - here) / _SLOPE for h in np.diag(_SLOPE * sizes)], axis=1)
        now = now - sizes * (np.linalg.pinv(slopes, rcond=1e-4) @ here)
    left = float(np.sqrt(np.mean(missed(now) ** 2)))
    for one, value in zip(moving, now, strict=True):
        least = 0.0 if one.truth and one.truth[0] >= 0 else -np.inf
        one.equivalent = max(float(value), least) if left < _EXACT else one.equivalent
    return left


def _damping_beside(one: Free, free: Sequence[Free], base: mujoco.MjModel, true: mujoco.MjModel) -> float:
    """What a velocity gain has to take over of a damping that is fixed."""
    joint = one.slowed_joint
    if not joint or any(f"joint:{joint}.damping" in f.targets for f in free):
        return 0.0
    more = float(true.joint(joint).damping[0] - base.joint(joint).damping[0])
    return more if next(iter(one.targets)).endswith(".kv") else -more


def written_into(base: mujoco.MjModel, free: Sequence[Free], values: FloatArray) -> mujoco.MjModel:
    """A copy of a model with these values."""
    model = copy.deepcopy(base)
    for one, value in zip(free, values, strict=True):
        for target, times in one.targets.items():
            bind(base, target).write(model, max(bind(base, target).minimum, float(value) * times))
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def motions(model: mujoco.MjModel, samples: Mapping[str, FloatArray], forces: bool) -> FloatArray:
    """Accelerations (n, nv) at positions, velocities, activations and commands, and forces of actuators (n, nu)."""
    data, out = mujoco.MjData(model), []
    for qpos, qvel, act, ctrl in zip(*(samples[k] for k in ("qpos", "qvel", "act", "ctrl")), strict=True):
        data.qpos[:], data.qvel[:], data.act[:], data.ctrl[:] = qpos, qvel, act, ctrl
        data.qacc_warmstart[:] = 0
        mujoco.mj_forward(model, data)
        out.append(np.append(data.qacc, data.actuator_force if forces else []))
    return np.array(out)


def intervals(free: Sequence[Free], result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Of each free parameter the estimate, the intervals and the truth."""
    rows: list[dict[str, Any]] = []
    for own, one in zip(result["parameters"], free, strict=True):
        low, high = own["further"] or (own["q05"], own["q95"])
        row = {"name": own["name"], "nominal": own["default"], "bounds": one.bounds, "estimate": own["mode"]}
        row |= {"printed": [low, high], "plain": [own["q05"], own["q95"]], "flags": own["flags"]}
        if one.truth is not None and one.equivalent is not None:
            apart = one.truth[1] - one.truth[0] > 1e-9 * abs(one.truth[1])  # parts that share a parameter
            span = one.truth if apart else (one.equivalent, one.equivalent)
            row |= {"truth": list(one.truth) if apart else one.truth[0], "equivalent": one.equivalent}
            row |= {"holds": bool(low <= span[1] and span[0] <= high)}
            row |= {"plain_holds": bool(own["q05"] <= span[1] and span[0] <= own["q95"])}
            row |= {"holds_truth": bool(low <= one.truth[1] and one.truth[0] <= high)}
            row |= {"in_bounds": bool(one.bounds[0] <= span[1] and span[0] <= one.bounds[1])}
        rows.append(_rounded(row))
    return rows


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.4g}")
    if isinstance(value, Mapping):
        return {key: _rounded(x) for key, x in value.items()}
    return [_rounded(x) for x in value] if isinstance(value, (list, tuple)) else value


def changing(machine: Machine, numbers: Mapping[str, float], targets: Sequence[str]) -> list[str]:
    """The numbers of a machine that change one of these targets."""
    nominal = machine.nominal()
    base, others = machine.compiled(nominal), {n: machine.compiled({**nominal, n: x}) for n, x in numbers.items()}
    return [n for n, other in others.items() if any(_differs(base, other, target) for target in targets)]


def fixed(machine: Machine, numbers: Mapping[str, float], free: Sequence[str]) -> list[str]:
    """What the truth changes and no free parameter can follow."""
    followed, nominal = changing(machine, numbers, free), machine.nominal()
    out = [f"{n}: {nominal[n]:.4g}, truly {x:.4g}" for n, x in numbers.items() if n not in followed]
    if machine.delay and not any(target.endswith(".delay") for target in free):
        out.append(f"delay: 0, truly {machine.delay:g}")
    return out


def _differs(base: mujoco.MjModel, other: mujoco.MjModel, target: str) -> bool:
    if target.startswith("sensor:"):
        return False
    return bool(bind(base, target).value != bind(other, target).value)


def one_machine(name: str, seed: int) -> dict[str, Any]:
    """What a user would do who edits nothing, and where the truth lies."""
    machine, folder = MACHINES[name], prepared(name, seed)
    row: dict[str, Any] = {"machine": name, "seed": seed}
    row["command"] = f"python examples/studies/init_then_calibrate.py --machines {name} --seed {seed}"
    row["init"] = command(folder, "init", "model.xml", *[f"{log}.{machine.suffix}" for log in LOGS], "--yes")
    if row["init"]["code"]:
        return {**row, "failed": (folder / "init.txt").read_text()[-600:]}
    written = tomllib.loads((folder / "calibrate.toml").read_text())
    row["misread"] = misread(machine, written)
    row["open"] = re.findall("# OPEN: (.*)", (folder / "calibrate.toml").read_text())
    row["calibrate"] = command(folder, "calibrate", "calibrate.toml", "--out", "out")
    if not (folder / "out" / "result.json").is_file():
        return {**row, "failed": (folder / "calibrate.txt").read_text()[-600:]}
    return row | judged(name, seed, row)


def judged(name: str, seed: int, row: Mapping[str, Any]) -> dict[str, Any]:
    """What a calibration found, against the truth."""
    machine, folder = MACHINES[name], FOLDERS / f"{name}-{seed}"
    numbers = machine.true_numbers(generator(name, seed))
    written = tomllib.loads((folder / "calibrate.toml").read_text())
    result = json.loads((folder / "out" / "result.json").read_text())
    true = machine.compiled(numbers)
    free = free_parameters(folder, machine, true)
    left = find_equivalent(folder, machine, numbers, free)
    codes = [f["code"] for f in result["findings"] if f["severity"] == "blocking"]
    errors = [{k: s[k] for k in ("channel", "unit", "rmse", "rmse_default")} for s in result["holdout"]]
    return {
        "converged": result["checked"] and row["calibrate"]["code"] in (0, 3) and not {*codes} & {*NOT_CONVERGED},
        "blocking": codes,
        "foretold": next(iter(re.findall(r"\(about [^)]*\)", (folder / "init.txt").read_text())), ""),
        "holdout": _rounded(errors),
        "ratio": _rounded(float(np.exp(np.mean([np.log(e["rmse"] / e["rmse_default"]) for e in errors])))),
        "left of the motion": _rounded(left),
        "parameters": intervals(free, result),
        "fixed": fixed(machine, numbers, [target for one in free for target in one.targets]),
        "likelihood": written.get("likelihood", "segments"),
        "rollouts": result["rollouts"],
    }


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Totals over machines."""
    values = [p for row in rows for p in row.get("parameters", []) if "holds" in p]
    times = [row["calibrate"] for row in rows if "calibrate" in row]
    return {
        "machines": len(rows),
        "failed": [row["machine"] for row in rows if "failed" in row],
        "converged": sum(row.get("converged", False) for row in rows),
        "calibrated within 120 s of one core": sum(t["cpu"] <= 120 and t["code"] in (0, 3) for t in times),
        "held-out error no larger than nominal": sum(row.get("ratio", np.inf) <= 1 for row in rows),
        "every channel no larger": sum(
            all(e["rmse"] <= e["rmse_default"] for e in row["holdout"]) for row in rows if row.get("holdout")
        ),
        "columns misread": sum(len(row.get("misread", [])) for row in rows),
        "free parameters": len(values),
        "equivalent inside the printed interval": sum(p["holds"] for p in values),
        "equivalent inside the plain interval": sum(p["plain_holds"] for p in values),
        "truth inside the printed interval": sum(p["holds_truth"] for p in values),
        "equivalent outside the bounds that init wrote": sum(not p["in_bounds"] for p in values),
        "init, s of one core, median and most": _spread([row["init"]["cpu"] for row in rows]),
        "calibrate, s of one core, median and most": _spread([t["cpu"] for t in times]),
    }


def _spread(values: Sequence[float]) -> list[float]:
    return [float(np.median(values)), max(values)] if values else []


def mjcf(bodies: str, actuators: str = "", more: str = "", step: float = 0.002) -> str:
    """A model without contacts; braces stay for the numbers."""
    option = f'<option timestep="{step}" integrator="implicitfast"><flag contact="disable"/></option>'
    world = f'<compiler angle="radian"/>{option}<worldbody>{bodies}</worldbody>'
    return f"<mujoco>{world}<actuator>{actuators}</actuator>{more}</mujoco>"


def link(name: str, axis: str, to: str, mass: str, joint: str, inside: str = "", at: str = "0 0 0") -> str:
    """A body with a hinge of its name, and a capsule along it."""
    turn = f'<joint name="{name}" axis="{axis}" {joint}/>'
    shape = f'<geom type="capsule" fromto="0 0 0 {to}" size=".015" mass="{mass}"/>'
    return f'<body name="{name}_link" pos="{at}">{turn}{shape}{inside}</body>'


def block(
    body: str,
    name: str,
    shape: str,
    mass: str,
    at: str = "0 0 0",
    kind: str = "slide",
    rest: str = "",
    inside: str = "",
) -> str:
    """A body of one geom with a joint of its own, along x or as the rest says."""
    rest = rest or f'axis="1 0 0" {friction(name)}'
    joint = f'<joint name="{name}" type="{kind}" {rest}/>'
    return f'<body name="{body}" pos="{at}">{joint}<geom {shape} mass="{mass}"/>{inside}</body>'


def friction(name: str) -> str:
    """What of a joint's friction and rotor is drawn."""
    return f'damping="{{d_{name}}}" frictionloss="{{f_{name}}}" armature="{{a_{name}}}"'


def drawn(name: str, damping: float, dry: float, rotor: float) -> dict[str, tuple[float, float, float]]:
    """Damping, dry friction and rotor of a joint: about so much, of which the MJCF has half the damping only."""
    return {
        f"d_{name}": (damping / 2, 1.4, 2.6),
        f"f_{name}": (0.0, 0.6 * dry, 1.4 * dry),
        f"a_{name}": (0.0, 0.6 * rotor, 1.4 * rotor) if rotor else (0.0, 0.0, 0.0),
    }


def toward(kp: float, kd: float, most: float = np.inf) -> Held:
    """A controller of the joints that actuators move: a force, or what the gear makes one of."""

    def held(model: mujoco.MjModel, data: mujoco.MjData, goal: FloatArray) -> FloatArray:
        joints = model.actuator_trnid[: model.nu, 0]
        position, velocity = data.qpos[model.jnt_qposadr[joints]], data.qvel[model.jnt_dofadr[joints]]
        return np.clip(kp * (goal - position) - kd * velocity, -most, most)

    return held


def level(model: mujoco.MjModel, data: mujoco.MjData, goal: FloatArray) -> FloatArray:
    """Thrusts that keep a body at a height and let it lean as it is told."""
    lean = np.zeros(3)
    mujoco.mju_negQuat(turned := np.zeros(4), data.qpos[3:7])
    mujoco.mju_rotVecQuat(lean, np.array([0.0, 0.0, 1.0]), turned)
    rise = 0.49 + 0.15 * (1 + 0.2 * goal[0] - data.qpos[2]) - 0.12 * data.qvel[2]
    roll = 0.15 * (0.25 * goal[1] + 0.1 * data.qpos[1] + 0.15 * data.qvel[1] - lean[1]) - 0.02 * data.qvel[3]
    pitch = 0.15 * (0.25 * goal[2] - 0.1 * data.qpos[0] - 0.15 * data.qvel[0] + lean[0]) - 0.02 * data.qvel[4]
    yaw = -0.1 * data.qvel[5] + 0.03 * goal[3]
    places, turns = model.site_pos[model.actuator_trnid[:, 0]], np.sign(model.actuator_gear[:, 5])
    mixed = rise + roll * np.sign(places[:, 1]) - pitch * np.sign(places[:, 0]) + yaw * turns
    return np.clip(mixed, 0, 1)


def desk_arm() -> Machine:
    joints = "shoulder elbow"
    elbow = link("elbow", "0 1 0", ".15 0 0", "{m_elbow}", friction("elbow"), at=".18 0 0")
    xml = mjcf(
        link("shoulder", "0 1 0", ".18 0 0", "{m_shoulder}", friction("shoulder"), elbow),
        "".join(f'<position name="{j}" joint="{j}" kp="{{kp_{j}}}" kv="{{kv_{j}}}"/>' for j in joints.split()),
    )
    numbers = drawn("shoulder", 0.1, 0.06, 0.006) | drawn("elbow", 0.06, 0.04, 0.004)
    numbers |= {"m_shoulder": (0.22, 0.96, 1.04), "m_elbow": (0.16, 0.96, 1.04)}
    numbers |= {f"kp_{j}": (4.0, 1.3, 2.0) for j in joints.split()} | {
        f"kv_{j}": (0.1, 1.2, 2.0) for j in joints.split()
    }
    columns = [
        *of("servo{i}_angle", "position", joints, "deg", "+-", step=0.088, noise=3e-4),
        *of("servo{i}_target", "command", joints, "deg", "+-", step=0.088),
        Column("servo1_temp", "", "1", zero=41.0, step=1.0),
    ]
    return Machine(xml, numbers, columns, 50, 24, (0.8, 0.9), (0.1, 0.3), delay=0.022, steps=True, clock=("ms", "ms"))


def so_arm() -> Machine:
    names = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]
    axes, ends = (
        ["0 0 1", "0 1 0", "0 1 0", "0 1 0", "1 0 0", "0 0 1"],
        ["0 0 .06", ".11 0 .02", ".13 0 0", ".06 0 0", ".05 0 0", ".07 .01 0"],
    )
    masses, body = (0.15, 0.12, 0.11, 0.08, 0.06, 0.04), ""
    for k in reversed(range(6)):
        at = ends[k - 1] if k else "0 0 .05"
        body = link(names[k], axes[k], ends[k], f"{{m_{k}}}", friction(names[k]), body, at)
    drives = "".join(f'<position name="{j}" joint="{j}" kp="{{kp}}" kv="{{kv}}"/>' for j in names)
    numbers = {"kp": (8.0, 1.5, 2.2), "kv": (0.3, 1.2, 2.2)}
    numbers |= {f"m_{k}": (mass, 0.96, 1.04) for k, mass in enumerate(masses)}
    for name in names:
        numbers |= drawn(name, 0.5, 0.06, 0.028)
    joints = " ".join(names)
    columns = [
        *of("observation.state.{j}.pos", "position", joints, "deg", step=0.088),
        *of("action.{j}.pos", "command", joints, "deg", step=0.088),
    ]
    sizes, mid = (0.8, 0.6, 0.7, 0.7, 0.8, 0.5), (0, -0.5, 0.6, 0.3, 0, 0.4)
    return Machine(
        mjcf(body, drives), numbers, columns, 50, 30, sizes, mid, delay=0.03, steps=True, clock=("timestamp", "s")
    )


def pendulum() -> Machine:
    xml = mjcf(link("pivot", "0 1 0", "0 0 -.4", "{mass}", friction("pivot")), '<motor name="motor" joint="pivot"/>')
    numbers = drawn("pivot", 0.03, 0.05, 0.01) | {"mass": (0.7, 1.15, 1.35)}
    columns = [
        *of("theta_deg", "position", "pivot", "deg", noise=1e-3, step=0.05, zero=-4.0),
        *of("tau_Nm", "command", "motor", "N m", step=0.001),
    ]
    return Machine(xml, numbers, columns, 200, 15, (0.5,), pace=1.0, delay=0.006, clock=("t_s", "s"))


def cart_pole() -> Machine:
    pole = link("pole", "0 1 0", "0 0 -.5", "{m_pole}", 'damping="{d_pole}" frictionloss="{f_pole}"')
    trolley = block("trolley", "cart", 'type="box" size=".1 .06 .04"', "{m_cart}", inside=pole)
    xml = mjcf(trolley, '<motor name="drive" joint="cart"/>')
    numbers = drawn("cart", 3.0, 0.8, 0.0) | {"d_pole": (0.001, 1.5, 3.0), "f_pole": (0.0, 0.003, 0.008)}
    numbers |= {"m_cart": (1.2, 0.75, 0.9), "m_pole": (0.25, 1.1, 1.3)}
    columns = [
        *of("cart_pos_mm", "position", "cart", "mm", noise=1e-4, step=0.1),
        *of("pole_angle_deg", "position", "pole", "deg", "-", noise=5e-4, step=0.09),
        *of("force_N", "command", "drive", "N", step=0.01),
    ]
    held = toward(18.0, 1.0, 12.0)
    return Machine(xml, numbers, columns, 100, 20, (0.25,), pace=0.8, delay=0.01, held=held, clock=("time_ms", "ms"))


def ball_screw() -> Machine:
    motor = '<general name="servo" joint="stage" gear="45" gainprm="{gain}"/>'
    xml = mjcf(block("table", "stage", 'type="box" size=".1 .1 .03"', "{mass}"), motor, step=0.001)
    numbers = drawn("stage", 60.0, 14.0, 3.0) | {"mass": (8.0, 0.98, 1.02), "gain": (1.0, 0.8, 0.95)}
    columns = [
        *of("pos_um", "position", "stage", "um", step=1.0),
        *of("vel_mm_s", "velocity", "stage", "mm/s", noise=2e-4),
        *of("iq_A", "command", "servo", "A", step=0.001),
    ]
    held = toward(300.0, 12.0, 10.0)
    return Machine(
        xml,
        numbers,
        columns,
        1000,
        25,
        (0.12,),
        pace=1.5,
        delay=0.002,
        held=held,
        clock=("t", "s"),
        suffix="npz",
    )


def gripper() -> Machine:
    bodies = ""
    for side, sign in (("left", 1), ("right", -1)):
        rest = f'axis="0 {sign} 0" range="-.01 .06" stiffness="{{k_{side}}}" damping="{{d_{side}}}" '
        rest += f'frictionloss="{{f_{side}}}"'
        box = 'type="box" size=".01 .01 .04"'
        bodies += block(f"{side}_finger", side, box, f"{{m_{side}}}", f"0 {0.02 * sign} 0", rest=rest)
    cord = '<tendon><fixed name="cord"><joint joint="left" coef="1"/><joint joint="right" coef="1"/></fixed></tendon>'
    xml = mjcf(bodies, '<motor name="winch" tendon="cord"/>', cord)
    numbers: dict[str, tuple[float, float, float]] = {}
    for side in ("left", "right"):
        numbers |= {f"d_{side}": (3.0, 1.3, 2.0), f"f_{side}": (0.0, 0.1, 0.3), f"k_{side}": (60.0, 1.15, 1.4)}
        numbers |= {f"m_{side}": (0.12, 1.1, 1.3)}
    columns = [
        *of("finger_{j}_mm", "position", "left right", "mm", noise=5e-5, step=0.05),
        *of("cable_force_N", "command", "winch", "N", step=0.01),
    ]
    return Machine(xml, numbers, columns, 100, 15, (1.2,), (1.6,), pace=2.0, delay=0.012, clock=("t_ms", "ms"))


def hydraulic() -> Machine:
    valve = '<general name="valve" joint="cylinder" dyntype="filterexact" dynprm="{lag}" gainprm="{gain}" '
    valve += 'biastype="affine" biasprm="0 0 {back}" ctrlrange="-1 1"/>'
    xml = mjcf(block("ram", "cylinder", 'type="box" size=".3 .3 .3"', "{mass}"), valve, step=0.005)
    numbers = drawn("cylinder", 900.0, 350.0, 0.0) | {"mass": (300.0, 0.97, 1.03), "lag": (0.1, 1.2, 1.6)}
    numbers |= {"gain": (6000.0, 0.8, 0.95), "back": (-20000.0, 0.8, 1.2)}
    columns = [
        *of("stroke_mm", "position", "cylinder", "mm", noise=2e-4, step=0.5),
        *of("valve_pct", "command", "valve", "%", step=0.1),
        Column("tank_bar", "", "1", zero=180.0, step=1.0),
    ]
    return Machine(xml, numbers, columns, 20, 60, (0.45,), pace=0.5, delay=0.05, clock=("Time", "s"))


def rover() -> Machine:
    wheels, bodies = "left_wheel right_wheel", ""
    for k, name in enumerate(wheels.split()):
        bodies += link(name, "0 1 0", "0 .04 0", f"{{m_{name}}}", friction(name), at=f"0 {k - 0.5} 0")
    drives = "".join(f'<velocity name="{j}" joint="{j}" kv="{{kv}}"/>' for j in wheels.split())
    numbers = {"kv": (0.05, 1.4, 2.0)}
    for name in wheels.split():
        numbers |= {**drawn(name, 0.004, 0.03, 0.0), f"m_{name}": (0.6, 0.97, 1.03), f"a_{name}": (0.01, 1.2, 1.6)}
    columns = [
        *of("{j}_enc_deg", "position", wheels, "deg", "+-", step=0.25),
        *of("{j}_rpm", "velocity", wheels, "rpm", "+-", noise=0.05, step=0.1),
        *of("{j}_cmd_rpm", "command", wheels, "rpm", "+-", step=0.5),
    ]
    return Machine(
        mjcf(bodies, drives),
        numbers,
        columns,
        50,
        25,
        (9.0, 9.0),
        delay=0.04,
        steps=True,
        clock=("stamp", "ms"),
    )


def crazyflie() -> Machine:
    rotors = (("1", ".032 -.032", "-"), ("2", "-.032 -.032", ""), ("3", "-.032 .032", "-"), ("4", ".032 .032", ""))
    sites = "".join(f'<site name="m{k}" pos="{at} 0"/>' for k, at, _ in rotors)
    thrusts = "".join(
        f'<motor name="m{k}" site="m{k}" gear="0 0 {{thrust}} 0 0 {s}{{drag}}" ctrlrange="0 1"/>' for k, _, s in rotors
    )
    box = '<geom type="box" size=".035 .035 .012" mass="{mass}"/>'
    frame = f'<body name="cf2" pos="0 0 1"><freejoint/>{box}<site name="imu"/>{sites}</body>'
    xml = mjcf(frame, thrusts, '<sensor><gyro name="gyro" site="imu"/></sensor>')
    numbers = {"mass": (0.03, 1.05, 1.2), "thrust": (0.15, 1.05, 1.2), "drag": (9e-4, 0.9, 1.1)}
    columns = [
        Column("stateEstimate.x stateEstimate.y stateEstimate.z", "body:cf2.position", "m", noise=5e-4, step=1e-4),
        Column(
            "stateEstimate.qw stateEstimate.qx stateEstimate.qy stateEstimate.qz",
            "body:cf2.orientation",
            "1",
            noise=5e-4,
        ),
        Column("gyro.x gyro.y gyro.z", "sensor:gyro", "deg/s", noise=0.01, step=0.01),
        *of("motor.m{i}", "command", "m1 m2 m3 m4", "1", counts=65535.0, step=1.0),
    ]
    clock, starts = ("timestamp", "ms"), ((0, 0, 1),)
    return Machine(xml, numbers, columns, 100, 10, (1.0,) * 4, (), 1.5, 0.01, level, starts, clock=clock)


def double_pendulum() -> Machine:
    lower = link("beta", "0 1 0", "0 0 -.22", "{m_beta}", 'damping="{d_beta}" frictionloss="{f_beta}"', at="0 0 -.3")
    xml = mjcf(link("alpha", "0 1 0", "0 0 -.3", "{m_alpha}", 'damping="{d_alpha}" frictionloss="{f_alpha}"', lower))
    numbers = {"m_alpha": (0.3, 0.96, 1.04), "m_beta": (0.2, 0.95, 1.05), "d_alpha": (0.001, 2.0, 4.0)}
    numbers |= {"d_beta": (0.001, 1.0, 2.5), "f_alpha": (0.0, 0.004, 0.01), "f_beta": (0.0, 0.002, 0.006)}
    columns = of("{j}_deg", "position", "alpha beta", "deg", "+-", noise=5e-4, step=0.09)
    starts = ((0.9, 0.4), (-0.7, 0.9), (0.6, -1.0))
    return Machine(xml, numbers, columns, 200, 8, starts=starts, clock=("t_us", "us"))


def conveyor() -> Machine:
    motor = '<general name="motor" joint="roller" gainprm="{gain}" biastype="affine" biasprm="0 0 {emf}"/>'
    rest = f'axis="0 1 0" {friction("roller")}'
    shape = 'type="cylinder" size=".04 .3" euler="1.5708 0 0"'
    xml = mjcf(block("drum", "roller", shape, "{mass}", kind="hinge", rest=rest), motor)
    numbers = drawn("roller", 0.04, 0.25, 0.0) | {"mass": (6.0, 0.97, 1.03), "a_roller": (0.01, 1.1, 1.5)}
    numbers |= {"gain": (0.12, 0.8, 0.95), "emf": (-0.03, 1.2, 1.6)}
    columns = [
        *of("encoder_rev", "position", "roller", "rev", step=1 / 1024),
        *of("motor_mV", "command", "motor", "mV", step=10.0),
        Column("supply_V", "", "V", zero=24.0, step=0.1),
    ]
    return Machine(xml, numbers, columns, 100, 20, (12.0,), (4.0,), delay=0.015, clock=("time_ms", "ms"))


def leg() -> Machine:
    joints = "coxa femur tibia"
    tibia = link("tibia", "0 1 0", "0 0 -.13", "{m_tibia}", friction("tibia"), at=".09 0 0")
    femur = link("femur", "0 1 0", ".09 0 0", "{m_femur}", friction("femur"), tibia, at=".05 0 0")
    drives = "".join(f'<position name="{j}" joint="{j}" kp="{{kp_{j}}}" kv="{{kv_{j}}}"/>' for j in joints.split())
    xml = mjcf(link("coxa", "0 0 1", ".05 0 0", "{m_coxa}", friction("coxa"), femur), drives)
    numbers: dict[str, tuple[float, float, float]] = {}
    for name, mass in zip(joints.split(), (0.3, 0.35, 0.2), strict=True):
        numbers |= drawn(name, 0.08, 0.08, 0.008) | {f"m_{name}": (mass, 1.1, 1.3)}
        numbers |= {f"kp_{name}": (14.0, 0.6, 0.8), f"kv_{name}": (0.3, 1.1, 1.6)}
    columns = [
        *of("/joint_states/{j}/position", "position", joints, "rad", noise=5e-4, step=1e-4),
        *of("/joint_states/{j}/velocity", "velocity", joints, "rad/s", noise=0.02, step=1e-3),
        *of("/joint_states/{j}/effort", "force", joints, "N m", noise=0.02, step=1e-3),
        *of("/leg_controller/reference/{j}", "command", joints, "rad"),
    ]
    return Machine(xml, numbers, columns, 100, 15, (0.5, 0.6, 0.7), (0, 0.3, 0.2), 1.3, 0.008, clock=("__time", "s"))


MACHINES: dict[str, Machine] = {
    make.__name__: make()
    for make in (desk_arm, so_arm, pendulum, cart_pole, ball_screw, gripper, hydraulic, rover, crazyflie,
                 double_pendulum, conveyor, leg)
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--machines", nargs="*", default=list(MACHINES), choices=list(MACHINES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--judge", action="store_true")
    given = parser.parse_args()
    if given.judge:
        again = [row if "failed" in row else row | judged(row["machine"], row["seed"], row) for row in fits(KEPT)]
        write_text(KEPT, "".join(json.dumps(row) + "\n" for row in again))
        given.machines = []
    for name in given.machines:
        ensure(KEPT, {"machine": name, "seed": given.seed}, partial(one_machine, name, given.seed))
    rows = sorted(fits(KEPT), key=lambda row: (row["seed"], list(MACHINES).index(row["machine"])))
    out = {
        "command": "python examples/studies/init_then_calibrate.py",
        "source": source(),
        "versions": {p: version(p) for p in ("mujoco", "numpy", "scipy")},
        "in all": summary(rows),
        "machines": rows,
    }
    write_text(RESULTS, json.dumps(out, indent=2) + "\n")
    print(json.dumps(out["in all"], indent=2))


if __name__ == "__main__":
    main()
