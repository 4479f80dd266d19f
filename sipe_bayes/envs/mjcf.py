"""The user's own MJCF as an Environment: which actuators the log drives and which quantities it measures.

Observations are read aligned: joint positions and velocities from the state itself, sensors from the
sensordata that belongs to that state (MuJoCo's own belong to the state one physics step earlier). What is measured of a
body is read by a sensor that the model is given; an orientation is observed as a rotation vector.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol

import mujoco
import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.parameters import Parameter, ParameterSpace
from sipe_bayes.envs.added import Added, AddedValues, check_added
from sipe_bayes.envs.base import Environment
from sipe_bayes.envs.channels import (
    Channel,
    Reader,
    add_sensors,
    check_sensors,
    expanded,
    read_channels,
    reader_of,
    rotation_triples,
    state_column,
)
from sipe_bayes.envs.foreign.load import compile_spec, load_spec
from sipe_bayes.envs.inertia import check_inertia, restore_inertia
from sipe_bayes.envs.internal.of_logs import mean_over, standing_for
from sipe_bayes.envs.internal.states import filtered_command, filtered_commands, start_sd
from sipe_bayes.envs.laws.base import LawError
from sipe_bayes.envs.laws.bound import declare, laws_of, moving_on
from sipe_bayes.envs.laws.firmware import firmware_of, supplies_of
from sipe_bayes.envs.laws.registry import LAW_OF
from sipe_bayes.envs.poses import PoseReading, felt_sd, pose_columns, pose_readings
from sipe_bayes.envs.sensing import Sensing, sensed_channels
from sipe_bayes.envs.target import Target, TargetError, named
from sipe_bayes.envs.targets import bind, split
from sipe_bayes.envs.unknowns import check_conflicts, physical_targets, with_model_values

_LONGEST_STEP = 0.25  # of the cube: a finite difference of what is not smooth
_LINEAR_INTERPOLATION = 1
_UNEVEN = 1e-9  # relative: values that differ by less are the same, written differently


class Edit(Protocol):
    """A change of a model before it is compiled: picklable, as a frozen dataclass is."""

    def __call__(self, spec: mujoco.MjSpec) -> None:
        """Change the spec in place."""


@dataclass(frozen=True, eq=False)
class MjcfEnvironment(Environment):
    """The user's MJCF with its unknowns. Build it with ``MjcfEnvironment.build``.

    Args:
        source: path of the MJCF or its text.
        actuators: what the columns of ``actions`` drive; others get zero.
        measurements: what the columns of ``observations`` are.
        parameters: the unknowns.
        edits: what is changed in the MJCF before it is compiled.
        added: what single logs have more than the model.
    """

    source: str
    actuators: tuple[str, ...]
    measurements: tuple[Channel, ...]
    parameters: ParameterSpace
    edits: tuple[Edit, ...] = ()
    added: tuple[Added, ...] = ()

    @classmethod
    def build(
        cls,
        source: str | Path,
        parameters: Iterable[Parameter],
        actuators: Sequence[str],
        measurements: Sequence[str | Channel],
        edits: Sequence[Edit] = (),
        added: Iterable[Added] = (),
    ) -> MjcfEnvironment:
        """Check everything against the model and fill in units and defaults.

        Args:
            source: path of the MJCF or its text.
            parameters: their ``targets`` name what they write; several targets of one parameter are all set to its
                value, or, where it is ``relative``, keep their proportions.
            actuators: names of those that the log drives.
            measurements: what the log holds; a text stands for a channel with that target, and the target of a
                body's vector or of an orientation for its three channels.
            edits: what is changed in the MJCF before it is compiled.
            added: what single logs have more than the model, where that is known.

        Raises:
            ModelError: for an MJCF that does not compile.
            TargetError: for what the model does not have, or what would be written twice.
            ValueError: for measurements of the same name.
        """
        channels = tuple(c if isinstance(c, Channel) else Channel(c) for c in measurements)
        parameters = tuple(parameters)
        try:
            model = compile_spec(_prepared(str(source), parameters, edits, channels), str(source))
            laws_of(model)
            firmware_of(model)
        except LawError as error:
            raise TargetError(str(error)) from None
        _controls_of(model, actuators)
        channels = tuple(part for c in channels for part in expanded(model, c))
        channels = tuple(replace(c, name=c.label, unit=reader_of(model, c).unit) for c in channels)
        twice = sorted({c.label for c in channels if [d.label for d in channels].count(c.label) > 1})
        if twice:
            raise ValueError(f"measurements: names must differ, but {twice} appear more than once")
        check_sensors(model, channels)
        rotation_triples(channels)
        space = ParameterSpace(with_model_values(model, p, channels) for p in parameters)
        check_conflicts(space)
        return cls(str(source), tuple(actuators), channels, space, tuple(edits), check_added(model, added))

    @property
    def space(self) -> ParameterSpace:  # type: ignore[override]
        """The unknowns."""
        return self.parameters

    @property
    def channels(self) -> tuple[str, ...]:  # type: ignore[override]
        """Names of what is measured."""
        return tuple(c.label for c in self.measurements)

    @property
    def channel_units(self) -> tuple[str, ...]:
        """Their units."""
        return tuple(c.unit for c in self.measurements)

    @property
    def num_actions(self) -> int:  # type: ignore[override]
        """A: how many actuators the log drives, and supplies whose voltage it holds."""
        return len(self.actuators) + len(supplies_of(self.edits))

    @property
    def needs_derived(self) -> bool:  # type: ignore[override]
        """Whether a sensor is measured."""
        return any(r.derived for r in self._readers)

    def spec(self) -> mujoco.MjSpec:
        """A fresh MjSpec, edited.

        It has a command history for each actuator whose delay is a parameter, the laws that parameters write, and not
        MuJoCo's short cut for bodies whose centre of mass lies in their origin where that may change.
        """
        return _prepared(self.source, self.parameters, self.edits, self.measurements)

    def compile(self) -> mujoco.MjModel:
        """A fresh model at the MJCF's own values."""
        return compile_spec(self.spec(), self.source)

    @cached_property
    def _model(self) -> mujoco.MjModel:
        return self.compile()

    def __getstate__(self) -> dict[str, object]:
        return {f: getattr(self, f) for f in ("source", "actuators", "measurements", "parameters", "edits", "added")}

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state)

    @cached_property
    def _targets(self) -> list[tuple[int, float, Target]]:
        """(parameter, multiplier, target) of all physical writes, in the order they must be done."""
        writes = []
        for j, parameter in enumerate(self.parameters):
            targets = [bind(self._model, t) for t in physical_targets(parameter.targets)]
            for target in targets:
                multiplier = target.value / targets[0].value if parameter.relative else 1.0
                writes.append((j, multiplier, target))
        return sorted(writes, key=lambda item: item[2].order)

    def uneven(self, parameter: Parameter) -> bool:
        """Whether targets that all get the parameter's value have different values in the model."""
        index = self.parameters.index(parameter.name)
        values = [target.value for j, _, target in self._targets if j == index]
        return not parameter.relative and len(values) > 1 and bool(np.ptp(values) > _UNEVEN * np.abs(values).max())

    def multipliers(self, parameter: Parameter) -> dict[str, float]:
        """What a parameter's value is multiplied by for each of its targets."""
        index = self.parameters.index(parameter.name)
        multipliers = {target.spec: multiplier for j, multiplier, target in self._targets if j == index}
        return {spec: multipliers.get(spec, 1.0) for spec in parameter.targets}

    @cached_property
    def _readers(self) -> tuple[Reader, ...]:
        return tuple(reader_of(self._model, c) for c in self.measurements)

    @cached_property
    def _inertial_bodies(self) -> list[int]:
        specs = [t.spec for _, _, t in self._targets if t.spec.startswith("body:") and ".inertia_" in t.spec]
        return sorted({named(self._model, "body", split(spec)[1], spec) for spec in specs})

    @cached_property
    def _shares(self) -> dict[str | None, dict[int, list[int]]]:
        """For a log: which parameter stands for which; built on demand by ``_resolve``."""
        return {}

    def _resolve(self, log: str | None) -> dict[int, list[int]]:
        """Parameter -> the parameters whose mean it takes in ``log``; absent when it does not apply there."""
        if log not in self._shares:
            self._shares[log] = standing_for(self.parameters, log)
        return self._shares[log]

    @cached_property
    def _more(self) -> AddedValues:
        return AddedValues(self._model, self.added, tuple(self._targets))

    @property
    def by_log(self) -> bool:
        """See ``Environment.by_log``; what is added in a log differs too."""
        return bool(self.added) or super().by_log

    def write(self, model: mujoco.MjModel, values: FloatArray, log: str | None = None) -> bool:
        """Write all targets of the parameters that apply in ``log``; see ``Environment.write``."""
        table, bodies = self._resolve(log), self._inertial_bodies
        physical = True
        if bodies:
            restore_inertia(model, self._model, bodies)
        for j, multiplier, target in self._more.writes:
            if j is None or j in table:
                value = target.value if j is None else multiplier * mean_over(values, table[j])
                value += self._more.to(target, log)
                physical &= value >= target.minimum
                target.write(model, value)
        return physical and (not bodies or check_inertia(model, bodies))

    def start_sd(self, model: mujoco.MjModel) -> FloatArray:
        """What the model says of its internal states, and else any state's."""
        return start_sd(model, felt_sd(model, self.poses, super().start_sd(model)))

    def least_steps(self, theta: FloatArray) -> FloatArray:
        """What the targets say, as far as it lies in the cube."""
        steps = np.zeros(len(self.parameters))
        for j, multiplier, target in self._targets:
            value = multiplier * float(self.parameters[j].value(theta[j]))
            if target.step and value < target.below:
                ahead = float(self.parameters[j].normalise((value + target.step) / multiplier))
                steps[j] = max(steps[j], min(ahead - theta[j], _LONGEST_STEP))
        return steps

    @property
    def needs_constants(self) -> bool:
        """Whether MuJoCo's derived constants depend on any of the parameters."""
        return bool(self.added) or any(t.constants for _, _, t in self._targets)

    def bias(self, values: FloatArray, log: str | None = None) -> FloatArray:
        """The sensor biases among the parameters, as they hold in ``log``."""
        return self.sensing(values, log).bias

    def sensing(self, values: FloatArray, log: str | None = None) -> Sensing:
        """What of the sensors is among the parameters, as it holds in ``log``; see ``Environment.sensing``."""
        if not self._sensed:
            return self.exact_sensing
        out, table = Sensing.of_bias(np.zeros(len(self.measurements))), self._resolve(log)
        for j, attribute, channels in self._sensed:
            if j in table and attribute == "scale":
                out.scale[channels] *= mean_over(values, table[j])
            elif j in table:
                getattr(out, attribute)[channels] += mean_over(values, table[j])
        return out

    @cached_property
    def _sensed(self) -> list[tuple[int, str, list[int]]]:
        """(parameter, what it writes of sensors, channels that it concerns)."""
        sensed = [(j, sensed_channels(t, self.measurements)) for j, p in enumerate(self.parameters) for t in p.targets]
        return [(j, *one) for j, one in sensed if one is not None]

    @cached_property
    def remembers(self) -> FloatArray:
        """Of sensors with an unknown delay or filter: the longest delay, three time constants of the slowest filter."""
        of_logs: dict[str | None, FloatArray] = {None: np.zeros(len(self.channels))}
        for j, attribute, channels in self._sensed:
            high, log = self.parameters[j].high, self.parameters[j].log
            spans = {"delay": high, "filter": 3 * high}
            of_logs.setdefault(log, np.zeros(len(self.channels)))[channels] += spans.get(attribute, 0.0)
        common = of_logs.pop(None)
        return common + np.max([*of_logs.values(), np.zeros(len(common))], axis=0)

    @cached_property
    def sensed(self) -> tuple[int, ...]:  # type: ignore[override]
        """Channels of whose sensor something is unknown."""
        return tuple(sorted({k for _, _, channels in self._sensed for k in channels}))

    @cached_property
    def _controls(self) -> list[int]:
        return _controls_of(self._model, (*self.actuators, *supplies_of(self.edits)))

    def control(self, model: mujoco.MjModel, states: FloatArray, actions: FloatArray) -> FloatArray:
        """The actions at the actuators that the log drives, zero at the others."""
        controls = np.zeros((*actions.shape[:-1], model.nu))
        controls[..., self._controls] = actions
        return controls

    def observe(
        self, model: mujoco.MjModel, states: FloatArray, derived: FloatArray | None, goals: FloatArray | None = None
    ) -> FloatArray:
        """What is measured, of states and sensordata; raises ValueError where that is wanted and missing."""
        return read_channels(self.channels, self._readers, self.rotations, states, derived)

    @cached_property
    def rotations(self) -> tuple[tuple[int, int, int], ...]:  # type: ignore[override]
        """Channels that are together a rotation vector."""
        return rotation_triples(self.measurements)

    @cached_property
    def poses(self) -> tuple[PoseReading, ...]:  # type: ignore[override]
        """What the channels tell of free and ball joints."""
        return pose_readings(self._model, self._readers)

    def state_columns(self, model: mujoco.MjModel) -> tuple[int | None, ...]:
        """Positions and velocities of joints, of free ones those of their body's origin."""
        return pose_columns(model, self.poses, [state_column(model, r) for r in self._readers])

    def history(
        self, model: mujoco.MjModel, states: FloatArray, actions: Sequence[FloatArray], timestep: FloatArray
    ) -> FloatArray:
        """Fill the history of every delayed actuator and begin at rest; see ``Environment.history``."""
        filtered, laws = filtered_commands(model), laws_of(model)
        if model.nhistory == 0 and not filtered and not laws:
            return states
        states, timestep = moving_on(laws, states), np.asarray(timestep)
        steps = np.broadcast_to(timestep, len(states))
        for index, column in filtered:
            control = int(model.actuator_ctrladr[index])
            for row, past in enumerate(actions):
                commands = self.control(model, states[row], past)[:, control]
                states[row, column] = filtered_command(model, index, commands, float(steps[row]))
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
            for row, past in enumerate(actions):
                tail = past[-samples:, column]
                block[row, 2 + samples :] = np.concatenate([np.full(samples - len(tail), tail[0]), tail])
        return states

    def _check_history(self, actuator: str, samples: int, timestep: float) -> None:
        longest = max((p.high for p in self.parameters if f"actuator:{actuator}.delay" in p.targets), default=0.0)
        if longest > (samples - 1) * timestep * (1 + 1e-9):
            raise ValueError(
                f"actuator:{actuator}.delay: {longest:g} s do not fit the history of {samples} physics steps "
                f"of {timestep:g} s; set the model's timestep no longer than the log's"
            )


def _prepared(
    source: str, parameters: Iterable[Parameter], edits: Iterable[Edit], channels: Sequence[Channel]
) -> mujoco.MjSpec:
    """The MjSpec of a source, edited, with what its parameters write to and what reads the channels."""
    spec = load_spec(source)
    for edit in edits:
        edit(spec)
    add_sensors(spec, channels)
    timestep = spec.option.timestep
    for parameter in parameters:
        for target in physical_targets(parameter.targets):
            kind, name, attribute = split(target, parameter.name)
            if kind == "body" and attribute != "mass" and spec.body(name) is not None:
                spec.body(name).simple = False
            if attribute == "armature" and spec.tendons:  # a tendon's inertia couples what it moves
                for body in spec.bodies[1:]:
                    body.simple = False
            if kind == "actuator" and attribute == "delay" and spec.actuator(name) is not None:
                actuator = spec.actuator(name)
                # the physics step may be refined to half the model's own
                actuator.nsample = max(actuator.nsample, math.ceil(2 * parameter.high / timestep) + 2)
                actuator.interp = _LINEAR_INTERPOLATION
            owner = {"joint": spec.joint, "actuator": spec.actuator}.get(kind)
            if (kind, attribute) in LAW_OF and owner is not None and owner(name) is not None:
                declare(spec, kind, name, LAW_OF[kind, attribute][0])
    return spec


def _controls_of(model: mujoco.MjModel, actuators: Sequence[str]) -> list[int]:
    indices = [named(model, "actuator", a, f"command for actuator {a!r}") for a in actuators]
    for actuator, index in zip(actuators, indices, strict=True):
        if int(model.actuator_ctrlnum[index]) != 1:
            raise TargetError(f"command for actuator {actuator!r}: only actuators with one control are supported")
    return [int(model.actuator_ctrladr[index]) for index in indices]
