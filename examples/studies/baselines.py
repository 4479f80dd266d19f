"""Accuracy and speed of the existing studies at reduced size, as one file of records to compare code against.

    python examples/studies/baselines.py --out before.jsonl                     # measure; goes on where it was ended
    python examples/studies/baselines.py --list                                 # the plan: cells and seeds
    python examples/studies/baselines.py --summary before.jsonl
    python examples/studies/baselines.py --summary before.jsonl --against after.jsonl

A record is one fit: a cell of a study and a seed. It holds the number of parameters, how many credible intervals of the
study's level hold the truth, the worst |estimate - truth| in posterior sd, whether a blocking diagnostic was reported,
the CPU seconds of the fit (one thread) and its rollouts. A silent miss is a fit with a worst error over 5 sd and no
blocking diagnostic. Every fit runs in its own process. A fit that raises is a record with its error. A fit over 15 CPU
minutes is ended and recorded as ``over_time`` with its CPU time. The first seed of every cell comes first, then the
second seeds, and so on; the cells of ``arm.py`` come last.

``net.py``: coverage only where the truth is known (not on real logs, not on the function in MuJoCo's place).
``wrong_models.py``: six effects and the right model on three machines, with the effect in the library; coverage is that
of the intervals that the report shows first, errors are in sd of the discrepancy-aware posterior, the time is that of
the fit; a record's ``checks_cpu_seconds`` is that of the checks after it. ``arm.py``: sipe_bayes only.

Left out: the Fetch, Relocate, Door and Humanoid tasks in ``contact.py``, which the table of that study does not hold
either (a fit takes longer than the limit); ``known_windows.py`` on tasks other than two of the half-cheetah; models
without the effect in the library (``unknown``) in ``wrong_models.py``, which repeat the same fits.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import platform
import resource
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import arm
import contact
import contact_unseen
import known_windows
import net
import numpy as np
import pendulum_coverage
import shapes
import torch
import tosses
import unmeasured
import wrong_models
from _kept import fits, keep

import sipe_bayes as sipe
from sipe_bayes.envs.task import Task

Row = dict[str, Any]

HERE = Path(__file__).parent
LIMIT = 900  # CPU seconds of a fit
MISS = 5.0  # posterior sd
LOADED_EARLY = ("sbi.inference", "botorch", "gpytorch", "emcee", "arviz")  # so that no fit pays for an import


@dataclass(frozen=True)
class Study:
    """What is run of a study.

    Args:
        one: a cell and a seed to the study's row.
        seeds: number of seeds of each cell.
        first: the first seed.
        level: of the credible intervals.
        last: whether its cells come after all others.
    """

    one: Callable[[str, int], Row]
    seeds: dict[str, int]
    first: int = 0
    level: float = 0.9
    last: bool = False


def one_net(cell: str, seed: int) -> Row:
    """A problem of the net with another seed; the truth is known for the arm and for the benchmark's tasks."""
    net.SEED = seed
    torch.manual_seed(seed)
    estimator, log = net.PROBLEMS[cell]()
    begin = time.process_time()
    posterior = estimator.fit(log)
    row = {"cpu_s": time.process_time() - begin, "rollouts": int(estimator.rollouts)}
    row |= {"blocked": bool(estimator.findings.blocking), "sd": posterior.stddev.tolist(), "size": len(posterior.space)}
    truth = net.ARM_TRUTH if cell.startswith("arm-") else None
    environment = getattr(estimator.simulator, "environment", None)
    if isinstance(environment, Task):
        truth = environment.theta("in_distribution")
    if truth is None:
        return row
    low, high = posterior.quantile([0.05, 0.95]).numpy()
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (posterior.mean.numpy() - truth) / posterior.stddev.numpy()
    return row | {"z": z.tolist(), "covered": ((low <= truth) & (truth <= high)).tolist()}


def one_shape(cell: str, seed: int) -> Row:
    shapes.prepare = partial(sipe.prepare, num_threads=1)
    return shapes.one_fit(cell, seed)


def one_unmeasured(cell: str, seed: int) -> Row:
    machine, _, name = cell.rpartition(", ")
    return unmeasured.one_fit(machine, unmeasured.LIKELIHOODS[name], seed)


def one_contact(cell: str, seed: int) -> Row:
    name, level = cell.split("/")
    return contact.one_fit(name, float(level), seed, steps=200)


def one_unseen(cell: str, seed: int) -> Row:
    for name in ("UNKNOWN", "JOINTS", "MOTORS", "clean"):
        setattr(contact, name, getattr(contact_unseen, name))
    return contact.one_fit(cell, contact_unseen.LEVEL, seed, contact_unseen.STEPS)


def one_pendulum(cell: str, seed: int) -> Row:
    estimator, rho = cell.split(", rho ")
    problem = sipe.prepare(pendulum_coverage.CONFIG, num_threads=1)
    return pendulum_coverage.one_fit(problem, estimator, float(rho), seed)


def one_wrong(cell: str, seed: int) -> Row:
    """The library as it is; the model-conditional intervals stand in the record beside those that are printed."""
    machine, effect = cell.split(", ")
    row = next(wrong_models.fitted(machine, effect, seed, wrong_models.SIZE))
    truth = np.array(row["truth"])
    covered = {}
    for kind, (low, high) in {"printed": wrong_models.printed(row), "plain": np.array(row["ends"]["plain"])}.items():
        covered[kind] = ((low <= truth) & (truth <= high)).tolist()
    z = {kind: (np.array(row["means"][kind]) - truth) / row["sds"][kind] for kind in ("plain", "lacking")}
    return {
        "z": z["lacking"].tolist(),
        "sd": row["sds"]["lacking"],
        "covered": covered["printed"],
        "blocking": row["blocking"],
        "rollouts": row["rollouts"],
        "cpu_s": row["fit_s"],
        "extra": {
            "covered_plain": sum(covered["plain"]),
            "worst_sd_plain": float(np.abs(z["plain"]).max()),
            "alarm": row["alarm"],
            "checks_cpu_seconds": row["checks_s"],
        },
    }


def one_arm(cell: str, seed: int) -> Row:
    simulator = arm.arm()
    log = arm.recorded(simulator, arm.TRUTH, *arm.CELLS[cell], seed)
    begin = time.process_time()
    row = arm.ours(simulator, log, seed)
    return {**row, "cpu_s": time.process_time() - begin}


def each(cells: Any, seeds: int, **others: int) -> dict[str, int]:
    """The same number of seeds for all cells but ``others``."""
    return {cell: others.get(cell.replace("-", "_"), seeds) for cell in cells}


CONTACT = {  # cell: seeds, by the cost of a fit
    f"{name}/{level:g}": seeds
    for name, seeds in {
        "CartPole": 8,
        "Pendulum": 8,
        "HalfCheetahJoints": 4,
        "HalfCheetahLinks": 4,
        "HalfCheetahAllJoints": 4,
        "quadruped": 4,
        "biped": 4,
        "pushed": 4,
        "Hopper": 2,
    }.items()
    for level in contact.LEVELS
}
STUDIES = {
    "net": Study(one_net, each(net.PROBLEMS, 3, furuta_laplace=1, pendulum_laplace=1, push_chain=1)),
    "shapes": Study(one_shape, each(shapes.MACHINES, 4, drive=8, servo=8, quadruped=2), first=1),
    "unmeasured": Study(
        one_unmeasured, each([f"{m}, {n}" for m in unmeasured.MACHINES for n in unmeasured.LIKELIHOODS], 8), first=500
    ),
    "contact": Study(one_contact, CONTACT),
    "contact_unseen": Study(one_unseen, each(contact_unseen.UNKNOWN, 4, bumpers=8, gripper=3)),
    "pendulum_coverage": Study(
        one_pendulum, {"laplace, rho 0": 8, "laplace, rho 0.99": 8, "mcmc, rho 0": 4, "mcmc, rho 0.99": 4}
    ),
    "known_windows": Study(
        lambda cell, seed: known_windows.one_fit(cell, seed, known=5, budget=1000),
        each(["HalfCheetahLinks", "HalfCheetahJoints"], 12),
    ),
    "wrong_models": Study(
        one_wrong, each([f"{m}, {e}" for m in wrong_models.MACHINES for e in ("null", *wrong_models.EFFECTS)], 4)
    ),
    "tosses": Study(lambda cell, seed: tosses.one_fit(cell, seed, count=12), each(tosses.BODIES, 4), first=1),
    "arm": Study(one_arm, each(arm.CELLS, 40), level=arm.LEVEL, last=True),
}


def plan() -> Iterator[tuple[str, str, int]]:
    """Study, cell and seed of all fits in their order."""
    for last in (False, True):
        chosen = {name: study for name, study in STUDIES.items() if study.last == last}
        for k in range(max(max(study.seeds.values()) for study in chosen.values())):
            for name, study in chosen.items():
                yield from ((name, cell, study.first + k) for cell, count in study.seeds.items() if k < count)


def record(study: Study, row: Row) -> Row:
    """A study's row in the words of this file."""
    z, covered = row.get("z", row.get("sds_off")), _first(row, "covered", "held", "inside")
    blocked = bool(_first(row, "blocking", "blocked"))
    point = not np.any(np.array(row["sd"]) > 0)  # an estimate without a posterior
    worst = None if z is None or point else float(np.nan_to_num(np.abs(z), nan=np.inf).max())
    return {
        "parameters": len(covered) if covered is not None else row["size"],
        "covered": None if covered is None or point else int(np.sum(covered)),
        "worst_sd": None if worst is None else round(worst, 3),
        "blocked": blocked,
        "silent_miss": worst is not None and worst > MISS and not blocked,
        "cpu_seconds": round(float(_first(row, "cpu_s", "processor_seconds", "seconds")), 2),
        "rollouts": row["rollouts"],
        "level": study.level,
        "sd": row["sd"],
        "diagnostics": row.get("blocking", row.get("findings")),
        **row.get("extra", {}),
    }


def _first(row: Row, *names: str) -> Any:
    return next((row[name] for name in names if name in row), None)


def measured(study: Study, cell: str, seed: int) -> Row:
    """A fit in a process of its own, which ends at the limit."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (LIMIT, LIMIT + 5))
        try:
            found = record(study, study.one(cell, seed))
        except BaseException as error:
            traceback.print_exc()
            found = {"error": f"{type(error).__name__}: {error}"}
        with os.fdopen(writing, "w", encoding="utf-8") as file:
            json.dump(found, file)
        sys.stderr.flush()
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, encoding="utf-8") as file:
        text = file.read()
    _, status, used = os.wait4(child, 0)
    total = {"process_cpu_seconds": round(used.ru_utime + used.ru_stime, 2)}
    if os.WIFSIGNALED(status):
        ended = os.WTERMSIG(status)
        if ended == signal.SIGXCPU or total["process_cpu_seconds"] >= LIMIT:
            return {"over_time": True, "cpu_seconds": total["process_cpu_seconds"], **total}
        return {"error": f"ended by {signal.Signals(ended).name}", **total}
    return {**json.loads(text), **total}


def reference() -> float:
    """CPU seconds of a fixed piece of work without this package: how fast the processor is now."""
    taken = []
    matrix = np.random.default_rng(0).standard_normal((120, 120))
    for _ in range(3):
        begin = time.process_time()
        for _ in range(20):
            np.linalg.solve(matrix, matrix)
        sum(k * k for k in range(100_000))
        taken.append(time.process_time() - begin)
    return round(min(taken), 5)


def run(file: Path) -> None:
    """All fits that a file does not have yet."""
    for name in LOADED_EARLY:
        import_module(name)
    done = {(row["study"], row["cell"], row["seed"]) for row in fits(file)}
    left = [which for which in plan() if which not in done]
    print(f"{len(done)} fits are there, {len(left)} are left", flush=True)
    for name, cell, seed in left:
        which = {"study": name, "cell": cell, "seed": seed}
        speed = {"reference_seconds": reference(), "processor": platform.processor() or platform.machine()}
        row = keep(file, {**which, **measured(STUDIES[name], cell, seed), **speed})
        shown = {key: row[key] for key in ("error", "over_time", "covered", "worst_sd", "blocked") if key in row}
        print(name, cell, seed, json.dumps(shown), f"{row.get('cpu_seconds', 0):.1f} s", flush=True)


def read(file: Path) -> dict[tuple[str, str, int], Row]:
    """The records of a file; a line that is cut off is left out."""
    lines = file.read_text(encoding="utf-8").split("\n")[:-1]
    rows = [json.loads(line) for line in lines]
    return {(row["study"], row["cell"], row["seed"]): row for row in rows}


def columns(rows: list[Row]) -> list[str]:
    """Fits, coverage, worst error, silent misses, blocked, failed, CPU seconds of a fit (mean)."""
    judged = [row for row in rows if row.get("worst_sd") is not None]
    share = np.array([row["covered"] / row["parameters"] for row in judged])
    error = f" ± {share.std(ddof=1) / np.sqrt(len(share)):.3f}" if len(share) > 1 else ""
    failed = sum("error" in row or "over_time" in row for row in rows)
    return [
        str(len(rows)),
        f"{share.mean():.3f}{error}" if len(share) else "-",
        f"{max(row['worst_sd'] for row in judged):.1f}" if judged else "-",
        str(sum(row.get("silent_miss", False) for row in rows)),
        str(sum(row.get("blocked", False) for row in rows)),
        str(failed),
        f"{np.mean(cpu):.2f}" if (cpu := [row["cpu_seconds"] for row in rows if "cpu_seconds" in row]) else "-",
    ]


HEAD = ["fits", "coverage", "worst sd", "silent", "blocked", "failed", "CPU s"]


def compared(before: list[Row], after: list[Row]) -> list[str]:
    """CPU after / before over the fits that both ended, and the ratio of posterior sd (geometric mean)."""
    pairs = [(a, b) for a, b in zip(before, after, strict=True) if "cpu_seconds" in a and "cpu_seconds" in b]
    sds = [np.log(np.array(b["sd"]) / a["sd"]) for a, b in pairs if _positive(a) and _positive(b)]
    old = sum(a["cpu_seconds"] for a, _ in pairs)
    ratio = f"{sum(b['cpu_seconds'] for _, b in pairs) / old:.2f}" if old else "-"
    return [ratio, f"{np.exp(np.mean(np.concatenate(sds))):.2f}" if sds else "-"]


def _positive(row: Row) -> bool:
    return "sd" in row and bool((np.array(row["sd"]) > 0).all())


def summary(before: dict[tuple[str, str, int], Row], after: dict[tuple[str, str, int], Row] | None) -> str:
    """A table of studies and cells, over the fits of both files where there are two."""
    both = [which for which in plan() if which in before and (after is None or which in after)]
    head = ["study", "level", "cell", *HEAD]
    if after is not None:
        head += [*(f"{name} after" for name in HEAD[1:]), "CPU after/before", "sd after/before"]
    table = [head]
    for name, study in STUDIES.items():
        for cell in [*study.seeds, "all"]:
            mine = [which for which in both if which[0] == name and cell in (which[1], "all")]
            if not mine:
                continue
            line = [name, f"{study.level:.0%}", cell, *columns(old := [before[which] for which in mine])]
            if after is not None:
                new = [after[which] for which in mine]
                line += [*columns(new)[1:], *compared(old, new)]
            table.append(line)
    widths = [max(len(line[k]) for line in table) for k in range(len(head))]
    lines = ["  ".join(part.ljust(width) for part, width in zip(line, widths, strict=True)).rstrip() for line in table]
    for title, rows in {"before": before, "after": after or {}}.items():
        if rows:
            cpu = sum(row.get("cpu_seconds", 0.0) for row in rows.values()) / 3600
            speed = 1e3 * np.median([row["reference_seconds"] for row in rows.values()])
            lines.append(f"{title}: {len(rows)} fits, {cpu:.2f} CPU hours; reference work {speed:.1f} ms (median)")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=HERE / "runs" / "baselines.jsonl", help="default: %(default)s")
    parser.add_argument("--summary", type=Path, metavar="FILE", help="print the table of a file's records")
    parser.add_argument("--against", type=Path, metavar="FILE", help="with --summary: a later file to set beside it")
    parser.add_argument("--list", action="store_true", help="print the plan")
    given = parser.parse_args()
    if given.list:
        for name, study in STUDIES.items():
            print(name, json.dumps(study.seeds))
        print(sum(1 for _ in plan()), "fits")
        return
    if given.summary is not None:
        print(summary(read(given.summary), read(given.against) if given.against is not None else None))
        return
    if any(os.environ.get(name) != one for name, one in net.ONE_THREAD.items()):  # read as NumPy is loaded
        os.execve(sys.executable, sys.orig_argv, {**os.environ, **net.ONE_THREAD})
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    run(given.out)


if __name__ == "__main__":
    main()
