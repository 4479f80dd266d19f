"""Writes docs/reference from the one source of each thing: no table there is written by hand.

python docs/generate.py            # after a change of an option, key, target, unit, extension, finding or command
python docs/generate.py --check    # says what is out of date, and ends with exit code 1
"""

from __future__ import annotations

import inspect
import json
import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import MISSING, fields
from pathlib import Path

import typer.main
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

import sipe_bayes
from sipe_bayes.calibration.config import Config
from sipe_bayes.calibration.config_fields import Table
from sipe_bayes.calibration.config_tables import NormalPrior
from sipe_bayes.calibration.readers.base import WIDEST
from sipe_bayes.calibration.readers.tables import READERS
from sipe_bayes.cli.app import app
from sipe_bayes.core.files import LIMITS, LONGEST_TEXT, VARIABLES
from sipe_bayes.core.finding_advice import ADVICE, plain
from sipe_bayes.core.finding_texts import Code
from sipe_bayes.core.options import Options
from sipe_bayes.core.thresholds import Thresholds
from sipe_bayes.core.units import DIMENSIONS, UNITS, unit_words
from sipe_bayes.core.validation import MOST_ROLLOUTS
from sipe_bayes.datasets.demonstrations import AGENT_FILES
from sipe_bayes.envs.foreign.load import LEAST_TIMESTEP
from sipe_bayes.envs.foreign.trial import MOST_FILES
from sipe_bayes.envs.registry import TASKS, make_task
from sipe_bayes.envs.target_texts import TARGET_TEXTS
from sipe_bayes.inference.registry import ESTIMATORS, estimator_class
from sipe_bayes.structure.registry import EXTENSIONS, get_extension

FOLDER = Path(__file__).parent / "reference"
NOTE = "<!-- Written by docs/generate.py: change the source that it names, then run it. -->\n"


def table(headings: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table; bars within cells are escaped."""
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join(f"| {' | '.join(str(c).replace('|', chr(92) + '|') for c in line)} |" for line in lines) + "\n"


def code(value: object) -> str:
    """A value as TOML and Python both may write it."""
    if value is None or value is MISSING or value in ("", ()):
        return ""
    return f"`{str(value).lower()}`" if isinstance(value, bool) else f"`{value}`"


def summary(thing: object) -> str:
    """The first paragraph of a docstring, on one line."""
    return " ".join((inspect.getdoc(thing) or "").split("\n\n")[0].split()).replace("``", "`")


def configuration() -> str:
    """Every key of the TOML file, from the docstrings below the fields of ``Config`` and its tables."""
    rows = [(f"`{key}`", text, default) for key, text, default in keys(Config, "")]
    return f"""# Configuration

A TOML file; paths are relative to it. A key with a dot stands in a table: `resample.rate` is `rate` below `[resample]`.
Tables of which there may be several (`[[commands]]`, `[[measurements]]`, `[[logs]]`, `[[parameters]]`) repeat. The
least that a file needs stands in [your robot in ten minutes](../tutorials/your-robot.md). Words of [units](units.md),
[targets](targets.md), [log formats](logs.md).

{table(("key", "what it is", "default"), rows)}"""


def keys(of: type[Table], prefix: str) -> list[tuple[str, str, str]]:
    """(key, what it is, default) of a table and those below it."""
    rows = [(f"{prefix}{key}", text, "") for key, text in of.also.items()]
    for name, field in of.model_fields.items():
        key = f"{prefix}{field.alias or name}"
        inner = next((t for t in (*tables(), NormalPrior) if t.__name__ in str(field.annotation)), None)
        if inner is not None:
            rows += keys(inner, f"{key}.")
        else:
            rows.append((key, " ".join((field.description or "").split()), default_of(field)))
    return rows


def tables() -> list[type[Table]]:
    """All tables of the configuration."""
    return [kind for kind in Table.__subclasses__() if kind is not Config]


def default_of(field: FieldInfo) -> str:
    """A key's default; none where it must be given, or where its description says what it is."""
    needed = field.is_required() and "in place of" not in (field.description or "")
    return "must be given" if needed else "" if field.default is PydanticUndefined else code(field.default)


def units() -> str:
    """Every unit word."""
    rows = [(dimension, ", ".join(f"`{word}`" for word in unit_words(dimension))) for dimension in DIMENSIONS]
    assert sum(len(unit_words(d)) for d in DIMENSIONS) == len(UNITS)
    return f"""# Units

Words for `unit` in a configuration; the first of each row is the one that values are kept in. How to give signs and
factors: [units and signs](../units-and-signs.md).

{table(("of", "words"), rows)}"""


def limits() -> str:
    """What files may ask for, and the environment variables that say so, from ``core.files``."""
    rows = [(f"`{name}`", text, code(LIMITS.get(name, ""))) for name, text in VARIABLES.items()]
    return f"""# Limits and environment variables

What a file may ask for is bounded before anything is allocated for it. A line that refuses a file names the limit; an
environment variable raises it, no file can.

{table(("variable", "what it is", "default"), rows)}
Without a variable: JSON and TOML have at most {LONGEST_TEXT // 2**20} MiB, a column of a log {WIDEST} numbers a row, a
model {MOST_FILES} included files and a timestep of at least {LEAST_TIMESTEP:g} s, a command {MOST_ROLLOUTS:g} rollouts.
What is promised of files: [SECURITY.md](../../SECURITY.md).
"""


def targets() -> str:
    """What a parameter may change, from ``envs.target_texts``."""
    rows = [
        (f"`{kind}{'' if kind == 'option' else ':NAME'}.{attribute}`", text)
        for kind, texts in TARGET_TEXTS.items()
        for attribute, text in texts.items()
    ]
    return f"""# Targets

What a parameter may change in the model. NAME is the name in the MJCF, which a body, joint, tendon or actuator must
have.

{table(("target", "what it is"), rows)}
A mass scales its inertia. Inertias that no rigid body has (A + B < C) are left out. `identified.xml` has no place for
what a sensor does, which is named instead.

Two geoms that touch share one contact: friction is the larger of theirs, `solref` and `solimp` are between theirs, so
name both as `targets`, or list the pair in the MJCF and name that.

What acts along a *tendon* is in N and m; in N m and rad where the coefficients of its hinges are 1 or -1; else in the
unit in which the coefficients are, which MJCF does not tell: for a radius of 12 mm, 0.012, in N and m again. Its length
is measured as a `tendonpos` sensor of the MJCF and its velocity as a `tendonvel`, as `sensor:NAME`, also where no joint
is: a winch's encoder. Where the sites of a spatial tendon lie is no target.

A *law* is a force that MJCF has no element for. Its numbers stand in the model as a custom numeric such as
`joint:elbow.load_friction`, also in `identified.xml`, and sipe_bayes writes the force before every physics step;
another program that loads the file simulates the model without it. What a law remembers are activations of an actuator
of the same name, which has no force.

A joint with a *compliance* or a *play* is one that an [extension](extensions.md) has put between a motor and its joint
(`NAME.gear`), behind the joint (`NAME.link`) or under the machine (`base_x`, `base_y`). MuJoCo itself simulates it.
"""


def options_table(kind: type[Options]) -> str:
    """Name, default, unit, and what each option is for."""
    rows = []
    for field in fields(kind):
        limits = field.metadata.get("limits")
        why, unit = (limits.why, limits.unit) if limits else (f"see `{field.type}`", "")
        legal = ", ".join(f"`{word}`" for word in limits.among) if limits and limits.among else ""
        if isinstance(field.default, Options):
            rows.append((f"`{field.name}`", f"`{type(field.default).__name__}()`", unit, why))
        else:
            rows.append((f"`{field.name}`", code(field.default), unit, f"{why} ({legal})" if legal else why))
    return table(("option", "default", "unit", "what it does, and why it is so"), rows)


def estimators() -> str:
    """Every method with its options, from the registry."""
    classes = {name: estimator_class(name) for name in ESTIMATORS}
    overview = [(f"[`{n}`](#{n})", f"`{c.__name__}`", summary(c)) for n, c in classes.items()]
    parts = [
        f"## {name}\n\n{summary(c)}\n\n{options_table(c.options_type)}"
        for name, c in classes.items()
        if fields(c.options_type)
    ]
    return f"""# Estimators

Every method gives a posterior behind one interface: `posterior = estimator.fit(trajectories)`, with the estimator of
`sipe.get_estimator(simulator, NAME, budget=..., seed=..., prior=..., **options)`. Which to take:
[which likelihood, which estimator](../which-likelihood.md).

{table(("name", "class", "what it is, and what it gives"), overview)}
{chr(10).join(parts)}"""


def extensions() -> str:
    """Physics that ``sipe discover`` may put into a model."""
    rows = []
    for name in EXTENSIONS:
        one = get_extension(name)
        native = "yes" if one.native else one.nearest or "no"
        rows.append((f"`{name}`", one.kind, one.sentence("NAME"), native, one.reference))
    return f"""# Extensions

Physics that [`sipe discover`](../what-a-model-lacks.md) may add to a model. `residual` is an unstructured
force: it is tried only where `--only` or `[structure]` names it.

{table(("extension", "at", "what it is", "MJCF has it, or its nearest", "described in"), rows)}"""


def environments() -> str:
    """The benchmark's tasks."""
    cells = ("parameters", "observations", "actions", "reproduces")
    rows = [(f"`{row['name']}`", *(row[k] for k in cells)) for row in (make_task(name).row() for name in TASKS)]
    return f"""# Environments

`sipe envs` lists them; `sipe envs Door` prints one with what every parameter writes. What they are
and how they differ from the published ones: [environments](../environments.md).

{table(("environment", *cells), rows)}"""


def agents() -> str:
    """The shipped agents, from their cards."""
    rows = []
    for path in sorted(AGENT_FILES.glob("*-expert.json")):
        card, task = json.loads(path.read_text(encoding="utf-8")), path.stem.removesuffix("-expert")
        other = json.loads((AGENT_FILES / f"{task}-suboptimal.json").read_text(encoding="utf-8"))
        scores = [returns(found) for found in (card["evaluation"], other["evaluation"], card["idle"], card["random"])]
        solved = f"{card['solved_at']['threshold']:,g} ({card['solved_at']['measure']})"
        rows.append((f"`{task}`", *scores, f"{card['steps']:,}, {card['wall_seconds'] / 60:.0f} min", solved))
    heads = ("task", "expert", "suboptimal", "idle", "random", "control steps, wall time", "solved at")
    return f"""# Agents

Returns ± one standard error, and success rates, over 100 episodes, as `sipe agents` evaluates them anew; idle is the
middle of the action range. Each card (`sipe_bayes/datasets/agents/*.json`) holds the command that made the agent. How
they were trained: [agents and trajectories](../agents.md).

{table(heads, rows)}"""


def returns(found: dict[str, float]) -> str:
    """Mean return with its standard error, and the success rate of tasks that have one."""
    rate = "" if found["success_rate"] is None else f" ({found['success_rate']:.2f})"
    return f"{found['mean']:,.0f} ± {found['standard_error']:.0f}{rate}"


def logs() -> str:
    """Formats of logs."""
    rows = [
        (f"`{kind}`", form.columns, f"`sipe-bayes[{form.extra}]`" if form.extra else "")
        for kind, form in READERS.items()
    ]
    return f"""# Log formats

What is done with them: [logs](../logs.md).

{table(("file, or what a folder holds", "a column is called", "needs"), rows)}"""


def findings() -> str:
    """Every code of a finding, from ``core.finding_texts`` and ``core.finding_advice``."""
    parts = []
    for one in Code:
        text = one.value
        parts.append(f"## {one}\n\n*{text.severity}*. {plain(one)}\n\n{ADVICE[one]}\n")
    return f"""# Findings

What a fit, a check or a log reader may notice, by its code: `findings` of `result.json`. A note is worth knowing; of a
caution a value or a prediction suffers; where one blocks, no plain interval is to be trusted. Braces stand for what the
run fills in. `sipe explain CODE` says the same.

{chr(10).join(parts)}"""


def thresholds() -> str:
    """Thresholds of verdicts."""
    return f"""# Thresholds

What a number has to reach for something to be said of it: `sipe_bayes.core.thresholds`.

{options_table(Thresholds)}"""


def commands() -> str:
    """Every command of ``sipe`` with its options."""
    root = typer.main.get_command(app)
    return f"# Commands\n\n`--help` of each says the same.\n\n{chr(10).join(command(root, 'sipe'))}"


def command(one: object, path: str) -> list[str]:
    """The sections of a command and of those below it."""
    inner = getattr(one, "commands", None)
    if inner is not None:
        return [part for name, below in inner.items() for part in command(below, f"{path} {name}")]
    rows, arguments = [], []
    for parameter in one.params:  # type: ignore[attr-defined]
        if parameter.param_type_name == "argument":
            word = parameter.metavar or parameter.name.upper()
            arguments.append(word if parameter.required else f"[{word}]")
            rows.append((f"`{word}`", getattr(parameter, "help", "") or "", ""))
        elif parameter.name != "help":
            shown = code(parameter.default) if isinstance(parameter.default, str | int | float) else ""
            shown = "" if parameter.is_flag else shown
            rows.append((f"`{', '.join((*parameter.opts, *parameter.secondary_opts))}`", parameter.help or "", shown))
    text = inspect.cleandoc(one.help or "").replace("``", "`")  # type: ignore[attr-defined]
    usage = " ".join([path, *arguments, "[OPTIONS]"])
    return [f"## {path}\n\n`{usage}`\n\n{text}\n\n{table(('', 'what it is', 'default'), rows)}"]


def python() -> str:
    """The public names."""
    names = [name for name in sipe_bayes.__all__ if name != "__version__"]
    rows = [(f"`{name}`", summary(getattr(sipe_bayes, name))) for name in names]
    return f"""# Python

`import sipe_bayes as sipe`; `help(sipe.NAME)` says shapes and units.

{table(("name", "what it is"), rows)}
{chr(10).join(entry(name) for name in names)}"""


def entry(name: str) -> str:
    """A public name in full, as the site shows it from its docstring."""
    thing = getattr(sipe_bayes, name)
    kind = "module" if inspect.ismodule(thing) else "class" if inspect.isclass(thing) else "function"
    members = "   :members:\n" if kind == "class" else ""
    where = f"{thing.__name__}" if kind == "module" else f"sipe_bayes.{name}"
    return f"## {name}\n\n```{{eval-rst}}\n.. auto{kind}:: {where}\n{members}```\n"


PAGES = {
    page.__name__: page
    for page in (
        *(configuration, limits, units, targets, logs, estimators, extensions, agents),
        *(environments, findings, thresholds, commands, python),
    )
}


def llms() -> str:
    """llms.txt: what the library is, and its pages in a line each."""
    pages = sorted(
        path for path in FOLDER.parent.rglob("*.md") if path.name != "index.md" and "_build" not in path.parts
    )
    lines = []
    for path in pages:
        text = re.sub(r"\A---\n.*?\n---\n", "", path.read_text(encoding="utf-8"), flags=re.DOTALL).replace(NOTE, "")
        title, _, rest = text.strip().partition("\n")
        first = " ".join(rest.strip().split("\n\n")[0].split())
        about = first.split(". ")[0].rstrip(".:") if first[:1].isalpha() else ""
        about = re.sub(r"\[([^\]]+)\]\([^)]+\)", r"\1", about)
        lines.append(f"- [{title.lstrip('# ')}]({path.relative_to(FOLDER.parents[1])}){f': {about}' if about else ''}")
    return f"""# sipe_bayes

> Give it a robot simulator (MuJoCo) and a log of the real machine; it gives back a probability distribution over the
> simulator's parameters, says how far you may trust it, and finds the physics that the simulator lacks.

`pip install -e .`, then `sipe calibrate CONFIG.toml`; in Python `import sipe_bayes as sipe`. Begin with README.md and
docs/tutorials/your-robot.md. Values are in SI; theta is normalised to [0, 1]. A value is to be trusted only where no
finding blocks.

## Pages

{chr(10).join(lines)}
"""


def main() -> int:
    """Writes the pages, or compares them."""
    stale = []
    wanted = [(FOLDER / f"{name}.md", lambda page=page: f"{NOTE}\n{page()}") for name, page in PAGES.items()]
    for path, make in (*wanted, (FOLDER.parents[1] / "llms.txt", llms)):
        text = make()
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            stale.append(path.name)
            if "--check" not in sys.argv:
                path.write_text(text, encoding="utf-8")
    print(f"docs: {', '.join(stale) or 'nothing'} {'is out of date' if '--check' in sys.argv else 'written'}")
    return int("--check" in sys.argv and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
