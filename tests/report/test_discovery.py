"""What is thought of a search over structures and in which words; its page and its twenty printed lines."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from sipe_bayes.cli.discover import print_discovery
from sipe_bayes.core.findings import Code, Finding, Severity, finding
from sipe_bayes.diagnostics.discovery import Discovery
from sipe_bayes.diagnostics.records import Comparison
from sipe_bayes.report.discovery.page import discovery_pictures, render_discovery
from sipe_bayes.report.discovery.words import discovery_verdicts, next_steps
from tests.problems.calibrations import EVIL, Page
from tests.problems.discoveries import LARGE, SMALL, make_discovery, piece, row

FRICTION = piece("friction", kept=True)
LAW = piece("stribeck", kept=True, native=False, nearest="LuGre", parameters=("hinge.size", "hinge.speed"))
TWIN = row("drag at hinge", weight=0.4, behind=4.0)
GAINS = piece("gain", "motor", kept=True, parameters=tuple(f"motor.gain[{k}]" for k in range(6)))

CUT = finding(
    Code.STRUCTURES_CUT_SHORT,
    why="with its budget of 30000 rollouts",
    before="any piece was tried",
    untried="",
    remedy="give --budget 60000",
)


def changed(*pieces: Any, **changes: Any) -> Discovery:
    return dataclasses.replace(make_discovery(*pieces), **changes)


def widened(discovery: Discovery) -> dict[str, Any]:
    wider = [dataclasses.replace(p, further=(p.q05 - p.sd, p.q95 + p.sd)) for p in discovery.parameters]
    return {"parameters": tuple(wider)}


def left(misfit: Any) -> dict[str, Any]:
    return {"after": dataclasses.replace(make_discovery().after, misfit=misfit)}


VERDICTS: dict[str, tuple[Discovery, str, str]] = {  # of what, the tone, words of the sentence
    "found": (
        make_discovery(FRICTION),
        "good",
        "The logs support friction at hinge, 0.1000 N m (0.0920 to 0.1080): the log predictive density rises by 20",
    ),
    "two numbers": (make_discovery(LAW), "good", "size 0.1000 N m (0.0920 to 0.1080) and speed 0.1000 N m ("),
    "many numbers": (make_discovery(GAINS), "good", "and 3 more: the log"),
    "two pieces": (make_discovery(FRICTION, LAW), "good", "0.1080); and stribeck at hinge, size"),
    "found, wrong": (changed(FRICTION, **left(LARGE)), "fair", "The logs support friction at hinge"),
    "nothing": (make_discovery(), "good", "Nothing is lacking that these logs would show."),
    "nothing, wrong": (changed(**left(LARGE)), "bad", "nothing that was tried is what the model lacks"),
    "better": (
        make_discovery(FRICTION),
        "good",
        "falls to 0.50 times that of the plain model, calibrated (95 %",
    ),
    "worse": (changed(FRICTION, comparison=Comparison(0.5, 0.4, 0.6, 1e-4, 20)), "bad", "LARGER, 2.00 times"),
    "not better": (changed(FRICTION, comparison=Comparison(1.2, 0.9, 1.6, 0.2, 20)), "fair", "NOT shown to be better"),
    "no log held out": (changed(FRICTION, comparison=None, errors=()), "fair", "No log was held out"),
    "a tie": (
        make_discovery(FRICTION, tied=(TWIN,)),
        "fair",
        "Within two standard errors these structures predict the logs as well: drag at hinge (difference "
        "-4.0 ± 9.0 nats). The simplest of "
        "them, dry friction at hinge, is written to discovered.xml. More logs, or other motions, may tell.",
    ),
    "a tie, parts of the logs": (
        dataclasses.replace(
            make_discovery(FRICTION, tied=(TWIN,)), findings=(finding(Code.SEARCHED_ON_PARTS, used=10.0, all=24.0),)
        ),
        "fair",
        "Logs cut to where they differ, or other motions, may tell.",
    ),
    "not needed": (
        dataclasses.replace(
            make_discovery(FRICTION), rows=(row("dry", weight=1.0), row("dry", "cogging", behind=-9.0))
        ),
        "fair",
        "Adding cogging gains +9.0 ± 9.0 nats: less than two standard errors, so it is left out.",
    ),
    "noise": (make_discovery(FRICTION), "good", "What remains passes for noise (p = 0.4)."),
    "small": (changed(FRICTION, **left(SMALL)), "fair", "something small, like drag at hinge"),
    "large": (changed(FRICTION, **left(LARGE)), "bad", "it looks most like drag at hinge"),
    "unknown": (changed(FRICTION, **left(None)), "fair", "cannot be told"),
    "trusted": (make_discovery(FRICTION), "good", "Values may be trusted within the printed intervals"),
    "small, trusted": (changed(FRICTION, **left(SMALL)), "good", "Values may be trusted within"),
    "not trusted": (changed(FRICTION, **left(LARGE)), "bad", "No value may be trusted within its interval yet"),
    "unknown, not trusted": (changed(FRICTION, **left(None)), "bad", "No value may be trusted within its interval yet"),
    "not settled": (changed(FRICTION, settled=False), "bad", "raise its budget"),
    "not settled, no fact": (
        changed(FRICTION, settled=False),
        "bad",
        "were fitted to their end; of these, the simplest of the best has",
    ),
    "cut short": (
        changed(FRICTION, settled=False, findings=(CUT,), **left(LARGE)),
        "bad",
        "--budget 60000, and the same folder",
    ),
    "refused": (
        dataclasses.replace(
            make_discovery(FRICTION), rows=(row("dry", weight=1.0), dataclasses.replace(row("drag"), refused=True))
        ),
        "fair",
        "Refused, since errors on held-out logs are larger than those of the plain model: drag.",
    ),
    "cut short, a tie": (
        dataclasses.replace(make_discovery(FRICTION, tied=(TWIN,)), settled=False, findings=(CUT,)),
        "bad",
        "No value may be trusted yet",
    ),
    "cut short, noise": (changed(FRICTION, settled=False, findings=(CUT,)), "fair", "printed intervals, though the"),
    "nothing, cut short": (changed(settled=False, findings=(CUT,)), "fair", "was not tried to the end"),
    "cut short, wider": (
        changed(FRICTION, settled=False, findings=(CUT,), **left(LARGE), **widened(make_discovery())),
        "fair",
        "Use values within the intervals",
    ),
    "nothing tried": (changed(**left(LARGE), settled=False, findings=(CUT,)), "bad", "no piece was fitted to its end"),
}


@pytest.mark.parametrize(("discovery", "tone", "words"), VERDICTS.values(), ids=VERDICTS)
def test_verdicts(discovery: Discovery, tone: str, words: str) -> None:
    said = [verdict for verdict in discovery_verdicts(discovery) if words in verdict.text]
    assert [verdict.tone for verdict in said] == [tone], [verdict.text for verdict in discovery_verdicts(discovery)]


def test_what_is_clearly_behind_is_no_tie() -> None:
    sentences = [v.text for v in discovery_verdicts(make_discovery(FRICTION, piece("drag")))]
    assert not [text for text in sentences if "drag" in text]


NEXT = {
    "found": (make_discovery(FRICTION), "sipe calibrate runs/pendulum-discover/discovered.toml"),
    "nothing": (make_discovery(), "go on with the configuration"),
    "nothing, wrong": (changed(**left(LARGE)), "structure.extra"),
    "nothing tried": (changed(**left(LARGE), findings=(CUT,)), "the search again, as said above"),
}


@pytest.mark.parametrize(("discovery", "words"), NEXT.values(), ids=NEXT)
def test_what_to_do_next(discovery: Discovery, words: str) -> None:
    assert words in next_steps(discovery)
    assert "that structure alone" not in next_steps(discovery)


def test_a_structure_that_may_be_another_is_not_calibrated_without_a_word() -> None:
    assert next_steps(make_discovery(FRICTION, tied=(TWIN,))).endswith("those above for all of the set")


def test_twenty_lines_hold_whatever_there_is_to_say(capsys: pytest.CaptureFixture[str]) -> None:
    full = make_discovery(FRICTION, LAW, GAINS, rows=12, tied=(TWIN,) * 9)
    full = dataclasses.replace(
        full,
        errors=full.errors * 5,
        parameters=full.parameters * 4,
        findings=tuple(Finding(Code.NOT_EXPORTED, Severity.CAUTION, f"{k}") for k in range(5)),
        settled=False,
        **left(LARGE),
    )
    print_discovery(full)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 20
    assert [line for line in lines if "more, in the report" in line]
    assert lines[-1].startswith("next: ")


def test_page_says_it_all_and_escapes_names() -> None:
    measured = piece("delay", "angle", kept=True, kind="channel", native=False)
    made = make_discovery(FRICTION, LAW, measured, tied=(TWIN,))
    discovery = dataclasses.replace(made, name=EVIL)
    images = discovery_pictures(discovery)
    assert {image.section for image in images} == {"signals_holdout", "signals_train", "residuals", "values"}
    html = render_discovery(discovery, images)
    page = Page(html)
    assert page.tags.count("script") == 2  # the numbers, and what draws them
    for verdict in discovery_verdicts(discovery):
        assert verdict.text in page.text
    for words in (
        "Structures within two standard errors of the best predict alike",
        "MJCF has no element for stribeck at hinge",
        "The nearest element is LuGre",
        "Delay at angle is of the measurement and has no place in discovered.xml",
        "these structures predict the logs as well: drag at hinge (difference -4.0 ± 9.0 nats)",
        "a spring at hinge +2.0 not to its end",
        "Next: sipe calibrate runs/pendulum-discover/discovered.toml",
    ):
        assert words in page.text, words
