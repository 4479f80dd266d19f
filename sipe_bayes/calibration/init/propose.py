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

from sipe_bayes.calibration.column_names import pieces_of, read_vocabulary
from sipe_bayes.calibration.init.cases import Source, case_of, gyros_of, rough_unknowns, tried_part
from sipe_bayes.calibration.init.decisions import (
    Case,
    absolute_angles,
    decide,
    searched,
    tied_of,
    with_gyros,
    with_units_of_names,
    with_zeros,
)
from sipe_bayes.calibration.init.draft import Draft, LogLine, Reading, Unknown
from sipe_bayes.calibration.init.forces import with_forces
from sipe_bayes.calibration.init.matching import Match, Matches, match_columns
from sipe_bayes.calibration.init.oddities import oddities
from sipe_bayes.calibration.init.readings import first_readings, straightened, with_velocities
from sipe_bayes.calibration.init.regression import Outcome, Regression
from sipe_bayes.calibration.init.tables import Opened, ask_of_columns, richest
from sipe_bayes.calibration.init.unknowns.bounds import informed, sizes_of, started
from sipe_bayes.calibration.init.unknowns.candidates import candidates, scale_is_open, springs
from sipe_bayes.calibration.init.unknowns.choice import RELATIVE, chosen, roomy, sprung
from sipe_bayes.calibration.init.unknowns.contacts import nameless
from sipe_bayes.calibration.init.unknowns.effects import delay_of, fit_unknowns
from sipe_bayes.calibration.machine import Drive, Machine, touching_bodies
from sipe_bayes.calibration.readers.base import LogError
from sipe_bayes.calibration.readers.many import episodes_of, matching
from sipe_bayes.calibration.readers.numbered import starred
from sipe_bayes.calibration.readers.tables import READERS, read_table
from sipe_bayes.core.telling import Tell, silent
from sipe_bayes.envs.foreign.load import compile_spec, load_spec
from sipe_bayes.envs.foreign.urdf import notes_of
from sipe_bayes.envs.internal.closed_chains import dependent_joints
from sipe_bayes.envs.internal.resting import resting_joints
from sipe_bayes.envs.poses import has_pose, is_round
from sipe_bayes.likelihood import StateSpace, default_likelihood

_PASSED = 300  # states of each log, of which it is looked what they touch
_LOOKED_AT = 6  # logs
_CHECKED = 60  # logs whose columns are looked at
_HELD = 0.75  # share of a single log that trains
_SINGLE, _COUPLED = 0.4, 0.2  # of the time in which the motion goes to and fro, windows of the fit
_FLOWN = 0.1  # likewise of what thrust carries, which falls over soon
_LARGEST_BIAS = {"accelerometer": 1.0, "gyro": 0.2}  # m/s^2, rad/s
_BLIND = 0.5  # s, windows where nothing tells how fast the machine moves
_UNTOLD = 0.9  # of the forces, from which no unknown is told
_UNFOLLOWED = 0.8  # of the forces of a joint, what is left where the model hardly explains them
_PACED, _ROUNDS = 500, 8  # steps of which the pace is measured; rounds of a fit
_SPARE = 3  # columns that are not used, of which names are told
_SHORT = 2.0  # s: logs as short are one window each


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
    machine = Machine.of(model)
    files = _files(logs)
    opened, others = richest([files[i] for i in _spread(len(files))], rate, columns)
    matches = match_columns(machine, opened.columns)
    _check_some(machine, matches, opened, files[0])
    tables = [one.columns for one in (opened, *others)]
    table, turns = straightened(tables, matches, machine)
    measurements, commands = first_readings(machine, matches, table, turns, opened.clock)
    lines, sources, dropped = _split(files, opened, measurements, commands, folder)
    draft = Draft(
        _relative(model_path, folder), opened.clock, opened.episodes, commands, measurements, lines, 1e-3,
        doubts=(
            *notes_of(spec), *dropped, *matches.doubts, *ask_of_columns([opened, *others]),
            *_unmatched(model, machine, matches, commands),
        ),
        notes=tuple(nameless(model, {model.body(body).id for body in machine.bodies})),
        unused=_unused(matches, commands), names=columns,
    )  # fmt: skip
    positions = bool(tried_part(draft).measurements)
    with threadpool_limits(1):  # all matrices are small
        trained = (
            _decided(draft, model, machine, sources, folder, matches.forces, opened, tell)
            if positions
            else _undecided(draft, model, machine)
        )
    trained = replace(trained, measurements=with_velocities(trained.measurements, table, opened.clock))
    done = _felt(trained) if _is_felt(machine, matches) else trained
    count = sum(max(1, len(log.episodes)) for log in done.logs if log.use == "train")
    return replace(done, seconds=_expected(model, opened.seconds * count, len(done.proposed)))


def _expected(model: mujoco.MjModel, seconds: float, parameters: int) -> float:
    """How long a calibration may take: some rounds of one rollout for each parameter, at the pace of a few steps."""
    data, begun = mujoco.MjData(model), time.perf_counter()
    mujoco.mj_step(model, data, _PACED)
    step = (time.perf_counter() - begun) / _PACED
    return 5.0 + _ROUNDS * (parameters + 2) * seconds / model.opt.timestep * step / (os.cpu_count() or 1)


def _is_felt(machine: Machine, matches: Matches) -> bool:
    """Whether an accelerometer tells of a free body whose pose nothing measures."""
    targets = {match.target for match in matches.vectors}
    felt = any(kind == "accelerometer" and f"sensor:{name}" in targets for name, kind in machine.sensors)
    return bool(machine.bodies) and felt and not any(t.startswith("body:") for t in targets)


def _felt(draft: Draft) -> Draft:
    """The draft with inertial sensors fitted, their biases unknown, and states unknown at every sample."""
    measurements, biases = [], []
    for reading in draft.measurements:
        inertial = reading.match.target.startswith("sensor:")
        measurements.append(replace(reading, fit=True) if inertial else reading)
        name, acceleration = reading.match.target.removeprefix("sensor:"), reading.unit in ("m/s^2", "g0")
        largest = _LARGEST_BIAS["accelerometer" if acceleration else "gyro"]
        for axis in "xyz" if inertial else "":
            target = (f"sensor:{name}_{axis}.bias",)
            biases.append(Unknown(f"{name}_bias_{axis}", target, -largest, largest, False, "constant error"))
    note = "an inertial unit tells the pose: see floating-base.md"
    return replace(
        draft, measurements=tuple(measurements), unknowns=(*draft.unknowns, *biases), window=None, window_note=note
    )


def _files(logs: Sequence[Path]) -> list[Path]:
    """The logs' files: of a pattern those that match, of a folder that is no log itself those within."""
    out: list[Path] = []
    for log in logs:
        inner = [kind for kind in READERS if not kind.startswith(".")]
        if log.is_dir() and not any((log / kind).is_file() for kind in inner):
            within = sorted(p for p in log.iterdir() if p.suffix.lower() in READERS or (p.is_dir() and _is_log(p)))
            if not within:
                raise LogError(f"{log}: a folder without logs; name the files")
            out += [p for p in within if p.suffix.lower() not in (".txt", ".json")] or within  # notes beside the logs
            continue
        files = matching(log, Path())
        if not files:
            raise LogError(f"{log}: no file matches; correct the pattern")
        out += files
    return list(dict.fromkeys(out))


def _is_log(folder: Path) -> bool:
    return any((folder / kind).is_file() for kind in READERS if not kind.startswith("."))


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()


def _check_some(machine: Machine, matches: Matches, opened: Opened, file: Path) -> None:
    if matches.positions or matches.velocities or matches.vectors:
        return
    if turns := _resolved(opened):
        raise LogError(f"{file}: no column could be matched: {turns[0]}")
    joints = ", ".join(joint.name for joint in machine.joints) or "none with a name"
    columns = ", ".join(map(repr, list(opened.columns)[:20])) or "none that change"
    raise LogError(
        f"{file}: no column could be matched to a joint or free body of the model (joints: {joints}; columns: "
        f"{columns}); rename the columns after the joints, such as `NAME_position`, or write the configuration by hand"
    )


def _resolved(opened: Opened) -> list[str]:
    """What is to be said of columns that are cosines and sines."""
    columns = [column for column in opened.columns if read_vocabulary().of("resolved") & {*pieces_of(column)}]
    if not columns:
        return []
    return [
        f"{', '.join(columns)}: cosine and sine of an angle are no position; add a column of atan2(sine, cosine), or a "
        "framexaxis sensor to the MJCF and its numbers under [[measurements]] by hand, such as sensor:NAME[0]"
    ]


def _unmatched(model: mujoco.MjModel, machine: Machine, matches: Matches, commands: Sequence[Reading]) -> list[str]:
    """What of the model has no column."""
    out = []
    driven = {reading.match.target for reading in commands}
    still = [a.name for a in machine.actuators if f"actuator:{a.name}" not in driven]
    if still:
        out.append(f"no column drives {', '.join(still)}: it gets zero; name its column under [[commands]]")
    measured = {m.target for m in (*matches.positions, *matches.velocities, *matches.vectors)}
    owners = {target.rpartition(".")[0] for target in measured}
    known = {model.joint(joint.name).id for joint in machine.joints if f"joint:{joint.name}.position" in measured}
    turning = [j for j in range(model.njnt) if has_pose(model, j)]
    known |= {j for j in turning if _poses(model, j) and measured.issuperset(f"body:{p}" for p in _poses(model, j))}
    follow = {model.joint(joint).name for joint in {*dependent_joints(model, known), *resting_joints(model, known)}}
    blind = [j.name for j in machine.joints if f"joint:{j.name}" not in owners and j.name not in follow]
    posed = [] if _is_felt(machine, matches) else turning
    blind += [pose for j in posed for pose in _poses(model, j) if f"body:{pose}" not in measured]
    unnamed = sum(not has_pose(model, j) and not model.joint(j).name for j in range(model.njnt))
    if blind:
        spare = ", ".join(map(repr, matches.left[:_SPARE]))
        unused = f" (not used: {spare}{', ...' if len(matches.left) > _SPARE else ''})" if spare else ""
        out.append(f"no column measures {', '.join(blind)}{unused}: windows start it where the model does")
    if unnamed:
        out.append(f"{unnamed} joints have no name; give them one in the MJCF, so that they can be measured")
    return out


def _poses(model: mujoco.MjModel, joint: int) -> list[str]:
    """What of a body that a free joint or a ball carries a log should measure: none of a body without a name."""
    body = model.body(int(model.jnt_bodyid[joint])).name
    free = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_FREE)
    turns = not (free and is_round(model, joint))
    quantities = ["position"] * free + ["orientation"] * turns
    return [f"{body}.{quantity}" for quantity in quantities if body]


def _unused(matches: Matches, commands: Sequence[Reading]) -> tuple[str, ...]:
    supplies = {reading.supply[0] for reading in commands if reading.supply}
    return tuple(column for column in matches.left if column not in supplies)


def _split(
    files: Sequence[Path], opened: Opened, measurements: Sequence[Reading], commands: Sequence[Reading], folder: Path
) -> tuple[tuple[LogLine, ...], list[Source], list[str]]:
    """Logs that train and that are held out, those to be simulated, and what is said of files that lack columns."""
    wanted = [c for reading in (*measurements, *commands) for c in reading.match.columns]
    kept, lost = [files[0]], []
    for file in files[1:]:
        if len(kept) > _CHECKED or not [c for c in wanted if c not in read_table(file, starred(wanted), opened.names)]:
            kept.append(file)
        else:
            lost.append(file.name)
    notes = [f"left out, for they lack columns: {', '.join(lost[:6])}"] if lost else []
    if opened.episodes is not None:
        return (*_episodes(kept, opened.episodes, folder, opened.names), notes)
    if len(kept) == 1:
        cut = _HELD * opened.seconds
        name, only = kept[0].stem, _relative(kept[0], folder)
        spans = ((0.0, float(f"{cut:.4g}")), (float(f"{cut:.4g}"), float(f"{opened.seconds:.6g}")))
        train = LogLine(only, "train", f"{name}-begin", spans[0])
        return (train, LogLine(only, "holdout", f"{name}-end", spans[1])), [Source(kept[0])], notes
    held = max(1, len(kept) // 5)
    stems = [file.stem for file in kept]
    names = stems if len(set(stems)) == len(stems) else [f"{s}-{k}" for k, s in enumerate(stems)]
    lines = tuple(
        LogLine(_relative(f, folder), "holdout" if k >= len(kept) - held else "train", n if n != f.stem else "")
        for k, (f, n) in enumerate(zip(kept, names, strict=True))
    )
    train_files = kept[: len(kept) - held]
    return lines, [Source(train_files[i]) for i in _spread(len(train_files))], notes


def _episodes(
    files: Sequence[Path], column: str, folder: Path, names: Sequence[str]
) -> tuple[tuple[LogLine, ...], list[Source]]:
    """Episodes of files: of each the last fifth is held out."""
    lines, sources = [], []
    for file in files:
        numbers = episodes_of(file, column, names)
        held = max(1, len(numbers) // 5)
        path = _relative(file, folder)
        lines.append(LogLine(path, "train", f"{file.stem}-train", None, tuple(numbers[:-held])))
        lines.append(LogLine(path, "holdout", f"{file.stem}-held", None, tuple(numbers[-held:])))
        sources += [Source(file, number) for number in numbers[:-held]]
    return tuple(lines), [sources[i] for i in _spread(len(sources))]


def _spread(count: int) -> list[int]:
    return np.unique(np.round(np.linspace(0, count - 1, min(count, _LOOKED_AT))).astype(int)).tolist()


def _decided(
    draft: Draft,
    model: mujoco.MjModel,
    machine: Machine,
    sources: list[Source],
    folder: Path,
    forces: Sequence[Match],
    opened: Opened,
    tell: Tell,
) -> Draft:
    """Units, signs, zeros, delay, unknowns and the window's length, by regressions of the logs."""
    draft = replace(draft, unknowns=tuple(rough_unknowns(model, machine, draft.readings)))
    part, gyros = tried_part(draft), gyros_of(draft, model, machine)

    def case(part: Draft) -> Case:
        return case_of(part, model, machine, sources, folder, gyros, tell)

    tell("units and signs")
    search = searched(case(part))
    against_world = absolute_angles(search, model)
    decided, springs_act = decide(search), search.case.regression.springs
    tell("zeros of joints")
    placed = with_zeros(case(decided), model)
    if (
        placed != decided and against_world
    ):  # it may have been a zero that made an angle look like one against the world
        against_world = absolute_angles(searched(case(placed)), model)
    there = case(placed)
    read, turned = with_units_of_names(there, placed.readings), with_gyros(there, gyros)
    done, unlike = with_forces(placed.with_readings(read), forces, model, machine, sources, folder)
    tell("delay and unknowns")
    last = case(done)
    last.regression.springs = springs_act
    unknowns, delay, notes, lost = _unknowns(last, model, sources, folder)
    unknowns, doubts = _some(unknowns)
    window, why = _window(machine, last.regression)
    rest = tuple(turned.get(r.match.target, r) for r in draft.measurements if r not in part.measurements)
    odd = [one.text for one in oddities(there, opened)]
    return replace(
        done, measurements=(*done.measurements, *rest), unknowns=tuple(unknowns), window=window, window_note=why,
        notes=(*draft.notes, *unlike, *notes), delay=delay,
        doubts=(*odd, *against_world, *done.doubts, *lost, *doubts),
    )  # fmt: skip


def _undecided(draft: Draft, model: mujoco.MjModel, machine: Machine) -> Draft:
    """Where no position is measured, from which windows could start: what the names and the model alone tell."""
    doubt = "no column measures a position, so nothing was simulated: units and signs are those of the names"
    unknowns = rough_unknowns(model, machine, draft.readings)
    return replace(draft, unknowns=tuple(unknowns), window=_BLIND, doubts=(*draft.doubts, doubt))


def _unknowns(
    case: Case, model: mujoco.MjModel, sources: Sequence[Source], folder: Path
) -> tuple[list[Unknown], float, list[str], list[str]]:
    """Parameters that these logs tell apart, the delay in samples, notes, and doubts of columns that nothing follows.

    Bounds are of the size of the motion.
    """
    draft, machine, regression = case.draft, case.machine, case.regression
    logs, outcome = regression.logs, regression.fit(regression.given)
    sizes = sizes_of(model, machine, regression, outcome)
    passed = np.concatenate([own[:: 1 + len(own) // _PASSED] for own in regression.states])
    touching = touching_bodies(model, passed)
    unknowns = candidates(model, machine, draft.readings, sizes, sorted(touching))
    unknowns, values = informed(model, unknowns, regression, outcome)
    beside = springs(model, machine, draft.readings, sizes)
    wide = case_of(replace(draft, unknowns=(*unknowns, *beside)), model, machine, sources, folder)
    names = list(wide.regression.simulator.environment.space.names)
    unknowns = [unknown for unknown in unknowns if unknown.name in names]
    told = outcome.miss[regression.known]
    actuators = [r.match.target.removeprefix("actuator:") for r in draft.commands]
    space = wide.regression.environment.space
    own = np.clip(space.default_theta, 0.0, 1.0)
    left = fit_unknowns(wide.regression, outcome, started(space, values))
    late, note = delay_of(actuators, outcome, regression.independent(outcome), regression.delays, logs[0].dt)
    shown, at = chosen(model, unknowns, left, own, scale_is_open(model, machine, draft.readings))
    if len(told) and told.min() > _UNTOLD:
        shown = [u if u.left_out else replace(u, left_out="the model explains nothing of these logs") for u in shown]
    contacts = ("geom:", "pair:")  # of which forces without contacts tell nothing
    shown = [replace(u, left_out="") if u.targets[0].startswith(contacts) else u for u in shown]
    shown = [u if u.left_out else roomy(model, u, float(x)) for u, x in zip(shown, at, strict=False)]
    notes = [note] if note and not late else []
    notes += [*nameless(model, touching - {model.body(body).id for body in machine.bodies})]
    doubts = [
        f"the model explains little of the forces that move {reading.match.column!r} ({100 * (1 - miss):.0f} %): "
        "look at its zero, unit and sign, and at what the model lacks"
        for reading, miss in _followed_badly(case, outcome)
    ]
    asked, pulls = sprung(model, unknowns, beside, left, passed)
    return [*late, *shown, *asked], outcome.delay if late else 0.0, notes, [*doubts, *pulls]


def _followed_badly(case: Case, outcome: Outcome) -> list[tuple[Reading, float]]:
    """Readings of joints whose forces the model hardly explains, and the share that is left."""
    model, out = case.regression.simulator.model, []
    served = {case.draft.readings[place].match.target for place, _ in tied_of(case).values()}
    for reading in case.draft.measurements:
        if reading.match.target.startswith("joint:") and reading.match.target not in served:
            dof = int(model.joint(reading.match.target[6:].rpartition(".")[0]).dofadr[0])
            if case.regression.known[dof] and outcome.miss[dof] > _UNFOLLOWED:
                out.append((reading, min(1.0, float(outcome.miss[dof]))))
    return out


def _some(unknowns: list[Unknown]) -> tuple[list[Unknown], list[str]]:
    """The unknowns, all of them asked for where the simulations told none apart, and what is said of that."""
    if any(not unknown.left_out for unknown in unknowns):
        relative = [u.name for u in unknowns if u.left_out == RELATIVE]
        said = f"no force is known, so that all forces are relative to the model's masses ({', '.join(relative)})"
        doubts = [f"{said}: weigh one and correct the model"] * bool(relative)
        return unknowns, doubts
    if not unknowns:
        return [], ["nothing of the model could be proposed as unknown; add [[parameters]] by hand"]
    doubt = "no parameter is identifiable in these logs, so all are free; look at the log and at the model"
    return [replace(unknown, left_out="") for unknown in unknowns], [doubt]


def _window(machine: Machine, regression: Regression) -> tuple[float | str | None, str]:
    """Length of the segments of the fit, a part of the time in which the motion goes to and fro: joints couple soon.

    At most a fifth of a log, so that its held-out quarter is longer. None where bodies strike: ``state_space``.
    """
    logs = regression.logs
    if isinstance(default_likelihood(regression.simulator, logs), StateSpace):
        return None, "bodies strike or slip along the logs"
    durations = [len(log) * log.dt for log in logs]
    if max(durations) <= _SHORT:
        return "log", "each log as one: they are short"
    swing = regression.period * logs[0].dt
    held = [a.drive in (Drive.POSITION, Drive.VELOCITY) for a in machine.actuators]
    part = _COUPLED if len(machine.joints) > 1 and not (held and all(held)) else _SINGLE
    part = _FLOWN if machine.flies else part
    length = float(np.clip(part * swing, max(0.1, 20 * logs[0].dt), min(2.0, min(durations) / 5)))
    return float(f"{length:.2g}"), f"s; the motion goes to and fro in about {swing:.2g} s"
