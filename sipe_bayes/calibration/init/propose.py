"""What ``sipe init`` does: a model and logs in, a configuration with its evidence out."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
from threadpoolctl import threadpool_limits

from sipe_bayes.calibration.column_names import Kind, pieces_of, read_vocabulary
from sipe_bayes.calibration.init.cases import Scene, Source, gyros_of, rough_parameters, tried_part, with_forces
from sipe_bayes.calibration.init.decisions import (
    Case,
    check_gyros,
    check_named_units,
    decide,
    find_absolute_angles,
    find_zeros,
    search_answers,
)
from sipe_bayes.calibration.init.draft import Draft, LogLine, Proposal, Reading
from sipe_bayes.calibration.init.matching import Match, Matches, match_columns
from sipe_bayes.calibration.init.oddities import find_oddities
from sipe_bayes.calibration.init.parameters import FORCES, candidates, nameless, springs
from sipe_bayes.calibration.init.readings import first_readings, straightened, with_velocities
from sipe_bayes.calibration.init.regression import SERVOS, Outcome, Regression
from sipe_bayes.calibration.init.selection import (
    RELATIVE,
    choose,
    delay_of,
    find_springs,
    fit_parameters,
    inform_bounds,
    sizes_of,
    widen_bounds,
)
from sipe_bayes.calibration.init.tables import Opened, ask_of_columns, richest
from sipe_bayes.calibration.machine import Machine, touching_bodies
from sipe_bayes.calibration.readers.base import LogError
from sipe_bayes.calibration.readers.many import episodes_of, matching
from sipe_bayes.calibration.readers.numbered import starred
from sipe_bayes.calibration.readers.tables import READERS, read_table
from sipe_bayes.core.telling import Tell, silent
from sipe_bayes.core.units import find_unit
from sipe_bayes.envs.foreign.load import compile_spec, load_spec
from sipe_bayes.envs.foreign.urdf import notes_of
from sipe_bayes.envs.internal.closed_chains import dependent_joints
from sipe_bayes.envs.internal.resting import resting_joints
from sipe_bayes.envs.poses import has_pose, is_round
from sipe_bayes.likelihood import StateSpace, default_likelihood


def propose(
    model_path: Path,
    logs: Sequence[Path],
    folder: Path,
    rate: float | None = None,
    tell: Tell = silent,
    columns: tuple[str, ...] = (),
) -> Draft:
    """A configuration for a model and its logs.

    Args:
        model_path: the MJCF.
        logs: files, folders of files, or patterns.
        folder: of the configuration, to which its paths are relative.
        rate: Hz, of logs without a clock.
        tell: called with what is being done.
        columns: names, of logs without a header.

    Raises:
        ModelError: for a model that does not compile.
        LogError: for logs that can not be read, or that hold nothing of the model.
    """
    tell("reading the logs")
    spec = load_spec(str(model_path))
    model = compile_spec(spec, str(model_path))
    machine, files = Machine.of(model), _files(logs)
    opened, others = richest([files[i] for i in _spread(len(files))], rate, columns)
    matches = match_columns(machine, opened.columns)
    if not (matches.positions or matches.velocities or matches.vectors):
        raise LogError(f"{files[0]}: no column could be matched{_reason(machine, opened)}")
    table, turns = straightened([one.columns for one in (opened, *others)], matches, machine)
    measurements, commands = first_readings(machine, matches, table, turns, opened.clock)
    used = [column for reading in (*measurements, *commands) for column in reading.match.columns]
    lines, sources, dropped = _split(files, opened, used, folder)
    felt = _is_felt(machine, matches)
    doubts = (*notes_of(spec), *dropped, *matches.doubts, *ask_of_columns([opened, *others]))
    supplies = {reading.supply[0] for reading in commands if reading.supply}
    draft = Draft(
        _relative(model_path, folder), opened.clock, opened.episodes, commands, measurements, lines, 1e-3,
        doubts=(*doubts, *_unmatched(model, machine, matches, commands, felt)),
        notes=tuple(nameless(model, {model.body(body).id for body in machine.bodies})),
        unused=tuple(column for column in matches.left if column not in supplies), names=columns,
    )  # fmt: skip
    if tried_part(draft).measurements:
        with threadpool_limits(1):  # all matrices are small
            draft = _decided(draft, Scene(model, machine, sources, folder, tell), matches.forces, opened)
    else:  # from which windows could start
        doubt = "no column measures a position, so nothing was simulated: units and signs are those of the names"
        rough = rough_parameters(model, machine, draft.readings)
        draft = replace(draft, parameters=rough, window=0.5, doubts=(*draft.doubts, doubt))
    draft = replace(draft, measurements=with_velocities(draft.measurements, table, opened.clock))
    draft = _fit_sensors(draft) if felt else draft
    count = sum(max(1, len(log.episodes)) for log in draft.logs if log.use == "train")
    dt = opened.clock.period * find_unit(opened.clock.unit).factor
    return replace(draft, seconds=_expected(model, opened.seconds * count, dt, len(draft.free)))


def _expected(model: mujoco.MjModel, seconds: float, dt: float, parameters: int) -> float:
    """How long a calibration may take: 150 runs of the logs, and 10 for each parameter and number of a start.

    Each costs its physics steps, at the pace of a few, and 20 us for each of its samples of ``dt`` s.
    """
    data, begun = mujoco.MjData(model), time.perf_counter()
    mujoco.mj_step(model, data, 500)
    step = (time.perf_counter() - begun) / 500
    runs = 150 + 10 * (parameters + 2 * model.nv)
    return 10.0 + runs * seconds * (step / model.opt.timestep + 2e-5 / dt) / (os.cpu_count() or 1)


def _is_felt(machine: Machine, matches: Matches) -> bool:
    """Whether an accelerometer tells of a free body whose pose nothing measures."""
    targets = {match.target for match in matches.vectors}
    felt = any(kind == "accelerometer" and f"sensor:{name}" in targets for name, kind in machine.sensors)
    return bool(machine.bodies) and felt and not any(t.startswith("body:") for t in targets)


def _fit_sensors(draft: Draft) -> Draft:
    """The draft with inertial sensors fitted, their biases free, and states free at every sample."""
    measurements, parameters = list(draft.measurements), list(draft.parameters)
    for k, reading in enumerate(measurements):
        kind, _, name = reading.match.target.partition(":")
        if kind == "sensor":
            measurements[k] = replace(reading, fit=True)
            most = 1.0 if reading.unit in ("m/s^2", "g0") else 0.2  # m/s^2, rad/s
            for axis in "xyz":
                target = (f"sensor:{name}_{axis}.bias",)
                parameters.append(Proposal(f"{name}_bias_{axis}", target, -most, most, False, "constant error"))
    draft = replace(draft, measurements=tuple(measurements), parameters=tuple(parameters))
    return replace(draft, window=None, window_note="an inertial unit tells the pose: see floating-base.md")


def _files(logs: Sequence[Path]) -> list[Path]:
    """The logs' files: of a pattern those that match, of a folder that is no log itself those within."""
    out: list[Path] = []
    for log in logs:
        if log.is_dir() and not _is_log(log):
            within = sorted(p for p in log.iterdir() if p.suffix.lower() in READERS or (p.is_dir() and _is_log(p)))
            if not within:
                raise LogError(f"{log}: a folder without logs; name the files")
            out += [p for p in within if p.suffix.lower() not in (".txt", ".json")] or within  # notes beside the logs
        elif files := matching(log, Path()):
            out += files
        else:
            raise LogError(f"{log}: no file matches; correct the pattern")
    return list(dict.fromkeys(out))


def _is_log(folder: Path) -> bool:
    return any((folder / kind).is_file() for kind in READERS if not kind.startswith("."))


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()


def _reason(machine: Machine, opened: Opened) -> str:
    """Why no column may have been matched, with the remedy."""
    if turns := [column for column in opened.columns if read_vocabulary().of("resolved") & {*pieces_of(column)}]:
        return (
            f": {', '.join(turns)}: cosine and sine of an angle are no position; add a column of atan2(sine, cosine), "
            "or a framexaxis sensor to the MJCF and its numbers under [[measurements]] by hand, such as sensor:NAME[0]"
        )
    joints = ", ".join(joint.name for joint in machine.joints) or "none with a name"
    columns = ", ".join(map(repr, list(opened.columns)[:20])) or "none that change"
    return (
        f" to a joint or free body of the model (joints: {joints}; columns: {columns}); rename the columns after the "
        "joints, such as `NAME_position`, or write the configuration by hand"
    )


def _unmatched(
    model: mujoco.MjModel, machine: Machine, matches: Matches, commands: Sequence[Reading], felt: bool
) -> list[str]:
    """What of the model has no column; poses of what an inertial unit feels are none."""
    out, driven = [], {reading.match.target for reading in commands}
    if still := [a.name for a in machine.actuators if f"actuator:{a.name}" not in driven]:
        out.append(f"no column drives {', '.join(still)}: it gets zero; name its column under [[commands]]")
    measured = {m.target for m in (*matches.positions, *matches.velocities, *matches.vectors)}
    owners = {target.rpartition(".")[0] for target in measured}
    poses = {j: _poses(model, j) for j in range(model.njnt) if has_pose(model, j)}
    known = {model.joint(joint.name).id for joint in machine.joints if f"joint:{joint.name}.position" in measured}
    known |= {j for j, own in poses.items() if own and measured.issuperset(f"body:{pose}" for pose in own)}
    follow = {model.joint(joint).name for joint in {*dependent_joints(model, known), *resting_joints(model, known)}}
    blind = [j.name for j in machine.joints if f"joint:{j.name}" not in owners and j.name not in follow]
    blind += [pose for own in poses.values() for pose in own if not felt and f"body:{pose}" not in measured]
    if blind:
        spare = ", ".join(map(repr, matches.left[:3])) + ", ..." * (len(matches.left) > 3)
        unused = f" (not used: {spare})" if spare else ""
        out.append(f"no column measures {', '.join(blind)}{unused}: windows start it where the model does")
    if unnamed := sum(not has_pose(model, j) and not model.joint(j).name for j in range(model.njnt)):
        out.append(f"{unnamed} joints have no name; give them one in the MJCF, so that they can be measured")
    return out


def _poses(model: mujoco.MjModel, joint: int) -> list[str]:
    """What of a body that a free joint or a ball carries a log should measure: none of a body without a name."""
    body = model.body(int(model.jnt_bodyid[joint])).name
    free = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_FREE)
    quantities = ["position"] * free + ["orientation"] * (not (free and is_round(model, joint)))
    return [f"{body}.{quantity}" for quantity in quantities if body]


def _spread(count: int) -> list[int]:
    """Up to six of so many, from the first to the last."""
    return np.unique(np.round(np.linspace(0, count - 1, min(count, 6))).astype(int)).tolist()


def _split(
    files: Sequence[Path], opened: Opened, used: Sequence[str], folder: Path
) -> tuple[tuple[LogLine, ...], list[Source], list[str]]:
    """Logs that train and, the last fifth, that are held out; those to be looked at; what is said of files left out."""
    kept, lost = [files[0]], list[Path]()
    for file in files[1:]:  # the first sixty are looked at
        full = len(kept) > 60 or {*used} <= {*read_table(file, starred(used), opened.names)}
        (kept if full else lost).append(file)
    notes = [f"left out, for they lack columns: {', '.join(file.name for file in lost[:6])}"] if lost else []
    lines, sources = list[LogLine](), list[Source]()
    if opened.episodes is not None:
        for file in kept:
            path, numbers = _relative(file, folder), episodes_of(file, opened.episodes, opened.names)
            held = max(1, len(numbers) // 5)
            lines.append(LogLine(path, "train", f"{file.stem}-train", None, tuple(numbers[:-held])))
            lines.append(LogLine(path, "holdout", f"{file.stem}-held", None, tuple(numbers[-held:])))
            sources += [Source(file, number) for number in numbers[:-held]]
    elif len(kept) == 1:
        cut, end = float(f"{0.75 * opened.seconds:.4g}"), float(f"{opened.seconds:.6g}")
        begin = LogLine(_relative(kept[0], folder), "train", f"{kept[0].stem}-begin", (0.0, cut))
        lines = [begin, replace(begin, use="holdout", name=f"{kept[0].stem}-end", span=(cut, end))]
        sources = [Source(kept[0])]
    else:
        train, unique = len(kept) - max(1, len(kept) // 5), len({file.stem for file in kept}) == len(kept)
        for k, file in enumerate(kept):
            name = "" if unique else f"{file.stem}-{k}"
            lines.append(LogLine(_relative(file, folder), "train" if k < train else "holdout", name))
        sources = [Source(file) for file in kept[:train]]
    return tuple(lines), [sources[i] for i in _spread(len(sources))], notes


def _decided(draft: Draft, scene: Scene, forces: Sequence[Match], opened: Opened) -> Draft:
    """Units, signs, zeros, delay, parameters and the window's length, by regressions of the logs."""
    part, gyros = tried_part(draft), gyros_of(draft, scene.model, scene.machine)
    scene.tell("units and signs")
    search = search_answers(scene.case(part, gyros))
    against_world = find_absolute_angles(search)
    decided = decide(search)
    scene.tell("zeros of joints")
    placed = find_zeros(scene.case(decided, gyros))
    there = scene.case(placed, gyros)
    if placed != decided and against_world:  # a zero may have made an angle look like one against the world
        against_world = find_absolute_angles(search_answers(scene.case(placed, gyros)))
    read, turned = check_named_units(there, placed.readings), check_gyros(there, gyros)
    done, unlike = with_forces(placed.with_readings(read), forces, scene)
    scene.tell("delay and parameters")
    last = scene.case(done, gyros)
    last.regression.springs = search.case.regression.springs
    chosen = _choose_parameters(last, scene)
    window, why = _window(scene.machine, last.regression)
    rest = tuple(turned.get(r.match.target, r) for r in draft.measurements if r not in part.measurements)
    odd = find_oddities(there, opened)
    return replace(
        done, measurements=(*done.measurements, *rest), window=window, window_note=why, delay=chosen.delay,
        parameters=chosen.parameters, notes=(*draft.notes, *unlike, *chosen.notes),
        doubts=(*odd, *against_world, *done.doubts, *chosen.doubts),
    )  # fmt: skip


def _choose_parameters(case: Case, scene: Scene) -> Draft:
    """The draft with the parameters that these logs tell apart, the delay, and only their notes and doubts.

    Bounds are of the size of the motion.
    """
    draft, model, machine, regression = case.draft, case.model, case.machine, case.regression
    outcome, dt = regression.fit(regression.given), regression.logs[0].dt
    sizes = sizes_of(model, machine, regression, outcome)
    passed = np.concatenate([own[:: 1 + len(own) // 300] for own in regression.states])
    touching = touching_bodies(model, passed)
    proposals = candidates(model, machine, draft.readings, sizes, sorted(touching))
    proposals, values = inform_bounds(model, proposals, regression, outcome)
    beside = springs(model, machine, draft.readings, sizes)
    wide = scene.case(replace(draft, parameters=(*proposals, *beside))).regression
    proposals = [one for one in proposals if one.name in wide.environment.space.names]
    fit = fit_parameters(wide, outcome, values)
    actuators = [r.match.target.removeprefix("actuator:") for r in draft.commands]
    late, note = delay_of(actuators, outcome, regression.independent(outcome), regression.delays, dt)
    chosen, at = choose(model, proposals, fit, not _knows_force(draft.readings, proposals))
    nothing = bool(regression.known.any()) and case.explains_nothing(outcome)
    for k, one in enumerate(chosen):
        reason = one.left_out or "the model explains nothing of these logs" * nothing
        reason = "" if one.targets[0].startswith("geom:") else reason  # forces without contacts tell nothing of these
        chosen[k] = (
            replace(one, left_out=reason) if reason else widen_bounds(model, replace(one, left_out=""), float(at[k]))
        )
    free, pulls = find_springs(model, beside, fit, passed)
    chosen, doubts = _all_if_none([*late, *chosen, *free])
    notes = [note] * bool(note and not late) + nameless(model, touching - {model.body(b).id for b in machine.bodies})
    return replace(
        draft, parameters=tuple(chosen), delay=outcome.delay if late else 0.0, notes=tuple(notes),
        doubts=(*_unexplained(case, outcome), *pulls, *doubts),
    )  # fmt: skip


def _knows_force(readings: Sequence[Reading], proposals: Sequence[Proposal]) -> bool:
    """Whether a force is known; without, everything moves alike with all forces and masses as many times larger."""
    driven = [r for r in readings if r.commanded]
    known = any(r.match.target.endswith(".force") and not r.doubts for r in readings)
    known |= any(r.match.label.kind == Kind.TORQUE or r.unit in FORCES for r in driven)
    return bool(driven) and (known or not any(p.targets[0].startswith("actuator:") for p in proposals))


def _unexplained(case: Case, outcome: Outcome) -> list[str]:
    """What is said of joints whose forces the model hardly explains, but of those that servos hold."""
    served = {place for place, _ in case.ties.values()}
    places = [k for k, r in enumerate(case.draft.measurements) if r.joint and k not in served]
    lost = {k: min(1.0, float(outcome.miss[case.dof(k)])) for k in places if case.regression.known[case.dof(k)]}
    return [
        f"the model explains little of the forces that move {case.draft.readings[k].match.column!r} "
        f"({100 * (1 - miss):.0f} %): look at its zero, unit and sign, and at what the model lacks"
        for k, miss in lost.items() if miss > 0.8
    ]  # fmt: skip


def _all_if_none(proposals: list[Proposal]) -> tuple[list[Proposal], list[str]]:
    """The proposals, all of them free where the logs told none apart, and what is said of that."""
    if any(not one.left_out for one in proposals):
        relative = [one.name for one in proposals if one.left_out == RELATIVE]
        said = f"no force is known, so that all forces are relative to the model's masses ({', '.join(relative)})"
        return proposals, [f"{said}: weigh one and correct the model"] * bool(relative)
    if not proposals:
        return [], ["nothing of the model could be proposed as a parameter; add [[parameters]] by hand"]
    doubt = "no parameter is identifiable in these logs, so all are free; look at the log and at the model"
    return [replace(one, left_out="") for one in proposals], [doubt]


def _window(machine: Machine, regression: Regression) -> tuple[float | str | None, str]:
    """Length of the segments of the fit, a part of the time in which the motion goes to and fro: joints couple soon.

    What thrust carries falls over sooner. At most a fifth of a log, so that its held-out quarter is longer. None where
    bodies strike: ``state_space``.
    """
    logs = regression.logs
    if isinstance(default_likelihood(regression.simulator, logs), StateSpace):
        return None, "bodies strike or slip along the logs"
    durations = [len(log) * log.dt for log in logs]
    if max(durations) <= 2.0:
        return "log", "each log as one: they are short"
    swing, held = regression.period * logs[0].dt, [a.drive in SERVOS for a in machine.actuators]
    coupled = len(machine.joints) > 1 and not (held and all(held))
    part = 0.1 if machine.flies else 0.2 if coupled else 0.4
    length = float(np.clip(part * swing, max(0.1, 20 * logs[0].dt), min(2.0, min(durations) / 5)))
    return float(f"{length:.2g}"), f"s; the motion goes to and fro in about {swing:.2g} s"
