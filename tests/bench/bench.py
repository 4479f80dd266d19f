"""`make bench`: tables of ratios.

Whatever stands in one row was run in one process, the two sides in turn (first the one, then the other first), seven
pairs unless told otherwise; a row gives the medians and the median of the pairs' ratios.

Seconds depend on the machine and on what else it does; ratios should not.
"""

from __future__ import annotations

import argparse
import cProfile
import importlib.metadata
import os
import platform
import pstats
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))  # where this is run as a command
import arm
import batch
import ddpg
import envs
import everyday
import fits
import init
import laws
import mujoco
import mujoco.rollout
import numpy as np
import searches
import shapes
import transfer

from sipe_bayes.calibration.problem import prepare
from sipe_bayes.inference import get_estimator
from sipe_bayes.likelihood import Segments
from sipe_bayes.simulation.simulator import Simulator
from tests.problems import sysid

PENDULUM = Path(__file__).parents[2] / "examples" / "simple_pendulum" / "calibrate.toml"
NUM_ENVS, STEPS = 64, 200
PENDULUM_XML = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body><joint name="a" axis="0 1 0"
damping="0.1"/><geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="1"/></body></worldbody>
<actuator><motor name="a" joint="a"/></actuator></mujoco>
"""
TWO_LINKS_XML = """
<mujoco><option timestep="0.002" integrator="implicitfast"><flag contact="disable"/></option><worldbody><body>
<joint name="a" axis="0 1 0" damping="0.1"/><geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="1"/>
<body pos="0 0 -0.5"><joint name="b" axis="0 1 0" damping="0.1"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.6"/></body></body></worldbody>
<actuator><motor name="a" joint="a"/><motor name="b" joint="b"/></actuator></mujoco>
"""
Seconds = tuple[float, float, float]


def seconds(work: Callable[[], Any]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def side_by_side(ours: Callable[[int], float], other: Callable[[int], float], pairs: int) -> Seconds:
    """Median seconds of each and the median of the pairs' ratios, after one warm-up of each.

    Both are given the number of the pair and return seconds.
    """
    ours(0), other(0)
    times = []
    for k in range(pairs):
        first, second = (ours, other) if k % 2 == 0 else (other, ours)
        a, b = first(k), second(k)
        times.append((a, b) if k % 2 == 0 else (b, a))
    mine, theirs = zip(*times, strict=True)
    return statistics.median(mine), statistics.median(theirs), statistics.median(a / b for a, b in times)


def engine(pairs: int) -> None:
    print(f"\nEngine: Simulator.rollout against mujoco.rollout, {NUM_ENVS} simulations x {STEPS} control steps")
    print("mujoco.rollout: models written beforehand, controls repeated beforehand, states alone read")
    print(f"{'model':<12}{'substeps':>9}{'ours ms':>10}{'bare ms':>10}{'ratio':>8}{'M steps/s':>11}")
    for name, xml, joints in (("pendulum", PENDULUM_XML, "a"), ("two links", TWO_LINKS_XML, "ab")):
        for substeps in (1, 5):
            mine, bare, ratio = _engine_row(xml, joints, substeps, pairs)
            rate = NUM_ENVS * STEPS * substeps / mine / 1e6
            print(f"{name:<12}{substeps:>9}{1e3 * mine:>10.2f}{1e3 * bare:>10.2f}{ratio:>8.2f}{rate:>11.2f}")


def _engine_row(xml: str, joints: str, substeps: int, pairs: int) -> Seconds:
    from sipe_bayes.core.parameters import Parameter
    from sipe_bayes.envs.mjcf import MjcfEnvironment

    parameters = [Parameter(f"damping_{j}", 0.01, 1.0, targets=(f"joint:{j}.damping",)) for j in joints]
    simulator = Simulator(MjcfEnvironment.build(xml, parameters, list(joints), [f"joint:{j}.position" for j in joints]))
    rng = np.random.default_rng(0)
    theta = rng.random((NUM_ENVS, len(joints)))
    actions = rng.standard_normal((NUM_ENVS, STEPS, len(joints)))
    start = np.tile(simulator.default_state(), (NUM_ENVS, 1))
    dt = substeps * simulator.model.opt.timestep
    models = []
    for row in theta:
        model = mujoco.MjModel.from_xml_string(xml)
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART
        model.dof_damping[:] = simulator.space.values(row)
        models.append(model)
    datas = [mujoco.MjData(models[0]) for _ in range(simulator.num_threads)]
    controls = np.repeat(actions, substeps, axis=1)

    def bare() -> Any:
        return mujoco.rollout.rollout(models, datas, initial_state=start, control=controls, persistent_pool=True)[0]

    def ours() -> Any:
        return simulator.rollout(theta, actions, start, dt)

    np.testing.assert_array_equal(ours().states[:, 1:], bare()[:, substeps - 1 :: substeps])
    return side_by_side(lambda _: seconds(ours), lambda _: seconds(bare), 3 * pairs)


def rival(pairs: int) -> None:
    print(
        "\nlaplace against mujoco.sysid: the arm of sysid's own test, five armatures from 0.01 kg m^2, bounds 0.001 "
        "and 1,"
    )
    print(
        "2 s at 500 Hz, ten channels with white noise of 1 % of their rms, another log for every pair. sysid: optimize "
        "with"
    )
    print(
        "its default 'mujoco', start state given, white noise. laplace: fit; start states and noise estimated with "
        "theta."
    )
    simulator, single = arm.arm_simulator(), {"restarts": 1, "candidates": 0}
    white = Segments(window=None, noise="white")
    settings: dict[str, tuple[Segments, dict[str, Any]]] = {
        "default: windows 0.5 s, ar1, 2 starts": (Segments(), {}),
        "windows 0.5 s, ar1, 1 start": (Segments(), single),
        "one window, white, 2 starts": (white, {}),
        "one window, white, 1 start": (white, single),
    }
    logs = [arm.arm_log(seed) for seed in range(pairs)]
    print(f"{'laplace settings':<40}{'ours s':>8}{'sysid s':>9}{'ratio':>7}{'rollouts':>10}")
    found: dict[str, dict[int, arm.Estimate]] = {"mujoco.sysid": {}}
    for name, (likelihood, more) in settings.items():
        mine = found.setdefault(name, {})

        def ours(k: int, likelihood: Segments = likelihood, more: Any = more, mine: Any = mine) -> float:
            mine[k] = arm.ours(simulator, logs[k], likelihood, **more)
            return float(mine[k].seconds)

        def other(k: int) -> float:
            found["mujoco.sysid"][k] = arm.rival(logs[k])
            return found["mujoco.sysid"][k].seconds

        a, b, ratio = side_by_side(ours, other, pairs)
        rollouts = round(statistics.median(e.rollouts for e in mine.values()))
        print(f"{name:<40}{a:>8.2f}{b:>9.2f}{ratio:>7.2f}{rollouts:>10}")
    print(f"\n{'95 % intervals, g m^2':<40}{'mean |error|':>14}{'mean half-width':>17}{'truths inside':>15}")
    for name, estimates in found.items():
        error = 1e3 * np.mean([e.error for e in estimates.values()])
        half = 1e3 * np.mean([e.half for e in estimates.values()])
        inside = sum(e.inside for e in estimates.values())
        print(f"{name:<40}{error:>14.3f}{half:>17.3f}{inside:>9} of {5 * len(estimates)}")


def starts() -> None:
    """What mujoco.sysid answers on a cart of which only gear / mass shows, from three starts."""
    print("\nmujoco.sysid on a cart of which only gear / mass shows, little noise, from three starts; laplace")
    print("names the ridge (tests/inference/test_rival.py)")
    print(
        f"{'start: gear, mass':<24}{'answer: gear, mass':>22}{'gear / mass':>14}   (truth {sysid.GEAR / sysid.MASS:g})"
    )
    for gear, mass in sysid.CART_STARTS:
        xml = sysid.CART_XML.format(gear=gear, mass=mass)
        answer = sysid.rival(xml, sysid.cart_log(), sysid.cart_unknowns("log")).value
        print(f"{gear:>8g}, {mass:<14g}{answer[0]:>14.3f}, {answer[1]:<6.3f}{answer[0] / answer[1]:>14.3f}", flush=True)


STAGES = {  # stage: (file, function) pairs whose cumulative seconds it is; none of a stage calls another of it
    "simulate": (("simulation/simulator.py", "rollout"),),
    "noise": (("likelihood/restricted.py", "estimate_noise"), ("likelihood/restricted.py", "noise_cloud")),
}


def profiled(work: Callable[[], int]) -> tuple[dict[str, float], int]:
    """Seconds of each of the ``STAGES`` and of the whole, and what ``work`` returned."""
    profile = cProfile.Profile()
    rollouts = profile.runcall(work)
    stats: Any = pstats.Stats(profile)
    table = dict.fromkeys((*STAGES, "total"), 0.0)
    for (file, _, function), (*_, cumulative, _callers) in stats.stats.items():
        for stage, places in STAGES.items():
            if any(place in file.replace(os.sep, "/") and function == name for place, name in places):
                table[stage] += cumulative
    table["total"] = stats.total_tt
    return table, rollouts


def stages(pairs: int) -> None:
    print("\nWhere a laplace fit spends its time, by a profile, which slows Python's share (medians, seconds)")
    print(f"{'problem':<34}{'simulate':>10}{'noise':>8}{'other':>9}{'total':>8}{'rollouts':>10}")
    pendulum = prepare(PENDULUM)
    log = arm.arm_log(0)
    simulator = arm.arm_simulator()
    problems: dict[str, Callable[[], int]] = {
        "arm, windows 0.5 s, ar1": lambda: arm.ours(simulator, log, Segments()).rollouts,
        "pendulum (ddp), its configuration": lambda: _pendulum_fit(pendulum),
    }
    for name, work in problems.items():
        rows = []
        for _ in range(pairs):
            table, rollouts = profiled(work)
            if not all(table.values()):
                raise RuntimeError(f"stages: nothing was measured of {[k for k, v in table.items() if not v]}")
            rows.append((table["simulate"], table["noise"], table["total"]))
        a, b, d = np.median(rows, axis=0)
        print(f"{name:<34}{a:>10.2f}{b:>8.2f}{d - a - b:>9.2f}{d:>8.2f}{rollouts:>10}", flush=True)


def _pendulum_fit(problem: Any) -> int:
    estimator = get_estimator(problem.simulator, "laplace", likelihood=problem.likelihood, prior=problem.prior)
    estimator.fit(problem.train)
    return estimator.rollouts


def chain() -> None:
    print("\nmcmc on the pendulum's ddp log, its configuration, one run")
    problem = prepare(PENDULUM)
    estimator = get_estimator(problem.simulator, "mcmc", likelihood=problem.likelihood, prior=problem.prior, seed=0)
    elapsed = seconds(lambda: estimator.fit(problem.train))
    mixing = estimator.diagnostics["mixing"]
    print(
        f"{estimator.rollouts} rollouts, {elapsed:.1f} s, {mixing['ess']:.0f} effective draws, R-hat "
        f"{mixing['rhat']:.3f}: "
        f"{estimator.rollouts / mixing['ess']:.0f} rollouts and {1e3 * elapsed / mixing['ess']:.0f} ms an effective "
        "draw"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    tables = (
        *("engine", "batch", "rival", "stages", "chain", "envs", "memory", "fits", "ddpg", "laws"),
        *("discover", "transfer", "shapes", "everyday", "init"),
    )
    parser.add_argument("tables", nargs="*", help=f"any of {', '.join(tables)}; default all")
    parser.add_argument("--pairs", type=int, default=7)
    given = parser.parse_args()
    versions = ", ".join(f"{p} {importlib.metadata.version(p)}" for p in ("mujoco", "numpy", "scipy", "torch"))
    load = os.getloadavg()[0]
    print(
        f"{os.cpu_count()} cores ({platform.machine()}), load {load:.1f}, Python {platform.python_version()}, "
        f"{versions}"
    )
    for name in given.tables or tables:
        if name == "rival" and not hasattr(__import__("mujoco.sysid").sysid, "optimize"):
            print("\nmujoco.sysid is not installed (pip install 'mujoco[sysid]'): no comparison")
        elif name == "chain":
            chain()
        elif name == "memory":
            envs.memory()
        elif name == "fits":
            fits.table()
        elif name == "ddpg":
            ddpg.table(given.pairs, side_by_side)
        elif name == "everyday":
            everyday.table()
        elif name == "init":
            init.table()
        elif name == "laws":
            laws.table(given.pairs, side_by_side)
        elif name == "discover":
            searches.table(prepare(PENDULUM))
        elif name == "shapes":
            shapes.table()
        elif name == "transfer":
            transfer.table(given.pairs, side_by_side)
        elif name == "batch":
            models = {"pendulum": (PENDULUM_XML, "a"), "two links": (TWO_LINKS_XML, "ab")}
            batch.table(given.pairs, side_by_side, models)
        elif name == "envs":
            envs.table(given.pairs, side_by_side)
            envs.against_parsing(given.pairs, side_by_side)
        else:
            {"engine": engine, "rival": rival, "stages": stages}[name](given.pairs)
            if name == "rival":
                starts()


if __name__ == "__main__":
    main()
