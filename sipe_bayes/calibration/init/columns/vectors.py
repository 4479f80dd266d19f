"""Which columns together are a vector or a quaternion: of free bodies, and of inertial sensors."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from sipe_bayes.calibration.init.columns.match import SURE, Match
from sipe_bayes.calibration.init.columns.names import (
    Kind,
    Label,
    alike,
    is_accelerometer,
    is_gyro,
    is_spin,
    is_turn,
    read_name,
    two_ways,
)
from sipe_bayes.calibration.init.machine import Machine


def match_vectors(machine: Machine, labels: list[Label]) -> tuple[list[Match], list[Label]]:
    """Poses of free bodies and readings of inertial sensors: groups of three or four columns; and what is left."""
    groups: dict[str, list[Label]] = defaultdict(list)
    for label in labels:
        if label.axis or label.number is not None:
            groups[label.vector if label.axis else label.stem].append(label)
    out: list[Match] = []
    taken: set[str] = set()
    for wanted, size, target_of in _wanted(machine):
        for stem, group in groups.items():
            part = [x for x in group if x.column not in taken]
            fitting = [x for x in part if wanted(x, stem)]
            if len(fitting) != size:
                continue
            order = "xyz" if size == 3 else ("wxyz" if fitting[0].axis in ("w", "") else "xyzw")
            if fitting[0].axis:
                fitting = sorted(fitting, key=lambda x: order.index(x.axis))
            else:
                fitting = sorted(fitting, key=lambda x: x.number or 0)
            target, score = target_of(stem)
            if any(m.target == target for m in out):
                continue
            quaternion = order if size == 4 else ""
            columns = tuple(x.column for x in fitting)
            taken |= set(columns)
            sure = score if fitting[0].axis or size == 3 else 0.0
            out.append(Match(columns, target, fitting[0], sure, quaternion))
    return out, [x for x in labels if x.column not in taken]


Wanted = tuple[Callable[[Label, str], bool], int, Callable[[str], tuple[str, float]]]


def _wanted(machine: Machine) -> list[Wanted]:
    """What vectors a model may have: whether a column is one of them, how many, and the target of a stem."""
    out: list[Wanted] = [
        (is_gyro if kind == "gyro" else is_accelerometer, 3, partial(_sensor, name)) for name, kind in machine.sensors
    ]
    if machine.bodies:
        turns = partial(is_turn, alone=not machine.joints)
        out.append((turns, 4, partial(_body, machine, "orientation")))
        out.append((lambda x, s: x.kind == Kind.POSITION and not turns(x, s), 3, partial(_body, machine, "position")))
        out.append((is_spin, 3, partial(_body, machine, "angular_velocity")))
        out.append(
            (lambda x, s: x.kind == Kind.VELOCITY and not is_spin(x, s), 3, partial(_body, machine, "linear_velocity"))
        )
    return out


def held_open(vectors: Sequence[Match]) -> tuple[list[Match], list[str]]:
    """Vectors, of which none that may be another one is sure unless that one is there; and what is to be said."""
    reasons = [two_ways(m.label, m.target) if m.target.startswith("body:") else "" for m in vectors]
    clear = {match.target for match, why in zip(vectors, reasons, strict=True) if not why}
    other = {"linear_velocity": "angular_velocity", "angular_velocity": "linear_velocity"}
    out, doubts = [], []
    for match, why in zip(vectors, reasons, strict=True):
        body, _, quantity = match.target.rpartition(".")
        if why and ("<gyro>" in why or f"{body}.{other[quantity]}" not in clear):
            names = ", ".join(map(repr, match.columns))
            doubts.append(f"{names} are taken for {match.target}: {why}")
            match = replace(match, score=0.0)
        out.append(match)
    return out, doubts


def _sensor(name: str, stem: str) -> tuple[str, float]:
    return f"sensor:{name}", SURE


def _body(machine: Machine, quantity: str, stem: str) -> tuple[str, float]:
    """The free body that a stem speaks of, and how sure that is."""
    words = read_name(stem).words
    best = max(machine.bodies, key=lambda name: alike(words, name))
    return f"body:{best}.{quantity}", SURE if len(machine.bodies) == 1 or alike(words, best) > 0.5 else 0.0
