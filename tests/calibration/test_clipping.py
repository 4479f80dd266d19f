"""What counts as cut off at an extreme value, and which rests do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sipe_bayes.calibration.checks.clipping import Signal, clipped_of
from sipe_bayes.calibration.gathered import of_logs
from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.findings import Code, Findings, Severity, finding
from sipe_bayes.diagnostics.records import LogReport

COUNT = 2 * np.pi / 4096


def led(seed: int, time: FloatArray) -> FloatArray:
    """A set-point (n,) that goes from place to place and pauses there, in an encoder's counts."""
    rng, dt = np.random.default_rng(seed), time[1] - time[0]
    places, out = [0.0], np.zeros(0)
    while len(out) < len(time):
        places.append(float(rng.uniform(-1, 1)))
        s = np.linspace(0, 1, round(rng.uniform(0.4, 0.9) / dt))
        way = places[-2] + (places[-1] - places[-2]) * (10 * s**3 - 15 * s**4 + 6 * s**5)
        out = np.concatenate([out, way, np.full(round(rng.uniform(0.3, 0.9) / dt), places[-1])])
    return np.round(out[: len(time)] / COUNT) * COUNT


def following(command: FloatArray, dt: float, late: float = 0.08) -> FloatArray:
    """A joint (n,) that follows it, as an encoder tells it."""
    out = np.empty_like(command)
    at = command[0]
    for k, wanted in enumerate(command):
        at += (wanted - at) * (1 - np.exp(-dt / late))
        out[k] = at
    return np.round(out / COUNT) * COUNT


def arm(seed: int, rate: float = 30.0) -> tuple[FloatArray, list[Signal]]:
    """Two servos that are led by hand."""
    time = np.arange(0, 15, 1 / rate)
    signals = []
    for joint in range(2):
        command = led(2 * seed + joint, time)
        signals.append(Signal(f"q{joint}", time, following(command, 1 / rate), False))
        signals.append(Signal(f"actuator:{joint}", time, command, True))
    return time, signals


@pytest.mark.parametrize("rate", [30.0, 200.0])
@pytest.mark.parametrize("seed", range(6))
def test_pauses_of_a_led_arm_are_not_cut_off(seed: int, rate: float) -> None:
    _, signals = arm(seed, rate)
    counts = clipped_of(signals)
    print(counts)
    assert not any(counts.values())


@pytest.mark.parametrize("rate", [30.0, 200.0])
@pytest.mark.parametrize("name", ["q0", "actuator:0"])
def test_what_is_flat_while_the_other_moves_on_is_cut_off(name: str, rate: float) -> None:
    time, signals = arm(1, rate)
    moved = np.round(np.sin(2.0 * time) / COUNT) * COUNT
    pair = {"actuator:0": moved, "q0": following(moved, 1 / rate)}
    pair[name] = np.clip(pair[name], -2, 0.7 * pair[name].max())
    counts = clipped_of([replace(s, values=pair.get(s.name, s.values)) for s in signals])
    print(counts)
    assert counts[name] > 0.1 * len(time)
    assert sum(counts.values()) == counts[name]


def test_a_set_point_of_steps_that_holds_its_largest_value_is_not_cut_off() -> None:
    """The joint goes on turning there, so that nothing rests: a set-point of the speed."""
    time, steps = np.arange(0, 24, 0.02), np.repeat(np.random.default_rng(0).uniform(-1, 1, 40), 30)
    turned = Signal("q", time, np.cumsum(following(steps, 0.02)), False)
    assert clipped_of([Signal("u", time, steps, True), turned])["u"] == 0
    assert clipped_of([Signal("u", time, np.clip(np.sin(2.0 * time), -2, 0.7), True), turned])["u"] > 0.1 * len(time)


def test_without_a_set_point_the_rest_of_the_machine_tells() -> None:
    time, _ = arm(3)
    flat = np.minimum(np.sin(2.0 * time), 0.7)
    alone = clipped_of([Signal("q", time, flat, False)])["q"]
    assert alone > 0.1 * len(time), "where nothing is beside it, nothing tells that it rests"
    moving = Signal("force", time, np.cos(11 * time) + np.cos(3 * time), True)
    assert clipped_of([Signal("q", time, flat, False), moving])["q"] == alone
    resting = replace(moving, values=np.where(flat == 0.7, 0.3, moving.values))
    assert clipped_of([Signal("q", time, flat, False), resting])["q"] == 0


def test_what_several_logs_say_of_a_channel_is_one_line() -> None:
    reports = []
    for k in range(5):
        name, clipped = f"run{k}", {"q": 5} | ({"w": 7} if k == 2 else {})
        notes = tuple(finding(Code.LOG_CLIPPED, log=name, channel=c, clipped=n) for c, n in clipped.items())
        reports.append(LogReport(name, "", "", 1.0, 1.0, 2, 0.0, False, clipped=clipped, findings=notes))
    noticed = of_logs(reports)
    assert [item.text for item in noticed] == [
        "logs run0, run1, run2 and 2 more: q: 25 samples stuck at an extreme value: saturated, or at rest",
        "log run2: w: 7 samples stuck at an extreme value: saturated, or at rest",
    ]
    assert {item.severity for item in noticed} == {Severity.CAUTION}
    assert Findings(noticed).kinds == [f"{noticed[0].text} (and so 1 more)"], "one line on the terminal"
