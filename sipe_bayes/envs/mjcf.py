"""The user's own MJCF as an Environment: which actuators the log drives and which quantities it measures.

Observations are read aligned: joint positions and velocities from the state itself, sensors from the
sensordata that belongs to that state (MuJoCo's own belong to the state one physics step earlier).
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.envs.base import Environment
from sipe_bayes.envs.targets import Target, TargetError, bind, check_inertia, named, restore_inertia, split

FloatArray = NDArray[np.float64]
_CHANNEL = re.compile(
    r"^(?:joint:(?P<joint>.+)\.(?P<what>position|velocity)|sensor:(?P<sensor>[^\[\]]+)(?:\[(?P<item>\d+)\])?)$"
)
_LONGEST_STEP = 0.25  # of the cube: a finite difference of what is not smooth
_BIAS = re.compile(r"^sensor:(.+)\.bias$")
_LINEAR_INTERPOLATION = 1


class ModelError(ValueError):
    """An MJCF that does not compile."""


@dataclass(frozen=True)
class Channel:
    """One measured quantity. target: ``joint:NAME.position``, ``joint:NAME.velocity`` or
    ``sensor:NAME[i]``."""

    target: str
    name: str = ""
    unit: str = ""

    @property
    def label(self) -> str:
        return self.name or self.target


@dataclass(frozen=True)
class _Reader:
    """Where a channel is found: column ``index`` of the sensordata (``derived``) or of the physics state."""

    index: int
    derived: bool
    unit: str


def load_spec(source: str) -> Any:
    """MjSpec of a path or of MJCF text; raises ModelError with MuJoCo's first line."""
    text = source.lstrip().startswith("<")
    if not text and not Path(source).is_file():
        raise ModelError(f"model: no file {source!r}; give the path of an MJCF file, or the MJCF text itself")
    try:
        return mujoco.MjSpec.from_string(source) if text else mujoco.MjSpec.from_file(source)
    except ValueError as error:
        where = "the MJCF text" if text else source
        raise ModelError(f"model: {where} is not valid MJCF: {' '.join(str(error).split())}; correct it") from None


def compile_spec(spec: Any, source: str) -> Any:
    """MjModel of a spec; raises ModelError with MuJoCo's first line."""
    try:
        return spec.compile()
    except ValueError as error:
        where = "the MJCF text" if source.lstrip().startswith("<") else source
        raise ModelError(f"model: {where} does not compile: {' '.join(str(error).split())}; correct it") from None


@dataclass(frozen=True, eq=False)
class MjcfEnvironment(Environment):
    """The user's MJCF with its unknowns. Build it with ``MjcfEnvironment.build``.

    source: path of the MJCF or its text. actuators: what the columns of ``actions`` drive; others get zero.
    measurements: what the columns of ``observations`` are.
    """

    source: str
    actuators: tuple[str, ...]
    measurements: tuple[Channel, ...]
    parameters: ParameterSpace

    @classmethod
    def build(
        cls,
        source: str | Path,
        parameters: Iterable[Parameter],
        actuators: Sequence[str],
        measurements: Sequence[str | Channel],
    ) -> MjcfEnvironment:
        """Check everything against the model and fill in units and defaults.

        parameters: their ``targets`` name what they write; several targets of one parameter are all set to
        its value, or, where it is ``relative``, keep their proportions. Raises ModelError, TargetError or
        ValueError.
        """
        channels = tuple(c if isinstance(c, Channel) else Channel(c) for c in measurements)
        model = compile_spec(load_spec(str(source)), str(source))
        for actuator in actuators:
            _single_control(model, actuator)
        channels = tuple(replace(c, name=c.label, unit=_reader(model, c).unit) for c in channels)
        twice = sorted({c.label for c in channels if [d.label for d in channels].count(c.label) > 1})
        if twice:
            raise ValueError(f"measurements: names must differ, but {twice} appear more than once")
        _check_sensors(model, channels)
        space = ParameterSpace(_with_model_values(model, p, channels) for p in parameters)
        _check_conflicts(space)
        return cls(str(source), tuple(actuators), channels, space)

    @property
    def space(self) -> ParameterSpace:  # type: ignore[override]
        return self.parameters

    @property
    def channels(self) -> tuple[str, ...]:  # type: ignore[override]
        return tuple(c.label for c in self.measurements)

    @property
    def channel_units(self) -> tuple[str, ...]:
        return tuple(c.unit for c in self.measurements)

    @property
    def num_actions(self) -> int:  # type: ignore[override]
        return len(self.actuators)

    @property
    def needs_derived(self) -> bool:  # type: ignore[override]
        return any(r.derived for r in self._readers)

    def spec(self) -> Any:
        """A fresh MjSpec, with a command history for each actuator whose delay is a parameter, and without
        MuJoCo's short cut for bodies whose centre of mass lies in their origin where that may change."""
        spec = load_spec(self.source)
        timestep = spec.option.timestep
        for parameter in self.parameters:
            for target in parameter.targets:
                if _BIAS.match(target):
                    continue
                kind, name, attribute = split(target)
                if kind == "body" and attribute != "mass":
                    spec.body(name).simple = False
                if kind == "actuator" and attribute == "delay":
                    actuator = spec.actuator(name)
                    # the physics step may be refined to half the model's own
                    actuator.nsample = max(actuator.nsample, math.ceil(2 * parameter.high / timestep) + 2)
                    actuator.interp = _LINEAR_INTERPOLATION
        return spec

    def compile(self) -> Any:
        return compile_spec(self.spec(), self.source)

    @cached_property
    def _model(self) -> Any:
        return self.compile()

    def __getstate__(self) -> dict[str, Any]:
        return {f: getattr(self, f) for f in ("source", "actuators", "measurements", "parameters")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)

    @cached_property
    def _targets(self) -> list[tuple[int, float, Target]]:
        """(parameter, multiplier, target) of all physical writes, in the order they must be done."""
        found = []
        for j, parameter in enumerate(self.parameters):
            targets = [bind(self._model, t) for t in parameter.targets if not _BIAS.match(t)]
            for target in targets:
                multiplier = target.value / targets[0].value if parameter.relative else 1.0
                found.append((j, multiplier, target))
        return sorted(found, key=lambda item: item[2].order)

    def uneven(self, parameter: Parameter) -> bool:
        """Whether targets that all get the parameter's value have different values in the model."""
        index = self.parameters.index(parameter.name)
        values = [target.value for j, _, target in self._targets if j == index]
        return not parameter.relative and len(values) > 1 and bool(np.ptp(values) > 1e-9 * np.abs(values).max())

    def multipliers(self, parameter: Parameter) -> dict[str, float]:
        """What a parameter's value is multiplied by for each of its targets."""
        index = self.parameters.index(parameter.name)
        found = {target.spec: multiplier for j, multiplier, target in self._targets if j == index}
        return {spec: found.get(spec, 1.0) for spec in parameter.targets}

    @cached_property
    def _readers(self) -> tuple[_Reader, ...]:
        return tuple(_reader(self._model, c) for c in self.measurements)

    @cached_property
    def _inertial_bodies(self) -> list[int]:
        return sorted(
            {
                named(self._model, "body", split(t.spec)[1], t.spec)
                for _, _, t in self._targets
                if t.spec.startswith("body:") and ".inertia_" in t.spec
            }
        )

    @cached_property
    def _shares(self) -> dict[str | None, dict[int, list[int]]]:
        """For a log: which parameter stands for which; built on demand by ``_resolve``."""
        return {}

    def _resolve(self, log: str | None) -> dict[int, list[int]]:
        """Parameter -> the parameters whose mean it takes in ``log``; absent when it does not apply there.

        A nuisance parameter of a log that was not calibrated takes the mean over the logs that were."""
        if log not in self._shares:
            groups: dict[tuple[str, ...], list[int]] = {}
            for j, p in enumerate(self.parameters):
                if p.log is not None:
                    groups.setdefault(p.targets, []).append(j)
            table = {j: [j] for j, p in enumerate(self.parameters) if p.log is None or p.log == log}
            for members in groups.values():
                if not any(self.parameters[j].log == log for j in members):
                    table[members[0]] = members
            self._shares[log] = table
        return self._shares[log]

    def write(self, model: Any, values: FloatArray, log: str | None = None) -> bool:
        table, bodies = self._resolve(log), self._inertial_bodies
        physical = True
        if bodies:
            restore_inertia(model, self._model, bodies)
        for j, multiplier, target in self._targets:
            if j in table:
                value = multiplier * _mean(values, table[j])
                physical &= value >= target.minimum
                target.write(model, value)
        return physical and (not bodies or check_inertia(model, bodies))

    def least_steps(self, theta: FloatArray) -> FloatArray:
        found = np.zeros(len(self.parameters))
        for j, multiplier, target in self._targets:
            value = multiplier * float(self.parameters[j].value(theta[j]))
            if value < target.step:
                ahead = float(self.parameters[j].normalise((value + target.step) / multiplier))
                found[j] = max(found[j], min(ahead - theta[j], _LONGEST_STEP))
        return found

    @property
    def needs_constants(self) -> bool:
        return any(t.constants for _, _, t in self._targets)

    def bias(self, values: FloatArray, log: str | None = None) -> FloatArray:
        found, table = np.zeros(len(self.measurements)), self._resolve(log)
        for j, channels in self._biases:
            if j in table:
                found[channels] += _mean(values, table[j])
        return found

    @cached_property
    def _biases(self) -> list[tuple[int, list[int]]]:
        """(parameter, channels that it shifts) of all sensor biases."""
        targets = [(j, _BIAS.match(t)) for j, p in enumerate(self.parameters) for t in p.targets]
        return [(j, _bias_channels(self.measurements, m.group(1))) for j, m in targets if m]

    @cached_property
    def _controls(self) -> list[int]:
        return [_single_control(self._model, a) for a in self.actuators]

    def control(self, model: Any, states: FloatArray, actions: FloatArray) -> FloatArray:
        controls = np.zeros((*actions.shape[:-1], model.nu))
        controls[..., self._controls] = actions
        return controls

    def observe(
        self, model: Any, states: FloatArray, derived: FloatArray | None, goals: FloatArray | None = None
    ) -> FloatArray:
        out = np.empty((*states.shape[:-1], len(self._readers)))
        for k, reader in enumerate(self._readers):
            source = derived if reader.derived else states
            if source is None:
                raise ValueError(f"channel {self.channels[k]!r}: needs sensordata, got none")
            out[..., k] = source[..., reader.index]
        return out

    def state_columns(self, model: Any) -> tuple[int | None, ...]:
        return tuple(_state_column(model, r) for r in self._readers)

    def history(
        self, model: Any, states: FloatArray, actions: Sequence[FloatArray], timestep: FloatArray
    ) -> FloatArray:
        if model.nhistory == 0:
            return states
        states, timestep = states.copy(), np.asarray(timestep)
        start = 1 + model.nq + model.nv + model.na
        for column, actuator in enumerate(self.actuators):
            index = named(model, "actuator", actuator, "actuator")
            address, samples = int(model.actuator_historyadr[index]), int(model.actuator_history[index, 0])
            if address < 0:
                continue
            self._check_history(actuator, samples, float(timestep.min()))
            block = states[:, start + address : start + address + 2 + 2 * samples]
            block[:, 0], block[:, 1] = 0.0, samples - 1
            block[:, 2 : 2 + samples] = states[:, :1] + np.arange(-samples, 0) * timestep[:, None]
            for lane, past in enumerate(actions):
                tail = past[-samples:, column]
                block[lane, 2 + samples :] = np.concatenate([np.full(samples - len(tail), tail[0]), tail])
        return states

    def _check_history(self, actuator: str, samples: int, timestep: float) -> None:
        longest = max((p.high for p in self.parameters if f"actuator:{actuator}.delay" in p.targets), default=0.0)
        if longest > (samples - 1) * timestep * (1 + 1e-9):
            raise ValueError(
                f"actuator:{actuator}.delay: {longest:g} s do not fit the history of {samples} physics steps "
                f"of {timestep:g} s; set the model's timestep no longer than the log's"
            )


def _mean(values: FloatArray, members: list[int]) -> float:
    return float(values[members[0]] if len(members) == 1 else np.mean(values[members]))


def _check_sensors(model: Any, channels: Sequence[Channel]) -> None:
    """Raises TargetError for sensors that do not read the present state, which no window could start from."""
    for channel in channels:
        match = _CHANNEL.match(channel.target)
        if match and match["sensor"]:
            sensor = named(model, "sensor", match["sensor"], f"measurement {channel.label!r}")
            if model.sensor_delay[sensor] > 0 or model.sensor_interval[sensor, 0] > 0:
                raise TargetError(
                    f"measurement {channel.label!r}: sensor {match['sensor']!r} has a delay or an interval; "
                    "remove it and shift the log instead"
                )


# the numbers that a target writes, where they are not its own
_WRITES = {"kp": ("gain", "bias_position"), "kv": ("bias_velocity",), "offset": ("bias_force",)}


def _check_conflicts(space: ParameterSpace) -> None:
    """Raises TargetError when two targets write the same number in the same log: one would overrule the
    other."""
    owners: dict[str, list[tuple[str, str | None]]] = {}
    for parameter in space:
        for spec in parameter.targets:
            head, _, attribute = spec.rpartition(".")
            if attribute == "bias":  # they add up
                continue
            numbers = _WRITES.get(attribute, (attribute,)) if head.startswith("actuator:") else (attribute,)
            for number in numbers:
                for other, log in owners.setdefault(f"{head}.{number}", []):
                    if log is None or parameter.log is None or log == parameter.log:
                        raise TargetError(
                            f"parameter {parameter.name!r}: target {spec!r} writes what parameter {other!r} "
                            "writes too; keep one"
                        )
                owners[f"{head}.{number}"].append((parameter.name, parameter.log))


def _single_control(model: Any, actuator: str) -> int:
    index = named(model, "actuator", actuator, f"command for actuator {actuator!r}")
    if int(model.actuator_ctrlnum[index]) != 1:
        raise TargetError(f"command for actuator {actuator!r}: only actuators with one control are supported")
    return int(model.actuator_ctrladr[index])


def _reader(model: Any, channel: Channel) -> _Reader:
    where = f"measurement {channel.label!r}"
    match = _CHANNEL.match(channel.target)
    if not match:
        raise TargetError(
            f"{where}: target {channel.target!r} is not one of joint:NAME.position, joint:NAME.velocity, sensor:NAME[i]"
        )
    if match["joint"]:
        joint = named(model, "joint", match["joint"], where)
        hinge = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_HINGE)
        if not hinge and int(model.jnt_type[joint]) != int(mujoco.mjtJoint.mjJNT_SLIDE):
            raise TargetError(f"{where}: joint {match['joint']!r} is neither hinge nor slide; measure it by a sensor")
        if match["what"] == "position":
            return _Reader(1 + int(model.jnt_qposadr[joint]), False, "rad" if hinge else "m")
        return _Reader(1 + model.nq + int(model.jnt_dofadr[joint]), False, "rad/s" if hinge else "m/s")
    sensor = named(model, "sensor", match["sensor"], where)
    size, item = int(model.sensor_dim[sensor]), int(match["item"] or 0)
    if (size > 1 and match["item"] is None) or item >= size:
        raise TargetError(
            f"{where}: sensor {match['sensor']!r} has {size} components; write sensor:NAME[i], i < {size}"
        )
    return _Reader(int(model.sensor_adr[sensor]) + item, True, _sensor_unit(model, sensor))


def _state_column(model: Any, reader: _Reader) -> int | None:
    if not reader.derived:
        return reader.index
    sensor = int(np.flatnonzero(model.sensor_adr == reader.index)[0]) if reader.index in model.sensor_adr else -1
    kind, joint = int(model.sensor_type[sensor]), int(model.sensor_objid[sensor])
    if sensor >= 0 and kind == int(mujoco.mjtSensor.mjSENS_JOINTPOS):
        return 1 + int(model.jnt_qposadr[joint])
    if sensor >= 0 and kind == int(mujoco.mjtSensor.mjSENS_JOINTVEL):
        return 1 + int(model.nq) + int(model.jnt_dofadr[joint])
    return None


def _sensor_unit(model: Any, sensor: int) -> str:
    kinds, kind, joint = mujoco.mjtSensor, int(model.sensor_type[sensor]), int(model.sensor_objid[sensor])
    units = {
        "rad": (kinds.mjSENS_JOINTPOS,),
        "rad/s": (
            kinds.mjSENS_JOINTVEL,
            kinds.mjSENS_GYRO,
            kinds.mjSENS_FRAMEANGVEL,
            kinds.mjSENS_BALLANGVEL,
        ),
        "rad/s^2": (kinds.mjSENS_FRAMEANGACC,),
        "m/s^2": (kinds.mjSENS_ACCELEROMETER, kinds.mjSENS_FRAMELINACC),
        "m/s": (kinds.mjSENS_VELOCIMETER, kinds.mjSENS_FRAMELINVEL, kinds.mjSENS_SUBTREELINVEL),
        "m": (kinds.mjSENS_FRAMEPOS, kinds.mjSENS_SUBTREECOM, kinds.mjSENS_RANGEFINDER),
        "N": (kinds.mjSENS_FORCE, kinds.mjSENS_TOUCH),
        "N m": (kinds.mjSENS_TORQUE, kinds.mjSENS_JOINTACTFRC),
    }
    unit = next((unit for unit, members in units.items() if kind in [int(k) for k in members]), "")
    of_joint = (kinds.mjSENS_JOINTPOS, kinds.mjSENS_JOINTVEL, kinds.mjSENS_JOINTACTFRC)
    if kind in [int(k) for k in of_joint] and int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_SLIDE):
        return {"rad": "m", "rad/s": "m/s", "N m": "N"}[unit]
    return unit


def _bias_channels(channels: Sequence[Channel], name: str) -> list[int]:
    """The channels that ``sensor:NAME.bias`` shifts: those called NAME, or those that read the sensor
    NAME."""
    sensor = re.compile(rf"^sensor:{re.escape(name)}(\[\d+\])?$")
    return [k for k, c in enumerate(channels) if c.label == name or sensor.match(c.target)]


def _with_model_values(model: Any, parameter: Parameter, channels: Sequence[Channel]) -> Parameter:
    """The parameter with the unit and the default that the model gives it."""
    if not parameter.targets:
        raise TargetError(f"parameter {parameter.name!r}: names no target; give what it changes, such as body:rod.mass")
    units, values, least = [], [], -np.inf
    for spec in parameter.targets:
        match = _BIAS.match(spec)
        if match:
            found = _bias_channels(channels, match.group(1))
            if not found:
                names = [c.label for c in channels]
                close = difflib.get_close_matches(match.group(1), names, 1)
                hint = f"did you mean {close[0]!r}?" if close else f"measured are {names}"
                raise TargetError(
                    f"parameter {parameter.name!r}: target {spec!r} names no measured sensor or channel; {hint}"
                )
            units.append(channels[found[0]].unit)
            values.append(0.0)
        else:
            try:
                target = bind(model, spec)
            except TargetError as error:
                raise TargetError(f"parameter {parameter.name!r}: {error}") from None
            units.append(target.unit)
            values.append(target.value)
            least = max(least, target.minimum)
    if parameter.relative and parameter.default is None:
        if not values[0]:
            raise TargetError(
                f"parameter {parameter.name!r}: {parameter.targets[0]} is 0 in the model, so a factor of it "
                "says nothing; give absolute bounds"
            )
        low, high = sorted((parameter.low * values[0], parameter.high * values[0]))
        mean, sd = parameter.prior_mean, parameter.prior_sd
        if mean is not None and sd is not None:
            mean, sd = mean * values[0], abs(sd * values[0])
        parameter = replace(parameter, low=low, high=high, prior_mean=mean, prior_sd=sd)
    if parameter.low < least:
        raise TargetError(
            f"parameter {parameter.name!r}: bounds from {parameter.low:g} {parameter.unit or units[0]}, but "
            f"{parameter.targets[0]} cannot be below {least:g}; raise the lower one"
        )
    return replace(parameter, unit=parameter.unit or units[0], default=values[0])
