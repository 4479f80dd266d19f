"""The command line: every option of every command with numbers and texts that nobody means.

No simulation runs: a command that has come to simulating, fitting or training has taken what it was given, and ends
there. What a command refuses is one line on standard error, exit code 2, and no file.
"""

from __future__ import annotations

import contextlib
import io
import os
import random
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

from tests.fuzz.mutations import Change, Read, Target

NUMBERS = (
    *("0", "-1", "1", "2", "1000000000000", "999999999999999999999999999999", "1" * 5000, "-0", "1e3", "1e400"),
    *("1e-300", "nan", "inf", "-inf", "0.5", "0x10", "1_0", "٣", "", " ", "1,2", "true"),
)
TEXTS = (
    *("", " ", "x", "é", "a" * 300, "a" * 5000, "\x00", "\x07\x1b[31m", "\n", "..", "/", "/dev/null", "/proc/self/mem"),
    *("*", "[", "[[", "\\", "--", "-", "%s", "{0}", "$(id)", "<b>", "\udcff", "a/b/c", "~", "laplace", "Pendulum"),
    *("log.csv", "config.toml", "pendulum.xml", "."),
)
FIRST: dict[str, list[str]] = {
    "init": ["pendulum.xml", "log.csv"],
    "validate": ["config.toml"],
    "calibrate": ["config.toml"],
    "discover": ["config.toml"],
    "check": ["config.toml", "laplace"],
    "suggest": ["config.toml"],
    "video": ["config.toml"],
    "explain": ["misfit"],
    "envs": [],
    "train": ["Pendulum"],
    "agents": ["runs"],
    "simulate": ["Pendulum"],
    "data generate": ["--task", "Pendulum"],
    "data verify": ["runs"],
    "data install": ["log.csv"],
    "data pack": ["--folder", "runs"],
    "data export": ["--minari", "a/b-v0", "--task", "Pendulum"],
    "data demonstrate": ["Door", "--out", "shown.npz"],
    "benchmark run": ["--suite", "quick", "--executor", "inline"],
    "benchmark status": ["runs"],
    "benchmark cells": ["quick"],
    "benchmark report": ["runs"],
    "transfer run": ["--suite", "quick", "--executor", "inline"],
    "transfer status": ["runs"],
    "transfer cells": ["quick"],
    "transfer report": ["runs"],
    "leaderboard run": ["prior", "--out", "entry"],
    "leaderboard tasks": [],
    "leaderboard submit-check": ["runs"],
    "leaderboard report": ["runs", "--out", "page"],
}
"""What each command is given where nothing odd stands in its place; a test holds that every command is here."""


class Reached(BaseException):
    """A command has taken what it was given and begins its work."""


FOLDERS = (
    *("case", "with space", "it's", 'a"b', "caf\u00e9", "cafe\u0301", "[x]*?", "%s{0}", "$HOME", "-x", "#a;b&c", "~"),
    *("n" * 200, "<b>", "a\\b", "..x", "CON", "\u202ereversed", "\U0001f916"),
)
"""Names of the folder that a command runs in."""
VARIABLES = {
    "COLUMNS": ("0", "1", "20", "-5", "abc", "1000000000000"),
    "TERM": ("dumb", "", "nonsense"),
    "TMPDIR": ("/nonexistent", "/dev/null", ""),
    "HOME": ("/nonexistent", "/dev/null", ""),
    "SIPE_LOG_GIB": ("abc", "-1", "0", "nan", "1e300", "1e-300", " "),
    "SIPE_MODEL_SECONDS": ("abc", "-1", "nan", "1e300", "1e-300"),
    "SIPE_BAYES_DATA": ("/nonexistent", "/dev/null", "\n"),
    "NO_COLOR": ("1",),
    "FORCE_COLOR": ("1",),
}
"""Of the environment, with values that nobody means."""


def _begin(*_: object, **__: object) -> Any:
    raise Reached


@contextlib.contextmanager
def nothing_runs() -> Iterator[None]:
    """Every way into long work ends at once; what is replaced comes back at the end."""
    from torch.utils import tensorboard

    from sipe_bayes.benchmark.executors import pool
    from sipe_bayes.benchmark.leaderboard import run
    from sipe_bayes.simulation.engine import Engine

    places: list[tuple[Any, str]] = [
        *((Engine, "advance"), (pool, "Pool"), (tensorboard, "SummaryWriter"), (run, "made")),
    ]
    kept = [(place, name, getattr(place, name)) for place, name in places]
    for place, name in places:
        setattr(place, name, _begin)
    try:
        yield
    finally:
        for place, name, original in kept:
            setattr(place, name, original)


def commands() -> dict[str, Any]:
    """Every command of the parser by its words."""
    from typer.main import get_command

    from sipe_bayes.cli.app import app

    commands: dict[str, Any] = {}

    def walk(words: str, group: Any) -> None:
        for name, command in group.commands.items():
            if hasattr(command, "commands"):
                walk(f"{words}{name} ", command)
            else:
                commands[f"{words}{name}"] = command

    walk("", get_command(app))
    return commands


def command_lines(folder: Path) -> Change:
    """Commands in a folder with a configuration, its model and its log."""
    from tests.problems.swings import write_case

    known = commands()

    def arguments(chance: random.Random) -> list[str]:
        words = chance.choice(sorted(known))
        given = list(FIRST[words])
        options = [p for p in known[words].params if p.param_type_name == "option" and p.name != "help"]
        for option in chance.sample(options, min(len(options), chance.choice([0, 1, 1, 1, 2, 3]))):
            name = option.opts[-1]
            if option.is_flag:
                given.append(name)
            else:
                number = option.type_descriptor.annotation in (int, float)
                value = chance.choice(NUMBERS if number else (*TEXTS, *NUMBERS))
                given += [f"{name}={value}"] if chance.random() < 0.3 else [name, value]
        if given and chance.random() < 0.3:
            given[chance.randrange(len(given))] = chance.choice(TEXTS)
        return [*words.split(), *given]

    def change(chance: random.Random) -> Read:
        shutil.rmtree(folder / "around", ignore_errors=True)
        case = folder / "around" / (chance.choice(FOLDERS) if chance.random() < 0.3 else "case")
        write_case(case)
        (case / "runs").mkdir()
        words, variables = arguments(chance), dict[str, str]()
        if chance.random() < 0.3:
            name = chance.choice(sorted(VARIABLES))
            variables[name] = chance.choice(VARIABLES[name])
        before = {path.relative_to(folder) for path in folder.rglob("*")}

        def read() -> None:
            code, errors = _call(words, case, variables)
            if code not in (0, 1, 2):
                raise AssertionError(f"{words}: exit code {code}")
            if code == 2:
                made = {path.relative_to(folder) for path in folder.rglob("*")} - before
                if made:
                    raise AssertionError(f"{words}: refused, and made {made}")
                raise ValueError(errors.removesuffix("\n"))

        return read

    return change


def _call(words: list[str], folder: Path, variables: dict[str, str]) -> tuple[int, str]:
    """Exit code and standard error of ``sipe`` in a folder, with some variables of the environment."""
    from sipe_bayes.cli.app import main

    errors, argv, back = io.StringIO(), sys.argv, os.getcwd()
    sys.argv = ["sipe", *words]
    os.chdir(folder)
    try:
        with (
            mock.patch.dict(os.environ, variables),
            nothing_runs(),
            contextlib.redirect_stderr(errors),
            contextlib.redirect_stdout(io.StringIO()),
        ):
            main()
    except SystemExit as ended:
        return int(ended.code or 0), errors.getvalue()
    except Reached:
        return 0, ""
    finally:
        sys.argv = argv
        os.chdir(back)
    return 0, errors.getvalue()


COMMANDS: dict[str, tuple[Target, int]] = {"command line": (command_lines, 24)}
