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
        probability: that the model lacks it, given the logs and what was tried.
        evidence: nats that it adds to the rest of the most probable structure that has it; None where the rest was not
            fitted.
        held_out: nats of held-out pieces, likewise; None also where there are no pieces.
        kept: whether the most probable structure has it.
        log_score: nats that held-out logs gain by it in the round that it would have won; None where it was not asked.
        undecided: whether it is out although its evidence pays for it, since held-out pieces or logs speak against it.
        kind: what it is placed at: ``joint``, ``actuator``, ``channel`` (a measurement) or ``world``.
        native: whether MJCF has an element for it.
        nearest: the element that comes nearest where it has none.
        parameters: names of its parameters.
    """

    label: str
    sentence: str
    reference: str
    probability: float
    evidence: float | None
    held_out: float | None
    log_score: float | None
    kept: bool
    undecided: bool
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
        after: of the most probable structure, from measured starts.
        fitted_before: of the plain model, calibrated, from the starts that fit it best.
        fitted_after: of the most probable structure, from the starts that fit it best.
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
        columns: of the logs that have a wrong sign or unit, in words; everything below is of the logs set right.
        rows: structures that were fitted, most probable first.
        pieces: extensions that were fitted, most probable first.
        promises: what extensions promised at the plain model, best first.
        posterior: of the user's parameters, averaged over structures.
        prior: of them.
        parameters: that posterior by parameter.
        plain_parameters: the posterior under the plain model.
        added: parameters of the most probable structure's extensions, averaged over the structures that have them.
        cost: nats of evidence that an extension has to gain, since there were so many to choose from.
        best: the optimum of the most probable structure, in units.
        errors: before and after, held-out logs first.
        comparison: of the held-out errors after with those before, from the starts that each model fits best; None
            without both.
        before: what the plain model leaves.
        after: what the most probable structure leaves.
        signals: of each log and channel; ``mode`` is the structure, ``default`` the plain model, calibrated.
        named_share: of what can be explained, what named pieces explain; None where that was not asked.
        settled: whether every fit that counts came to rest, and the budget was enough.
        rollouts: of all fits.
        column_rollouts: those of them that tried signs and units of columns.
        seconds: that it took.
        findings: what was noticed on the way.
        run: record of the run.
        out: folder of the results.
        best_settled: whether the fit of the most probable structure came to rest.
    """

    name: str
    columns: tuple[str, ...]
    rows: tuple[StructureRow, ...]
    pieces: tuple[Piece, ...]
    promises: tuple[Promise, ...]
    posterior: Posterior
    prior: Posterior
    parameters: tuple[ParameterSummary, ...]
    plain_parameters: tuple[ParameterSummary, ...]
    added: tuple[ParameterSummary, ...]
    cost: float
    best: Mapping[str, float]
    errors: tuple[ModelErrors, ...]
    comparison: Comparison | None
    before: Stage
    after: Stage
    signals: tuple[Signal, ...] = field(repr=False)
    named_share: float | None
    settled: bool
    rollouts: int
    column_rollouts: int
    seconds: float
    findings: tuple[Finding, ...] = ()
    run: Mapping[str, object] = field(default_factory=dict)
    out: str = ""
    best_settled: bool = True

    @property
    def kept(self) -> tuple[Piece, ...]:
        """The pieces of the most probable structure."""
        return tuple(piece for piece in self.pieces if piece.kept)

    @property
    def passes(self) -> bool:
        """Whether what the most probable structure leaves passes for noise, or for something small beside it."""
        return self.after.misfit is not None and not self.after.misfit.matters

    def to_dict(self) -> dict[str, object]:
        """As JSON has it, without signals and residuals."""
        return {
            "name": self.name,
            "columns": list(self.columns),
            "structures": [asdict(row) for row in self.rows],
            "pieces": [asdict(piece) for piece in self.pieces],
            "promises": [asdict(promise) for promise in self.promises],
            "parameters": [asdict(p) for p in self.parameters],
            "plain_parameters": [asdict(p) for p in self.plain_parameters],
            "added": [asdict(p) for p in self.added],
            "cost": self.cost,
            "best": dict(self.best),
            "errors": [asdict(row) for row in self.errors],
            "comparison": None if self.comparison is None else self.comparison.to_dict(),
            **{name: _stage(stage) for name, stage in (("before", self.before), ("after", self.after))},
            "named_share": self.named_share,
            "settled": self.settled,
            "best_settled": self.best_settled,
            "findings": [item.to_dict() for item in self.findings],
            "warnings": Findings(self.findings).warnings,
            "rollouts": self.rollouts,
            "column_rollouts": self.column_rollouts,
            "seconds": self.seconds,
            "out": self.out,
        }


def _stage(stage: Stage) -> dict[str, object]:
    misfit = None if stage.misfit is None else {**asdict(stage.misfit), "alarm": stage.misfit.alarm}
    return {"noise": {channel: asdict(noise) for channel, noise in stage.noise.items()}, "misfit": misfit}
