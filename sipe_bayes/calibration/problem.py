"""A configuration read and bound: model, logs, unknowns, prior and likelihood, and the estimator that it asks for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from pydantic import TypeAdapter

from sipe_bayes.calibration.commands import check_commands
from sipe_bayes.calibration.config import Config, check_dimensions, load_config
from sipe_bayes.calibration.config_fields import ConfigError, overlap
from sipe_bayes.calibration.config_tables import LogEntry
from sipe_bayes.calibration.logs import load_logs
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.files import read_json, reading
from sipe_bayes.core.findings import Code, Finding, Findings, finding
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.core.units import find_unit, to_si
from sipe_bayes.core.validation import nearest_name
from sipe_bayes.diagnostics.records import LogReport
from sipe_bayes.envs.added import of_logs
from sipe_bayes.envs.channels import Channel
from sipe_bayes.envs.foreign.load import ModelError
from sipe_bayes.envs.laws.firmware import Firmware
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.envs.target import TargetError
from sipe_bayes.inference import get_estimator
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.recorded import Progress
from sipe_bayes.inference.registry import estimator_class
from sipe_bayes.likelihood import Segments, StateSpace
from sipe_bayes.posterior import GaussianMixture, Posterior, load_posterior
from sipe_bayes.posterior import prior as default_prior
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.tolerances import Tolerances

_FLAT_SD = 1e3  # stands for a uniform prior beside an earlier posterior
RUN = "run.json"
_SCORED = 0.5  # s, windows over which logs are scored and drawn where the likelihood has none


@dataclass(frozen=True)
class Problem:
    """A configuration read and bound: what an Estimator needs, and the logs behind it.

    Args:
        config: the file's content.
        environment: the model with its unknowns.
        simulator: of the environment.
        likelihood: of the fit.
        prior: of the parameters.
        train: logs to fit.
        holdout: logs to predict.
        reports: what was done to each log.
        findings: what is to be said of the prior.
    """

    config: Config
    environment: MjcfEnvironment
    simulator: Simulator
    likelihood: Segments | StateSpace
    prior: Posterior
    train: Trajectories
    holdout: Trajectories | None
    reports: tuple[LogReport, ...]
    findings: tuple[Finding, ...] = ()

    @property
    def warnings(self) -> list[str]:
        """The texts of what was found."""
        return Findings(self.findings).warnings

    @property
    def tolerances(self) -> Tolerances:
        """How well forces, drawings and times are known."""
        commands = {command.actuator: command.tolerance for command in self.config.commands}
        shares = self.config.geometry_tolerance, self.config.timing_tolerance, self.config.step_tolerance
        return Tolerances(commands, *shares)

    @property
    def segments(self) -> Segments:
        """The windows by which logs are scored, drawn and checked: the likelihood's own.

        Beside a ``StateSpace`` they are of half a second, or what a held-out log's ``window`` says; a shorter log is
        one window.
        """
        if isinstance(self.likelihood, Segments):
            return self.likelihood
        own = {log.name: self.config.window_of(log) for log in self.config.logs if log.window is not None}
        every = [*self.train, *(self.holdout or ())]
        short = {log.name: None for log in every if len(log) * log.dt < _SCORED}
        windows = tuple({**short, **own}.items())
        return Segments(_SCORED, "white", self.likelihood.fit, self.likelihood.noise_sd, windows)


def prepare(config: Config | str | Path, num_threads: int | None = None, device: str = "cpu") -> Problem:
    """Read the model and the logs of a configuration.

    Args:
        config: or its file.
        num_threads: native ones of the simulator; default all cores.
        device: that it simulates on, as ``Simulator`` has them.

    Raises:
        ConfigError: for a configuration that cannot be used.
        LogError: for a log that cannot be used.
        ModelError: for a model that cannot be read.
        TargetError: for a parameter that the model does not have.
    """
    config = config if isinstance(config, Config) else load_config(config)
    train_logs, held_logs = config.logs_for("train"), config.logs_for("holdout")
    environment = environment_of(config, train_logs, held_logs)
    units = dict(zip(environment.channels, environment.channel_units, strict=True))
    dimensions = {
        m.target: "dimensionless" if m.quaternion else _dimension(units[m.channels[0][1]]) for m in config.measurements
    }
    dimensions = {target: d for target, d in dimensions.items() if d}
    check_dimensions(config, dimensions)
    doubts = check_commands(config)
    train, train_reports = _read(config, train_logs, dimensions)
    held, held_reports = _read(config, held_logs, dimensions)
    for held_log, copy in zip(held_logs, held_reports, strict=True):
        for log, report in zip(train_logs, train_reports, strict=True):
            if copy.sha256 == report.sha256 and overlap(held_log.span, log.span):
                raise ConfigError(
                    f"{config.path}: log {held_log.name!r} is held out, but {held_log.file} is a copy of {log.file}, "
                    "which trains; hold out another log"
                )
    prior, remarks = _prior(config, environment.space, train_reports)
    return Problem(
        config,
        environment,
        Simulator(environment, num_threads, device),
        _likelihood(config),
        prior,
        Trajectories.stack(train),
        Trajectories.stack(held) if held else None,
        (*train_reports, *held_reports),
        (*doubts, *remarks, *_of_structure(config.structure.weight)),
    )


def _of_structure(weight: float) -> list[Finding]:
    """That a search was not sure of the model's structure."""
    sure = weight >= THRESHOLDS.sure_of_structure
    return [] if sure else [finding(Code.STRUCTURE_UNCERTAIN, weight=weight)]


def _read(
    config: Config, logs: Sequence[LogEntry], dimensions: Mapping[str, str]
) -> tuple[list[Trajectory], list[LogReport]]:
    read = load_logs(config, logs, dimensions)
    return [trajectory for trajectory, _ in read], [report for _, report in read]


def _dimension(unit: str) -> str:
    try:
        return find_unit(unit).dimension
    except ValueError:
        return ""


def environment_of(config: Config, train: Sequence[LogEntry], held: Sequence[LogEntry] = ()) -> MjcfEnvironment:
    """A configuration's model and parameters, with what is added in logs.

    Raises ConfigError, TargetError or ModelError for what does not fit.
    """
    parameters: list[Parameter] = []
    # the unit of a command offset is the command's; other units are the model's own (empty here)
    units = {f"{c.target}.offset": to_si(c.unit)[1] for c in config.commands}
    for i, entry in enumerate(config.parameters):
        try:
            one = Parameter(
                entry.name,
                *entry.range,
                scale=entry.scale,
                targets=entry.targets,
                relative=entry.factor is not None,
                unit=units.get(entry.targets[0], ""),
                prior_mean=entry.prior.mean if entry.prior else None,
                prior_sd=entry.prior.sd if entry.prior else None,
                description=entry.description,
            )
        except ValueError as error:
            raise ConfigError(f"{config.path}: key `parameters[{i}]`: {error}") from None
        logs = [log.name for log in train] if entry.per_log else []
        parameters += [replace(one, name=f"{one.name}[{log}]", log=log) for log in logs] or [one]
    channels = [Channel(*channel) for m in config.measurements for channel in m.channels]
    edits = [Firmware(c.actuator, c.rate, c.fed.actuator if c.fed else "") for c in config.commands if c.rate]
    actuators = [c.actuator for c in config.commands]
    added = of_logs([(log.name, log.added) for log in (*train, *held)])
    try:
        environment = MjcfEnvironment.build(config.model, parameters, actuators, channels, edits, added)
    except (TargetError, ModelError):
        raise
    except ValueError as error:
        raise ConfigError(f"{config.path}: {error}") from None
    known = {channel.target for channel in environment.measurements}
    for m in config.measurements:
        if not m.columns and m.target not in known:
            raise ConfigError(
                f"{config.path}: measurement {m.name!r}: {m.target} is an orientation; give its quaternion's four "
                "`columns`, and quaternion = 'wxyz' or 'xyzw'"
            )
    return environment


def _likelihood(config: Config) -> Segments | StateSpace:
    fit = tuple(name for m in config.measurements if m.fit for _, name in m.channels)
    noise_sd = tuple(m.noise_sd for m in config.measurements for _ in m.channels)
    if config.likelihood == "state_space":
        return StateSpace(fit, noise_sd)
    return Segments(
        window=None if config.window == "log" else config.window,
        noise=config.noise.model,
        fit=fit,
        noise_sd=noise_sd,
        windows=tuple((log.name, config.window_of(log)) for log in config.logs if log.window is not None),
    )


def _prior(config: Config, space: ParameterSpace, train: Sequence[LogReport]) -> tuple[Posterior, tuple[Finding, ...]]:
    """The parameters' own priors, or the normal of an earlier posterior for those that it knows, matched by name."""
    own = default_prior(space)
    if config.prior is None:
        return own, ()
    earlier = load_posterior(config.prior.source)
    shared = [n for n in space.names if n in earlier.space.names]
    if not shared:
        raise ConfigError(
            f"{config.path}: key `prior.from`: the posterior knows {list(earlier.space.names)}, none of them is asked "
            f"for here ({list(space.names)}); rename the parameters or drop the key"
        )
    mean, covariance = (x.numpy().copy() for x in own.gaussian_moments())
    covariance[np.isinf(covariance)] = _FLAT_SD**2
    old_mean, old_covariance = (x.numpy() for x in earlier.gaussian_moments())
    new, old = [space.index(n) for n in shared], [earlier.space.index(n) for n in shared]
    slope, shift = np.empty(len(shared)), np.empty(len(shared))
    for k, (i, j) in enumerate(zip(new, old, strict=True)):
        for what in ("scale", "unit"):
            before, now = getattr(earlier.space[j], what), getattr(space[i], what)
            if before != now:
                raise ConfigError(
                    f"{config.path}: key `prior.from`: {space[i].name!r} had the {what} {before!r} there and has "
                    f"{now!r} here; use the same"
                )
        ends = space[i].normalise(earlier.space[j].value(np.array([0.0, 1.0])))
        slope[k], shift[k] = ends[1] - ends[0], ends[0]
    mean[new] = shift + slope * old_mean[old]
    covariance[np.ix_(new, new)] = slope[:, None] * old_covariance[np.ix_(old, old)] * slope
    noticed = _of_earlier(config.prior.source, earlier, train)
    return GaussianMixture(torch.zeros(1), mean[None], covariance[None], space), noticed


def _of_earlier(source: Path, earlier: Posterior, train: Sequence[LogReport]) -> tuple[Finding, ...]:
    """What is to be said of an earlier posterior as the prior."""
    noticed = []
    if isinstance(earlier, GaussianMixture) and len(earlier.means) > 1:
        noticed.append(finding(Code.PRIOR_OF_MIXTURE, components=len(earlier.means)))
    record = source.parent / RUN
    if record.is_file():
        remedy = "calibrate again, or give a copy of the posterior alone"
        plain = read_json(record, "the record of a run", remedy)
        with reading(record, "the record of a run", remedy):
            before = set(TypeAdapter(dict[str, str]).validate_python(plain.get("logs_sha256", {})).values())
        again = [report.name for report in train if report.sha256 in before]
        if again:
            noticed.append(finding(Code.PRIOR_COUNTED_TWICE, logs=", ".join(again)))
    return tuple(noticed)


def method_of(
    problem: Problem,
    estimator: str | None,
    seed: int | None,
    budget: int | None,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
) -> Estimator:
    """The configuration's estimator.

    Args:
        problem: the configuration read and bound.
        estimator: default the configuration's.
        seed: default the configuration's.
        budget: rollouts; default the configuration's, then the estimator's.
        checkpoint: file that an interrupted fit goes on from.
        progress: called along the way.

    Raises:
        ConfigError: for keys that the estimator does not take.
    """
    config = problem.config
    name = estimator or config.estimator
    takes = estimator_class(name).searches
    if not takes and config.search != type(config.search)():
        raise ConfigError(f"{config.path}: key `search`: {name} does not search from several starts; drop the key")
    if not takes and config.likelihood == "state_space":
        raise ConfigError(
            f"{config.path}: key `likelihood`: 'state_space' is for laplace and mcmc, got {name}; use 'segments'"
        )
    return get_estimator(
        problem.simulator,
        name,
        prior=problem.prior,
        likelihood=problem.likelihood,
        seed=config.seed if seed is None else seed,
        budget=config.budget if budget is None else budget,
        **(config.search.model_dump(exclude={"start"}) if takes else {}),
        **({"initial": _start(problem)[None]} if config.search.start and name == "laplace" else {}),
        checkpoint=checkpoint,
        progress=progress,
    )


def _start(problem: Problem) -> FloatArray:
    """Theta (N,) where the search begins: the configuration's values, the model's own of the others."""
    space, theta = problem.environment.space, np.clip(problem.environment.space.default_theta, 0, 1)
    for name, value in (problem.config.search.start or {}).items():
        if name not in space.names:
            hint = nearest_name(name, space.names) or f"; known are {', '.join(space.names)}"
            raise ConfigError(f"{problem.config.path}: key `search.start`: no parameter {name!r}{hint}")
        index = space.index(name)
        theta[index] = np.clip(float(space[index].normalise(value)), 0, 1)
    return theta
