"""What a search over structures says, made up: as the report and the printed answer get it."""

from __future__ import annotations

import numpy as np

from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.diagnostics.discovery import Discovery, ModelErrors, Piece, Promise, Stage
from sipe_bayes.diagnostics.records import ChannelNoise, Comparison, Misfit, Residual
from sipe_bayes.diagnostics.result import ParameterSummary
from sipe_bayes.posterior import prior
from sipe_bayes.structure.structures import StructureRow
from tests.problems.calibrations import make_posterior, signal, summaries

FALLS = Comparison(2.0, 1.6, 2.5, 1e-4, 20)
NOISE = Misfit(0.4, "drag at hinge", "put it in", "train", "angle", 0, 1, {"angle": 0.01})
SMALL = Misfit(0.005, "drag at hinge", "put it in", "train", "angle", 0, 1, {"angle": 0.04})
LARGE = Misfit(0.005, "drag at hinge", "put it in", "train", "angle", 0, 1, {"angle": 0.4})


def summary(name: str, value: float, unit: str = "N m", nuisance: bool = False) -> ParameterSummary:
    """A value known to a twentieth."""
    sd = value / 20
    return ParameterSummary(
        name, unit, (), value, sd, value - 1.6 * sd, value, value + 1.6 * sd, value, 0.0, 0.9, nuisance
    )


def piece(name: str, site: str = "hinge", kept: bool = False, **changes: object) -> Piece:
    """An extension that was fitted."""
    told: dict[str, object] = {
        "label": f"{name}:{site}",
        "sentence": f"{name} at {site}",
        "reference": "somebody 1900",
        "weight": 1.0 if kept else 0.0,
        "gain": 40.0,
        "error": 9.0,
        "kept": kept,
        "tied": False,
        "kind": "joint",
        "native": True,
        "nearest": "",
        "parameters": (f"{site}.{name}",),
    }
    return Piece(**told | changes)  # type: ignore[arg-type]


def row(*labels: str, weight: float = 0.0, behind: float = 0.0) -> StructureRow:
    """A structure, the plain one without labels; of the set that the logs support where it has a weight."""
    gain = 20.0 * len(labels)
    return StructureRow(labels, labels, gain / 2, gain, 6.3, behind, 9.0, weight > 0, weight, 100)


def make_discovery(*pieces: Piece, rows: int = 2, tied: tuple[StructureRow, ...] = ()) -> Discovery:
    """A pendulum with two unknowns and a log each to train and hold out; what was kept has values of 0.1."""
    posterior = make_posterior(ParameterSpace(Parameter(n, 1.0, 2.0, 1.5, "kg") for n in ("mass", "arm")))
    found = [name for p in pieces if p.kept for name in p.parameters]
    residual = Residual("train", "angle", "rad", np.arange(201) * 0.01, np.ones(201), np.ones(201))
    noise = {"angle": ChannelNoise(0.01, 0.1, "rad")}
    return Discovery(
        name="pendulum",
        rows=(row("dry friction at hinge", weight=0.6 if tied else 1.0), *tied, *[row() for _ in range(rows - 1)]),
        pieces=pieces,
        promises=(
            Promise("dry_friction:hinge", "dry friction at hinge", 44.0, True),
            Promise("spring:hinge", "a spring at hinge", 2.0, False, True),
        ),
        posterior=posterior,
        prior=prior(posterior.space),
        parameters=tuple(summaries(posterior)),
        plain_parameters=tuple(summaries(posterior)),
        added=tuple(summary(name, 0.1) for name in found),
        best={"mass": 1.2, "arm": 1.6} | dict.fromkeys(found, 0.1),
        errors=tuple(ModelErrors(log, log, "angle", "rad", 0.5, 0.1, 0.05, 0.08, 0.04) for log in ("holdout", "train")),
        comparison=FALLS,
        before=Stage(noise, LARGE, (residual,)),
        after=Stage(noise, NOISE, (residual,)),
        signals=tuple(signal(log, log, "angle") for log in ("holdout", "train")),
        settled=True,
        rollouts=1234,
        seconds=5.6,
        out="runs/pendulum-discover",
    )
