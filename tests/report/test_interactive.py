"""The report's charts: what they hold, and how they behave in a browser."""

from __future__ import annotations

import base64
import dataclasses
import json
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.diagnostics.records import Signal
from sipe_bayes.report.interactive import charts as drawn
from sipe_bayes.report.page import write_report
from tests.problems.browser import BROWSER, Tab, chromium
from tests.problems.calibrations import EVIL, make_calibration, signal

SAMPLES = 5000
ENDS = "document.querySelector('[data-part=above]').dataset.span.split(' ').map(Number)"
DRAWN = """new Promise(done => {
  const look = () => document.documentElement.classList.contains('drawn') ? done(0) : setTimeout(look, 10);
  look();
})"""
PICK = """(() => {{
  const list = document.querySelector('[data-part={part}]');
  list.value = {value};
  list.dispatchEvent(new Event('change'));
}})()"""
NAMED = "document.querySelector('[data-part=above]').getAttribute('aria-label')"
INK = """(() => {{
  const canvas = document.querySelector('[data-part={part}] canvas');
  return canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data.some(value => value > 0);
}})()"""


def noisy(log: str, use: str, channel: str) -> Signal:
    rng = np.random.default_rng(len(log) + len(channel))
    plain = signal(log, use, channel, steps=SAMPLES - 1, window=100)
    return dataclasses.replace(plain, measured=plain.measured + 0.01 * rng.normal(size=SAMPLES))


def decoded(content: dict[str, list[float]], codes: NDArray[np.uint16], place: int, count: int, key: str) -> FloatArray:
    """The plain reference of what the script does."""
    index = ("measured", "default", "mode", "low", "high").index(key)
    chosen = np.cumsum(codes[place + index * count :][:count].astype(int)) % 65536
    low, step = content[key]
    return np.where(chosen == 65535, np.nan, low + step * chosen)


def test_numbers_come_back() -> None:
    signals = [signal("a", "train", "x"), noisy("b", "holdout", "x"), noisy("b", "holdout", "y")]
    empty = dataclasses.replace(signals[0], channel="z", low=np.full(201, np.nan), default=np.full(201, 2.0))
    made = drawn.charts([*signals, empty], ["b", "a", "nobody"], "after", "before")
    assert made is not None
    content = json.loads(made.data)
    assert [(log["name"], log["use"]) for log in content["logs"]] == [("b", "held out"), ("a", "training")]
    codes, place = np.frombuffer(zlib.decompress(base64.b64decode(content["codes"])), "<u2"), 0
    by_key = {(s.log, s.channel): s for s in (*signals, empty)}
    for log in content["logs"]:
        for channel in log["channels"]:
            one = by_key.pop((log["name"], channel["name"]))
            assert np.allclose(log["start"] + log["step"] * np.arange(log["count"]), one.time)
            for key in ("measured", "default", "mode", "low", "high"):
                given = getattr(one, key)
                back = decoded(channel, codes, place, log["count"], key)
                assert np.array_equal(np.isnan(back), np.isnan(given))
                assert np.nanmax(np.abs(back - given), initial=0.0) <= 0.51 * channel[key][1]
            place += 5 * log["count"]
    assert not by_key
    assert place == len(codes)


def test_no_signals_no_charts() -> None:
    assert drawn.charts([], ["a"], "after", "before") is None


def test_long_logs_are_thinned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawn, "_NUMBERS", 400)
    made = drawn.charts([signal("a", "train", "x")], ["a"], "after", "before")
    assert made is not None
    assert made.thinned == 3
    content = json.loads(made.data)["logs"][0]
    assert content["count"] == 67
    assert content["step"] == pytest.approx(0.03)


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    calibration = make_calibration(size=2)
    logs = [(f"log {k}", "train", k < 1) for k in range(4)] + [(EVIL, "holdout", True)]
    calibration.signals[:] = [noisy(log, use, f"angle_{c}") for log, use, two in logs for c in range(1 + two)]
    return write_report(calibration, tmp_path_factory.mktemp("report"))


@pytest.fixture(scope="module")
def tab(report: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    if BROWSER is None:
        pytest.skip("needs Chromium")
    with chromium(tmp_path_factory.mktemp("browser")) as tab:
        yield tab


def test_five_logs_of_5000_samples_are_small(report: Path) -> None:
    assert report.stat().st_size < 3e6


@pytest.mark.parametrize(("width", "dark"), [(1300, False), (400, True)])
def test_in_a_browser(tab: Tab, report: Path, width: int, dark: bool) -> None:
    tab.requests.clear()
    tab.open(report.as_uri(), width, dark=dark)
    tab.value(DRAWN)
    tab.value("document.querySelector('#signals-panel').scrollIntoView()")
    tab.frames()
    assert tab.value("document.documentElement.scrollWidth") <= width
    assert tab.value("getComputedStyle(document.querySelector('.still')).display") == "none"
    assert tab.value("document.querySelector('[data-part=log]').selectedOptions[0].text") == f"{EVIL} (held out)"
    duration = 0.01 * (SAMPLES - 1)
    assert tab.value(ENDS) == pytest.approx([0, duration])
    # zoom by hand
    over = "document.querySelector('[data-part=above] .u-over').getBoundingClientRect()"
    left, top, wide, high = (tab.value(f"{over}.{key}") for key in ("left", "top", "width", "height"))
    middle = top + high / 2
    tab.drag((left + 0.25 * wide, middle), (left + 0.5 * wide, middle))
    assert tab.value(ENDS) == pytest.approx([duration / 4, duration / 2], abs=2 * duration / wide)
    below = ENDS.replace("above", "below")
    assert tab.value(below) == pytest.approx(tab.value(ENDS))
    # hover
    tab.call("Input.dispatchMouseEvent", type="mouseMoved", x=left + 0.5 * wide, y=middle)
    tab.frames()
    shown = tab.value("[...document.querySelectorAll('[data-part=above] .u-value')].map(e => e.textContent)")
    at = float(shown[0])
    assert duration / 4 < at < duration / 2
    assert float(shown[3]) == pytest.approx(np.sin(3 * at) + 0.01, abs=2e-3)  # the posterior's mode
    # pick
    tab.value(PICK.format(part="log", value=1))
    tab.value(PICK.format(part="channel", value=1))
    assert tab.value(NAMED) == "angle_1 of log 0, measured and simulated over time"
    assert tab.value(ENDS) == pytest.approx([0, duration])
    tab.value("document.querySelector('[data-part=closer]').click()")
    tab.value("document.querySelector('[data-part=later]').click()")
    assert tab.value(ENDS) == pytest.approx([duration / 2, duration])
    assert tab.value(INK.format(part="above"))
    assert tab.value(INK.format(part="below"))
    assert not [url for url in tab.requests if not url.startswith(("data:", "blob:")) and url != report.as_uri()]
    assert report.as_uri() in tab.requests
    assert not tab.trouble
