"""Small machines with logs as their users have them, up to 40 % off their models, and what each log holds."""

from __future__ import annotations

import itertools
import re
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd

from sipe_bayes.calibration.init.draft import Draft
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.units import find_unit


@dataclass(frozen=True)
class Column:
    """What a column holds: names of a vector have blanks between; no target: the model has nothing of it."""

    name: str
    target: str
    unit: str = "rad"  # of its numbers; "" where nothing can tell it
    sign: int = 1
    zero: float = 0.0  # what it says where the model has 0
    counts: float = 1.0  # for each unit
    noise: float = 0.0  # SI
    step: float = 0.0  # of its last digit
    source: str = ""  # targets whose sum it is, where that is another


@dataclass(frozen=True)
class Plant:
    """A machine and its log."""

    xml: str  # as it is given
    columns: Sequence[Column]
    sizes: Sequence[float] = ()  # of each command's changes
    mid: Sequence[float] = ()  # around which each changes
    dt: float = 0.01  # s, from row to row
    steps: int = 800  # rows
    delay: int = 0  # samples, of the commands
    clock: tuple[str, str] = ("time", "s")
    stiff: float = 1.0  # how many times the model's the gains of actuators are
    dry: Sequence[float] = ()  # friction of each joint
    start: Sequence[float] = ()  # positions
    way: str = "waves"  # or steps
    pace: float = 1.0  # of the commands
    hold: Sequence[float] = ()  # gains of a controller that moves each joint to its command and logs its force
    off: tuple[float, float] = (2.0, 2.0)  # shares of the log between which drives have no force
    told: Mapping[str, str] = field(default_factory=dict)  # columns with a word that stands beside them in what is open


def of(
    names: str, kinds: str, joints: str, unit: str = "rad", signs: str = "",
    noise: float = 0.0, step: float = 0.0, counts: float = 1.0, zero: float = 0.0,
) -> tuple[Column, ...]:  # fmt: skip
    """Columns of joints; in names {i} counts them from 1, {k} from 0, {j} is the joint. A rate commands a velocity."""
    out = []
    kinds_of = zip(names.split(), kinds.split(), strict=True)
    for (name, kind), (k, joint) in itertools.product(kinds_of, enumerate(joints.split())):
        driven = kind in ("command", "rate")
        target = f"actuator:{joint}" if driven else f"joint:{joint}.{kind}"
        fast, noisy = kind in ("velocity", "rate"), noise * (30 if kind == "velocity" else not driven)
        own = name.format(i=k + 1, k=k, j=joint), target, unit + "/s" * fast, -1 if signs[k : k + 1] == "-" else 1
        out.append(Column(*own, zero, counts, noisy, 0.0 if fast else step))
    return tuple(out)


def true_machine(plant: Plant, rng: np.random.Generator) -> mujoco.MjModel:
    """What the log is of: other masses, friction and gains."""
    out = mujoco.MjModel.from_xml_string(plant.xml)
    sizes = rng.uniform(1.1, 1.4, out.nbody) ** rng.choice([-1, 1], out.nbody)
    out.body_mass *= sizes
    out.body_inertia *= sizes[:, None]
    out.dof_damping *= rng.uniform(0.7, 1.4, out.nv)
    out.dof_frictionloss[: len(plant.dry)] = plant.dry
    times = plant.stiff * rng.uniform(0.85, 1.15, out.nu)
    out.actuator_gainprm[:, 0] *= times
    out.actuator_biasprm[:, 1] *= times
    out.actuator_biasprm[:, 2] *= np.where(out.actuator_biasprm[:, 1] == 0, times, np.sqrt(times))
    out.opt.timestep = plant.dt / np.ceil(plant.dt / out.opt.timestep - 1e-9)
    mujoco.mj_setConst(out, mujoco.MjData(out))
    return out


def wanted(plant: Plant, rng: np.random.Generator) -> FloatArray:
    """Commands (n, A): sums of waves, or ramps from pose to pose with rests between."""
    time, count = plant.dt * np.arange(plant.steps), len(plant.sizes)
    if plant.way == "waves":
        rates, phases = plant.pace * rng.uniform(0.15, 1.2, (4, count)), rng.uniform(0, 6, (4, count))
        out = 0.5 * np.sin(2 * np.pi * rates * time[:, None, None] + phases).sum(1)
    else:
        knots = np.arange(0, time[-1] + 2, 0.35 / plant.pace)
        poses = np.repeat(rng.uniform(-1, 1, (len(knots) // 2 + 1, count)), 2, axis=0)[: len(knots)]
        out = np.stack([np.interp(time, knots, own) for own in poses.T], axis=1)
    return out * np.array(plant.sizes) + (np.array(plant.mid) if len(plant.mid) else 0.0)


def _held(machine: mujoco.MjModel, data: mujoco.MjData, goal: FloatArray, hold: Sequence[float]) -> FloatArray:
    """Forces of a controller that moves joints to a goal; of a body that flies, thrusts that keep it level."""
    if machine.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
        at, dof = (x[machine.actuator_trnid[:, 0]] for x in (machine.jnt_qposadr, machine.jnt_dofadr))
        return np.asarray(np.array(hold) * (goal - data.qpos[at] - 0.12 * data.qvel[dof]))
    up, places = np.zeros(3), machine.site_pos[machine.actuator_trnid[:, 0]]
    mujoco.mju_rotVecQuat(up, np.array([0.0, 0.0, 1.0]), data.qpos[3:7] * [1, -1, -1, -1])
    goal = goal + hold[0] + 0.1 * (1 - data.qpos[2] - data.qvel[2])
    about_x, about_y = -0.5 * up[1] - 0.12 * data.qvel[3], 0.5 * up[0] - 0.12 * data.qvel[4]
    return np.clip(goal + about_x * places[:, 1] - about_y * places[:, 0], 0, 1)


def simulated(plant: Plant, rng: np.random.Generator) -> dict[str, FloatArray]:
    """What happens, (n, k) by target."""
    machine = true_machine(plant, rng)
    sent, out, data = wanted(plant, rng), dict[str, list[FloatArray]](), mujoco.MjData(machine)
    gains, biases = machine.actuator_gainprm.copy(), machine.actuator_biasprm.copy()
    data.qpos[: len(plant.start)] = plant.start
    for k in range(plant.steps):
        on = not plant.off[0] <= k / plant.steps < plant.off[1]
        machine.actuator_gainprm[:], machine.actuator_biasprm[:] = gains * on, biases * on
        sent[k] = _held(machine, data, sent[k], plant.hold) if len(plant.hold) else sent[k]
        data.ctrl[:] = sent[max(0, k - plant.delay)]
        mujoco.mj_forward(machine, data)
        row = {f"actuator:{machine.actuator(a).name}": sent[k, a] for a in range(machine.nu)} | {"on": on, "none": 0}
        for j in range(machine.njnt):
            name, dof = f"joint:{machine.joint(j).name}.", machine.jnt_dofadr[j]
            row |= {f"{name}position": data.qpos[machine.jnt_qposadr[j]], f"{name}velocity": data.qvel[dof]}
            row |= {f"{name}force": data.qfrc_actuator[dof], f"{name}size": abs(data.qfrc_actuator[dof])}
        row |= {"body:drone.position": data.xpos[-1], "body:drone.orientation": data.xquat[-1]}
        row |= {f"sensor:{machine.sensor(s).name}": data.sensor(s).data for s in range(machine.nsensor)}
        for target, value in row.items():
            out.setdefault(target, []).append(np.array(value, float))
        mujoco.mj_step(machine, data, round(plant.dt / machine.opt.timestep))
    return {target: np.reshape(values, (plant.steps, -1)) for target, values in out.items()}


def written(folder: Path, name: str, plant: Plant) -> None:
    """Write ``model.xml`` and ``log.csv``, its columns in any order."""
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    seen, table, time = simulated(plant, rng), dict[str, object](), plant.dt * np.arange(plant.steps)
    for column in plant.columns:
        values = np.sum([seen[source] for source in (column.source or column.target).split(" + ")], axis=0)
        values += column.noise * rng.standard_normal(values.shape)
        values = column.sign * values / find_unit(column.unit or "1").factor * column.counts + column.zero
        values = np.round(values / column.step) * column.step if column.step else values
        table |= dict(zip(column.name.split(), values.T, strict=True))
    word, unit = plant.clock
    known = {"s": time, "iso": pd.to_datetime(1.7e9 + time, unit="s").strftime("%FT%H:%M:%S.%fZ")}
    begin = 1.7e18 if unit == "ns" else 12e3
    table[word] = known[unit] if unit in known else np.round(time / find_unit(unit).factor + begin).astype(np.int64)
    (folder / "model.xml").write_text(plant.xml)
    order = rng.permutation(list(table)).tolist()
    pd.DataFrame({n: table[n] for n in order}).to_csv(folder / "log.csv", index=False, float_format="%.7g")


def asks(draft: Draft, column: str, *words: str) -> bool:
    """Whether something open, or an alternative beside it, names a column and one of some words."""
    own = [r for r in draft.readings if column in r.match.columns and r.doubts]
    lines = [*draft.open_doubts, *(f"{column!r} {line}" for r in own for line in r.instead)]
    return any(repr(column) in line and any(word in line for word in words) for line in lines)


def turned_together(draft: Draft, truths: Sequence[Column], wrong: set[str]) -> bool:
    """Whether the signs that are wrong are those of columns that are named as flipped together, or alone."""
    parts = [part for d in draft.open_doubts if "flipped together" in d for part in d.split(";")]
    groups = [{t.name for t in truths if repr(t.name) in part} for part in parts]
    groups += [{t.name} for t in truths if asks(draft, t.name, f"sign = {t.sign}", "its sign does not show")]
    turned = [set[str]()]
    for group in groups[:12]:
        turned += [one ^ group for one in turned]
    return wrong in turned


def misread(draft: Draft, truth: Column) -> list[tuple[str, bool]]:
    """What is other than it is of one column, but for signs, and whether it is asked."""
    t, out = truth, []
    reading = next((r for r in draft.readings if r.match.target == t.target), None)
    if reading is None or {*reading.match.columns} != {*t.name.split()}:
        asked = asks(draft, t.name.split()[0], re.split("[:.]", t.target)[1])
        return [(f"{t.target} is {t.name}, not {reading and reading.match.column}", asked)]
    size = find_unit(t.unit or "1").factor / t.counts
    if t.unit and abs(np.log(find_unit(reading.unit).factor * reading.factor / size)) > 0.02:
        counts = (f"or {t.counts:g}", f", {t.counts:g}") if t.counts != 1 else (f'unit = "{t.unit}"', f" in {t.unit}")
        asked = asks(draft, t.name, *counts)
        out.append((f"{t.name} is {t.unit} of {t.counts:g}, not {reading.scale}", asked))
    if t.unit and abs(reading.zero - t.zero) * size > max(0.09, 1.5 * reading.unsure):
        out.append((f"{t.name} has zero {t.zero:g}, not {reading.zero:g}", asks(draft, t.name, "zero")))
    return out


def model(bodies: str, actuators: str = "", more: str = "", step: float = 0.002) -> str:
    """MJCF of bodies and actuators without contacts; more: tendons, sensors."""
    option = f'<option timestep="{step}" integrator="implicitfast"><flag contact="disable"/></option>'
    world = f'<compiler angle="radian"/>{option}<worldbody>{bodies}</worldbody>'
    return f"<mujoco>{world}<actuator>{actuators}</actuator>{more}</mujoco>"


def chain(parts: str, inner: str = "") -> str:
    """Bodies in a row, each: joint, axis, end of the link (none: a box on a slide), mass, what else its joint has."""
    out, rows = inner, [(*part.split(" ", 4), 'damping=".05"')[:5] for part in parts.split("; ")]
    ends = [None, *("0 0 0" if end == "none" else end.replace(",", " ") for _, _, end, *_ in rows)]
    for (joint, axis, end, mass, rest), at, to in reversed([*zip(rows, ends[:-1], ends[1:], strict=True)]):
        along, box = " ".join(str(int(axis == one)) for one in "xyz"), end == "none"
        shape = 'type="box" size=".05 .05 .05"' if box else f'type="capsule" fromto="0 0 0 {to}" size=".015"'
        turn = f'<joint name="{joint}" type="{"slide" if box else "hinge"}" axis="{along}" {rest}/>'
        out = f'<body name="{joint}_link" pos="{at or "0 0 0"}">{turn}<geom {shape} mass="{mass}"/>{out}</body>'
    return out


def drives(kind: str, joints: str, rest: str = "") -> str:
    """Actuators that are alike, each called as its joint; rest: of their tags."""
    return "".join(f'<{kind} name="{joint}" joint="{joint}" {rest}/>' for joint in joints.split())


SE, LEGS, SIX, POSE = "shoulder elbow", "coxa femur tibia", "A1 A2 A3 A4 A5 A6", "position command"
PAIR, SO = "shoulder y .25,0,0 .8; elbow y .2,0,0 .5", "shoulder_pan shoulder_lift elbow_flex wrist_flex wrist_roll"
ARM, ROS, DAMPED = chain(PAIR), chain(f"base z 0,0,.1 1; {PAIR}"), 'damping=".01"'
LEG = chain(f"coxa z .05,0,0 .1 {DAMPED}; femur y .08,0,0 .1 {DAMPED}; tibia y 0,0,-.12 .08 {DAMPED}")
KUKA = chain("A1 z 0,0,.3 8; A2 y 0,0,.4 6; A3 y .2,0,0 4; A4 x .2,0,0 2; A5 y .1,0,.05 1; A6 x .05,.06,0 .8")
LOWER = "shoulder_pan z 0,0,.06 .15; shoulder_lift y .11,0,0 .12; elbow_flex y .13,0,0 .1; wrist_flex y .06,0,0 .08"
SO101 = chain(LOWER + '; wrist_roll x .05,.03,0 .05; gripper z .07,0,0 .03 damping=".05" range="-.17 1.75"')
ROTORS = (("0", ".12 -.12", ".05"), ("1", "-.12 .12", ".05"), ("2", ".12 .12", "-.05"), ("3", "-.12 -.12", "-.05"))
SITES = "".join(f'<site name="m{k}" pos="{at} 0"/>' for k, at, _ in ROTORS)
THRUSTS = "".join(f'<motor name="m{k}" site="m{k}" gear="0 0 5 0 0 {t}" ctrlrange="0 1"/>' for k, _, t in ROTORS)
FRAME = f'<body name="drone"><freejoint/><geom type="box" size=".1 .1 .03" mass=".8"/>{SITES}</body>'
POS, PV, PVC, C, ODOM = "position", "position velocity", "position velocity command", "command", "vehicle_odometry."
MACHINES: dict[str, Plant] = {
    "lerobot_six": Plant(model(SO101, drives(POS, f"{SO} gripper", 'kp="2" kv=".15"')), (*of(
      "observation.state.{j}.pos action.{j}.pos", POSE, SO, "deg", step=0.044), *of(
      "observation.state.{j}.pos action.{j}.pos", POSE, "gripper", counts=100 / 1.92, zero=8.854, step=0.1)), (0.8, 0.6,
      0.6, 0.6, 0.8, 0.7), (0, -0.5, 0.6, 0.3, 0, 0.75), 1 / 30, 700, 2, ("timestamp", "s"), 4, (0.04, 0.04, 0.04, 0.03,
      0.02, 0.01), (0, -0.5, 0.6, 0.3, 0, 0.75), "steps"),
    "dynamixel_ticks": Plant(model(ARM.replace("<joint", '<joint range="-1.7 1.7"'), drives(POS, SE, 'kp="3" kv=".4"')),
      of("present_position_{i} goal_position_{i}", POSE, SE, "rev", counts=4096, zero=2048, step=1), (0.7, 0.9), (0,
      0.3), 0.02, 700, 2, ("t_ms", "ms"), 10, (0.15, 0.08), (0, 0.3), "steps"),
    "ros_three": Plant(model(ROS, drives(POS, f"base {SE}", 'kp="400" kv="8"')), (*of(
      "/joint_states.position[{k}] /joint_states.velocity[{k}] /command.data[{k}]", PVC, f"base {SE}", noise=3e-4), *of(
      "/joint_states.effort[{k}]", "force", f"base {SE}", "N m", noise=0.03)), (0.9, 0.6, 0.8), (0, 0.2, 0), 0.01, 900,
      1, ("__time", "s"), 0.1, (0.2, 0.2, 0.1)),
    "isaac_leg": Plant(model(LEG, drives(POS, LEGS, 'kp="25" kv=".5"')), of(
      "joint_pos_{k} joint_vel_{k} joint_pos_target_{k}", PVC, LEGS, noise=1e-3), (0.5, 0.5, 0.6), (0, 0.2, 0.1), 0.02,
      600, 1, stiff=0.15, dry=(0.01,) * 3, pace=1.5),
    "simulink_degrees": Plant(model(chain("axis y 0,0,-.25 .6"), drives(POS, "axis", 'kp="2" kv=".2"')), (Column(
      "q_ref", "actuator:axis", "deg"), Column("q_meas", "joint:axis.position", noise=2e-4)), (1.2,), (), 0.002, 3000,
      3, ("Time", "s"), 6, (0.05,)),
    "kran_wagen": Plant(model(chain('wagen x none 2 damping="1"; pendel y 0,0,-.5 .4 damping=".004"'), drives("motor",
      "wagen")), (*of("weg_mm", "position", "wagen", "mm", "-", noise=1e-4, step=0.1), *of("winkel", "position",
      "pendel", "deg", noise=1e-3, step=0.1), *of("kraft_N", C, "wagen", "N", "-")), (8,), (), 0.01, 900, 1, ("zeit_ms",
      "ms"), dry=(0.4,)),
    "cart_pole": Plant(model(chain('slider x none 1 damping="1"; hinge y 0,0,-.6 .2 damping=".003"'), drives("motor",
      "slider", 'gear="2"')), (*of("x x_dot", PV, "slider", "m", noise=3e-4), Column("action", "actuator:slider", ""),
      *of("theta theta_dot", PV, "hinge", signs="-", noise=1e-3)), (4,), (), 0.02, 600, 1),
    "absolute_angles": Plant(model(chain('upper y 0,0,-.25 .4 damping=".001"; lower y 0,0,-.25 .3 damping=".001"')), (
      Column("theta1", "joint:upper.position", noise=1e-3), Column("theta2", "", noise=1e-3,
      source="joint:upper.position + joint:lower.position")), steps=700, start=(1.2, 0.4), told={"theta2":
      "against the world"}),
    "acrobot": Plant(model(chain('upper y 0,0,-.25 .5 damping=".01"; lower y 0,0,-.25 .4 damping=".01"'), drives(
      "motor", "lower")), (*of("q{i} dq{i}", PV, "upper lower", "deg", "-+", noise=1e-3, step=0.088), *of("tau", C,
      "lower", "N m", "-")), (0.7,), (), 0.005, 1500, 2, ("t_us", "us"), pace=1.4),
    "scara": Plant(model(chain('j1 z .25,0,0 4 damping="2"; j2 z .2,0,0 2.5 damping="1"; z z none 1 damping="20"'),
      drives(POS, "j1 j2", 'kp="200" kv="15"') + drives(POS, "z", 'kp="2000" kv="100"')), (*of("{j}_deg {j}_soll_deg",
      POSE, "j1 j2", "deg", "+-", step=0.01), *of("z_mm z_soll_mm", POSE, "z", "mm")), (0.9, 1.0, 0.05), (), 0.008, 900,
      2, ("t_ms", "ms"), 3, (1, 0.6, 2), pace=1.5),
    "encoder_1khz": Plant(model(chain('axis y 0,0,-.25 .7 damping=".01"'), drives("motor", "axis"), step=0.001), (*of(
      "enc", "position", "axis", "rev", "-", counts=2000, step=1), *of("trq_mNm", C, "axis", "mN m", step=1)), (0.6,), (
      ), 0.001, 6000, 4, ("tick_us", "us"), dry=(0.02,)),
    "gripper_share": Plant(model(chain('jaw x none .2 damping="4" range="0 .08"'), drives(POS, "jaw",
      'kp="100" kv="3"')), of("gripper_position gripper_command", POSE, "jaw", "m", counts=100 / 0.08, step=0.1), (
      0.036,), (0.04,), 0.02, 700, 3, ("timestamp", "s"), 5, (0.5,), (0.04,), "steps"),
    "tendon_finger": Plant(model(chain(
      'mcp y .05,0,0 .03 damping=".001" stiffness=".08"; pip y .03,0,0 .02 damping="8e-4" stiffness=".06"'),
      '<motor name="flexor" tendon="cord"/>', '<tendon><fixed name="cord"><joint joint="mcp" coef=".01"/>'
      '<joint joint="pip" coef=".007"/></fixed></tendon>'), (*of("{j}_angle_deg", "position", "mcp pip", "deg",
      step=0.05), *of("flexor_N", C, "flexor", "N")), (4,), (5,), 0.005, 1500, 1, ("t", "s"), start=(0.5, 0.5), pace=2),
    "quadrotor_px4": Plant(model(FRAME, THRUSTS), (Column(" ".join(f"{ODOM}position[{k}]" for k in range(3)),
      "body:drone.position", "m", noise=1e-3), Column(" ".join(f"{ODOM}q[{k}]" for k in range(4)),
      "body:drone.orientation", "", noise=5e-4), *of("actuator_outputs[{k}]", C, "m0 m1 m2 m3", "1", zero=1000,
      counts=1000, step=1)), (0.03,) * 4, (), 0.01, 600, 2, ("timestamp", "us"), pace=3, start=(0, 0, 1), hold=(0.4,)),
    "rc_wheel": Plant(model(chain('wheel y .001,0,0 .4 damping=".002" armature=".001"'), drives("dcmotor", "wheel",
      'resistance=".8" motorconst=".05"')), (*of("wheel_angle_rad", "position", "wheel", noise=1e-3), *of("duty", C,
      "wheel", "", step=0.01), Column("battery_V", "", "V", zero=7.6, noise=0.02, source="none")), (0.5,), (), 0.01,
      900, 2, ("t_ms", "ms"), dry=(0.01,)),
    "volt_pendulum": Plant(model(chain('arm y 0,0,-.25 .15 damping=".002"'), drives("dcmotor", "arm",
      'resistance="2" motorconst=".12"')), (*of("angle", "position", "arm", "deg", "-", step=0.1), *of("u_mV", C, "arm",
      "mV", step=10)), (9,), (), 0.01, 800, 1, ("time_ms", "ms"), dry=(0.01,)),
    "current_arm": Plant(model(chain("elbow y .25,0,0 .5"), drives("motor", "elbow", 'gear="1.9"')), (*of(PV, PV,
      "elbow", noise=3e-4), *of("current_mA", C, "elbow", "mA", "-", step=1)), (0.8,), (), 0.005, 1400, 2, ("stamp_ns",
      "ns"), dry=(0.06,), hold=(4,)),
    "hexapod_goals": Plant(model(LEG, drives(POS, LEGS, 'kp="1.5" kv=".02"')), of("{j}_deg {j}_goal_deg", POSE, LEGS,
      "deg", "++-", step=0.29), (0.5, 0.5, 0.6), (0, 0.2, 0.1), 0.02, 700, 2, ("millis", "ms"), 4, (0.02,) * 3,
      way="steps"),
    "gimbal_gyro": Plant(model(chain("pan z 0,0,.1 .4; tilt y .1,0,0 .3", inner='<site name="imu" pos=".1 0 0"/>'),
      drives("velocity", "pan tilt", 'kv=".5"'), '<sensor><gyro name="gyro" site="imu"/></sensor>'), (*of(
      "{j}_angle {j}_rate_cmd_dps", "position rate", "pan tilt", "deg", "-+", step=0.02), Column("gyro_x gyro_y gyro_z",
      "sensor:gyro", "deg/s", noise=0.01)), (1.2, 1), (), 0.005, 1600, 3, ("time_us", "us"), 4, (0.02, 0.02)),
    "elevator": Plant(model(chain('lift z none 12 damping="30"'), drives("motor", "lift")), (*of(
      "height_mm lift_velocity_mm_s", PV, "lift", "mm", noise=3e-4, step=0.1), *of("force", C, "lift", "N", step=0.1)),
      (0.3,), (0.5,), 0.01, 900, 2, dry=(5,), start=(0.5,), hold=(2500,)),
    "turned_pair": Plant(model(ARM, drives(POS, SE, 'kp="150" kv="3"')), of("position[{i}] goal[{i}]", POSE, SE, "rad",
      "-+", noise=1e-3), (0.6, 0.8), (0.2, 0), 0.02, 800, 3, ("timestamp", "ns"), 0.12, (0.2, 0.1), pace=1.2),
    "slipped_encoder": Plant(model(ARM, drives(POS, SE, 'kp="25" kv="2"')), (*of("{j}_pos", POS, "shoulder", noise=5e-4,
      zero=0.7), *of("{j}_pos", POS, "elbow", noise=5e-4), *of("{j}_goal", C, SE)), (0.8, 0.8)),
    "mrad_arm": Plant(model(ARM, drives("motor", SE)), (*of("q{i}_mrad", "position", SE, "mrad", "+-", step=1), *of(
      "tau{i}", C, SE, "N m", "--", step=0.001)), (0.8, 0.9), (), 0.004, 1500, 3, dry=(0.1, 0.05), hold=(8, 1.2)),
    "odrive_turns": Plant(model(chain("hinge y .2,0,0 .4"), drives(POS, "hinge", 'kp="1" kv=".2"')), of(
      "axis0.pos_estimate axis0.vel_estimate axis0.input_pos", PVC, "hinge", "rev", noise=3e-3), (1.3,), (), 0.005,
      1500, 2, stiff=12, dry=(0.05,), pace=1.5),
    "encoder_quarter": Plant(model(chain('pivot y 0,0,-.4 .6 damping=".02"'), drives("motor", "pivot")), (*of(
      "winkel_grad", "position", "pivot", "deg", zero=90, step=0.1), *of("moment_Nm", C, "pivot", "N m")), (1.8,), (),
      0.01, 900, 1, ("zeit_s", "s"), dry=(0.02,)),
    "torque_off": Plant(model(ARM, drives(POS, SE, 'kp="5" kv="1"')), (*of("{j}_pos {j}_target", POSE, SE, noise=5e-4),
      Column("torque_enable", "", "", source="on"), *(Column(f"{j}_current_mA", "", "1", counts=700, step=1,
      source=f"joint:{j}.size") for j in SE.split())), (0.7, 0.9), (), 0.02, 900, 1, stiff=8, dry=(0.1, 0.05), off=(
      0.55, 0.75), told={"shoulder_current_mA": "size", "torque_enable": "off"}),
    "effort_millis": Plant(model(chain("shoulder y .25,0,0 .3; wrist x .1,.06,0 .2"), drives(POS, "shoulder wrist",
      'kp="60" kv=".6"')), (*of("{j}_position {j}_setpoint", POSE, "shoulder wrist", "deg", "+-", step=0.02), *of(
      "{j}_effort", "force", "shoulder wrist", "mN m", "+-", noise=0.01)), (0.6, 1), (0.1, 0), 0.01, 900, 2, ("t_ms",
      "ms"), 0.15, (0.08, 0.03), pace=1.3),
    "base_wheels": Plant(model("".join(chain(f'{s}_wheel y .001,0,0 1.5 damping=".05" armature=".01"') for s in ("left",
      "right")), drives("velocity", "left_wheel right_wheel", 'kv=".2"')), of("{j}_pos {j}_vel {j}_cmd_vel",
      "position velocity rate", "left_wheel right_wheel", noise=1e-3), (6, 6), (), 0.02, 800, 3, ("stamp", "iso"), 4, (
      0.1, 0.1), way="steps"),
    "kuka_six": Plant(model(KUKA, drives(POS, SIX, 'kp="300" kv="30"')), of("axis_act_a{i} axis_cmd_a{i}", POSE, SIX,
      "deg", step=0.001), (0.6, 0.4, 0.5, 0.8, 0.7, 1), (0, 0.2, 0.2, 0, 0.3, 0), 0.012, 900, 2, ("t_ms", "ms"), 8, (2,
      2, 1.5, 0.5, 0.3, 0.2)),
}  # fmt: skip
