"""Texts are for people alone: with every text of a finding changed, nothing behaves otherwise."""

from __future__ import annotations

import dataclasses
import string
from pathlib import Path
from typing import Any

import pytest

from sipe_bayes.calibration import gathered
from sipe_bayes.cli import app as command
from sipe_bayes.cli.errors import NOTHING_USABLE
from sipe_bayes.core.finding_texts import TEXTS, Code, Severity, Text
from sipe_bayes.core.findings import Finding, Findings, finding
from sipe_bayes.diagnostics.records import ChannelScore
from sipe_bayes.diagnostics.result import FLAGS, Calibration
from sipe_bayes.report.verdicts import parameter_verdict, verdicts
from tests.problems.calibrations import make_calibration, with_chains
from tests.problems.swings import call, strict_json, swing, write_case


def in_other_words(code: Code, text: Text) -> Text:
    """No word of it is left; the places stay, in reverse."""
    fields = [(name, spec) for _, name, spec, _ in string.Formatter().parse(text.template) if name]
    places = " ".join(f"{{{name}:{spec}}}" for name, spec in reversed(fields))
    return Text(text.severity, f"{code.name} {places}".strip(), f"row of {code}" if text.row else "")


def change_all(monkeypatch: pytest.MonkeyPatch) -> None:
    for code, text in list(TEXTS.items()):
        monkeypatch.setitem(TEXTS, code, in_other_words(code, text))


def made(code: Code, *names: str, **about: Any) -> Finding:
    """A finding whose places all hold something."""
    fields = {name: spec for _, name, spec, _ in string.Formatter().parse(TEXTS[code].template) if name}
    values = {name: 1.0 if spec else name for name, spec in fields.items() if name not in ("parameters", "log")}
    return finding(code, parameters=names, **values, **about)


def behaviour(calibration: Calibration) -> dict[str, Any]:
    """All that a program sees, and of what people see how it looks and how much there is of it."""
    findings = Findings(calibration.findings)
    plain = calibration.to_dict()
    return {
        "findings": [(f.code, f.severity, f.parameters, f.log) for f in calibration.findings],
        "flags": {p.name: calibration.flags(p.name) for p in calibration.parameters},
        "rows": [parameter_verdict(p, findings).tone for p in calibration.parameters],
        "top": [v.tone for v in verdicts(calibration)],
        "counts": [len(plain[key]) for key in ("warnings", "doubts", "findings")],  # type: ignore[arg-type]
        "keys": sorted(plain),
    }


def calibrations() -> dict[str, Calibration]:
    """One with each finding about its first parameter, one with all of them, one with chains that have not mixed."""
    plain = dataclasses.replace(make_calibration(), findings=())
    names = plain.posterior.space.names
    ridge = made(Code.RIDGE, *names[-2:])
    every = [made(code, names[0]) for code in Code]
    cases = {str(item.code): dataclasses.replace(plain, findings=(item, ridge)) for item in every}
    cases["blocking"] = dataclasses.replace(plain, findings=(made(Code.NOT_EXPORTED, severity=Severity.BLOCKING),))
    cases["all"] = dataclasses.replace(plain, findings=(*every, ridge))
    unmixed = (made(Code.NOT_MIXED), made(Code.BUDGET_SPENT))
    cases["chains"] = dataclasses.replace(with_chains(plain, 1.4), findings=unmixed)
    return cases


def test_every_code_has_a_text_and_no_place_is_forgotten() -> None:
    assert set(TEXTS) == set(Code)
    for code in Code:
        assert made(code, "mass", log="swing").text
        assert TEXTS[code].row or code not in FLAGS


def test_no_text_changes_what_a_calibration_is_taken_for(monkeypatch: pytest.MonkeyPatch) -> None:
    before = {name: behaviour(calibration) for name, calibration in calibrations().items()}
    assert len({str(seen) for seen in before.values()}) > len(Code) / 2  # the cases differ
    assert {flag for seen in before.values() for flags in seen["flags"].values() for flag in flags} == {
        str(code) for code in FLAGS
    }
    texts = {name: calibration.warnings for name, calibration in calibrations().items()}
    change_all(monkeypatch)
    after = calibrations()
    assert {name: behaviour(calibration) for name, calibration in after.items()} == before
    assert all(set(after[name].warnings).isdisjoint(said) for name, said in texts.items())


def test_what_the_checks_gather_does_not_depend_on_texts(monkeypatch: pytest.MonkeyPatch) -> None:
    scores = [ChannelScore("a", "x", "m", *rmse) for rmse in ((1.0, 2.0), (2.0, 1.0), (float("nan"), 1.0))]

    def seen() -> list[tuple[Code, Severity]]:
        logs = make_calibration().logs
        logs = [dataclasses.replace(log, findings=(made(Code.LOG_GAP, log=log.name),)) for log in logs]
        return [(f.code, f.severity) for f in (*gathered.not_better(scores), *gathered.of_logs(logs))]

    before = seen()
    assert (Code.HELD_OUT_WORSE, Severity.CAUTION) in before
    assert (Code.HELD_OUT_DIVERGES, Severity.CAUTION) in before
    assert (Code.LOG_GAP, Severity.CAUTION) in before  # the log has a gap
    change_all(monkeypatch)
    assert seen() == before


def calibrated(folder: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[int, Calibration, dict[str, Any]]:
    """Exit code, what was printed, and result.json of a search on a log with a gap and a torque that is off."""
    log = swing()
    log = log.assign(torque=log["torque"] - 0.3).drop(index=range(40, 60))
    printed: list[Calibration] = []
    show = command.print_calibration
    with monkeypatch.context() as patch:
        patch.setattr(command, "print_calibration", lambda found: (printed.append(found), show(found)))
        result = call(write_case(folder, log), "--estimator", "cem", "--budget", 150, "--out", folder / "out")
    assert result.exit_code == NOTHING_USABLE, result.output
    return result.exit_code, printed[0], strict_json((folder / "out" / "result.json").read_text())


def test_a_run_does_the_same_in_other_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code, found, written = calibrated(tmp_path / "before", monkeypatch)
    codes = {item.code for item in found.findings}
    print(codes)
    assert {Code.SEARCH_SPREAD, Code.LOG_GAP} <= codes
    assert codes & {Code.MISFIT, Code.SMALL_MISFIT}
    assert len(codes) >= 5
    change_all(monkeypatch)
    other_code, other, other_written = calibrated(tmp_path / "after", monkeypatch)
    assert (other_code, behaviour(other)) == (code, behaviour(found))
    for plain in (written, other_written):
        for row in plain["findings"]:
            row.pop("text")
    assert other_written["findings"] == written["findings"]
    assert [p["flags"] for p in other_written["parameters"]] == [p["flags"] for p in written["parameters"]]
    assert set(other.doubts).isdisjoint(found.doubts)
