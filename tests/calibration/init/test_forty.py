"""`sipe init` on the logs of many machines: what it takes a column for is right, or it asks."""

from __future__ import annotations

from pathlib import Path

from sipe_bayes.calibration.init.draft import Draft
from sipe_bayes.calibration.init.propose import propose
from sipe_bayes.calibration.readers.base import LogError
from tests.problems.forty_machines import MACHINES, Column, Plant, asks, misread, turned_together, written
from tests.problems.made_up_logs import KINDS, make_log

FELT = (".velocity", ".force")  # which are turned round with the position


def judged(draft: Draft, plant: Plant) -> tuple[str, list[str]]:
    """RIGHT, ASKED or WRONG, and what is other than it is."""
    truths = [column for column in plant.columns if column.target]
    signs = {r.match.target: r.sign for r in draft.readings}
    times = {t.target: signs.get(t.target, t.sign) * t.sign for t in truths}
    faults = [fault for t in truths for fault in misread(draft, t)]
    for t in truths:
        if t.target.endswith(FELT) and times[t.target] != times.get(f"{t.target.rpartition('.')[0]}.position", 1):
            faults.append((f"{t.name} is turned round beside its position", False))
    turned = {t.name for t in truths if times[t.target] < 0 and not t.target.endswith(FELT)}
    if turned:
        faults.append((f"signs of {sorted(turned)}", turned_together(draft, truths, turned)))
    for c in plant.columns:
        taken = [r for r in draft.readings if c.name in r.match.columns and not c.target and c.name not in plant.told]
        faults += [(f"{c.name} is not {r.match.target}", asks(draft, c.name, "?")) for r in taken]
    faults += [(f"{c}: nothing of {word!r}", False) for c, word in plant.told.items() if not asks(draft, c, word)]
    if (draft.clock.column, draft.clock.unit) != (plant.clock[0], plant.clock[1].replace("iso", "s")):
        faults.append((f"clock {draft.clock.column} in {draft.clock.unit}", False))
    if abs(draft.delay - plant.delay) > 1.1:
        bounds = [(u.low, u.high) for u in draft.free if u.name == "delay"]
        asked = any(low <= plant.delay * plant.dt <= high for low, high in bounds)
        faults.append((f"delay {plant.delay}, not {draft.delay:.2f}", asked))
    word = "WRONG" if not all(asked for _, asked in faults) else "ASKED" if faults else "RIGHT"
    return word, [("asked: " if asked else "") + text for text, asked in faults]


def proposed(folder: Path, plant: Plant) -> tuple[str, list[str]]:
    """The verdict of a log; one that is refused is asked for where the refusal names its clock."""
    try:
        return judged(propose(folder / "model.xml", [folder / "log.csv"], folder), plant)
    except LogError as error:
        return ("ASKED" if repr(plant.clock[0]) in str(error) else "WRONG"), [f"refused: {error}"]


def test_every_column_of_forty_nine_logs_is_right_or_asked(tmp_path: Path) -> None:
    """None is wrong without a question, and nine of ten are right or asked."""
    verdicts = {}
    for name, plant in MACHINES.items():
        (folder := tmp_path / name).mkdir()
        written(folder, name, plant)
        verdicts[name] = proposed(folder, plant)
    for kind, variant in ((kind, variant) for kind in KINDS for variant in range(5)):
        (folder := tmp_path / f"{kind}_{variant}").mkdir()
        truth = make_log(folder, KINDS[kind], variant, 40 + variant, steps=600)
        columns = [Column(c, t, unit, sign) for (c, t), (unit, sign) in truth.columns.items()]
        verdicts[folder.name] = proposed(folder, Plant("", columns, delay=truth.delay, clock=truth.clock))
    table = "\n".join(f"{name:26} {word:6} {'; '.join(why)}" for name, (word, why) in verdicts.items())
    good = sum(word != "WRONG" for word, _ in verdicts.values())
    assert good >= 0.9 * len(verdicts), f"{good} of {len(verdicts)} are right or asked:\n{table}"
    assert good == len(verdicts), f"wrong without a question:\n{table}"
