"""The command ``sipe check``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from sipe_bayes.cli.errors import exit_on_error
from sipe_bayes.core.validation import at_least, whole
from sipe_bayes.inference.progress_bar import ProgressBar
from sipe_bayes.inference.registry import ESTIMATORS

SimulatedOn = Annotated[
    str, typer.Option("--device", help="cpu; or cuda, cuda:1: rollouts in float32 on a GPU, with the extra gpu.")
]


def check(
    target: Annotated[str, typer.Argument(help="A configuration (.toml), or a task of `sipe envs`.")],
    estimator: Annotated[str, typer.Argument(help=", ".join(ESTIMATORS))],
    truths: Annotated[int, typer.Option(help="Logs simulated and fitted, at least 20.")] = 100,
    budget: Annotated[int | None, typer.Option(help="Rollouts of each fit; default the estimator's.")] = None,
    refits: Annotated[int, typer.Option(help="Check sipe.Recalibrated(ESTIMATOR, refits=...) instead.")] = 0,
    noise: Annotated[float, typer.Option(help="Of a task: sd as a share of each channel's spread.")] = 0.01,
    steps: Annotated[int, typer.Option(help="Of a task: control steps of a log.")] = 100,
    every: Annotated[bool, typer.Option("--every", help="Go on where the answer is clear before the end.")] = False,
    seed: Annotated[int, typer.Option(help="Of truths, noise and fits.")] = 0,
    out: Annotated[
        Path | None, typer.Option(help="Folder; default checks/NAME-ESTIMATOR. The same command goes on.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")] = False,
    threads: Annotated[int | None, typer.Option(help="Native threads; default all cores.")] = None,
    device: SimulatedOn = "cpu",
) -> None:
    """Simulation-based calibration: do the estimator's intervals hold the truth on this model, noise and commands?

    Exit code 1 where they do not.
    """
    with exit_on_error("; the same command goes on"):
        from sipe_bayes.calibration import check as checks
        from sipe_bayes.calibration.run import run_name
        from sipe_bayes.calibration.study import study_of_config, study_of_task
        from sipe_bayes.core.files import to_json
        from sipe_bayes.diagnostics.coverage import FEWEST

        whole("--truths", truths, FEWEST)
        whole("--steps", steps)
        whole("--refits", refits, 0)
        whole("--seed", seed, 0)
        at_least("--noise", noise, 0)
        path = Path(target)
        make = (
            partial(study_of_config, path)
            if path.suffix == ".toml"
            else partial(study_of_task, target, steps=steps, noise=noise)
        )
        study = make(estimator, budget=budget, refits=refits, seed=seed, threads=threads, device=device)
        folder = out or Path("checks") / f"{run_name(path)}-{estimator}{f'-recalibrated{refits}' if refits else ''}"
        once, each = study.cost
        trained = f"one training of {once} rollouts, then " * bool(once)
        of = f" of at most {each} rollouts each" * bool(each)
        if not as_json:
            print(f"{trained}{truths} fits{of}, kept in {folder}", flush=True)
        with ProgressBar(quiet=as_json, unit="logs", counted=False) as progress:
            outcome = checks.run(study, truths, folder, progress, early=not every)
    if as_json:
        print(to_json(outcome.to_dict()))
    else:
        print(outcome.sentence())
        for line in outcome.check.sentences():
            print(line)
        for name, c in zip(outcome.check.names, outcome.contraction, strict=True):
            print(f"{name}: {outcome.check.verdict(name)}, mean contraction {c:.2f}")
        print(f"figures: {folder / 'ranks.png'}, {folder / 'coverage.png'}")
    if not outcome.calibrated:
        raise typer.Exit(1)
