"""The commands ``sipe train`` and ``sipe agents``."""

from __future__ import annotations

import inspect
import platform
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_type_hints

import typer

from sipe_bayes.cli.errors import check_least, command_line, exit_on_error
from sipe_bayes.rl.settings import Settings

if TYPE_CHECKING:
    from sipe_bayes.rl.evaluation import Evaluation


def _with_settings(command: Callable[..., None]) -> Callable[..., None]:
    """``command`` with an option for each of ``Settings``' fields, which it gets as keywords."""
    hints = get_type_hints(Settings)
    own = [p for p in inspect.signature(command, eval_str=True).parameters.values() if p.kind != p.VAR_KEYWORD]
    for f in fields(Settings):
        default, hint, metavar = f.default, hints[f.name], None
        if isinstance(default, tuple):
            default, hint, metavar = [",".join(map(str, default))], list[str], "N,N"
        option = typer.Option(default, help=f.metadata["limits"].why, metavar=metavar)
        own.append(inspect.Parameter(f.name, inspect.Parameter.KEYWORD_ONLY, default=option, annotation=hint))
    command.__signature__ = inspect.Signature(own)  # type: ignore[attr-defined]
    command.__annotations__ = {p.name: p.annotation for p in own}
    return command


def _sizes(given: object) -> tuple[int, ...]:
    assert isinstance(given, list)
    *before, text = given
    if before:
        raise ValueError(f"--hidden {text}: given {len(given)} times; write all layers at once, such as 400,300")
    try:
        return tuple(int(size) for size in text.split(","))
    except ValueError:
        raise ValueError(f"--hidden {text}: expected the layers' sizes, such as 400,300") from None


@_with_settings
def train(
    task: Annotated[str, typer.Argument(help="A task of `sipe envs`.")],
    steps: Annotated[int, typer.Option(help="Control steps, of all lanes together.")] = 1_000_000,
    seed: Annotated[int, typer.Option(help="The same seed gives the same agent.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Output folder; default runs/TASK-ddpg-SEED.")] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on from the folder's checkpoint, if it has one.")
    ] = False,
    demonstrations: Annotated[
        Path | None,
        typer.Option(help="npz of `sipe data demonstrate`, or others with rewards, for --demonstration-share."),
    ] = None,
    randomization: Annotated[
        Path | None,
        typer.Option(help="domain_randomization.json of `sipe calibrate`: every episode runs under a draw of it."),
    ] = None,
    evaluate_every: Annotated[int, typer.Option(help="Steps between the points of the learning curve.")] = 5_000,
    evaluation_episodes: Annotated[int, typer.Option(help="Episodes of each point.")] = 10,
    checkpoint_every: Annotated[int, typer.Option(help="Steps between checkpoints.")] = 25_000,
    episodes: Annotated[int, typer.Option(help="Episodes of the cards' evaluation.")] = 100,
    threads: Annotated[int, typer.Option(help="Native threads, of simulation and networks.")] = 1,
    device: Annotated[
        str, typer.Option(help="cpu; or cuda, cuda:1: worlds, replay buffer and networks on a GPU, with the extra gpu.")
    ] = "cpu",
    **settings: object,
) -> None:
    """Train an agent by DDPG: expert, suboptimal agent and their cards, learning curve, checkpoint."""
    with exit_on_error("; with --resume the same command goes on"):
        import torch

        from sipe_bayes.core.trajectory import Trajectories
        from sipe_bayes.inference.progress_bar import ProgressBar
        from sipe_bayes.rl.randomization import load_randomization
        from sipe_bayes.rl.train import train as run

        check_least(1, threads=threads)
        torch.set_num_threads(threads)
        folder = out or Path("runs") / f"{task}-ddpg-{seed}"
        chosen = Settings.of({**settings, "hidden": _sizes(settings["hidden"])}, "train")
        shown = None if demonstrations is None else Trajectories.load(demonstrations)
        drawn = None if randomization is None else load_randomization(randomization)
        for name, reason in {} if drawn is None else drawn.uncalibrated.items():
            print(f"warning: {name} is not calibrated, and drawn from its prior: {reason}")
        print(f"how it goes: {folder / 'curve.csv'}; tensorboard --logdir {folder / 'tensorboard'}", flush=True)
        with ProgressBar(unit="steps") as progress:
            run(
                *(task, steps, seed, folder, chosen),
                resume=resume,
                randomization=drawn,
                demonstrations=shown,
                evaluate_every=evaluate_every,
                evaluation_episodes=evaluation_episodes,
                checkpoint_every=checkpoint_every,
                threads=threads,
                device=device,
                report=progress,
            )
        for name, card in _write_cards(folder, task, seed, steps, chosen, episodes, demonstrations).items():
            print(f"{name}: {_earned(card)}, {folder / name}.safetensors")


def agents(
    folder: Annotated[Path | None, typer.Argument(help="Of agents and their cards; default the shipped ones.")] = None,
    episodes: Annotated[int, typer.Option(help="Of each agent.")] = 100,
    install: Annotated[bool, typer.Option("--install", help="First ship FOLDER's pair, made by `sipe train`.")] = False,
) -> None:
    """Evaluate each agent anew and compare with its card; exit code 1 where one is beyond two standard errors."""
    with exit_on_error():
        from sipe_bayes.datasets.demonstrations import AGENT_FILES
        from sipe_bayes.rl import evaluation
        from sipe_bayes.rl.evaluation import check_agents

        if install:
            if folder is None:
                raise ValueError("--install: expected the output folder of a run, got none; give FOLDER")
            for path in evaluation.install(folder):
                print(f"installed {path}")
        differing = 0
        for check in check_agents(folder or AGENT_FILES, episodes):
            verdict = "within two standard errors" if check.agrees else "BEYOND two standard errors"
            print(f"{check.agent}: {_earned(check.now)}; card {_earned(check.card)}: {verdict}", flush=True)
            differing += not check.agrees
    if differing:
        raise typer.Exit(1)


def _earned(by: Evaluation) -> str:
    rate = "" if by.success_rate is None else f", success {by.success_rate:.2f}"
    return f"return {by.mean:.1f} ± {by.standard_error:.1f} (sd {by.sd:.1f}){rate}"


def _write_cards(
    folder: Path, task: str, seed: int, steps: int, settings: Settings, episodes: int, demonstrations: Path | None
) -> dict[str, Evaluation]:
    from importlib.metadata import version

    from sipe_bayes.envs.registry import make_task
    from sipe_bayes.rl.demonstrate import facts_of
    from sipe_bayes.rl.evaluation import references, write_card
    from sipe_bayes.rl.train import choose, read_curve

    curve = read_curve(folder)
    packages = {name: version(name) for name in ("sipe-bayes", "mujoco", "numpy", "torch")}
    facts = {
        "command": command_line(),
        "seed": seed,
        "steps": steps,
        "wall_seconds": curve[-1].wall_seconds,
        "deviations": settings.deviations(),
        "settings": settings.plain(),
        "demonstrations": None if demonstrations is None else facts_of(demonstrations),
        "versions": {"python": platform.python_version(), **packages},
    }
    made = make_task(task)
    others = references(made, episodes)
    return {
        name: write_card(
            folder / f"{name}.safetensors", made, {"agent": name, "kept_at_step": step, **facts}, others, episodes
        )
        for name, step in choose(curve, steps).items()
    }
