"""A log without noise raises no alarm, and its values are right to many digits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from sipe_bayes.calibration.run import run
from sipe_bayes.core.findings import Code, Findings
from tests.problems.swings import NOISE, SAMPLES, TRUTH, swing, write_case


def noise_free() -> pd.DataFrame:
    log = swing().copy()
    log["position"] -= np.random.default_rng(0).normal(0, NOISE, SAMPLES)
    return log


def test_a_log_without_noise_raises_no_alarm(tmp_path: Path) -> None:
    result = run(write_case(tmp_path, noise_free()), out=tmp_path / "out")
    findings = Findings(result.findings)
    assert findings.of(Code.NOISE_FREE)
    assert not findings.blocking
    assert result.misfit is None
    for parameter in result.parameters:
        np.testing.assert_allclose(parameter.mode, TRUTH[parameter.name], rtol=1e-4)
        assert parameter.q05 <= parameter.mode <= parameter.q95
