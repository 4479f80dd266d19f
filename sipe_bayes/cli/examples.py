"""An example of every command, which its ``--help`` ends with."""

from __future__ import annotations

import typer

EXAMPLES = {
    "init": "sipe init robot.xml log1.csv log2.csv --out robot.toml",
    "validate": "sipe validate robot.toml",
    "calibrate": "sipe calibrate robot.toml --out runs/robot",
    "discover": "sipe discover robot.toml --only dry_friction --only delay",
    "check": "sipe check robot.toml laplace --truths 100",
    "suggest": "sipe suggest robot.toml --for damping --posterior runs/robot/posterior",
    "video": "sipe video robot.toml --posterior runs/robot/posterior --out robot.gif",
    "explain": "sipe explain not_mixed",
    "envs": "sipe envs Door",
    "train": "sipe train HalfCheetahLinks --steps 1000000 --seed 0 --out runs/cheetah --resume",
    "agents": "sipe agents",
    "simulate": "sipe simulate Door --budget 1000 --out runs/simulations",
    "data generate": "sipe data generate --out trajectories",
    "data verify": "sipe data verify",
    "data export": "sipe data export --minari sipe/pendulum/random-v0 --task Pendulum --type random",
    "data install": "sipe data install sipe_bayes-trajectories-0.2.0.zip",
    "data pack": "sipe data pack --out trajectories.zip",
    "data demonstrate": "sipe data demonstrate FetchPush --count 100 --out push.npz",
    "transfer run": "sipe transfer run --suite quick --out runs/transfer",
    "transfer report": "sipe transfer report runs/transfer",
    "transfer status": "sipe transfer status runs/transfer",
    "transfer cells": "sipe transfer cells quick",
    "benchmark run": "sipe benchmark run --suite quick --out runs/quick",
    "benchmark report": "sipe benchmark report runs/quick",
    "benchmark status": "sipe benchmark status runs/quick",
    "benchmark cells": "sipe benchmark cells quick",
    "leaderboard run": "sipe leaderboard run laplace --out runs/leaderboard/laplace",
    "leaderboard tasks": "sipe leaderboard tasks",
    "leaderboard submit-check": "sipe leaderboard submit-check runs/leaderboard/laplace",
    "leaderboard report": "sipe leaderboard report runs/leaderboard/laplace --out runs/leaderboard/page",
}


def give_examples(app: typer.Typer, above: str = "") -> None:
    """Let the help of every command of an app, and of those below it, end with its example."""
    for one in app.registered_commands:
        name = one.name or getattr(one.callback, "__name__", "").replace("_", "-")
        if f"{above}{name}" in EXAMPLES:
            one.epilog = f"Example: {EXAMPLES[f'{above}{name}']}"
    for group in app.registered_groups:
        if group.typer_instance is not None:
            give_examples(group.typer_instance, f"{above}{group.typer_instance.info.name} ")
