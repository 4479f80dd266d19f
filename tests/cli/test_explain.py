"""`sipe explain`: of a code, and of what a run found."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from sipe_bayes.cli.app import app
from sipe_bayes.core.finding_advice import ADVICE
from sipe_bayes.core.findings import Code, finding


@pytest.mark.parametrize("record", ["result.json", "structures.json"])  # of a calibration, and of a search
def test_what_a_run_found(record: str, tmp_path: Path) -> None:
    """With the run's own numbers, the worst first, each code once."""
    found = [
        finding(Code.MISFIT_NOT_ASKED),
        finding(Code.NOISE_EXCEEDS_SCATTER, channel="q", ratio=12.34),
        finding(Code.NOISE_EXCEEDS_SCATTER, channel="q", ratio=5.0),
    ]
    (tmp_path / record).write_text(json.dumps({"findings": [one.to_dict() for one in found]}))
    lines = CliRunner().invoke(app, ["explain", str(tmp_path)]).output.splitlines()
    assert lines[0] == "noise_exceeds_scatter (blocking, 2 times, of which the first)"
    assert "12.3 times" in lines[1]
    assert lines[2].strip() == ADVICE[Code.NOISE_EXCEEDS_SCATTER]
    assert lines[3].startswith("misfit_not_asked (note)")


@pytest.mark.parametrize(
    ("content", "words"),
    [(None, "no such file"), ('{"findings": [1]}', "result.json"), ('{"findings": [{"code": "nothing"}]}', "nothing")],
)
def test_a_folder_without_a_result(content: str | None, words: str, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "result.json").write_text(content)
    done = CliRunner().invoke(app, ["explain", str(tmp_path)])
    assert done.exit_code == 2
    assert words in done.output
    assert done.output.count("\n") == 1


def test_a_run_that_found_nothing(tmp_path: Path) -> None:
    (tmp_path / "result.json").write_text('{"findings": []}')
    done = CliRunner().invoke(app, ["explain", str(tmp_path)])
    assert done.exit_code == 0
    assert done.output.rstrip().endswith("nothing was noticed")
