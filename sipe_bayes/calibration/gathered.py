"""What a calibration's checks say, gathered as findings: of parameters, held-out logs and the logs as read."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.optimize
import torch

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.findings import Code, Finding, Severity, finding
from sipe_bayes.core.parameters import ParameterSpace
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.diagnostics.evaluate import compare_errors
from sipe_bayes.diagnostics.identifiability import ridges
from sipe_bayes.diagnostics.records import ChannelScore, LogReport, Ridge, improvement
from sipe_bayes.diagnostics.result import ParameterSummary
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.envs.poses import has_pose
from sipe_bayes.likelihood import (
    UNIFORM_PRECISION,
    BoundLikelihood,
    Segments,
    StateSpace,
    tied_joints,
    unmeasured_joints,
)
from sipe_bayes.posterior import GaussianMixture, Posterior
from sipe_bayes.simulation.simulator import Simulator

_FREE = 0  # mjJNT_FREE
_DRAWS = 4000  # of the posterior: quantiles to one or two percent of an sd
_CUT = 2e-3  # of the range, within which an interval ends at a bound
_MOVED = 2.0  # prior sds, by which logs that move a value say something else than its prior
_DIFFERENT, _APART = 0.1, 3.0  # of the mean of the logs, and sds of a difference
_NO_BODY = 0.01  # of the posterior, from which it is told
_HARDLY_A_BODY = 0.5  # of the prior, likewise
_NAMED = 3  # logs of what is summed up


def most_probable(posterior: Posterior) -> FloatArray:
    """The most probable theta (N,) among those within every parameter's own 90 % interval.

    Where bounds cut a ridge off, the mode sits in a corner of the cube that has next to no mass.
    """
    mode, levels = posterior.mode.numpy(), torch.tensor([0.05, 0.95], dtype=torch.float64)
    low, high = posterior.quantile(levels).numpy()
    if ((mode >= low) & (mode <= high)).all():
        return mode
    high = np.maximum(high, low + 1e-12)
    if isinstance(posterior, GaussianMixture):
        normals = zip(posterior.means.numpy(), posterior.covariances.numpy(), strict=True)
        points = [_nearest(mean, covariance, low, high) for mean, covariance in normals]
    else:
        draws = posterior.sample((_DRAWS,), generator=torch.Generator().manual_seed(0)).numpy()
        points = [*draws[((draws >= low) & (draws <= high)).all(1)], np.clip(mode, low, high)]
    best = posterior.log_prob(torch.from_numpy(np.stack(points))).argmax()
    return np.asarray(points[int(best)])


def _nearest(mean: FloatArray, covariance: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """The most probable point (N,) of a normal between two corners of a box."""
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    return np.asarray(scipy.optimize.lsq_linear(root, root @ mean, (low, high), tol=1e-12).x)


@dataclass(frozen=True)
class Marginals:
    """A posterior by parameter.

    Args:
        space: of the N parameters.
        theta: (N,) as of ``most_probable``.
        sd: (N,) in theta.
        contraction: (N,) 1 - sd / prior sd.
        draws: (n, N) in units.
        known: (N,) those that the prior alone determines well, and of which the logs do not say otherwise.
        natural: names of those whose lower bound is the smallest physical value.
    """

    space: ParameterSpace
    theta: FloatArray
    sd: FloatArray
    contraction: FloatArray
    draws: FloatArray
    known: BoolArray
    natural: frozenset[str] = frozenset()

    @classmethod
    def of(cls, posterior: Posterior, prior: Posterior, seed: int, natural: frozenset[str] = frozenset()) -> Marginals:
        """Those of a posterior, which started from a prior."""
        sd = posterior.stddev.numpy()
        before = np.maximum(prior.stddev.numpy(), 1e-300)
        moved = np.abs(posterior.mean.numpy() - prior.mean.numpy()) / before
        known = (before < (1 - THRESHOLDS.well_determined) / math.sqrt(UNIFORM_PRECISION)) & (moved < _MOVED)
        draws = posterior.values(_DRAWS, generator=torch.Generator().manual_seed(seed))
        return cls(posterior.space, most_probable(posterior), sd, 1 - sd / before, draws, known, natural)

    def summaries(self, further: Posterior | None = None) -> list[ParameterSummary]:
        """One for each parameter.

        Args:
            further: theta with what the model lacks or may lack; its intervals hold the plain ones.
        """
        mode = self.space.values(self.theta)
        beyond = None if further is None else further.quantile(torch.tensor([0.05, 0.95], dtype=torch.float64)).numpy()
        quantiles = np.quantile(self.draws, [0.05, 0.5, 0.95], axis=0)
        summaries = []
        for j, p in enumerate(self.space):
            drawn, determined = self.draws[:, j], float(self.contraction[j])
            mean, sd, q05, q50, q95, best = (float(x) for x in (drawn.mean(), drawn.std(), *quantiles[:, j], mode[j]))
            q05, q95 = min(q05, best), max(q95, best)  # quantiles of draws are a little off
            if self._shows_none(j):
                q05 = p.low
            marginal = (mean, sd, q05, q50, q95, best, p.default, determined, p.log is not None)
            ends = None
            if beyond is not None and p.log is None:
                low, high = (float(p.value(float(end))) for end in beyond[:, j])
                ends = (min(low, q05), max(high, q95))
            summaries.append(ParameterSummary(p.name, p.unit, p.targets, *marginal, ends, bool(self.known[j])))
        return summaries

    def cut_at_bounds(self, summaries: Sequence[ParameterSummary]) -> list[Finding]:
        """Wider intervals that end at a bound which nature does not set, where the plain ones do not."""
        noticed = []
        for p, one in zip(self.space, summaries, strict=False):
            ends = zip((0.0, 1.0), one.further or (), (one.q05, one.q95), strict=False)
            cut = [
                (p.low, p.high)[int(end)]
                for end, far, near in ends
                if abs(float(p.normalise(far)) - end) < _CUT < abs(float(p.normalise(near)) - end)
            ]
            for bound in [bound for bound in cut if not (bound == p.low and p.name in self.natural)]:
                noticed.append(finding(Code.WIDER_AT_BOUND, parameters=[p.name], bound=bound, unit=_after(p.unit)))
        return noticed

    def means_of_logs(self) -> list[Finding]:
        """What differs between logs by more than a tenth, of which others and the written model have the mean."""
        groups: dict[tuple[str, ...], list[int]] = {}
        for j, p in enumerate(self.space):
            if p.log is not None and not p.targets[0].startswith("sensor:"):
                groups.setdefault(p.targets, []).append(j)
        noticed, values = [], self.space.values(self.theta)
        for members in (group for group in groups.values() if len(group) > 1):
            mean, p = float(values[members].mean()), self.space[members[0]]
            apart = float(np.ptp(self.theta[members])) > _APART * float(np.hypot(*np.sort(self.sd[members])[-2:]))
            if apart and np.ptp(values[members]) > _DIFFERENT * abs(mean):
                name = p.name.removesuffix(f"[{p.log}]")
                noticed.append(finding(Code.MEAN_OF_LOGS, parameters=[name], value=mean, unit=_after(p.unit)))
        return noticed

    @property
    def _near(self) -> FloatArray:
        """How near to a bound a theta (N,) sits on it."""
        return np.minimum(THRESHOLDS.at_bound, THRESHOLDS.bound_sds * self.sd)

    def _shows_none(self, j: int) -> bool:
        """Whether a parameter is as small as nature lets it be."""
        return self.space[j].name in self.natural and bool(self.theta[j] < self._near[j])

    @cached_property
    def ridges(self) -> list[Ridge]:
        """Combinations that are determined where their members are not, which then are worth no more than a note."""
        return ridges(self.space, self.draws, self.contraction.tolist())

    def findings(
        self, dead: dict[str, list[tuple[float, float]]], wider: Sequence[ParameterSummary] = ()
    ) -> list[Finding]:
        """Of each parameter whether it does anything, is determined, and lies at a bound.

        Args:
            dead: parameter -> pieces of [0, 1] over which it changes nothing.
            wider: summaries whose wider intervals are what is to be used; none where the plain ones are.
        """
        on_ridge = {name for ridge in self.ridges for name in ridge.parameters}
        noticed, near = [], self._near
        for j, p in enumerate(self.space):
            about = functools.partial(finding, parameters=[p.name], unit=_after(p.unit))
            pieces = dead.get(p.name, [])
            idle = any(low <= 0 and high >= 1 for low, high in pieces)
            if idle:
                noticed.append(about(Code.NO_EFFECT))
            elif pieces:
                ranges = ", ".join(f"{p.value(a):.4g} to {p.value(b):.4g}" for a, b in pieces)
                noticed.append(about(Code.DEAD_RANGE, ranges=ranges))
            if self.contraction[j] < THRESHOLDS.not_determined and not self.known[j]:
                severity = Severity.NOTE if idle or p.name in on_ridge else Severity.CAUTION
                contraction = float(self.contraction[j])
                noticed.append(about(Code.NOT_DETERMINED, severity=severity, contraction=contraction))
            elif min(self.theta[j], 1 - self.theta[j]) < near[j]:
                value = float(p.value(float(self.theta[j])))
                bound = p.low if value - p.low < p.high - value else p.high
                code = Code.AT_PHYSICAL_BOUND if self._shows_none(j) else Code.MODE_AT_BOUND
                noticed.append(about(code, bound=bound))
        return [*noticed, *self.cut_at_bounds(wider), *self.means_of_logs()]


def _after(unit: str) -> str:
    """A unit behind a number."""
    return "" if unit in ("", "1") else f" {unit}"


def unmeasured_starts(
    simulator: Simulator, logs: Trajectories, likelihood: Segments | StateSpace, holdout: bool
) -> list[Finding]:
    """Free and ball joints whose pose no channel tells, so that windows start them where the model has them.

    And joints of closed chains that do not follow from what is measured.

    With a ``StateSpace`` these are those of the logs in ``holdout`` alone.
    """
    if isinstance(likelihood, StateSpace) and not holdout:
        return []
    model, findings = simulator.model, []
    unmeasured, tied = unmeasured_joints(simulator, logs), tied_joints(simulator, logs)
    for joint in (joint for joint in unmeasured if joint in tied):
        findings.append(finding(Code.CHAIN_NOT_FOLLOWED, joint=model.joint(joint).name or f"joint {joint}"))
    for joint in (joint for joint in unmeasured if has_pose(model, joint)):
        body = model.body(int(model.jnt_bodyid[joint])).name or f"body {int(model.jnt_bodyid[joint])}"
        name = model.joint(joint).name or f"of {body}"
        wanted = ("position", "orientation") if int(model.jnt_type[joint]) == _FREE else ("orientation",)
        seen = {reading.quantity for reading in simulator.environment.poses if reading.joint == joint}
        missing = [f"body:{body}.{quantity}" for quantity in wanted if quantity not in seen]
        severity, where, instead = None, "every window starts", ", or use likelihood = 'state_space'"
        if isinstance(likelihood, StateSpace):
            severity, where, instead = (
                Severity.CAUTION,
                "simulations of held-out logs start",
                " to believe their errors",
            )
        about = functools.partial(finding, Code.STARTS_AT_REST, severity=severity, joint=name)
        findings.append(about(where=where, needed=" and ".join(missing), instead=instead))
    return findings


def uneven_targets(environment: MjcfEnvironment) -> list[Finding]:
    """Parameters whose targets have different values in the model, where one number stands for the model as given."""
    return [
        finding(Code.UNEVEN_TARGETS, parameters=[p.name], default=p.default, unit=p.unit)
        for p in environment.space
        if environment.uneven(p)
    ]


def no_rigid_bodies(environment: MjcfEnvironment, density: Posterior, seed: int, prior: bool = False) -> list[Finding]:
    """Where moments of inertia are unknown: a density of which a part is no body's, and is never simulated.

    prior: whether it is the prior, of which a part may be, but hardly all.
    """
    own = [p.name for p in environment.space if any(".inertia_" in target for target in p.targets)]
    if not own:
        return []
    drawn = density.sample((_DRAWS,), generator=torch.Generator().manual_seed(seed)).numpy()
    model = environment.compile()
    share = float(np.mean([not environment.write(model, values) for values in environment.space.values(drawn)]))
    name, least = ("prior", _HARDLY_A_BODY) if prior else ("posterior", _NO_BODY)
    return [finding(Code.NO_RIGID_BODY, parameters=own, share=100 * share, density=name)] if share > least else []


def not_better(scores: Sequence[ChannelScore]) -> list[Finding]:
    """Held-out channels that the calibrated model does not predict better than the model as given."""
    noticed = []
    for s in scores:
        if not math.isfinite(s.rmse):
            noticed.append(finding(Code.HELD_OUT_DIVERGES, log=s.log, channel=s.channel))
        elif math.isfinite(s.rmse_default) and s.rmse > THRESHOLDS.same * s.rmse_default:
            where = functools.partial(finding, log=s.log, channel=s.channel, unit=s.unit)
            noticed.append(where(Code.HELD_OUT_WORSE, rmse=s.rmse, rmse_default=s.rmse_default))
    return noticed


def worse_in_training(windows: BoundLikelihood, theta: FloatArray, scores: Sequence[ChannelScore]) -> list[Finding]:
    """Where theta (N,) follows the logs that it was fitted to worse than the model as given does.

    From measured starts, and if it is worse from these, from those that each model fits best. scores: of these logs.
    """
    if not improvement(scores) < 1 / THRESHOLDS.same:
        return []
    compared = compare_errors(windows, theta, fit_starts=True)
    if compared is None or compared.ratio >= 1 / THRESHOLDS.alike:
        return []
    return [finding(Code.TRAIN_WORSE, ratio=1 / compared.ratio)]


def _of_log(report: LogReport, note: Finding) -> Severity:
    """What the user should read is a caution; that all samples passed through unchanged is none."""
    unchanged = note.code is Code.LOG_CLOCK and not report.resampled
    return Severity.CAUTION if report.suspect and not unchanged else note.severity


def of_logs(reports: Sequence[LogReport]) -> list[Finding]:
    """What the readers noticed; cautions where a log is not simply as it was recorded, else notes."""
    return [
        replace(note, text=f"log {report.name}: {note.text}", severity=_of_log(report, note))
        for report in reports
        for note in report.findings
        if note.code is not Code.LOG_CLIPPED
    ] + _clipped(reports)


def _clipped(reports: Sequence[LogReport]) -> list[Finding]:
    """What is stuck at extreme values, one of each channel, which stands for the first of its logs."""
    noticed = [(report, note) for report in reports for note in report.findings if note.code is Code.LOG_CLIPPED]
    out = []
    for channel in dict.fromkeys(channel for report in reports for channel in report.clipped):
        alike = [(report, note) for report, note in noticed if note.text.startswith(f"{channel}: ")]
        if not alike:
            continue
        names = [report.name for report, _ in alike]
        count = sum(report.clipped[channel] for report, _ in alike)
        total = finding(Code.LOG_CLIPPED, channel=channel, clipped=count, log=names[0])
        more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
        where = f"log{'s' * (len(names) > 1)} {', '.join(names[:_NAMED])}{more}"
        out.append(replace(total, text=f"{where}: {total.text}", severity=Severity.CAUTION))
    return out
