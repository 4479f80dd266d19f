"""Every extension of the registry wherever three machines have a place for it; no second list."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.export import write_identified
from sipe_bayes.envs.internal.elastic import NUMBERS as ELASTIC_NUMBERS
from sipe_bayes.envs.laws.registry import LAWS
from sipe_bayes.envs.laws.residual import Residual
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood import Segments
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.extension import Placed, extended, placements
from sipe_bayes.structure.machine import Machine, machine_of
from sipe_bayes.structure.probes import effects
from sipe_bayes.structure.registry import EXTENSIONS, get_extension
from tests.problems.machines import MACHINES, environment

THETA = np.array([0.4])
STEPS, DT = 150, 0.008
PLACES = [(name, machine) for name in EXTENSIONS for machine in MACHINES]


@cache
def bound(machine: str) -> Windows:
    """Two logs of a machine in windows of a quarter of a second."""
    simulator, rng = Simulator(environment(MACHINES[machine]), 1), np.random.default_rng(1)
    time, count = np.arange(STEPS) * DT, simulator.environment.num_actions
    logs = []
    for name in ("a", "b"):
        waves = 2 * np.pi * rng.uniform(0.3, 2.0, (3, count)) * time[:, None, None] + rng.uniform(0, 6, (3, count))
        actions = 1.5 * np.sin(waves).sum(1)
        run = simulator.rollout(THETA, actions, simulator.default_state(), DT)
        noise = 1e-3 * rng.standard_normal(run.observations[0].shape)
        channels = simulator.environment.channels
        logs.append(Trajectory(run.observations[0] + noise, actions, DT, name=name, channels=channels))
    return Windows(Segments(window=0.24), simulator, Trajectories.stack(logs))


@cache
def machine(name: str) -> Machine:
    windows = bound(name)
    return machine_of(windows, THETA, windows.no_starts())


@cache
def placed(extension: str, name: str) -> tuple[Placed, ...]:
    return tuple(placements(get_extension(extension), machine(name)))


def motion(environment: MjcfEnvironment, theta: Any, name: str) -> Any:
    """Observations (T+1, O) of the first log's commands, from a start off the rest."""
    simulator, windows = Simulator(environment, 1), bound(name)
    start = simulator.default_state()
    model, plain = simulator.model, windows.simulator.model
    for joint in range(plain.njnt):
        address = int(model.joint(plain.joint(joint).name).qposadr[0])
        start[1 + address] = 0.3
    past = [windows.trajectories.actions[0, :1]]
    start = simulator.environment.history(model, start[None], past, np.array([model.opt.timestep]))
    run = simulator.rollout(theta, windows.trajectories.actions[:1], start, DT, ["a"])
    assert run.valid.all()
    return run.observations[0]


def test_every_extension_has_a_place() -> None:
    for name in EXTENSIONS:
        assert any(placed(name, each) for each in MACHINES), name


def test_every_law_is_written_by_an_extension() -> None:
    parameters = (p for name, where in PLACES for one in placed(name, where) for p in one.parameters)
    written = {target.rpartition(".")[2] for parameter in parameters for target in parameter.targets}
    numbers = {number.attribute for law in LAWS.values() for number in law.numbers}
    assert numbers - set(Residual.scales) <= written


NUMBERS = [*ELASTIC_NUMBERS, *(number for law in LAWS.values() for number in law.numbers)]
SHAPES = {number.attribute for number in NUMBERS if number.shape}


@pytest.mark.parametrize(("name", "where"), PLACES)
def test_at_its_plain_value_it_is_the_plain_model(name: str, where: str) -> None:
    plain = motion(bound(where).simulator.environment, THETA, where)
    for one in () if get_extension(name).fixed else placed(name, where):
        larger = extended(bound(where).simulator.environment, [one])
        seen = motion(larger, np.concatenate([THETA, one.plain]), where)
        np.testing.assert_allclose(seen, plain, rtol=1e-9, atol=1e-9, err_msg=one.label)


@pytest.mark.parametrize(("name", "where"), PLACES)
def test_its_probes_change_what_is_observed(name: str, where: str) -> None:
    windows = bound(where)
    seen = effects(windows, THETA, windows.no_starts(), placed(name, where))
    # no log of the slide shows the zero of its position, and it never rests
    hidden = {"sensor_offset:joint:slider.position", "hard_friction:world"} if where == "slide" else set()
    assert {effect.placed.label for effect in seen} == {one.label for one in placed(name, where)} - hidden
    for effect in seen:
        assert np.isfinite(effect.change).all()
        assert (np.abs(effect.change).max((0, 1, 2)) > 1e-7).all(), effect.placed.label


@pytest.mark.parametrize(("name", "where"), PLACES)
def test_its_parameters_have_bounds_in_si_and_a_sentence(name: str, where: str) -> None:
    for one in placed(name, where):
        assert one.sentence
        assert one.extension.reference
        assert one.probes.shape[2] == len(one.parameters) == len(one.plain)
        assert ((one.probes >= 0) & (one.probes <= 1)).all()
        for parameter in one.parameters:
            assert 1e-12 < max(abs(parameter.low), abs(parameter.high)) < 1e6, parameter.name
            shape = parameter.targets[0].rpartition(".")[2] in SHAPES
            assert (parameter.default is None) == shape, parameter.name
            assert parameter.unit, parameter.name
            assert parameter.description, parameter.name


@pytest.mark.parametrize("factor", [0.01, 100.0])
@pytest.mark.parametrize(("name", "where"), PLACES)
def test_it_has_the_same_places_on_machines_of_another_size(name: str, where: str, factor: float) -> None:
    """What the model itself has may lie beyond what the motion's size suggests."""
    own = machine(where)
    joints = {joint: type(s)(*(factor * x for x in vars(s).values())) for joint, s in own.joints.items()}
    forces = {actuator: factor * size for actuator, size in own.forces.items()}
    other = replace(own, joints=joints, forces=forces)
    labels = [one.label for one in placements(get_extension(name), other)]
    assert labels == [one.label for one in placed(name, where)]


@pytest.mark.parametrize(("name", "where"), PLACES)
def test_the_written_model_loads_again_and_moves_the_same(name: str, where: str, tmp_path: Path) -> None:
    drive, rng = MACHINES[where], np.random.default_rng(5)
    for one in placed(name, where):
        larger = extended(bound(where).simulator.environment, [one])
        away = np.clip(one.plain + np.where(one.plain > 0.5, -1, 1) * rng.uniform(0.05, 0.3, len(one.plain)), 0, 1)
        theta = np.concatenate([THETA, away])
        path = tmp_path / "identified.xml"
        findings = write_identified(larger, larger.space.values(theta), path)
        sensors = [p.name for p in one.parameters if any(t.startswith("sensor:") for t in p.targets)]
        assert [name for found in findings for name in found.parameters] == sensors
        if sensors or any(p.log for p in one.parameters):
            continue
        mass = Parameter("mass", 0.1, 10.0, targets=(f"body:{drive.body}.mass",))
        again = MjcfEnvironment.build(path, [mass], larger.actuators, larger.measurements)
        assert mujoco.MjModel.from_xml_path(str(path)).nq == larger.compile().nq
        loaded = motion(again, again.space.default_theta, where)
        np.testing.assert_allclose(loaded, motion(larger, theta, where), rtol=2e-3, atol=2e-3, err_msg=one.label)
