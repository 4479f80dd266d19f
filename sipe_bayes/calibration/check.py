"""Is an estimator calibrated on one's own model, noise and commands? What ``sipe check`` does, also from Python.

Truths are drawn from the prior, the recorded experiment is simulated at each of them with the noise of the recording
(``sipe_bayes.likelihood.replicas``), the estimator is fitted to each simulated log, and ``diagnostics.coverage``
compares. Where the answer is clear sooner the rest is spared. Each fit has a seed of its
own: with one seed the errors of sampling would be the same in all. An amortised estimator is trained once, so that
its errors are, and then conditions on each log. Every fit is one file, so an interrupted check goes on.

A truth whose simulation diverges is drawn anew: the check is of the prior restricted to what can be simulated.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sipe_bayes.calibration.output import claimed
from sipe_bayes.calibration.study import Study
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.files import FileError, read_arrays, reading, replacing, to_json, write_bytes, write_text
from sipe_bayes.core.findings import Finding, Severity
from sipe_bayes.core.seeding import seed_integer, torch_generator
from sipe_bayes.core.thresholds import THRESHOLDS
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.core.validation import whole
from sipe_bayes.diagnostics.coverage import FEWEST, CalibrationCheck, check_draws, clearly_wrong, mass_below
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.recalibrated import Recalibrated
from sipe_bayes.likelihood import Replicas
from sipe_bayes.report.check_plots import coverage_curve, rank_check
from sipe_bayes.report.drawing import png

Tell = Callable[[str, int, int], None]

FITS, IDENTITY, RESULT = "fits", "check.json", "result.json"
_DRAWS = 999  # of each posterior: a rank among them to a thousandth
_TRIES = 50  # truths drawn until one can be simulated


@dataclass(frozen=True)
class Fit:
    """One simulation and its posterior; training once counts with the first.

    Args:
        truth: (N,) in theta.
        draws: (M, N) in theta.
        rollouts: of the fit.
        seconds: of the fit.
        error: why there are no draws.
        warned: codes of what the estimator itself noticed, notes aside.
    """

    truth: FloatArray
    draws: FloatArray
    rollouts: int
    seconds: float
    error: str = ""
    warned: tuple[str, ...] = ()

    def save(self, path: Path) -> None:
        """Write it as one file, whole or not at all."""
        with replacing(path) as temporary, temporary.open("wb") as file:
            numbers, error = np.array([self.rollouts, self.seconds]), np.array(self.error)
            warned = np.array(self.warned, dtype=str)
            np.savez_compressed(file, truth=self.truth, draws=self.draws, error=error, numbers=numbers, warned=warned)

    @classmethod
    def load(cls, path: Path) -> Fit | None:
        """None where there is none or it cannot be read: it is then done again."""
        try:
            with reading(path, "a fit", "delete it"):
                data: dict[str, Any] = read_arrays(path)
                rollouts, seconds = data["numbers"].tolist()
                error, warned = str(data["error"]), tuple(map(str, data["warned"]))
                return cls(data["truth"], data["draws"], int(rollouts), seconds, error, warned)
        except FileError:
            return None


@dataclass(frozen=True)
class CheckResult:
    """What the fits of a study say together.

    Args:
        study: what was checked.
        check: ranks, coverage and TARP.
        contraction: (N,) mean of 1 - sd / prior sd.
        interval_score: (N,) mean width of 90 % intervals plus 20 times what the truth lies outside, in theta.
        standard_error: of the pooled coverage, by fit.
        failed: logs that could not be fitted.
        seconds: of all fits.
        rollouts: of all fits.
        warned: fits of which the estimator itself warned.
        spared: logs that were not simulated any more, as the posteriors were clearly wrong before.
    """

    study: Study
    check: CalibrationCheck
    contraction: FloatArray
    interval_score: FloatArray
    standard_error: float
    failed: int
    seconds: float
    rollouts: int
    warned: int
    spared: int = 0

    @property
    def calibrated(self) -> bool:
        """Whether nothing gives cause for alarm."""
        return self.check.calibrated and not self.spared

    def sentence(self) -> str:
        """The verdict."""
        share = float(self.check.coverage(THRESHOLDS.shown_interval).mean())
        held = (
            f"{self.study.method} on {self.study.name}: {100 * THRESHOLDS.shown_interval:.0f} % intervals hold the "
            f"truth {100 * share:.0f} ± {100 * self.standard_error:.0f} % of the time ({self.check.truths} logs)"
        )
        lost = f"; {self.failed} more logs could not be fitted" if self.failed else ""
        lost += f"; the estimator itself warned of {self.warned} fits" if self.warned else ""
        lost += f"; {self.spared} logs were spared, as the answer was clear" if self.spared else ""
        if self.calibrated:
            idle = [n for n, c in zip(self.check.names, self.contraction, strict=True) if c < THRESHOLDS.idle]
            but = f", but of {', '.join(idle)} the posterior says no more than the prior" if idle else ""
            return f"{held}: no cause for alarm{but}{lost}"
        remedy = "give it more refits" if self.study.refits else "use sipe.Recalibrated(...)"
        return f"{held}: {self._fault()}; {remedy}{lost}"

    def _fault(self) -> str:
        verdicts = [self.check.verdict(name) for name in self.check.names]
        wrong = sorted(set(verdicts) - {"calibrated"})
        if not wrong:
            return "too few hold it" if self.spared else "the parameters are not right jointly (TARP)"
        most = max(wrong, key=verdicts.count)
        named = [name for name, verdict in zip(self.check.names, verdicts, strict=True) if verdict == most]
        return most if len(named) == len(self.check.names) else f"{most} ({', '.join(named)})"

    def to_dict(self) -> dict[str, object]:
        """What ``--json`` prints."""
        by_name = zip(self.check.names, self.contraction.tolist(), self.interval_score.tolist(), strict=True)
        return {
            "model": self.study.name,
            "estimator": self.study.method,
            "verdict": self.sentence(),
            "coverage_90": float(self.check.coverage(THRESHOLDS.shown_interval).mean()),
            "standard_error": self.standard_error,
            "sharpness": {name: {"contraction": c, "interval_score": s} for name, c, s in by_name},
            "failed": self.failed,
            "warned": self.warned,
            "spared": self.spared,
            "rollouts": self.rollouts,
            "seconds": round(self.seconds, 1),
            **self.check.to_dict(),
            "calibrated": self.calibrated,
        }


def run(
    study: Study, truths: int, folder: Path, tell: Tell = lambda what, done, of: None, early: bool = False
) -> CheckResult:
    """Fit what is missing in a folder, compare, write figures and result.

    Args:
        study: what is checked.
        truths: how many, at least 20.
        folder: of this check.
        tell: called with what is being done, how many are done, and of how many.
        early: whether it ends as soon as the posteriors are clearly wrong.

    Raises:
        ValueError: where the folder holds another check, one is at work in it, or fewer than 20 logs could be fitted.
    """
    whole("truths", truths, FEWEST)
    identity = study.identity()
    with claimed(folder, identity, IDENTITY, sorted(identity), "check"):
        worker = _Worker(study, folder, tell)
        fits, ranks = list[Fit](), list[FloatArray]()
        for number in range(truths):
            path = folder / FITS / f"{number:05d}.npz"
            fit = Fit.load(path)
            if fit is None:
                tell(f"{study.method}: log {number + 1} of {truths}{_left(fits, truths)}", number, truths)
                fit = worker.fit(number)
                fit.save(path)
            fits.append(fit)
            if not fit.error:
                ranks.append(mass_below(fit.draws, fit.truth, np.random.default_rng([study.seed, 6, number])))
            if early and len(ranks) >= FEWEST and clearly_wrong(np.stack(ranks)):
                break
        result = replace(compare(study, fits), spared=truths - len(fits))
        write_bytes(folder / "ranks.png", png(rank_check(result.check)))
        write_bytes(folder / "coverage.png", png(coverage_curve(result.check)))
        write_text(folder / RESULT, to_json(result.to_dict(), indent=2))
        return result


def _left(fits: list[Fit], truths: int) -> str:
    """The time that the rest will take, in words; that of the first log holds an amortised estimator's training."""
    if len(fits) < 2:
        return ""
    minutes = float(np.mean([fit.seconds for fit in fits[1:]])) * (truths - len(fits)) / 60
    return f", about {minutes:.0f} minutes left" if minutes >= 1.5 else ", about a minute left"


def compare(study: Study, fits: list[Fit]) -> CheckResult:
    """What the fits of a study's logs say together; raises ValueError where fewer than 20 gave a posterior."""
    good = [fit for fit in fits if not fit.error]
    if len(good) < FEWEST:
        why = next((fit.error for fit in fits if fit.error), "")
        raise ValueError(f"truths: {len(good)} of {len(fits)} logs could be fitted, {FEWEST} are the least ({why})")
    truths = np.stack([fit.truth for fit in good])
    check = check_draws(study.estimator.space.names, [fit.draws for fit in good], truths, seed=study.seed)
    inside = np.stack([u.values <= THRESHOLDS.shown_interval for u in check.intervals], axis=1)
    sd = np.stack([fit.draws.std(0) for fit in good])
    low, high = np.moveaxis(np.stack([np.quantile(fit.draws, [0.05, 0.95], axis=0) for fit in good]), 1, 0)
    outside = np.maximum(low - truths, 0) + np.maximum(truths - high, 0)
    return CheckResult(
        study,
        check,
        np.asarray(1 - (sd / study.estimator.prior.stddev.numpy()).mean(0)),
        np.asarray((high - low + 2 / (1 - THRESHOLDS.shown_interval) * outside).mean(0)),
        float(inside.mean(1).std(ddof=1) / np.sqrt(len(good))),
        len(fits) - len(good),
        sum(fit.seconds for fit in fits),
        sum(fit.rollouts for fit in fits),
        sum(bool(fit.warned) for fit in good),
    )


def simulated_log(study: Study, number: int, replicas: Replicas | None = None) -> tuple[FloatArray, Trajectories]:
    """A truth (N,) in theta of a study, and the experiment as it would have been recorded there.

    Args:
        study: whose experiment it is.
        number: of the log; the same one gives the same log.
        replicas: of the study's, where they are at hand.
    """
    replicas = replicas or Replicas(study.estimator.simulator, study.trajectories, study.noise, study.process)
    rng, generator = np.random.default_rng([study.seed, 1, number]), torch_generator([study.seed, 2, number])
    for _ in range(_TRIES):
        truth = study.estimator.prior.sample((), generator=generator).numpy()
        log = replicas.make(truth, rng)
        if log is not None:
            return truth, log
    raise ValueError(
        f"simulator: {_TRIES} draws of the prior in a row diverged under these commands; narrow the bounds"
    )


class _Worker:
    """Makes a truth's log and fits it."""

    def __init__(self, study: Study, folder: Path, tell: Tell) -> None:
        self.study, self.folder, self.tell = study, folder, tell
        self.replicas = Replicas(study.estimator.simulator, study.trajectories, study.noise, study.process)
        self._trained: Estimator | None = None
        self._before: tuple[int, frozenset[Finding]] = (0, frozenset())  # rollouts and findings of training

    def fit(self, number: int) -> Fit:
        """The fit of one truth's log."""
        truth, log = simulated_log(self.study, number, self.replicas)
        began, draws, error = time.monotonic(), np.empty((0, len(truth))), ""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            estimator = self._estimator(number)
            try:
                posterior = estimator.get_parameter_estimate(log) if estimator is self._trained else estimator.fit(log)
                draws = posterior.sample((_DRAWS,), generator=self._generator(3, number)).numpy()
            except ValueError as problem:  # LinAlgError is one
                error = " ".join(str(problem).split()) or type(problem).__name__
        seconds = time.monotonic() - began
        rollouts, of_training = self._before if number else (0, frozenset())
        own = (item for item in estimator.findings if item.severity is not Severity.NOTE and item not in of_training)
        warned = tuple(str(item.code) for item in own)
        return Fit(truth, draws, estimator.rollouts - rollouts, seconds, error, warned)

    def _tell_training(self, what: str, done: int, total: int) -> None:
        self.tell(f"{what}, {done} of at most {total} rollouts", done, total)

    def _estimator(self, number: int) -> Estimator:
        study = self.study
        if study.estimator.amortised and self._trained is None:
            self._trained = study.estimator.fresh()
            self._trained.checkpoint = self.folder / "trained.safetensors"
            self._trained.progress = self._tell_training
            self._trained.fit(study.trajectories)
            self._trained.progress = None
            self._before = self._trained.rollouts, frozenset(self._trained.findings)
        base = self._trained
        if base is None:
            base = study.estimator.fresh()
            base.seed = self._seed(5, number)
        return Recalibrated(base, refits=study.refits, seed=self._seed(4, number)) if study.refits else base

    def _seed(self, *what: int) -> int:
        return seed_integer([self.study.seed, *what])

    def _generator(self, *what: int) -> torch.Generator:
        return torch_generator([self.study.seed, *what])
