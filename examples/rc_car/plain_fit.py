"""A plain least-squares fit of the RC car, to compare ``sipe calibrate`` with.

    python examples/rc_car/plain_fit.py [--friction] [--out plain.json]

Each training log runs free from its first sample; SciPy's least_squares fits gain, lag and damping, with ``--friction``
also dry friction and a dead zone. There is no noise model and there are no intervals. Names, units and bounds are
those of ``calibrate.toml`` and ``calibrate_friction.toml``.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.signal import lfilter

FOLDER = Path(__file__).parent
TRAIN = "14_49_09", "14_50_29", "14_53_41", "14_57_14"
HELD_OUT = "14_51_42", "14_48_24"
LOGARITHMIC = {"gain": (1, 100), "lag": (0.004, 0.5), "damping": (0.05, 20)}
LINEAR = {"friction": (0, 5), "dead_zone": (0, 5)}
BOUNDS = {**{name: (np.log(low), np.log(high)) for name, (low, high) in LOGARITHMIC.items()}, **LINEAR}
NOMINAL = {"gain": 25.0, "lag": 0.08, "damping": 1.0}
FRICTION = {"friction": 0.3, "dead_zone": 0.3}
CONTROLS = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
Floats = NDArray[np.float64]


class Log(NamedTuple):
    """Times (T,) in s from 0, throttle (T,), velocity (T,) in m/s."""

    time: Floats
    throttle: Floats
    velocity: Floats


def load_model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(FOLDER / "car.xml"))


def load_log(name: str) -> Log:
    table = np.genfromtxt(FOLDER / "logs" / f"{name}.csv", delimiter=",", skip_header=1)
    return Log(table[:, 0] - table[0, 0], table[:, 8], table[:, 6])


def simulate(model: mujoco.MjModel, values: Mapping[str, float], log: Log) -> Floats:
    """Velocity (T,) at the log's samples, from its first on; ``model`` is written to."""
    step = model.opt.timestep
    model.actuator_gainprm[0, 0], model.actuator_dynprm[0, 0] = values["gain"], values["lag"]
    model.dof_damping.flat[0], model.dof_frictionloss[0] = values["damping"], values.get("friction", 0.0)
    times = np.arange(int(log.time[-1] / step) + 1) * step
    throttle = log.throttle[np.searchsorted(log.time, times + step / 2, side="right") - 1]
    decay = np.exp(-step / values["lag"])  # the activation as MuJoCo integrates it, from 0
    force = values["gain"] * lfilter([0.0, 1 - decay], [1.0, -decay], throttle)
    dead_zone = values.get("dead_zone", 0.0)
    controls = np.stack([throttle, -np.clip(force, -dead_zone, dead_zone)], axis=1)
    start = np.zeros((1, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    start[0, 2] = log.velocity[0]
    states, _ = rollout.rollout([model], [mujoco.MjData(model)], start, controls[None], control_spec=CONTROLS)
    return np.interp(log.time, np.r_[0.0, states[0, :, 0]], np.r_[log.velocity[0], states[0, :, 2]])


def pack(values: Mapping[str, float]) -> Floats:
    return np.array([np.log(value) if name in LOGARITHMIC else value for name, value in values.items()])


def unpack(x: Floats, names: Mapping[str, float]) -> dict[str, float]:
    return {k: float(np.exp(v) if k in LOGARITHMIC else v) for k, v in zip(names, x, strict=True)}


def fit(model: mujoco.MjModel, start: Mapping[str, float]) -> dict[str, float]:
    logs = [load_log(name) for name in TRAIN]

    def residuals(x: Floats) -> Floats:
        return np.concatenate([simulate(model, unpack(x, start), log) - log.velocity for log in logs])

    low, high = zip(*(BOUNDS[name] for name in start), strict=True)
    found = least_squares(residuals, pack(start), bounds=(low, high), diff_step=1e-3, x_scale="jac")
    return unpack(found.x, start)


def held_out_errors(values: Mapping[str, float]) -> dict[str, float]:
    """RMSE of the velocity in m/s by log, over whole logs."""
    model = load_model()
    logs = {name: load_log(name) for name in HELD_OUT}
    return {n: float(np.sqrt(np.square(simulate(model, values, g) - g.velocity).mean())) for n, g in logs.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--friction", action="store_true", help="also dry friction and a dead zone")
    parser.add_argument("--out", type=Path, help="JSON file for values and errors")
    given, begin = parser.parse_args(), time.perf_counter()
    values = fit(load_model(), {**NOMINAL, **(FRICTION if given.friction else {})})
    used = {"wall_s": time.perf_counter() - begin, "cpu_s": time.process_time()}
    print(", ".join(f"{name} {value:.4g}" for name, value in values.items()), f"({used['cpu_s']:.0f} CPU s)")
    errors = held_out_errors(values)
    print(", ".join(f"{name}: RMSE {error:.3f} m/s" for name, error in errors.items()))
    if given.out is not None:
        given.out.write_text(json.dumps({"values": values, "errors": errors, **used}, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
