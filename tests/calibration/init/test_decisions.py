"""What is said of readings that logs do not tell."""

from __future__ import annotations

from sipe_bayes.calibration.column_names import read_name
from sipe_bayes.calibration.init.decisions import list_guesses
from sipe_bayes.calibration.init.draft import Reading, Scale
from sipe_bayes.calibration.init.matching import SURE, Match


def counting(column: str, turn: int) -> Reading:
    scale = Scale("rev", 1 / turn)
    match = Match((column,), f"joint:{column}.position", read_name(column), SURE)
    return Reading(match, scale.unit, factor=scale.factor, scales=(scale,))


def test_counts_that_nothing_tells_are_open_by_their_number() -> None:
    """Of 49 the inverse of the inverse is another number; a column that counts nothing is not named."""
    plain = Reading(Match(("pitch_deg",), "joint:pitch.position", read_name("pitch_deg"), SURE), "deg")
    wheels = counting("left", 49), counting("right", 49), counting("boom", 4096), plain
    guesses = [doubt.split(" counts")[0] for doubt in list_guesses(wheels)]
    assert guesses == ["'left', 'right': 49", "'boom': 4096"]
