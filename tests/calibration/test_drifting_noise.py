"""Noise whose correlation time is as long as the logs is told: the fit then follows changes, mostly."""

from __future__ import annotations

from sipe_bayes.calibration.checks.fitted import drifting
from sipe_bayes.core.findings import Code, Severity
from sipe_bayes.diagnostics.records import ChannelNoise


def test_noise_that_drifts_is_told() -> None:
    """Of the channels whose correlation time is at its limit, and only of these."""
    white, walk = ChannelNoise(0.1, 0.0), ChannelNoise(0.1, 12.0, tau_at_limit=True)
    assert drifting({"left": white, "right": ChannelNoise(0.1, 0.3)}) == []
    (told,) = drifting({"left": walk, "middle": white, "right": walk})
    assert told.code is Code.NOISE_DRIFTS
    assert told.severity is Severity.CAUTION
    assert "left, right" in told.text
    assert "12 s" in told.text
