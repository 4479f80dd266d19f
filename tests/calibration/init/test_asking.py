"""What a person answers is what stands in the file: signs that go together, units, and nothing where all is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from sipe_bayes.calibration.config import load_config
from sipe_bayes.calibration.init.asking import asked, choices_of
from sipe_bayes.calibration.init.draft import Draft
from sipe_bayes.calibration.init.propose import propose
from sipe_bayes.calibration.init.write import toml_of
from tests.problems.made_up_logs import KINDS, make_log


def cart(folder: Path) -> Draft:
    """A cart and pole, which move alike with all signs turned round."""
    make_log(folder, KINDS["cart"], 1, 11)
    return propose(folder / "model.xml", [folder / "log.csv"], folder)


def test_signs_that_go_together_are_turned_together(tmp_path: Path) -> None:
    """Velocities with their positions."""
    draft = cart(tmp_path)
    shown: list[str] = []

    def turn(text: str, answers: Sequence[str]) -> int:
        shown.append(text)
        return answers.index("flipped") if "flipped" in answers else 0

    done = asked(draft, turn)
    assert len(shown) == 1
    assert [r.sign for r in done.readings] == [-r.sign for r in draft.readings]
    (tmp_path / "calibrate.toml").write_text(toml_of(done, "sipe init"))
    signs = {m.column: m.sign for m in load_config(tmp_path / "calibrate.toml").measurements}
    assert signs == {r.match.column: r.sign for r in done.measurements}


def test_the_first_answer_is_what_was_proposed(tmp_path: Path) -> None:
    draft = cart(tmp_path)
    done = asked(draft, lambda text, answers: 0)
    assert [r.row() for r in done.readings] == [r.row() for r in draft.readings]


def test_another_unit_takes_its_set_point_along(tmp_path: Path) -> None:
    make_log(tmp_path, KINDS["servo"], 0, 3)
    draft = propose(tmp_path / "model.xml", [tmp_path / "log.csv"], tmp_path)
    assert not choices_of(draft), "all is known"
    place, command = draft.readings[0], draft.commands[0]
    assert draft.tied == ((place.match.column, command.match.column),)
    open_ = replace(place, doubts=("rad or deg?",), instead=('unit = "deg"',))
    changed = draft.with_readings([open_, *draft.readings[1:]])
    done = asked(changed, lambda text, answers: 1)
    assert (done.readings[0].unit, done.commands[0].unit) == ("deg", "deg")
    assert not done.readings[0].doubts
