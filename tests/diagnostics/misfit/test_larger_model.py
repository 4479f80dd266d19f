"""Causes put into a model: found and sized where the library holds them, and nothing said where it does not."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from sipe_bayes.core.checkpoint import NOTHING_KEPT, Kept
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.diagnostics.misfit import larger_model as module
from sipe_bayes.diagnostics.misfit.asked_windows import AskedWindows
from sipe_bayes.diagnostics.misfit.larger_model import LargerModel, LargerModelOptions, larger_model
from sipe_bayes.diagnostics.misfit.missing_physics import missing_physics
from sipe_bayes.diagnostics.misfit.misspecification import misfit
from sipe_bayes.diagnostics.misfit.probed_logs import ProbedLogs
from sipe_bayes.diagnostics.records import Misfit
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.laplace.windows.followed import FollowedLook
from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior
from sipe_bayes.posterior import GaussianMixture, prior
from tests.problems.buffers import TRUTH, everything, look_at, machine, recorded

FRICTION = 0.2


@dataclass(frozen=True)
class Asked:
    """What is asked of logs, and their plain posterior."""

    asked: AskedWindows
    probed: ProbedLogs
    looks: Misfit
    plain: GaussianMixture

    def larger(self, kept: Kept = NOTHING_KEPT, **options: float) -> LargerModel | None:
        """With options of the search."""
        believed = prior(machine().space)
        given = LargerModelOptions(**options)  # type: ignore[arg-type]
        return larger_model(self.asked, self.probed, self.looks, self.plain, believed, kept=kept, options=given)


def asked_of(logs: Trajectories) -> Asked:
    """Of all windows that the plain model follows."""
    whole = everything(logs)
    some = look_at(whole)
    assert isinstance(some, FollowedLook)
    space = machine().space
    asked = AskedWindows.at(some.at, whole.windows, QuadraticPrior.of(prior(space)))
    probed = asked.probed()
    sd = np.sqrt(probed.seen.variance)
    plain = GaussianMixture([0.0], (some.at.theta + probed.seen.step[:2])[None], np.diag(sd**2)[None], space)
    return Asked(asked, probed, misfit(probed, sd), plain)


@pytest.fixture(scope="module")
def wrong() -> Asked:
    """A machine with dry friction that its model lacks."""
    return asked_of(recorded(FRICTION, seed=2))


def test_missing_friction_is_put_in_and_theta_is_where_it_should_be(wrong: Asked) -> None:
    """The plain estimate of the damping is twenty sds off; friction and damping of so short logs are a ridge."""
    larger = wrong.larger()
    assert larger is not None
    (friction,) = larger.causes
    assert friction.cause == "dry friction at ram"
    assert "joint:ram.frictionloss" in friction.remedy
    assert friction.unit == "N"
    assert 0 < friction.sd < 0.1
    assert abs(friction.value - FRICTION) < 4 * friction.sd
    low, high = larger.further.quantile([0.002, 0.998]).numpy()
    assert ((low < TRUTH) & (high > TRUTH)).all()
    assert abs(wrong.asked.theta[0] - TRUTH[0]) > 0.3
    middle = larger.further.mean.numpy()
    first = missing_physics(wrong.probed, wrong.plain, prior(machine().space), True)
    assert first is not None
    assert abs(middle[0] - TRUTH[0]) < 0.5 * abs(first.further.mean.numpy()[0] - TRUTH[0])
    assert larger.looks.cause == friction.cause
    assert (larger.looks.alike, larger.looks.searchable, larger.looks.alarm) == (1, False, True)
    assert larger.looks.shift["ram_damping"] < -10
    assert 0.1 < larger.looks.share["joint:ram.position"] < 0.4


def test_what_leaves_more_than_noise_or_is_not_told_is_not_put_in(
    wrong: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both ways beside the test above."""
    assert wrong.larger(agree=0.5) is None
    assert wrong.larger(clear=1e3) is None

    def never(*_: object) -> None:
        raise AssertionError("put in")

    monkeypatch.setattr(module, "_grown", never)
    assert wrong.larger(seen=20.0) is None
    right = asked_of(recorded(seed=2))
    assert not right.looks.alarm
    assert right.larger(seen=1e-3) is None
    assert replace(wrong, looks=replace(wrong.looks, p=1.0)).larger() is None


def test_a_larger_model_that_diverges_is_none(wrong: Asked, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is known to first order then stands; the run goes on."""

    def diverges(*_: object) -> ProbedLogs:
        raise ValueError("theta: the simulation diverges")

    monkeypatch.setattr(AskedWindows, "probed", diverges)
    assert wrong.larger() is None


def test_sizes_add_up_and_shapes_are_where_they_were_tried(wrong: Asked) -> None:
    """Of Stribeck friction the speed is a shape; what nothing is known of begins in the middle of its shapes."""
    probes = wrong.probed.probes
    mine = [k for k, probe in enumerate(probes) if probe.placed is not None and probe.placed.label == "stribeck:ram"]
    (placed,) = {id(probes[k].placed): probes[k].placed for k in mine}.values()
    assert placed is not None
    speeds = [probes[k].tried[1] for k in mine]
    assert len(set(speeds)) == len(mine) > 1
    sizes = np.zeros(len(probes))
    sizes[mine[-1]] = 10 * probes[mine[-1]].size
    begun = module._begun(placed, wrong.probed, sizes)
    np.testing.assert_allclose(begun, [10 * probes[mine[-1]].tried[0], speeds[-1]], rtol=1e-6)
    none = module._begun(placed, wrong.probed, np.zeros(len(probes)))
    np.testing.assert_allclose(none, [module._INSIDE, np.mean(speeds)], rtol=1e-6)


def test_two_that_write_the_same_number_are_not_put_in_together(wrong: Asked) -> None:
    """The same piece twice stands for two that write one number."""
    environment = wrong.asked.windows.simulator.environment
    assert isinstance(environment, MjcfEnvironment)
    both = {
        probe.placed.label: probe.placed
        for probe in wrong.probed.probes
        if probe.placed is not None and probe.placed.label in ("dry_friction:ram", "gain:push", "mass:ram")
    }
    assert module._can_have(environment, list(both.values()))
    assert not module._can_have(environment, [both["dry_friction:ram"], both["dry_friction:ram"]])


def test_windows_that_were_not_chosen_get_nothing_put_in(wrong: Asked) -> None:
    """Of smooth motion ``sipe discover`` compares structures by their evidence."""
    assert replace(wrong, asked=replace(wrong.asked, chosen=None)).larger() is None


def test_what_is_left_is_put_in_beside() -> None:
    """A force that the log does not have, and friction: one cause at a time, in two rounds but not in one."""
    logs = recorded(FRICTION, seed=2)
    pushed = asked_of(replace(logs, actions=logs.actions - 0.05))
    assert pushed.larger(most=1, rounds=1, rival=1.0) is None
    larger = pushed.larger(most=1, rival=1.0)
    assert larger is not None
    assert len(larger.causes) == 2
    assert "an offset of push" in larger.looks.cause
    assert " and " in larger.looks.cause
    low, high = larger.further.quantile([0.002, 0.998]).numpy()
    assert ((low < TRUTH) & (high > TRUTH)).all()


def test_a_round_that_is_kept_is_not_made_again(wrong: Asked, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = wrong.larger(Kept(tmp_path, "this run"))

    def never(*_: object) -> None:
        raise AssertionError("fitted again")

    monkeypatch.setattr(module, "followed_windows", never)
    after = wrong.larger(Kept(tmp_path, "this run"))
    assert before is not None
    assert after is not None
    assert after.causes == before.causes
    np.testing.assert_array_equal(after.further.theta, before.further.theta)
    with pytest.raises(AssertionError, match="fitted again"):
        wrong.larger(Kept(tmp_path, "another run"))
