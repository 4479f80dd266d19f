"""What a search over structures said about a user's logs, as plain data: the command prints it, the report draws it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

from sipe_bayes.core.findings import Finding, Findings
from sipe_bayes.diagnostics.records import ChannelNoise, Comparison, Misfit, Residual, Signal
from sipe_bayes.diagnostics.result import ParameterSummary
from sipe_bayes.posterior import Posterior
from sipe_bayes.structure.structures import StructureRow


@dataclass(frozen=True)
class Piece:
    """An extension that was fitted.

    Args:
        label: what tells it from others, as the table of structures has it.
        sentence: what it is.
        reference: where it is described.
        weight: sum of the stacking weights of the structures that have it.
        gain: nats of log predictive density that it adds to the rest of the best structure that has it; None where the
            rest was not fitted.
        error: standard error of the gain.
        kept: whether the structure that is written out has it.
        tied: whether another structure of the set that the logs support has it.
        kind: what it is placed at: ``joint``, ``actuator``, ``channel`` (a measurement) or ``world``.
        native: whether MJCF has an element for it.
        nearest: the element that comes nearest where it has none.
        parameters: names of its parameters.
    """

    label: str
    sentence: str
    reference: str
    weight: float
    gain: float | None
    error: float | None
    kept: bool
    tied: bool
    kind: str
    native: bool
    nearest: str
    parameters: tuple[str, ...]


@dataclass(frozen=True)
class Promise:
    """What an extension promised at the plain model.

    Args:
        label: of the extension.
        sentence: what it is.
        gain: log-likelihood that it is to gain, in nats.
        fitted: whether it was fitted.
        unfinished: whether a fit with it, alone or beside others, could not be brought to its end.
    """

    label: str
    sentence: str
    gain: float
    fitted: bool
    unfinished: bool = False


@dataclass(frozen=True)
class ModelErrors:
    """Root-mean-square errors of one channel of one log over open-loop windows.

    Args:
        log: its name.
        use: ``train`` or ``holdout``.
        channel: its name.
        unit: of the errors.
        given: of the model as given, from measured starts.
        before: of the plain model, calibrated, from measured starts.
        after: of the structure that is written out, from measured starts.
        fitted_before: of the plain model, calibrated, from the starts that fit it best.
        fitted_after: of the structure that is written out, from the starts that fit it best.
    """

    log: str
    use: str
    channel: str
    unit: str
    given: float
    before: float
    after: float
    fitted_before: float
    fitted_after: float


@dataclass(frozen=True)
class Stage:
    """What a model leaves of the training logs.

    Args:
        noise: of each channel.
        misfit: whether the residuals pass for noise; None where that cannot be told.
        residuals: of each log and channel.
    """

    noise: Mapping[str, ChannelNoise]
    misfit: Misfit | None
    residuals: tuple[Residual, ...] = field(repr=False)


@dataclass(frozen=True)
class Discovery:
    """The outcome of ``sipe discover``.

    Args:
        name: of the run.
        rows: structures that were fitted, the set that the logs support first.
        pieces: extensions that were fitted, those of the structure that is written out first.
        promises: what extensions promised at the plain model, best first.
        posterior: of the user's parameters, stacked over the set that the logs support.
        prior: of them.
        parameters: that posterior by parameter.
        plain_parameters: the posterior under the plain model.
        added: parameters of the written structure's extensions, stacked over the structures that have them.
        best: the optimum of the structure that is written out, in units.
        errors: before and after, held-out logs first.
        comparison: of the held-out errors after with those before, from the starts that each model fits best; None
            without both.
        before: what the plain model leaves.
        after: what the structure that is written out leaves.
        signals: of each log and channel; ``mode`` is the structure, ``default`` the plain model, calibrated.
        settled: whether every fit that counts came to rest, and the budget was enough.
        rollouts: of all fits.
        seconds: that it took.
        findings: what was noticed on the way.
        run: record of the run.
        out: folder of the results.
        best_settled: whether the fit of the structure that is written out came to rest.
        ended: what cut the search short: its "budget", its "time", or that it was "interrupted"; else nothing.
    """

    name: str
    rows: tuple[StructureRow, ...]
    pieces: tuple[Piece, ...]
    promises: tuple[Promise, ...]
    posterior: Posterior
    prior: Posterior
    parameters: tuple[ParameterSummary, ...]
    plain_parameters: tuple[ParameterSummary, ...]
    added: tuple[ParameterSummary, ...]
    best: Mapping[str, float]
    errors: tuple[ModelErrors, ...]
    comparison: Comparison | None
    before: Stage
    after: Stage
    signals: tuple[Signal, ...] = field(repr=False)
    settled: bool
    rollouts: int
    seconds: float
    findings: tuple[Finding, ...] = ()
    run: Mapping[str, object] = field(default_factory=dict)
    out: str = ""
    best_settled: bool = True
    ended: str = ""

    @property
    def kept(self) -> tuple[Piece, ...]:
        """The pieces of the structure that is written out."""
        return tuple(piece for piece in self.pieces if piece.kept)

    @property
    def passes(self) -> bool:
        """Whether what the structure that is written out leaves passes for noise, or for something small beside it."""
        return self.after.misfit is not None and not self.after.misfit.matters

    def to_dict(self) -> dict[str, object]:
        """As JSON has it, without signals and residuals."""
        return {
            "name": self.name,
            "structures": [asdict(row) for row in self.rows],
            "pieces": [asdict(piece) for piece in self.pieces],
            "promises": [asdict(promise) for promise in self.promises],
            "parameters": [asdict(p) for p in self.parameters],
            "plain_parameters": [asdict(p) for p in self.plain_parameters],
            "added": [asdict(p) for p in self.added],
            "best": dict(self.best),
            "errors": [asdict(row) for row in self.errors],
            "comparison": None if self.comparison is None else self.comparison.to_dict(),
            **{name: _stage(stage) for name, stage in (("before", self.before), ("after", self.after))},
            "settled": self.settled,
            "best_settled": self.best_settled,
            "findings": [item.to_dict() for item in self.findings],
            "warnings": Findings(self.findings).warnings,
            "rollouts": self.rollouts,
            "seconds": self.seconds,
            "out": self.out,
        }


def _stage(stage: Stage) -> dict[str, object]:
    misfit = None if stage.misfit is None else {**asdict(stage.misfit), "alarm": stage.misfit.alarm}
    return {"noise": {channel: asdict(noise) for channel, noise in stage.noise.items()}, "misfit": misfit}
