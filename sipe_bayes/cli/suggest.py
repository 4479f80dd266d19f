"""The command ``sipe suggest``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from sipe_bayes.cli.errors import exit_on_error
from sipe_bayes.core.validation import positive, whole

if TYPE_CHECKING:
    from sipe_bayes.calibration.problem import Problem
    from sipe_bayes.diagnostics.suggest import Plan
    from sipe_bayes.likelihood import Noise
    from sipe_bayes.posterior import Posterior

_SHOWN = 10
_MOST, _MOST_STEPS = 10_000, 10_000_000  # sequences, and control steps of all of them


def suggest(
    config: Annotated[Path, typer.Argument(help="TOML file of `sipe calibrate`.")],
    candidates: Annotated[int, typer.Option(help="Sequences that are generated.")] = 24,
    given: Annotated[
        list[Path] | None,
        typer.Option(help="CSV of commands with columns as the logs', to be ranked too; again for several."),
    ] = None,
    parameter: Annotated[
        list[str] | None, typer.Option("--for", help="Parameters that count; again for several; default all.")
    ] = None,
    posterior: Annotated[
        Path | None, typer.Option(help="What is known so far: RUN/posterior of `sipe calibrate`; default the prior.")
    ] = None,
    duration: Annotated[float, typer.Option(help="Seconds.")] = 5.0,
    low: Annotated[float | None, typer.Option(help="Hz; default one period in the duration.")] = None,
    high: Annotated[float | None, typer.Option(help="Hz; default 5, or a fifth of the log's rate.")] = None,
    draws: Annotated[int, typer.Option(help="Of what is known, over which the gain is averaged.")] = 4,
    seed: Annotated[int, typer.Option(help="Of candidates and draws.")] = 0,
    out: Annotated[Path, typer.Option(help="The best sequence, as CSV with the configuration's columns.")] = Path(
        "suggested.csv"
    ),
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")] = False,
    threads: Annotated[int | None, typer.Option(help="Native threads; default all cores.")] = None,
) -> None:
    """Which experiment next: command sequences ranked by the expected contraction of the parameters' sds."""
    with exit_on_error():
        from sipe_bayes.calibration.problem import prepare
        from sipe_bayes.core.files import to_json
        from sipe_bayes.diagnostics import suggest as suggestions
        from sipe_bayes.report.words import listed

        whole("--candidates", candidates, 0)
        whole("--seed", seed, 0)
        whole("--draws", draws)
        positive("--duration", duration)
        problem = prepare(config, threads)
        if any(command.supply is not None for command in problem.config.commands):
            raise ValueError(f"{config}: a supply's voltage can not be planned; drop `supply` from the commands")
        read = (config, problem.config.model, *(log.file for log in problem.config.logs), *(given or []))
        if out.resolve() in (path.resolve() for path in read):
            raise ValueError(f"--out {out}: is what {config} reads, and would be lost; choose another name")
        dt = float(problem.train.dt[0])
        _check_amount(candidates, duration, dt)
        bounds = suggestions.limits(problem.simulator, np.concatenate([log.actions for log in problem.train]))
        band = (low or 1 / duration, high or min(5.0, 0.2 / dt))
        plans = suggestions.generate(candidates, duration, dt, bounds, band, seed)
        plans += [_read(problem, file, dt) for file in given or []]
        if not plans:
            raise ValueError("--candidates: expected at least 1, or --given; got none")
        known, noise = _known(problem, posterior), _noise(problem, posterior)
        model = problem.simulator, problem.segments
        seen = np.concatenate([log.observations for log in problem.train])
        reached = np.stack([np.nanmin(seen, axis=0), np.nanmax(seen, axis=0)], axis=1)
        ranked = suggestions.rank(*model, plans, noise, known, parameter or (), reached=reached, draws=draws, seed=seed)
        _write(problem, ranked[0].plan, out)
    if as_json:
        names = list(parameter or problem.simulator.space.names)
        print(to_json({"parameters": names, "candidates": [one.to_dict() for one in ranked], "out": str(out)}))
        return
    environment, space = problem.environment, problem.simulator.space
    units = dict(zip(environment.channels, environment.channel_units, strict=True))
    for one in ranked[:_SHOWN]:
        each = ", ".join(f"{name} {one.contraction[name]:.2f}" for name in parameter or space.names)
        reach = ", ".join(f"{c} {a:.3g} to {b:.3g} {units[c]}" for c, (a, b) in one.reach.items())
        lost = f"; diverges at {one.diverged} of {draws} draws" if one.diverged else ""
        far = f"; far beyond the logs in {listed(one.strays)}" if one.strays else ""
        print(f"{one.score:.3f}  {one.plan.name}: expected contraction {each}; reaches {reach}{far}{lost}")
    if ranked[0].strays:
        print(
            f"the first one is in {out}; NOT to be run as it is: each takes the machine far beyond where the logs were"
        )
    else:
        print(f"the first one is in {out}; check what it reaches before it runs on the machine")


def _check_amount(candidates: int, duration: float, dt: float) -> None:
    """Raises ValueError for more sequences than anybody waits for."""
    if candidates > _MOST or candidates * duration / dt > _MOST_STEPS:
        raise ValueError(
            f"--candidates {candidates:.4g} --duration {duration:g}: expected at most {_MOST} sequences of "
            f"{_MOST_STEPS:.0e} control steps together; lower them"
        )


def _known(problem: Problem, path: Path | None) -> Posterior:
    from sipe_bayes.posterior import load_posterior

    if path is None:
        return problem.prior
    posterior = load_posterior(path)
    difference = posterior.space.difference(problem.simulator.space)
    if difference:
        raise ValueError(f"--posterior {path}: {difference} in the configuration; give that of a run of it")
    return posterior


def _noise(problem: Problem, path: Path | None) -> Noise:
    """Of the fitted channels: as the run beside the posterior found it, else by a fit."""
    from pydantic import TypeAdapter

    from sipe_bayes.core.files import read_json, reading
    from sipe_bayes.inference.log_noise import fitted_noise
    from sipe_bayes.likelihood import Noise

    channels = list(problem.simulator.environment.channels)
    fitted = list(problem.segments.fit or channels)
    record = None if path is None else path.parent / "result.json"
    if record is not None and record.is_file():
        remedy = "calibrate again, or give a copy of the posterior alone"
        plain = read_json(record, "the result of a run", remedy)
        with reading(record, "the result of a run", remedy):
            noise = TypeAdapter(dict[str, dict[str, float | None]]).validate_python(plain["noise"])
            if set(fitted) <= set(noise):
                return Noise(*(np.array([noise[c][what] for c in fitted], float) for what in ("sd", "tau")))
    every = fitted_noise(problem.simulator, problem.likelihood, problem.train, problem.prior).noise
    chosen = [channels.index(c) for c in fitted]
    return Noise(every.sd[chosen], every.tau[chosen])


def _read(problem: Problem, file: Path, dt: float) -> Plan:
    """Commands of a table, in the configuration's columns and units, on the logs' grid."""
    from sipe_bayes.calibration.readers.tables import read_table
    from sipe_bayes.core.units import to_si
    from sipe_bayes.diagnostics.suggest import Plan

    clock, commands, model = problem.config.columns.time, problem.config.commands, problem.simulator.model
    table, names = read_table(file), [clock.column, *(c.column for c in commands)]
    for name in names:
        if name not in table:
            raise ValueError(f"--given {file}: no column {name!r}; it has {list(table)}")
    seconds, *series = (_numbers(file, name, table[name]) for name in names)
    seconds = (seconds - seconds[0]) * to_si(clock.unit)[0]
    if any(len(values) != len(seconds) for values in series) or not (np.diff(seconds) > 0).all():
        raise ValueError(f"--given {file}: expected a command for each time, and times that increase; sort the rows")
    grid = np.arange(0.0, seconds[-1] + 0.5 * dt, dt)
    held = np.clip(np.searchsorted(seconds, grid + 1e-9, side="right") - 1, 0, None)
    scales = [c.sign * c.factor * to_si(c.unit)[0] for c in commands]
    columns = [scale * (values[held] - c.zero) for c, scale, values in zip(commands, scales, series, strict=True)]
    for command, values in zip(commands, columns, strict=True):
        actuator = model.actuator(command.actuator).id
        low, high = model.actuator_ctrlrange[actuator]
        slack = 1e-6 * (high - low)
        if model.actuator_ctrllimited[actuator] and not low - slack <= values.min() <= values.max() <= high + slack:
            raise ValueError(
                f"--given {file}: {command.column!r} makes {command.actuator} go from {values.min():.4g} to "
                f"{values.max():.4g}, beyond its control range, {low:.4g} to {high:.4g}, in the model's unit; "
                "make it smaller"
            )
    return Plan(np.stack(columns, axis=1), dt, name=str(file))


def _numbers(file: Path, name: str, column: Any) -> Any:
    try:
        values = np.asarray(column, float)
    except (TypeError, ValueError):
        values = np.full(1, np.nan)
    if not np.isfinite(values).all():
        raise ValueError(f"--given {file}: column {name!r} holds what is no number; fill it in")
    return values


def _write(problem: Problem, plan: Plan, out: Path) -> None:
    import pandas as pd

    from sipe_bayes.core.files import write_text
    from sipe_bayes.core.units import to_si

    clock = problem.config.columns.time
    columns: dict[str, Any] = {clock.column: np.arange(len(plan.actions)) * plan.dt / to_si(clock.unit)[0]}
    for command, column in zip(problem.config.commands, plan.actions.T, strict=True):
        columns[command.column] = command.sign * column / (command.factor * to_si(command.unit)[0]) + command.zero
    write_text(out, pd.DataFrame(columns).to_csv(index=False, float_format="%.9g"))
