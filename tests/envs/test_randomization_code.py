"""Generated randomisation: it compiles, holds the posterior's draws, and writes them as the library does."""

from __future__ import annotations

import ast
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.envs.randomization_code import sources, write_randomization

XML = """
<mujoco><worldbody>
  <body name="arm"><joint name="hinge" axis="0 1 0" damping="0.1"/>
    <geom name="link" type="capsule" fromto="0 0 0 0.1 0 -0.5" size="0.02" mass="0.5"/>
    <body name="tip" pos="0 0 -0.5"><joint name="slide" type="slide" axis="0 0 1"/>
    <geom name="tip" size="0.03" mass="0.2"/></body></body>
  </worldbody><contact><pair geom1="link" geom2="tip"/></contact>
  <actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
PARAMETERS = [
    Parameter("mass", 0.2, 1.0, targets=("body:arm.mass",)),
    Parameter("damping", 0.0, 0.5, targets=("joint:hinge.damping",)),
    Parameter("armature", 0.0, 0.1, targets=("joint:hinge.armature",)),
    Parameter("gear", 0.5, 2.0, targets=("actuator:motor.gear",)),
    Parameter("com", -0.1, 0.1, targets=("body:tip.com_x",)),
    Parameter("gravity", -11.0, -9.0, targets=("option.gravity_z",)),
    Parameter("density", 0.0, 2.0, targets=("option.density",)),
    Parameter("friction", 0.0, 0.1, targets=("joint:slide.frictionloss",)),
    Parameter("bounce", 0.1, 1.0, targets=("geom:link.solref_dampratio",)),
    Parameter("touching", 0.0, 0.01, targets=("pair:link/tip.margin",)),
    Parameter("impratio", 0.5, 10.0, targets=("option.impratio",)),
    Parameter("bias", -0.1, 0.1, targets=("sensor:joint:hinge.position.bias",)),
]
FILES = {"mujoco_playground.py", "gymnasium_wrapper.py", "isaac_lab_events.py"}


@pytest.fixture(scope="module")
def case() -> tuple[MjcfEnvironment, np.ndarray]:
    environment = MjcfEnvironment.build(XML, PARAMETERS, ["motor"], ["joint:hinge.position"])
    theta = np.random.default_rng(0).random((12, len(PARAMETERS)))
    return environment, environment.space.values(theta)


class Robot(gymnasium.Env):
    """Nothing but a model, as Gymnasium's MuJoCo environments have one."""

    observation_space = action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_string(XML)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        return np.zeros(1, np.float32), {}


def test_the_gymnasium_wrapper_writes_draws_as_the_library_does(case: tuple[MjcfEnvironment, np.ndarray]) -> None:
    """Every reset leaves the model of one draw, derived constants and options included; every draw comes up."""
    environment, draws = case
    space: dict[str, Any] = {}
    exec(sources(environment, draws)["gymnasium_wrapper.py"], space)
    wrapped, own, seen = space["PosteriorRandomization"](Robot()), environment.compile(), set()
    for k in range(80):
        wrapped.reset(seed=0 if k == 0 else None)
        model = wrapped.unwrapped.model
        number = int(np.argmin(np.abs(draws[:, 0] - model.body("arm").mass[0])))
        seen.add(number)
        environment.write(own, draws[number])
        mujoco.mj_setConst(own, mujoco.MjData(own))
        for field in (
            "body_mass",
            "body_inertia",
            "dof_damping",
            "dof_armature",
            "actuator_gear",
            "body_ipos",
            "dof_invweight0",
        ):
            np.testing.assert_allclose(getattr(model, field), getattr(own, field), rtol=1e-7, atol=1e-12, err_msg=field)
        assert model.opt.gravity[2] == pytest.approx(draws[number, 5])
        assert model.opt.density == pytest.approx(draws[number, 6])
    assert len(seen) == 12
    other = mujoco.MjModel.from_xml_string('<mujoco><worldbody><body><geom size="1"/></body></worldbody></mujoco>')
    robot = Robot()
    robot.model = other
    with pytest.raises(ValueError, match="expected nbody = 3, got 2"):
        space["PosteriorRandomization"](robot)


BODIES = """
<mujoco><worldbody>
  <body name="arm"><joint name="hinge" axis="0 1 0" damping="0.1" stiffness="0.5"/>
    <geom name="link" type="capsule" fromto="0 0 0 0.1 0 -0.5" size="0.02" mass="0.5"/>
    <body name="tip" pos="0 0 -0.5"><joint name="slide" type="slide" axis="1 0 0"/><joint name="twist" axis="1 1 1"/>
    <geom size="0.03" mass="0.2"/></body></body>
  </worldbody><actuator>
  <motor name="motor" joint="hinge"/><position name="servo" joint="twist" kp="2"/>
  <dcmotor name="drive" joint="hinge" resistance="2" motorconst=".3"/></actuator></mujoco>"""


class Bodies(Robot):
    def __init__(self, xml: str = BODIES) -> None:
        self.model = mujoco.MjModel.from_xml_string(xml)


def accelerations(model: Any) -> np.ndarray:
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = 0.3, 0.5, 0.2
    mujoco.mj_forward(model, data)
    return data.qacc.copy()


@pytest.mark.parametrize(
    ("target", "low", "high"),
    [
        *(("body:arm.mass", 0.2, 1.0), ("body:tip.com_x", -0.2, 0.2), ("body:tip.inertia_xy", -2e-5, 2e-5)),
        *(("body:tip.inertia_yy", 6e-5, 1.2e-4), ("joint:hinge.damping", 0, 1), ("joint:hinge.frictionloss", 0, 1)),
        *(("joint:twist.armature", 0, 1), ("joint:hinge.stiffness", 0, 3), ("joint:hinge.springref", -1, 1)),
        *(("actuator:motor.gear", 0.5, 2), ("actuator:motor.gain", 0.5, 2), ("actuator:servo.kp", 1, 4)),
        *(("actuator:motor.kv", 0, 2), ("actuator:motor.bias_force", 0, 1), ("actuator:motor.bias_position", -2, 0)),
        *(("actuator:motor.bias_velocity", -2, 0), ("actuator:motor.offset", 0, 1), ("option.gravity_x", -2, 2)),
        *(("actuator:drive.resistance", 1, 3), ("actuator:drive.motor_constant", 0.1, 0.5)),
        *(("option.density", 0, 300), ("option.viscosity", 0, 3)),
    ],
)
def test_the_users_own_model_moves_as_the_calibrated_one(target: str, low: float, high: float) -> None:
    """Accelerations after the wrapper wrote a draw into the MJCF as it is, which changes them."""
    parameter = Parameter("value", low, high, targets=(target,))
    environment = MjcfEnvironment.build(BODIES, [parameter], ["motor"], ["joint:hinge.position"])
    draws = environment.space.values(np.array([[0.9]]))
    space: dict[str, Any] = {}
    exec(sources(environment, draws)["gymnasium_wrapper.py"], space)
    wrapped, own = space["PosteriorRandomization"](Bodies()), environment.compile()
    wrapped.reset(seed=0)
    environment.write(own, draws[0])
    mujoco.mj_setConst(own, mujoco.MjData(own))
    found = accelerations(wrapped.unwrapped.model)
    np.testing.assert_allclose(found, accelerations(own), rtol=1e-6, atol=1e-9)
    assert np.abs(found - accelerations(Bodies().model)).max() > 1e-6


def test_a_delay_asks_for_a_model_that_remembers_commands() -> None:
    """Refused in the MJCF as it is, taken in the one that ``identified.xml`` is."""
    parameters = [Parameter("delay", 0.0, 0.03, targets=("actuator:motor.delay",))]
    environment = MjcfEnvironment.build(BODIES, parameters, ["motor"], ["joint:hinge.position"])
    space: dict[str, Any] = {}
    exec(sources(environment, np.array([[0.02]]))["gymnasium_wrapper.py"], space)
    with pytest.raises(ValueError, match=r"expected nhistory = \d+, got 0; load identified\.xml"):
        space["PosteriorRandomization"](Bodies())
    spec = environment.spec()
    spec.compile()
    wrapped = space["PosteriorRandomization"](Bodies(spec.to_xml()))
    wrapped.reset(seed=0)
    assert wrapped.unwrapped.model.actuator_delay[0] == 0.02


def test_files_are_python_and_name_what_has_no_place(case: tuple[MjcfEnvironment, np.ndarray], tmp_path: Path) -> None:
    environment, draws = case
    paths = write_randomization(environment, draws, tmp_path / "randomization")
    assert {path.name for path in paths} == FILES
    for path in paths:
        tree = ast.parse(path.read_text())
        assert "bias is what a sensor does" in (ast.get_docstring(tree) or "")
        assert "12 draws of " in (ast.get_docstring(tree) or "")
    isaac = (tmp_path / "randomization" / "isaac_lab_events.py").read_text()
    calls = [node for node in ast.walk(ast.parse(isaac)) if isinstance(node, ast.Call)]
    terms = [c for c in calls if isinstance(c.func, ast.Name) and c.func.id == "EventTerm"]
    assert len(terms) == 3  # mass, armature, friction; damping would be the controller's
    assert "# dry friction in N m" in isaac
    assert "damping: " in isaac
    assert "controller's gain" in isaac
    low, high = np.quantile(draws[:, 0], [0.05, 0.95])  # a normal with this sd would reach below zero
    assert (
        f'"mass_distribution_params": ({low:.9g}, {high:.9g}), "operation": "abs", "distribution": "uniform"' in isaac
    )
    narrow = draws.copy()
    narrow[:, 0] = 0.5 + 0.1 * (draws[:, 0] - draws[:, 0].mean())
    mean, sd = narrow[:, 0].mean(), narrow[:, 0].std()
    said = sources(environment, narrow)["isaac_lab_events.py"]
    assert f'"mass_distribution_params": ({mean:.9g}, {sd:.9g}), "operation": "abs", "distribution": "gaussian"' in said
    assert "# actuator:motor.gear:" in isaac
    playground = (tmp_path / "randomization" / "mujoco_playground.py").read_text()
    functions = [n.name for n in ast.parse(playground).body if isinstance(n, ast.FunctionDef)]
    assert functions == ["randomize_fn"]


def test_unphysical_draws_are_left_out(case: tuple[MjcfEnvironment, np.ndarray]) -> None:
    environment, draws = case
    wrong = draws.copy()
    wrong[0, 0] = -1.0
    assert "from 11 draws" in sources(environment, wrong)["gymnasium_wrapper.py"]
    with pytest.raises(ValueError, match="draws: expected some that a model can have"):
        sources(environment, wrong[:1])


def test_friction_that_mjx_would_not_know_is_refused(
    case: tuple[MjcfEnvironment, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """MJX makes no friction rows where the loaded model has none.

    The refusal comes before JAX is used, which need not be there.
    """
    jax = ModuleType("jax")
    jax.numpy = ModuleType("jax.numpy")  # type: ignore[attr-defined]
    for name, module in (("jax", jax), ("jax.numpy", jax.numpy)):  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, name, module)
    environment, draws = case
    space: dict[str, Any] = {}
    exec(sources(environment, draws)["mujoco_playground.py"], space)
    model = environment.compile()
    with pytest.raises(ValueError, match=r"body_sameframe is not that of the calibrated model.*load identified\.xml"):
        space["randomize_fn"](model, None)
    for name, (places, values) in space["KINDS"].items():
        getattr(model, name).flat[places] = values
    with pytest.raises(ValueError, match=r"dof_frictionloss is 0 where it is drawn.*load identified\.xml"):
        space["randomize_fn"](model, None)
    model.dof_frictionloss[:] = 0.05
    with pytest.raises(AttributeError, match="jax"):  # now it goes on, to what is not there
        space["randomize_fn"](model, None)


def test_the_playground_function_batches_the_draws(case: tuple[MjcfEnvironment, np.ndarray]) -> None:
    """In MJX: fields of one draw each, and accelerations as MuJoCo has them with that draw, to single precision."""
    import jax
    from mujoco import mjx

    environment, draws = case
    space: dict[str, Any] = {}
    exec(sources(environment, draws)["mujoco_playground.py"], space)
    given = environment.compile()
    for name, (places, values) in space["KINDS"].items():
        getattr(given, name).flat[places] = values
    given.dof_frictionloss[1] = 0.05
    model = mjx.put_model(given)
    batched, in_axes = space["randomize_fn"](model, jax.random.split(jax.random.key(0), 5))
    assert batched.body_mass.shape == (5, 3)
    assert in_axes.body_mass == 0
    assert in_axes.body_pos is None
    data = mjx.make_data(given).replace(qpos=np.full(2, 0.3), qvel=np.full(2, 0.5), ctrl=np.full(1, 0.2))
    accelerate = jax.vmap(lambda one: mjx.forward(one, data).qacc, in_axes=(in_axes,))
    quickly = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}  # compiled for one call
    found = jax.jit(accelerate, compiler_options=quickly)(batched)
    for mass, moved in zip(np.asarray(batched.body_mass)[:, 1], np.asarray(found), strict=True):
        number = int(np.abs(draws[:, 0] - mass).argmin())
        assert draws[number, 0] == pytest.approx(mass, abs=1e-5)
        own = environment.compile()
        environment.write(own, draws[number])
        mujoco.mj_setConst(own, mujoco.MjData(own))
        plain = mujoco.MjData(own)
        plain.qpos[:], plain.qvel[:], plain.ctrl[:] = 0.3, 0.5, 0.2
        mujoco.mj_forward(own, plain)
        np.testing.assert_allclose(moved, plain.qacc, rtol=2e-3, atol=2e-3)


HOSTILE = [
    '"""\nraise SystemExit\n"""',
    "a\nraise SystemExit\n#",
    "\\",
    'ends in "',
    "'''+exit()+'''",
    "{names}%s",
    "\\N{BULLET}\\x",
    "\u2028\x0craise",
]


@pytest.mark.parametrize("name", HOSTILE)
def test_no_name_is_code(name: str) -> None:
    """Names come from configurations of others; those of targets have no second line."""
    parameters = [Parameter(name, 0.2, 1.0, targets=("body:arm.mass",)), PARAMETERS[1]]
    own = MjcfEnvironment.build(XML, parameters, ["motor"], ["joint:hinge.position"])
    values = own.space.values(np.full((3, 2), 0.5))
    for text in sources(own, values).values():
        statements = [type(node).__name__ for node in ast.parse(text).body]
        assert ast.get_docstring(ast.parse(text))
        assert not {"Expr", "Raise"} & set(statements[1:])
