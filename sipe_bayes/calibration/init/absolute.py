"""Angles against the world in place of a joint's own: what cameras and inertial units tell of a chain of links."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np

from sipe_bayes.calibration.init.decisions import Case, Layout, ranked
from sipe_bayes.calibration.init.draft import Draft, questions
from sipe_bayes.calibration.init.machine import Machine
from sipe_bayes.calibration.init.trials import Trial

_FAR_BETTER = np.log(2.0)  # of the logarithm of misses of all channels together


def absolute_angles(draft: Draft, model: mujoco.MjModel, machine: Machine, trial: Trial, layout: Layout) -> list[str]:
    """What is to be said of columns that simulations follow far better with the angle of the link before taken off.

    Units and signs are tried anew for each, since with a wrong angle wrong ones may follow it best.

    Args:
        draft: of the trial.
        model: as given.
        machine: what of it logs hold.
        trial: windows of the logs.
        layout: where the draft's readings are in it.
    """
    channel = {r.match.target: layout.channels[k][0] for k, r in enumerate(draft.readings) if layout.channels[k]}
    column, asked = {r.match.target: r.match.column for r in draft.readings}, questions(draft, machine)
    pairs = _chained(model, machine, channel) if asked else []
    case, doubts = Case(draft, machine, trial, layout, trial.theta), []
    base = float(ranked(case, asked).scores.min()) if pairs else 0.0
    for own, before in pairs:
        taken_off = replace(layout, minus=((channel[own], channel[before]),))
        better = base - float(ranked(replace(case, layout=taken_off), asked).scores.min())
        if better > _FAR_BETTER:
            doubts.append(
                f"{column[own]!r} looks like the angle of a link against the world, not of a joint: with "
                f"{column[before]!r} taken off, simulations miss {np.exp(better / len(trial.given.observed)):.2g} "
                "times less; log the difference, or write it as a column of its own"
            )
    return doubts


def _chained(model: mujoco.MjModel, machine: Machine, measured: dict[str, int]) -> list[tuple[str, str]]:
    """Position targets of measured hinges, each with that of the nearest measured hinge of a body that carries it."""
    of_body = {
        int(model.joint(j.name).bodyid[0]): f"joint:{j.name}.position"
        for j in machine.joints
        if j.hinge and f"joint:{j.name}.position" in measured
    }
    pairs = []
    for body, target in of_body.items():
        parent = int(model.body_parentid[body])
        while parent and parent not in of_body:
            parent = int(model.body_parentid[parent])
        if parent:
            pairs.append((target, of_body[parent]))
    return pairs
