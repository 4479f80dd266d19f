"""What a search over structures said about a user's logs, as plain data: the command prints it, the report draws it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from sipe_bayes.core.findings import Finding, Findings
from sipe_bayes.diagnostics.records import ChannelNoise, Comparison, Misfit, Residual, Signal, plain
from sipe_bayes.diagnostics.result import ParameterSummary
from sipe_bayes.posterior import Posterior
from sipe_bayes.structure.structures import StructureRow


@dataclass(frozen=True)
class Piece:
    """An extension that was fitted; ``kind``, ``native`` and ``nearest`` as ``Extension`` has them.

    Args:
        label: what tells it from others, as the table of structures has it.
        weight: sum of the stacking weights of the structures that have it.
        gain: nats of log predictive density that it adds to the rest of the best structure that has it; None where the
            rest was not fitted, as its standard ``error``.
        kept: whether the structure that is written out has it.
        tied: whether another structure of the set that the logs support has it.
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
    """What an extension promised at the plain model: nats of log likelihood; ``unfinished``: a fit with it failed."""

    label: str
    sentence: str
    gain: float
    fitted: bool
    unfinished: bool = False


@dataclass(frozen=True)
class ModelErrors:
    """RMSE of one channel of one log in its unit: of the nominal model, the calibrated plain one, and the written one.

    From measured starts; ``fitted_before`` and ``fitted_after`` are those from the starts that each fits best.
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
    """What a model leaves of the training logs; ``misfit`` is None where it cannot be told."""

    noise: Mapping[str, ChannelNoise]
    misfit: Misfit | None
    residuals: tuple[Residual, ...] = field(repr=False)


@dataclass(frozen=True)
class Discovery:
    """The outcome of ``sipe discover``; "written" is the structure that is written out.

    Args:
        rows: structures that were fitted, the set that the logs support first.
        pieces: extensions that were fitted, the written ones first.
        promises: what extensions promised at the plain model, best first.
        posterior: of the user's parameters, stacked over the set that the logs support; ``parameters`` sums it up.
        plain_parameters: the posterior under the plain model.
        added: parameters of the written extensions, stacked over the structures that have them.
        best: the written optimum, in units.
        errors: before and after, held-out logs first.
        comparison: of the held-out errors after with those before, from best starts; None without both.
        before, after: what the plain and the written model leave.
        signals: of each log and channel; ``mode`` is the written, ``default`` the plain model, calibrated.
        settled: whether every fit that counts converged, and the budget was enough; ``best_settled`` the written one.
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
        names = "name pieces promises parameters plain_parameters added best errors comparison settled best_settled"
        stages = {"before": self.before, "after": self.after}
        return {
            **{name: plain(getattr(self, name)) for name in (*names.split(), "findings", "rollouts", "seconds", "out")},
            **{name: plain({"noise": one.noise, "misfit": one.misfit}) for name, one in stages.items()},
            "structures": plain(self.rows),
            "warnings": Findings(self.findings).warnings,
        }
