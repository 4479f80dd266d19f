"""Which unknowns the logs tell apart, and room for those that press against a bound."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from sipe_bayes.calibration.init.draft import Unknown, rounded_up
from sipe_bayes.calibration.init.unknowns.alike import SHARED, shared, together
from sipe_bayes.calibration.init.unknowns.candidates import least_of
from sipe_bayes.calibration.init.unknowns.effects import Fit
from sipe_bayes.core.arrays import FloatArray

RELATIVE = "no force is known, so that all forces are relative to it; weigh it and write it into the model"
"""Why a mass is left out."""
_NOTABLE = 0.03  # of its range, from which a spring is asked for
_STILL = 0.1  # rad or m, the least motion within which one may rest
MOST = 30
"""Parameters that are asked for: what shows and is left out is in all others."""
_WEAK = 3.0  # of the noise, what a parameter has to move over its range
_APART = 0.05  # share of its effect that no other parameter has: less is how exactly a simulation repeats
_EXACT = 0.01  # share below which it is another's effect whatever it costs: slopes are no better
_PRESSED = 1e-3  # of its range: the fit would have gone on
_BEYOND = 3.0  # times a bound that the fit presses against
_CLEAR = 15.0  # of the noise, what it has to move by itself where its share is small
_MIXED = 0.15  # a share that is small; with more it is asked for: friction that is left out is in all others


def chosen(
    model: mujoco.MjModel, unknowns: Sequence[Unknown], fit: Fit, given: FloatArray, open_scale: bool
) -> tuple[list[Unknown], FloatArray]:
    """The unknowns as ``told_apart`` tells them, and their values (N,) in the fit.

    Where more than ``MOST`` show, those of parts that are alike share a parameter, one property after the other until
    few enough are left.
    """
    unknowns = list(unknowns)
    for what in SHARED:
        if sum(not u.left_out for u in told_apart(unknowns, fit, given, open_scale, len(unknowns))) <= MOST:
            break
        unknowns, fit, given = together(unknowns, fit, given, shared(model, unknowns, what), what)
    return told_apart(unknowns, fit, given, open_scale), fit.theta


def told_apart(
    unknowns: Sequence[Unknown], fit: Fit, given: FloatArray, open_scale: bool = False, most: int = MOST
) -> list[Unknown]:
    """The unknowns, with the reason where one is better left out: it shows too little, or as another one does.

    One that shows as others do is kept where leaving it at the model's own value would cost more than noise.

    Args:
        unknowns: of the fit, those first that are to be kept first.
        fit: with the effects of each.
        given: (N,) of the model.
        open_scale: whether forces and masses are known relative to each other alone: masses are left out then.
        most: of how many no more are asked for.
    """
    masses = [k for k, unknown in enumerate(unknowns) if any(t.endswith(".mass") for t in unknown.targets)]
    scale = masses if open_scale and len(masses) < len(unknowns) else []
    kept: list[int] = []
    out = []
    effects = fit.jacobian / np.sqrt(max(1.0, len(fit.jacobian) / 400.0))  # residuals are correlated
    for k, unknown in enumerate(unknowns):
        effect = effects[:, k]
        size = float(np.linalg.norm(effect))
        reason = ""
        if k in scale:
            reason = RELATIVE
        elif size < _WEAK:
            reason = "moves too little in these logs"
        elif kept:
            basis = effects[:, kept]
            weights = np.linalg.lstsq(basis, effect, rcond=None)[0]
            alone = float(np.linalg.norm(effect - basis @ weights))
            costs = alone * abs(float(fit.theta[k] - given[k])) > _WEAK and alone > _EXACT * size
            if not costs and (alone < _APART * size or (alone < _MIXED * size and alone < _CLEAR)):
                share = np.abs(weights) * np.linalg.norm(basis, axis=0)
                names = " and ".join(unknowns[kept[i]].name for i in np.argsort(-share)[:2] if share[i] > 0.3 * size)
                reason = f"shows as {names or unknowns[kept[int(np.argmax(share))]].name} does in these logs"
        if not reason and len(kept) >= most:
            reason = f"{most} are enough to begin with"
        if not reason:
            kept.append(k)
        out.append(replace(unknown, left_out=reason))
    return out


def roomy(model: mujoco.MjModel, unknown: Unknown, theta: float) -> Unknown:
    """An unknown whose bounds leave room where a fit of windows pressed against one; no lower ones of contacts."""
    low, high = unknown.low, unknown.high
    if theta < _PRESSED and low > 0 and not any(target.startswith("geom:") for target in unknown.targets):
        low = max(low / _BEYOND, least_of(model, unknown))
    elif theta < _PRESSED and low < 0:
        low *= _BEYOND
    if theta > 1 - _PRESSED:
        high *= _BEYOND
    if (low, high) == (unknown.low, unknown.high):
        return unknown
    note = f"{unknown.note}; bounds wider, since the logs press against the usual one"
    low = rounded_up(low) if low > 0 else float(f"{low:.2g}")  # never below the least
    return replace(unknown, low=low, high=float(f"{high:.2g}"), note=note)


def sprung(
    model: mujoco.MjModel, unknowns: Sequence[Unknown], beside: Sequence[Unknown], fit: Fit, states: FloatArray
) -> tuple[list[Unknown], list[str]]:
    """Springs that stand behind the unknowns of a fit and show clearly, with where they rest; what is said of them.

    Args:
        model: as given.
        unknowns: of the fit.
        beside: springs, after these in the fit.
        fit: with the effects of each.
        states: (n, S) of the logs: a spring rests where its joint has been.
    """
    asked, remarks = [], []
    for k, spring in enumerate(beside, len(unknowns)):
        shown = fit.jacobian[:, k] * fit.theta[k] / np.sqrt(max(1.0, len(fit.jacobian) / 400.0))
        if not (float(np.linalg.norm(shown)) > _CLEAR and fit.theta[k] > _NOTABLE):
            continue
        value, target = spring.low + fit.theta[k] * (spring.high - spring.low), spring.targets[0]
        joint = model.joint(target.removeprefix("joint:").removesuffix(".stiffness"))
        places = [*states[:, 1 + int(joint.qposadr[0])], float(model.qpos_spring[joint.qposadr[0]])]
        size = 10.0 ** (np.floor(np.log10(max(np.ptp(places), _STILL))) - 1)
        first, last = np.floor(min(places) / size), 1 + np.floor(max(places) / size)
        low, high = float(f"{size * first:.6g}"), float(f"{size * last:.6g}")
        where = "where it rests, between the ends of the motion; one that is preloaded rests beyond"
        about = f"{spring.note}, about {value:.2g}"
        rest = f"joint:{joint.name}.springref"
        asked += [
            roomy(model, replace(spring, high=rounded_up(spring.high), note=about), float(fit.theta[k])),
            Unknown(f"{spring.name}_rest", (rest,), low, high, False, where),
        ]
        remarks.append(
            f"a spring of about {value:.2g} in SI seems to act where the model has none: {target!r} and {rest!r} are "
            "asked for; take them out if there is none, and look for what pulls instead"
        )
    return asked, remarks
