"""The commands ``sipe data ...``: make, check and export trajectory sets."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sipe_bayes.cli.errors import BAD_INPUT, check_least, check_one_of, command_line, exit_on_error

if TYPE_CHECKING:
    from sipe_bayes.datasets.trajectory_sets import SetName

app = typer.Typer(name="data", help="Trajectories of the benchmark: make, check, export.", no_args_is_help=True)

Tasks = Annotated[list[str] | None, typer.Option("--task", help="Again for several; default the benchmark's nine.")]
Variants = Annotated[list[str] | None, typer.Option("--variant", help="Again for several; default all three.")]
Splits = Annotated[list[str] | None, typer.Option("--split", help="Again for several; default all three.")]
Types = Annotated[list[str] | None, typer.Option("--type", help="expert, suboptimal or random; default all three.")]


@app.command()
def generate(
    task: Tasks = None,
    variant: Variants = None,
    split: Splits = None,
    type: Types = None,
    count: Annotated[int, typer.Option(help="Trajectories of each set.")] = 5,
    steps: Annotated[int | None, typer.Option(help="Control steps; default an episode, at most 250.")] = None,
    seed: Annotated[int, typer.Option(help="0 is that of the sets that are shipped.")] = 0,
    out: Annotated[Path, typer.Option(help="Folder; sets of the same name are replaced.")] = Path("trajectories"),
    threads: Annotated[int | None, typer.Option(help="Native threads; default all cores.")] = None,
) -> None:
    """Simulate trajectory sets; the same command gives the same bytes on the same versions and kind of processor.

    One process at a time to a folder: its manifest is written anew after each set.
    """
    from sipe_bayes.datasets.generation import generate as made_one_by_one

    made, missing = 0, 0
    with exit_on_error():
        check_least(1, count=count, steps=steps, threads=threads)
        check_least(0, seed=seed)
        names = _names(task, variant, split, type)
        for one in made_one_by_one(names, out, count, steps, seed, command_line(), threads):
            if one.missing:
                missing += 1
                print(f"{one.name.file}: not made: {one.missing}")
            else:
                made += 1
                print(f"{one.name.file}: {one.size / 1e3:.0f} kB, {one.seconds:.1f} s", flush=True)
    print(f"{made} sets in {out}, {missing} not made")
    if not made:
        raise typer.Exit(BAD_INPUT)


@app.command()
def verify(
    folder: Annotated[Path | None, typer.Argument(help="Default: the sets that are shipped.")] = None,
) -> None:
    """Check every file against the manifest's size and checksum; exit code 1 where one differs."""
    from sipe_bayes.datasets import trajectory_sets

    chosen = folder or trajectory_sets.shipped()
    with exit_on_error():
        wrong = trajectory_sets.verify(chosen)
        sizes = [entry.bytes for entry in trajectory_sets.manifest(chosen).values()]
    for line in wrong:
        print(f"sipe: {line}", file=sys.stderr)
    if wrong:
        raise typer.Exit(1)
    print(f"{len(sizes)} files, {sum(sizes) / 1e6:.1f} MB: as the manifest says")


@app.command()
def install(
    archive: Annotated[Path, typer.Argument(help="sipe_bayes-trajectories-VERSION.zip, from beside the release.")],
) -> None:
    """Store the trajectory sets of the release, each compared with its checksum, in SIPE_BAYES_DATA or the cache."""
    from sipe_bayes.datasets.archive import install as stored

    with exit_on_error():
        folder = stored(archive)
    print(f"{folder}: as the manifest says")


@app.command()
def pack(
    out: Annotated[Path | None, typer.Option(help="Default sipe_bayes-trajectories-VERSION.zip.")] = None,
    folder: Annotated[Path | None, typer.Option(help="Of the sets; default those that are installed.")] = None,
) -> None:
    """Write trajectory sets as the archive that `sipe data install` takes, and print its SHA-256."""
    from sipe_bayes.core import __version__
    from sipe_bayes.datasets import archive

    path = out or Path(f"sipe_bayes-trajectories-{__version__}.zip")
    with exit_on_error():
        digest = archive.pack(path, folder)
    print(f"{digest}  {path}")


@app.command()
def export(
    minari: Annotated[str, typer.Option(help="Name of the new Minari data set, such as sipe/door/expert-v0.")],
    task: Annotated[str, typer.Option(help="A task of `sipe envs`.")],
    variant: Annotated[str, typer.Option()] = "default",
    split: Annotated[str, typer.Option()] = "reference",
    type: Annotated[str, typer.Option(help="expert, suboptimal or random.")] = "expert",
    count: Annotated[int, typer.Option(help="Trajectories.")] = 5,
    seed: Annotated[int, typer.Option()] = 0,
    steps: Annotated[int | None, typer.Option(help="Control steps; default an episode, at most 250.")] = None,
    folder: Annotated[
        Path | None, typer.Option(help="Where `sipe data generate --out` wrote; default as shipped.")
    ] = None,
) -> None:
    """Write demonstrations as a Minari data set."""
    import warnings

    from sipe_bayes.datasets.demonstrations import NoAgentWarning, demonstrations
    from sipe_bayes.datasets.minari_data import to_minari

    with exit_on_error(), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        (one,) = _names([task], [variant], [split], [type])
        made = demonstrations(
            task, one.type, one.split, one.variant, count=count, seed=seed, steps=steps, folder=folder
        )
        about = f"{type} trajectories of {task} ({variant}, {split})."
        stand_in = [str(w.message) for w in caught if issubclass(w.category, NoAgentWarning)]
        written = to_minari(made, minari, task, " ".join([about, *stand_in]), command_line())
    for line in stand_in:
        print(f"sipe: {line}", file=sys.stderr)
    print(f"{len(made)} episodes of {made.actions.shape[1]} steps in {written}")


@app.command()
def demonstrate(
    task: Annotated[str, typer.Argument(help="FetchPush, FetchSlide, FetchPickAndPlace, Door or Relocate.")],
    out: Annotated[Path, typer.Option(help="An npz file; a JSON file beside it says how it was made.")],
    count: Annotated[int, typer.Option(help="Episodes that succeed.")] = 100,
    seed: Annotated[int, typer.Option(help="The same seed gives the same demonstrations.")] = 0,
    threads: Annotated[int, typer.Option(help="Native threads.")] = 1,
) -> None:
    """Make demonstrations for `sipe train --demonstrations`, by a scripted controller, or by a plan.

    A plan (Door, Relocate) is searched for minutes. It is kept beside OUT, and the same command goes on with it.
    """
    from sipe_bayes.inference.progress_bar import ProgressBar
    from sipe_bayes.rl.demonstrate import make

    with exit_on_error():
        check_least(1, count=count, threads=threads)
        check_least(0, seed=seed)
        if out.suffix != ".npz":
            raise ValueError(f"--out {out}: expected a name that ends in .npz; call it {out.stem}.npz")
        with ProgressBar(unit="iterations") as progress:
            facts = make(task, count, seed, out, command_line(), threads, progress)
    print(f"{count} of {facts.attempts} attempts kept, mean return {facts.return_mean:.1f}: {out}")


def _names(
    tasks: list[str] | None, variants: list[str] | None, splits: list[str] | None, types: list[str] | None
) -> list[SetName]:
    """The sets of the tasks, variants, splits and types given; raises ValueError for an unknown one."""
    from sipe_bayes.datasets import trajectory_sets
    from sipe_bayes.datasets.acting import AGENTS, SPLITS
    from sipe_bayes.envs.registry import TASKS
    from sipe_bayes.envs.task import VARIANTS

    legal = {"task": tuple(TASKS), "variant": VARIANTS, "split": SPLITS, "type": AGENTS}
    for (option, known), values in zip(legal.items(), (tasks, variants, splits, types), strict=True):
        for value in values or ():
            check_one_of(option, value, known)
    return list(
        trajectory_sets.names(
            tasks or trajectory_sets.TASKS,
            [v for v in VARIANTS if v in (variants or VARIANTS)],
            [s for s in SPLITS if s in (splits or SPLITS)],
            [t for t in AGENTS if t in (types or AGENTS)],
        )
    )
