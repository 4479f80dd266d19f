"""The command ``sipe``."""

from __future__ import annotations

import math
import shlex
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sipe_bayes.cli import benchmark as benchmark_commands
from sipe_bayes.cli import check as check_commands
from sipe_bayes.cli import data as data_commands
from sipe_bayes.cli import discover as discover_commands
from sipe_bayes.cli import explain as explain_commands
from sipe_bayes.cli import init as init_commands
from sipe_bayes.cli import leaderboard as leaderboard_commands
from sipe_bayes.cli import suggest as suggest_commands
from sipe_bayes.cli import train as rl_commands
from sipe_bayes.cli import transfer as transfer_commands
from sipe_bayes.cli import validate as validate_commands
from sipe_bayes.cli import video as video_commands
from sipe_bayes.cli.check import SimulatedOn
from sipe_bayes.cli.errors import (
    INTERRUPTED,
    NOTHING_USABLE,
    check_least,
    check_words,
    exit_code_of,
    exit_on_error,
    say_early,
    say_interrupted,
    was_announced,
)
from sipe_bayes.cli.examples import give_examples
from sipe_bayes.cli.surroundings import settle
from sipe_bayes.core import __version__
from sipe_bayes.inference.progress_bar import ProgressBar
from sipe_bayes.inference.registry import ESTIMATORS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rich.console import Console

    from sipe_bayes.core.findings import Findings
    from sipe_bayes.diagnostics.records import ChannelScore
    from sipe_bayes.diagnostics.result import Calibration
    from sipe_bayes.envs.task import Task

app = typer.Typer(
    name="sipe",
    help="Calibrate robot simulators with honest uncertainty.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
# what the parser says of options and arguments, whose name typer keeps private
_REFUSED: Any = typer.BadParameter.__mro__[2]
_PIPED_WIDTH = 120
_AXES = ("_x", "_y", "_z")
_LINES, _SENTENCES, _WARNINGS, _CHANNELS = 20, 3, 3, 3  # that a calibration may fill, and of each kind of line
_NAMED = 4  # of the parameters that the table has no room for
_TONES = {"good": "green", "fair": "yellow", "bad": "bold red"}  # on a terminal


def main() -> None:
    """Entry point: input errors are one line on standard error and exit code 2."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends as by Ctrl-C, workers too
    was_announced()  # of an earlier call in this process
    try:
        with exit_on_error():
            settle()
            check_words(sys.argv[1:])
        code = app(standalone_mode=False)
        sys.stdout.flush()
    except typer.Exit as ended:
        code = ended.exit_code
    except (typer.Abort, KeyboardInterrupt):  # before or after what ``exit_on_error`` sees to
        code = INTERRUPTED
    except _REFUSED as error:
        message = error.format_message()
        if not message or "\n" in message:  # the help, where a command was given nothing
            error.show()
        else:
            print(f"sipe: {message[:1].lower()}{message[1:].rstrip('.')}; see --help of the command", file=sys.stderr)
        code = error.exit_code
    except Exception as error:
        code = exit_code_of(error)
        if code is None:
            raise
    finally:
        signal.signal(signal.SIGTERM, before)
    if code == INTERRUPTED and not was_announced():
        say_interrupted("; the same command begins again")
    sys.exit(code or 0)


def _say_version(wanted: bool) -> None:
    if wanted:
        print(f"sipe_bayes {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_say_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Calibrate robot simulators with honest uncertainty."""


def calibrate(
    config: Annotated[Path, typer.Argument(help="TOML file: model, logs, parameters. See examples/.")],
    estimator: Annotated[
        str | None, typer.Option(help=f"{', '.join(ESTIMATORS)}; default: the configuration's.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Default: the configuration's.")] = None,
    budget: Annotated[int | None, typer.Option(help="Rollouts: logs times parameter values simulated.")] = None,
    out: Annotated[Path | None, typer.Option(help="Output folder; default runs/NAME-ESTIMATOR.")] = None,
    discover: Annotated[
        bool, typer.Option("--discover", help="Then search what the model lacks, into `discover` of the folder.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")] = False,
    threads: Annotated[int | None, typer.Option(help="Native threads; default all cores.")] = None,
    device: SimulatedOn = "cpu",
    time_limit: Annotated[
        float | None,
        typer.Option(help="Seconds; then the search ends with its best estimate, and checks are skipped."),
    ] = None,
) -> None:
    """Posterior of a simulator's parameters from logs; exit code 3 where no value may be used within its interval."""
    from sipe_bayes.calibration.discover import run_discovery
    from sipe_bayes.calibration.run import run
    from sipe_bayes.core.files import to_json
    from sipe_bayes.core.telling import silent
    from sipe_bayes.report.verdicts import doubt

    with exit_on_error("; the same command goes on"), ProgressBar(quiet=as_json) as progress:
        check_least(0, seed=seed)
        check_least(1, budget=budget, threads=threads)
        check_least(0, time_limit=time_limit)
        calibration = run(
            config, estimator, seed, budget, out, threads, progress, device, None if as_json else say_early, time_limit
        )
    discovery = None
    if discover:
        with exit_on_error("; the same command goes on"), ProgressBar(quiet=as_json, counted=False) as progress:
            paced = discover_commands.counted(progress)
            folder = Path(calibration.out) / "discover"
            limit = discover_commands.TIME_LIMIT
            warn = silent if as_json else say_early
            discovery = run_discovery(
                config, folder, seed, num_threads=threads, progress=paced, time_limit=limit, warn=warn
            )
    if as_json:
        print(to_json(calibration.to_dict() | ({} if discovery is None else {"discovery": discovery.to_dict()})))
    else:
        print_calibration(calibration)
        if discovery is not None:
            discover_commands.print_discovery(discovery)
    if discovery is not None and discovery.ended == "interrupted":
        say_interrupted("; the same command goes on")
        raise typer.Exit(INTERRUPTED)
    if doubt(calibration) is not None:
        raise typer.Exit(NOTHING_USABLE)


def envs(
    name: Annotated[str | None, typer.Argument(help="A task; without it all are listed.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON and nothing else.")] = False,
) -> None:
    """The benchmark's environments; with NAME its parameters and what each writes."""
    import mujoco  # noqa: F401 - where it cannot be imported there is a line of its own

    from sipe_bayes.core.files import to_json
    from sipe_bayes.envs.registry import TASKS, make_task

    with exit_on_error():  # assets may not be installed
        task = None if name is None else make_task(name)
        rows = [make_task(one).row() for one in TASKS] if task is None else []
    if as_json:
        print(to_json(rows if task is None else task.to_dict()))
    elif task is None:
        print_tasks(rows)
    else:
        print_task(task)


def _console() -> Console:
    from rich.console import Console

    console = Console(soft_wrap=True)
    if not console.is_terminal:
        console.width = _PIPED_WIDTH
    return console


def print_tasks(rows: Sequence[Mapping[str, object]]) -> None:
    """One line for every task, on standard output."""
    from rich.table import Table

    table = Table()
    for heading in ("environment", "parameters", "observations", "actions", "steps", "solved at", "reproduces"):
        table.add_column(heading, justify="left" if heading in ("environment", "reproduces") else "right")
    for t in rows:
        solved = f"{t['solved_by']} {t['solved_at']:g}"
        sizes = (str(n) for n in (t["parameters"], t["observations"], t["actions"], t["episode_steps"]))
        table.add_row(str(t["name"]), *sizes, solved, str(t["reproduces"]))
    _console().print(table)


def print_task(task: Task) -> None:
    """A task's parameter table, and what each parameter does, on standard output."""
    from rich.table import Table
    from rich.text import Text

    console, row = _console(), task.row()
    console.print(Text(f"{row['name']} ({row['id']}): {row['summary']}"))
    console.print(
        Text(
            f"{row['observations']} observations, {row['actions']} actions, {row['episode_steps']} steps an episode; "
            f"solved at a {row['solved_by']} of {row['solved_at']:g}; theta = 0.5 is {row['reproduces']}"
        )
    )
    table = Table()
    for heading in ("parameter", "default", "from", "to", "unit"):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit") else "right", no_wrap=True)
    for p in task.space:
        table.add_row(p.name, *(f"{x:.4g}" for x in (p.default, p.low, p.high)), p.unit)
    console.print(table)
    for p in task.space:
        console.print(Text(f"{p.name} ({', '.join(p.targets)}): {p.description}"))


def print_calibration(calibration: Calibration) -> None:
    """What to think of it, on standard output in at most 20 lines; all else is in the report."""
    from rich.text import Text

    from sipe_bayes.core.findings import Findings
    from sipe_bayes.report.verdicts import verdicts

    console, findings = _console(), Findings(calibration.findings)
    console.print(Text(f"{calibration.name}: posterior by {calibration.estimator}"))
    sentences = verdicts(calibration, brief=True)
    for verdict in sentences[:_SENTENCES]:
        console.print(Text(verdict.text, style=_TONES[verdict.tone]))
    below = [*_pooled(calibration), *_worst(findings, calibration.out), *_drawn_from_prior(calibration)]
    below.append(f"{calibration.rollouts} rollouts, {calibration.seconds:.1f} s" + _report(calibration))
    _print_parameters(console, calibration, findings, _LINES - 1 - min(len(sentences), _SENTENCES) - len(below))
    for line in below:
        console.print(line, highlight=False, markup=False)


def _print_parameters(console: Console, calibration: Calibration, findings: Findings, lines: int) -> None:
    """The table of the parameters in so many lines at most; the heading is one."""
    from rich.measure import Measurement
    from rich.table import Table
    from rich.text import Text

    from sipe_bayes.report.verdicts import lacking, parameter_verdict
    from sipe_bayes.report.words import listed, significant, unit_text

    wider = any(p.further is not None for p in calibration.parameters)
    table, words = Table(box=None, pad_edge=False), ["unit", "verdict"]
    numbers = ["value (mode)", *[f"with what it {lacking(findings)}"] * wider, "plain" if wider else "90 % interval"]
    for heading in ("parameter", *numbers, *words):
        table.add_column(heading, justify="right" if heading in numbers else "left", no_wrap=True)
    shown = calibration.parameters
    shown = shown if len(shown) < lines else shown[: lines - 2]
    for p in shown:
        scale = max(map(abs, (p.q05, p.q95, *(p.further or ()))))  # one way of writing for the whole row
        value, low, high = (significant(x, p.sd, scale) for x in (p.mode, p.q05, p.q95))
        verdict = parameter_verdict(p, findings)
        ends = [significant(x, p.sd, scale) for x in p.further or ()]
        cells = [value, *[" .. ".join(ends)] * wider, f"{low} .. {high}"]
        # brackets of a name are not markup
        table.add_row(Text(p.name), *cells, unit_text(p.unit), Text(verdict.text, style=_TONES[verdict.tone]))
    # a number that is cut is a wrong one: lines that are too long are the terminal's to wrap
    width = console.width
    console.width = max(console.width, Measurement.get(console, console.options.update(max_width=10**3), table).maximum)
    console.print(table)
    console.width = width
    rest = [p.name for p in calibration.parameters[len(shown) :]]
    if rest:
        more = [*rest[:_NAMED], *[f"{len(rest) - _NAMED} more"] * (len(rest) > _NAMED)]
        console.print(f"values and intervals of {listed(more)}: in the report", highlight=False, markup=False)


def _pooled(calibration: Calibration) -> list[str]:
    """A line for each channel, of vectors one for all three: root-mean-square errors on held-out logs, else on all."""
    from sipe_bayes.report.words import times

    title, scores = ("held out", calibration.holdout) if calibration.holdout else ("train", calibration.train)
    known, lines = {(s.channel, s.unit) for s in scores}, []
    quantities: dict[str, list[ChannelScore]] = {}
    for s in scores:
        stem = s.channel.removesuffix(s.channel[-2:]) if s.channel[-2:] in _AXES else ""
        whole = bool(stem) and all((stem + axis, s.unit) in known for axis in _AXES)
        quantities.setdefault(stem if whole else s.channel, []).append(s)
    for quantity, mine in quantities.items():
        logs = list(dict.fromkeys(s.log for s in mine))
        own, given = (math.sqrt(sum(e * e for e in rmse) / len(logs)) for rmse in _errors(mine))
        where = f"{title} {logs[0]}" if len(logs) == 1 else f"{title}, {len(logs)} logs"
        ratio = times(given / own if own else float("inf"))
        lines.append(f"{where}, {quantity}: RMSE {own:.3g} {mine[0].unit}; model as given {given:.3g} (here {ratio})")
    more = len(lines) - _CHANNELS
    return lines if more <= 0 else [*lines[: _CHANNELS - 1], f"{lines[_CHANNELS - 1]} [{more} more in the report]"]


def _errors(scores: Sequence[ChannelScore]) -> tuple[list[float], list[float]]:
    """Of the calibrated model and of that as given."""
    return [s.rmse for s in scores], [s.rmse_default for s in scores]


def _worst(findings: Findings, out: str) -> list[str]:
    """The warnings that matter most, how many there are beside them, and what no log tells."""
    from sipe_bayes.core.findings import Code

    kinds = findings.kinds
    lines = [f"warning: {text}" for text in kinds[:_WARNINGS]]
    if len(kinds) > len(lines):
        lines[-1] += f" [{len(kinds) - len(lines)} more in the report]"
    untold = findings.of(Code.UNTOLD)
    lines += [f"note: {item.text}" for item in untold]
    shown = [*(item for item in findings if item.text in kinds[:_WARNINGS]), *untold]
    where = shlex.quote(out) if out else " ".join(dict.fromkeys(str(item.code) for item in shown))
    return lines + [f"what these mean and what to do: sipe explain {where}"] * bool(lines)


def _drawn_from_prior(calibration: Calibration) -> list[str]:
    """What the file that randomises a simulation does not have from the calibration, if anything."""
    from sipe_bayes.report.recommended import recommended
    from sipe_bayes.report.words import listed
    from sipe_bayes.rl.randomization import Usable

    names = recommended(calibration).names(Usable.NONE) if calibration.out else ()
    whose = "every parameter" if len(names) == len(calibration.parameters) else listed(list(names))
    return [f"domain_randomization.json holds the prior of {whose}, for no interval may be used"] if names else []


def _report(calibration: Calibration) -> str:
    return f"; report: {Path(calibration.out) / 'report.html'}" if calibration.out else ""


_PANELS: dict[str, tuple[Callable[..., None], ...]] = {  # in the order in which a newcomer needs them
    "Your machine": (
        *(
            init_commands.init,
            validate_commands.validate,
            calibrate,
            discover_commands.discover,
            check_commands.check,
            suggest_commands.suggest,
        ),
        *(video_commands.video, explain_commands.explain),
    ),
    "Environments and policies": (envs, rl_commands.train, rl_commands.agents),
    "Studies": (benchmark_commands.simulate,),
}
for _panel, _commands in _PANELS.items():
    for _command in _commands:
        app.command(rich_help_panel=_panel)(_command)
for _group in (data_commands.app, transfer_commands.app, benchmark_commands.app, leaderboard_commands.app):
    app.add_typer(_group, rich_help_panel="Studies")
give_examples(app)


if __name__ == "__main__":
    main()
