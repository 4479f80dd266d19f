"""``sipe discover``: finds what was planted, keeps to its list, resumes to the same bits, hands back what runs."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import tomllib
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

import sipe_bayes as sipe
from sipe_bayes.calibration import discovery_summary
from sipe_bayes.calibration.discover import run_discovery
from sipe_bayes.calibration.discovery_summary import summarise
from sipe_bayes.calibration.output import CHECKPOINT
from sipe_bayes.calibration.run import run
from sipe_bayes.core.files import OutputError
from sipe_bayes.core.findings import Code
from sipe_bayes.diagnostics.discovery import Discovery
from sipe_bayes.diagnostics.records import Comparison, Misfit
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.posterior import Particles, Posterior
from sipe_bayes.report.discovery.words import discovery_verdicts
from sipe_bayes.structure.discrepancy import Discrepancy
from sipe_bayes.structure.registry import EXTENSIONS
from tests.problems.interruptions import stop_in_stage
from tests.problems.lacking import FRICTION, OWN, write_lacking
from tests.problems.pendulums import stepped


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Discovery]:
    """(configuration, what was found), in the folder ``out`` beside the configuration."""
    config = write_lacking(tmp_path_factory.mktemp("lacking"))
    return config, run_discovery(config, config.parent / "out", num_threads=1)


def test_finds_what_was_planted(case: tuple[Path, Discovery]) -> None:
    _, found = case
    (piece,) = found.kept
    assert piece.label == "dry_friction:hinge"
    assert piece.weight == pytest.approx(1.0)
    assert piece.gain is not None
    assert piece.error is not None
    assert piece.gain > 2 * piece.error
    (friction,) = found.added
    assert abs(friction.mode - FRICTION) < 5 * friction.sd
    (held_out,) = [row for row in found.errors if row.use == "holdout"]
    assert held_out.fitted_after < 0.8 * held_out.fitted_before
    assert found.after.noise["angle"].sd < found.before.noise["angle"].sd
    assert found.comparison is not None
    assert found.comparison.verdict == "better"


def test_what_was_added_has_an_interval_with_what_the_model_lacks(
    case: tuple[Path, Discovery], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the user's values have, where what remains matters: each its own, and the plain one lies within."""
    config, _ = case
    wide = {"rod_mass": (0.35, 0.95), "damping": (0.02, 0.18), "hinge.dry_friction": (0.05, 0.3)}

    def lacking(_: object, own: Posterior, __: int) -> Particles:
        assert own.space.names == tuple(wide)
        ends = np.stack([[p.normalise(end) for end in wide[p.name]] for p in own.space], axis=1)
        return Particles(np.repeat(ends, 50, axis=0), own.space)

    monkeypatch.setattr(Misfit, "matters", True)
    monkeypatch.setattr(Discrepancy, "draw", lacking)
    problem = sipe.prepare(config, 1)
    again = summarise(problem, sipe.discover(problem), "again", 0, 0.0)
    assert [p.name for p in again.added] == ["hinge.dry_friction"]
    for p in (*again.parameters, *again.added):
        assert p.further == pytest.approx(wide[p.name]), p
        assert wide[p.name][0] < p.q05 < p.q95 < wide[p.name][1], p


def test_averaged_values_hold_the_truth(case: tuple[Path, Discovery]) -> None:
    _, found = case
    for p, truth in zip(found.parameters, (0.6, 0.05), strict=True):
        assert abs(p.q50 - truth) < 5 * p.sd, p
    assert {p.name for p in found.parameters} == set(sipe.load_posterior(Path(found.out) / "posterior").space.names)


def test_folder_is_complete(case: tuple[Path, Discovery]) -> None:
    _, found = case
    out = Path(found.out)
    files = {p.name for p in out.iterdir()}
    wanted = {
        "discovered.xml",
        "discovered.toml",
        "structures.json",
        "posterior.safetensors",
        "report.html",
        "run.json",
    }
    assert wanted <= files
    assert json.loads((out / "run.json").read_text())["status"] == "complete"
    data = json.loads((out / "structures.json").read_text())
    assert data["structures"][0]["labels"] == ["dry_friction:hinge"]
    assert sum(row["weight"] for row in data["structures"]) == pytest.approx(1.0)
    assert "What the model of" in (out / "report.html").read_text(encoding="utf-8")


def test_discovered_model_has_the_values(case: tuple[Path, Discovery]) -> None:
    _, found = case
    model = mujoco.MjModel.from_xml_path(str(Path(found.out) / "discovered.xml"))
    assert model.dof_frictionloss[0] == pytest.approx(found.best["hinge.dry_friction"], rel=1e-4)


@pytest.mark.usefixtures("unreported")
def test_discovered_configuration_finds_the_same_optimum(case: tuple[Path, Discovery]) -> None:
    config, found = case
    data = tomllib.loads((Path(found.out) / "discovered.toml").read_text(encoding="utf-8"))
    assert [p["name"] for p in data["parameters"]] == ["rod_mass", "damping", "hinge.dry_friction"]
    assert not Path(data["model"]).is_absolute()
    assert data["search"]["start"] == pytest.approx(dict(found.best))
    assert data["structure"]["weight"] == pytest.approx(found.kept[0].weight, rel=0.01)
    again = run(Path(found.out) / "discovered.toml", out=config.parent / "again", num_threads=1)
    best = json.loads((Path(found.out) / "structures.json").read_text())["best"]
    assert {p.name: p.mode for p in again.parameters} == pytest.approx(best, rel=1e-2)


@pytest.mark.parametrize(("weight", "told"), [(0.62, True), (0.95, False)])
def test_that_other_structures_predict_as_well_is_not_forgotten(weight: float, told: bool, tmp_path: Path) -> None:
    config = write_lacking(tmp_path, structure=f"[structure]\nweight = {weight}\n")
    said = [text for text in sipe.prepare(config, 1).warnings if "predict these logs as well" in text]
    assert [f"a stacking weight of {weight:.2g}" in text for text in said] == [True] * told


def test_what_mjcf_has_no_element_for_travels_with_the_model_and_is_said(tmp_path: Path) -> None:
    """discovered.xml moves as the configuration at the best values does, and says who simulates its numbers."""
    table = '[structure]\nonly = ["direction_friction", "spring"]\n'
    config = write_lacking(tmp_path, table, target="joint:hinge.direction_friction")
    found = run_discovery(config, tmp_path / "out", num_threads=1)
    (piece,) = found.kept
    assert piece.label == "direction_friction:hinge"
    xml = (tmp_path / "out" / "discovered.xml").read_text(encoding="utf-8")
    assert "by sipe_bayes and not by MuJoCo itself; nearest element: joint frictionloss and damping" in xml
    assert "MJCF has no element for direction-dependent friction at hinge" in (
        tmp_path / "out" / "report.html"
    ).read_text("utf-8")
    problem = sipe.prepare(tmp_path / "out" / "discovered.toml", 1)
    space, actions = problem.simulator.space, problem.train.actions
    assert found.best["hinge.direction_friction"] == pytest.approx(FRICTION, rel=0.1)
    theta = space.normalise(np.array([found.best[name] for name in space.names]))
    path = str(tmp_path / "out" / "discovered.xml")
    environment = MjcfEnvironment.build(path, list(space)[:1], ["motor"], ["joint:hinge.position"])
    written = sipe.Simulator(environment, num_threads=1)
    start = written.default_state()[None]
    one = problem.simulator.rollout(theta[None], actions, start, 0.01).observations
    other = written.rollout(written.space.default_theta[None], actions, start, 0.01).observations
    assert np.abs(one).max() > 1
    np.testing.assert_allclose(other, one, atol=1e-3)  # six digits, over five seconds


def test_shorter_steps_are_written_into_the_model(tmp_path: Path) -> None:
    """Of a machine that takes none, and has no more friction than its model."""
    chosen = ("physics_step", "dry_friction", "spring", "delay")
    without = json.dumps([name for name in EXTENSIONS if name not in chosen])
    edits = [partial(stepped, seconds=1e-3)]
    config = write_lacking(tmp_path, f"[structure]\nwithout = {without}\n", friction=0.0, edits=edits)
    discovery = run_discovery(config, tmp_path / "out", num_threads=1)
    (piece,) = discovery.kept
    assert piece.label == "physics_step:world"
    assert not discovery.added
    assert discovery_verdicts(discovery)[0].text.startswith("The logs support physics steps an eighth as long")
    assert 'timestep="0.00125"' in (tmp_path / "out" / "discovered.xml").read_text(encoding="utf-8")
    again = run(tmp_path / "out" / "discovered.toml", out=tmp_path / "again", num_threads=1)
    assert {p.name: p.mode for p in again.parameters} == pytest.approx(dict(discovery.best), rel=1e-3)


@pytest.mark.usefixtures("unreported")
def test_a_wrong_sign_is_named_before_the_search(tmp_path: Path) -> None:
    table = '[structure]\nonly = ["dry_friction"]\nbudget = 1500\n'
    config = write_lacking(tmp_path, structure=table, factors={"torque": -1.0})
    warnings = list[str]()
    found = run_discovery(config, tmp_path / "out", num_threads=1, warn=warnings.append)
    (item,) = [item for item in found.findings if item.code is Code.COLUMN_NOT_FOLLOWED]
    assert warnings == [item.text]
    assert "angle" in item.text


def test_start_of_an_unknown_parameter_is_one_line(tmp_path: Path) -> None:
    config = write_lacking(tmp_path)
    config.write_text("search.start = { dampin = 0.1 }\n" + config.read_text())
    with pytest.raises(ValueError, match=r"`search\.start`: no parameter 'dampin'; did you mean 'damping'\?"):
        run(config, out=tmp_path / "out", num_threads=1)
    assert not (tmp_path / "out").exists()


def test_killed_search_goes_on_to_the_same_bits(
    case: tuple[Path, Discovery], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, found = case
    clock = SimpleNamespace(monotonic=itertools.count(0, 10).__next__)  # each step is kept, however fast it was
    monkeypatch.setattr("sipe_bayes.structure.discovery.time", clock)
    config = write_lacking(tmp_path)
    # inside the first fit; where the second and the third step begin; inside the one that comes first then
    for stage, calls, kept in ((1, 3, False), (2, 1, True), (3, 1, True), (1, 2, True)):
        progress = stop_in_stage(stage, calls)
        with contextlib.nullcontext() if kept else pytest.raises(KeyboardInterrupt):
            there = run_discovery(config, tmp_path / "out", num_threads=1, progress=progress)
            assert there.ended == "interrupted"
            assert any("when it was interrupted" in item.text for item in there.findings)
            assert (tmp_path / "out" / "report.html").exists()
        assert (tmp_path / "out" / CHECKPOINT).exists() == kept
    resumed = run_discovery(config, tmp_path / "out", num_threads=1)
    assert resumed.rows == found.rows
    for name in ("posterior.safetensors", "discovered.xml"):
        one, other = (hashlib.sha256((f / name).read_bytes()).hexdigest() for f in (Path(found.out), tmp_path / "out"))
        assert one == other, name


def test_folder_of_another_search_is_refused(case: tuple[Path, Discovery]) -> None:
    config, found = case
    with pytest.raises(OutputError, match="without"):
        run_discovery(config, Path(found.out), without=["spring"], num_threads=1)


def test_search_keeps_to_its_list(case: tuple[Path, Discovery]) -> None:
    config, found = case
    labels = {label for row in found.rows for label in row.labels} | {p.label for p in found.promises}
    assert {label.partition(":")[0] for label in labels} == {"dry_friction", "spring"}
    structures = sipe.discover(sipe.prepare(config, 1), only=["spring"], budget=400)
    assert {label for one in structures.fitted for label in one.labels} <= {"spring:hinge"}
    assert {offer.label for offer in structures.offers()} == {"spring:hinge"}
    assert list(structures.search.placed) == ["spring:hinge"]


def test_own_extension_by_path(tmp_path: Path) -> None:
    table = '[structure]\nonly = ["spring"]\nextra = ["own.py:Rub"]\nsites = ["hinge"]\n'
    found = run_discovery(write_lacking(tmp_path, structure=table), tmp_path / "out", num_threads=1)
    assert [piece.label for piece in found.kept] == ["rub:hinge"]
    data = tomllib.loads((tmp_path / "out" / "discovered.toml").read_text(encoding="utf-8"))
    assert data["structure"]["extra"] == ["../own.py:Rub"]
    assert data["model"] == "extended.xml"  # with what the extension adds, which does nothing yet
    problem = sipe.prepare(tmp_path / "out" / "discovered.toml", 1)
    model = problem.environment.compile()
    assert (model.nsite, model.dof_frictionloss[0]) == (1, 0)
    assert problem.simulator.space.names[-1] == "hinge.rub"


BROKEN = {  # what the file says, and words of the one line
    "syntax": ("class Rub(:", ["own.py:Rub", "SyntaxError", "correct it"]),
    "no class": ("x = 1", ["own.py:Rub", "no attribute 'Rub'"]),
    "another thing": ("class Rub: pass", ["is no Extension", "subclass"]),
    "abstract": (OWN.replace("def parameters", "def unknowns"), ["abstract", "parameters"]),
    "no kind": (OWN.replace('name, kind, reference = "rub", "joint", "-"', 'name, reference = "rub", "-"'), ["a kind"]),
    "wrong kind": (OWN.replace('"joint", "-"', '"joints", "-"'), ["kind is one of", "'joints'"]),
    "fails": (OWN.replace("machine.joints[site].force", "machine.joint[site]"), ["'rub'", "AttributeError", "'hinge'"]),
    "no place": (OWN.replace(".frictionloss", ".friction"), ["'rub'", "finds no joint", "targets"]),
}


@pytest.mark.parametrize(("content", "words"), BROKEN.values(), ids=BROKEN)
def test_broken_extension_is_one_line(content: str, words: list[str], tmp_path: Path) -> None:
    config = write_lacking(tmp_path, structure='[structure]\nextra = ["own.py:Rub"]\n')
    (tmp_path / "own.py").write_text(content)
    with pytest.raises(ValueError, match="structure") as refused:
        run_discovery(config, tmp_path / "out", num_threads=1)
    assert "\n" not in str(refused.value)
    assert [w for w in words if w not in str(refused.value)] == []
    assert not (tmp_path / "out").exists()


WRONG = {  # the table [structure], and words of the one line
    "unknown": ('only = ["dry_fricton"]', ["structure.only[0]", "'dry_fricton'", "did you mean 'dry_friction'?"]),
    "unknown left out": ('without = ["dry"]', ["structure.without[0]", "'dry'", "known are", "viscous_friction"]),
    "nothing left": ('only = ["spring"]\nwithout = ["spring"]', ["structure.only", "at least one"]),
    "no class": ('extra = ["own.py"]', ["structure.extra[0]", "path/to/file.py:Class"]),
    "no file": ('extra = ["won.py:Rub"]', ["structure.extra[0]", "no such file", "did you mean 'own.py'?"]),
    "no site": ('sites = ["hing"]', ["structure.sites", "'hing'", "did you mean 'hinge'?"]),
    "budget": ("budget = 0", ["structure.budget", "greater than 0"]),
    "key": ("sites_ = []", ["structure.sites_", "did you mean 'sites'?"]),
}


@pytest.mark.parametrize(("table", "words"), WRONG.values(), ids=WRONG)
def test_wrong_restriction_is_one_line(table: str, words: list[str], tmp_path: Path) -> None:
    config = write_lacking(tmp_path, structure=f"[structure]\n{table}\n")
    with pytest.raises(ValueError, match="structure") as refused:
        run_discovery(config, tmp_path / "out", num_threads=1)
    assert "\n" not in str(refused.value)
    assert [w for w in words if w not in str(refused.value)] == []
    assert not (tmp_path / "out").exists()


def test_a_budget_that_ends_too_soon_is_said_and_what_to_give(tmp_path: Path) -> None:
    """Before a piece was fitted to the end: neither that nothing is lacking nor that the values hold."""
    config = write_lacking(tmp_path, structure='[structure]\nonly = ["dry_friction"]\nbudget = 100\n')
    spent = run_discovery(config, tmp_path / "out", num_threads=1)
    assert not spent.settled
    assert spent.rollouts <= 100
    assert [item.code for item in spent.findings] == [Code.STRUCTURES_CUT_SHORT]
    texts = [verdict.text for verdict in discovery_verdicts(spent)]
    before = "before all extensions with a predicted gain were fitted"
    open_still = f"{before} (left open: dry friction at hinge): give --budget 200"
    assert any(
        text.startswith(f"No value may be trusted yet: the search ended with its budget of 100 rollouts {open_still}")
        for text in texts
    )
    assert "no piece was fitted to its end" in texts[0]
    assert json.loads((tmp_path / "out" / "structures.json").read_text())["settled"] is False
    assert before in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    onward = run_discovery(config, tmp_path / "out", budget=3000, num_threads=1)
    at_once = run_discovery(config, tmp_path / "other", budget=3000, num_threads=1)
    assert onward.settled
    assert [one.label for one in onward.kept] == ["dry_friction:hinge"]
    assert [one.gain for one in onward.kept] == pytest.approx([one.gain for one in at_once.kept], rel=1e-2)


@pytest.mark.parametrize(("ratio", "p", "refused"), [(0.8, 0.2, True), (0.8, 0.5, False), (1.3, 0.01, False)])
def test_a_structure_with_larger_errors_on_held_out_logs_is_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ratio: float, p: float, refused: bool
) -> None:
    """Larger by more than one standard error: the report says that it is left out, and why."""
    monkeypatch.setattr(discovery_summary, "_comparison", lambda *_: Comparison(ratio, 0.7, 1.5, p, 20))
    found = run_discovery(write_lacking(tmp_path), tmp_path / "out", num_threads=1)
    assert (found.kept == ()) == refused
    assert [row.labels for row in found.rows if row.refused] == ([("dry_friction:hinge",)] if refused else [])
    text = " ".join(one.text for one in discovery_verdicts(found))
    assert ("Refused, since errors on held-out logs are larger" in text) == refused
