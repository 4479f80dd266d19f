"""Causes put into a model: found and sized where the library holds them, and nothing said where it does not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from sipe_bayes.core.checkpoint import NOTHING_KEPT, Kept
from sipe_bayes.diagnostics.misfit import larger_model as module
from sipe_bayes.diagnostics.misfit.asked_windows import AskedWindows
from sipe_bayes.diagnostics.misfit.larger_model import LargerModel, LargerModelOptions, larger_model
from sipe_bayes.diagnostics.misfit.misspecification import misfit
from sipe_bayes.diagnostics.misfit.probed_logs import ProbedLogs
from sipe_bayes.diagnostics.records import Misfit
from sipe_bayes.inference.laplace.windows.followed import FollowedLook
from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior
from sipe_bayes.posterior import GaussianMixture, prior
from sipe_bayes.structure.extension import extended
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.registry import EXTENSIONS
from tests.problems.buffers import TRUTH, everything, look_at, machine, recorded

FRICTION = 0.2


@dataclass(frozen=True)
class Asked:
    """What is asked of logs, and their plain posterior."""

    asked: AskedWindows
    probed: ProbedLogs
    looks: Misfit
    plain: GaussianMixture

    def larger(self, kept: Kept = NOTHING_KEPT, options: LargerModelOptions | None = None) -> LargerModel | None:
        options = options or LargerModelOptions()
        return larger_model(
            self.asked, self.probed, self.looks, self.plain, prior(machine().space), kept=kept, options=options
        )


def asked_of(friction: float, seed: int = 0) -> Asked:
    whole = everything(recorded(friction, seed=seed))
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
    return asked_of(FRICTION)


def test_missing_friction_is_put_in_and_theta_is_where_it_should_be(wrong: Asked) -> None:
    larger = wrong.larger()
    assert larger is not None
    print(larger.causes, larger.further.quantile([0.05, 0.95]), larger.looks)
