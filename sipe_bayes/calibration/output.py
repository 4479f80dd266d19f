"""The output folder of a run: claimed, resumed, filled; every file written under a temporary name and renamed."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from sipe_bayes.calibration.problem import RUN, Problem
from sipe_bayes.core.files import (
    LOCK,
    OutputError,
    exclusive,
    installed_version,
    not_a_file,
    read_json,
    to_json,
    write_bytes,
    write_text,
)
from sipe_bayes.core.findings import Code, Finding, Guard, NotMade, finding
from sipe_bayes.diagnostics.result import Calibration
from sipe_bayes.envs.export import ExportError, write_identified
from sipe_bayes.envs.randomization_code import write_randomization
from sipe_bayes.posterior import Posterior
from sipe_bayes.report.interactive.clips import Clip, make_clip
from sipe_bayes.report.interactive.motion import motion
from sipe_bayes.report.page import write_report
from sipe_bayes.report.recommended import Recommended, recommended
from sipe_bayes.report.words import with_unit
from sipe_bayes.rl.randomization import Usable
from sipe_bayes.simulation.rendering import with_sky

CHECKPOINT = "checkpoint.safetensors"
CHECKS = "checks"  # folder of what the checks of a fit found
RANDOMIZATION = "randomization"
RANDOMIZATION_POSTERIOR = "domain_randomization_posterior"  # where it is not the one that was fitted
_RANDOMIZATION_DRAWS = 100  # in the generated code
_COVARIANCE_DRAWS = 4000  # behind the written covariance
_CLIP_WINDOW = 2.0  # s after which a clip's simulations start anew at the least: in less little is to be seen
PACKAGES = ("sipe-bayes", "mujoco", "numpy", "scipy", "torch", "pyro-ppl", "emcee", "arviz")


def describe_run(problem: Problem, estimator: str, seed: int, budget: int | None) -> dict[str, object]:
    """Configuration, versions, seed and checksums of the inputs of a fit, as JSON has them."""
    config = problem.config
    return {
        "config": str(config.path),
        "config_sha256": _checksum(config.path),
        "model_sha256": problem.simulator.checksum(),  # compiled: with included files and meshes
        "prior_sha256": _checksum(Path(f"{config.prior.source}.safetensors")) if config.prior else "",
        "logs_sha256": {report.name: report.sha256 for report in problem.reports},
        "device": problem.simulator.device,
        "estimator": estimator,
        "seed": seed,
        "budget": budget,
        "configuration": config.model_dump(mode="json", by_alias=True),
        "versions": {"python": platform.python_version(), **{name: installed_version(name) for name in PACKAGES}},
    }


def _checksum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


IDENTITY = ("config_sha256", "model_sha256", "prior_sha256", "logs_sha256", "estimator", "seed", "budget")


@contextmanager
def claimed(
    folder: Path, own: Mapping[str, object], file: str = RUN, keys: Sequence[str] = IDENTITY, what: str = "run"
) -> Iterator[None]:
    """Make ``folder`` this run's own while it is at work; the same run may come back to it.

    It is given back where the run is refused before it has anything to keep.

    Args:
        folder: of the results.
        own: the run's record.
        file: of the record, in the folder.
        keys: of the record, by which a run differs from others.
        what: the run is called.

    Raises:
        OutputError: when it holds another run, or one is at work in it.
    """
    mine = False
    _refuse(folder, own, file, keys, what)  # before another one's folder is given a lock
    try:
        with exclusive(folder):
            if not _refuse(folder, own, file, keys, what):
                write_text(folder / file, to_json(own, indent=2))
            mine = True
            yield
    except ValueError:
        if mine and {path.name for path in folder.iterdir()} == {file, LOCK}:
            with suppress(OSError):
                (folder / file).unlink()
                (folder / LOCK).unlink()
                folder.rmdir()
        raise


def _refuse(folder: Path, own: Mapping[str, object], file: str, keys: Sequence[str], what: str) -> bool:
    """Raises OutputError where a folder is not this run's; whether it has been before."""
    not_a_file(folder)
    record = folder / file
    if record.is_file():
        present = read_json(record, f"the record of a {what}", "choose another --out", OutputError)
        mine = json.loads(to_json(own))
        differing = ", ".join(key.removesuffix("_sha256") for key in keys if present.get(key) != mine[key])
        if differing:
            other = f"another {what} (it differs in {differing})"
            raise OutputError(f"--out {folder}: holds {other}; choose another folder or delete it")
        return True
    if folder.is_dir() and any(p for p in folder.iterdir() if not p.name.startswith(".")):
        raise OutputError(f"--out {folder}: holds files of something else; choose an empty or a new folder")
    return False


def write_all(calibration: Calibration, problem: Problem, folder: Path) -> Calibration:
    """Fill the folder of a finished run, which claimed it; its ``run.json`` comes last and says so.

    Returns:
        The result with what was noticed on the way.
    """
    guard = Guard()
    write_fit(calibration, folder, guard)
    noticed = guard.run("identified model", lambda: _write_model(calibration, problem, folder)).otherwise([])
    whole = replace(calibration, findings=(*calibration.findings, *noticed))
    guard.run("randomization", lambda: _write_randomization(recommended(whole), problem, folder))
    clip = guard.run("moving picture", lambda: _clip(whole, problem)).otherwise(None)
    guard.run("report", lambda: write_report(whole, folder, clip, guard))
    whole = replace(whole, findings=(*whole.findings, *guard.findings))
    _write_result(whole, folder, guard)
    write_text(folder / RUN, to_json({**whole.run, "status": "complete"}, indent=2))
    return whole


def write_fit(calibration: Calibration, folder: Path, guard: Guard) -> None:
    """Write the posterior and ``result.json``, each whole or not at all; either is written without the other."""
    guard.run("posterior", lambda: calibration.posterior.save(folder / "posterior"))
    guard.run("draws of the posterior", lambda: _write_draws(calibration.posterior, folder))
    _write_result(replace(calibration, findings=(*calibration.findings, *guard.findings)), folder, guard)


def _write_result(calibration: Calibration, folder: Path, guard: Guard) -> None:
    """Write ``result.json``, with mean and covariance of theta where no parameter could be summarised."""
    plain, posterior = calibration.to_dict(), calibration.posterior
    if not calibration.parameters:
        of_theta = {"mean": lambda: posterior.mean.tolist(), "covariance": lambda: posterior.covariance.tolist()}
        plain |= {f"theta_{key}": guard.run(key, make).otherwise(None) for key, make in of_theta.items()}
    write_text(folder / "result.json", to_json(plain, indent=2))


def _write_model(calibration: Calibration, problem: Problem, folder: Path) -> list[Finding]:
    """Write the identified model; what of it could not be written."""
    if not calibration.parameters:
        raise NotMade
    values = np.array([p.mode for p in calibration.parameters])
    try:
        return list(write_identified(problem.environment, values, folder / "identified.xml"))
    except ExportError as error:
        return [finding(Code.NOT_EXPORTED, reason=error)]


def _clip(calibration: Calibration, problem: Problem) -> Clip:
    """The first held-out log, or the first, beside the model as given and as calibrated, or why there is none."""
    log = next(iter(problem.holdout or problem.train))
    environment = problem.environment
    theta = {"model as given": environment.space.default_theta, "calibrated": calibration.posterior.mode.numpy()}
    label = with_unit(environment.channels[0], environment.channel_units[0])
    settings = problem.segments
    if settings.window is not None:
        settings = replace(settings, window=min(max(settings.window, _CLIP_WINDOW), len(log) * log.dt), windows=())
    try:
        shown = motion(problem.simulator, settings, log, theta, 0, label)
    except ValueError as error:
        return Clip(f"No moving picture: {error}")
    return make_clip(with_sky(environment.spec()), shown, log.name)


def save_posterior(posterior: Posterior, folder: Path) -> None:
    """Write ``posterior.*``: what ``load_posterior`` reads, and draws for ArviZ, the same each time."""
    posterior.save(folder / "posterior")
    _write_draws(posterior, folder)


def _write_draws(posterior: Posterior, folder: Path) -> None:
    write_bytes(folder / "posterior.nc", posterior.netcdf(torch.Generator().manual_seed(0)))


def _write_randomization(drawn: Recommended, problem: Problem, folder: Path) -> None:
    """What policies are trained under, as a file, as generated code, and where it is another one as a posterior."""
    if not drawn.bases:
        raise NotMade
    saved = "posterior"
    if not drawn.plain:
        saved = RANDOMIZATION_POSTERIOR
        drawn.posterior.save(folder / saved)
    plain = domain_randomization(drawn, problem, saved)
    write_text(folder / "domain_randomization.json", to_json(plain, indent=2))
    draws = drawn.posterior.values(_RANDOMIZATION_DRAWS, generator=torch.Generator().manual_seed(0))
    uncalibrated = drawn.names(Usable.NONE)
    write_randomization(problem.environment, draws, folder / RANDOMIZATION, drawn.remarks(), uncalibrated)


def domain_randomization(drawn: Recommended, problem: Problem, saved: str) -> dict[str, object]:
    """What a policy trainer samples from: each parameter's normal in its unit, its bounds, and the covariance.

    ``sipe_bayes.rl.randomization.load_randomization`` reads it. ``targets`` says what the value is multiplied by for
    each target that it is written to, ``usable`` which interval of the report is drawn from and ``reason`` why.

    Args:
        drawn: what the report says to use.
        problem: whose parameters.
        saved: the posterior beside the file that the normal stands for.
    """
    space = problem.environment.space
    draws = drawn.posterior.values(_COVARIANCE_DRAWS, generator=torch.Generator().manual_seed(0))
    ends = space.values(drawn.posterior.quantile(torch.tensor([0.05, 0.95], dtype=torch.float64)).numpy())
    rows = [
        {"name": s.name, "targets": problem.environment.multipliers(s), "unit": s.unit}
        | {"mean": draws[:, j].mean(), "sd": draws[:, j].std(), "q05": ends[0, j], "q95": ends[1, j]}
        | {key: getattr(s, key) for key in ("low", "high", "log")}
        | {"usable": str(drawn.bases[s.name].usable), "reason": drawn.bases[s.name].reason}
        for j, s in enumerate(space)
    ]
    covariance = np.atleast_2d(np.cov(draws.T))
    return {"parameters": rows, "names": list(space.names), "covariance": covariance.tolist(), "posterior": saved}
