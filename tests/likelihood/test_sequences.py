"""Which windows are kept of long logs."""

from __future__ import annotations

import numpy as np

from sipe_bayes.likelihood.sequences import spread_blocks


def test_blocks_are_spread_over_every_log() -> None:
    log = np.repeat([0, 1], [40, 3])
    kept = spread_blocks(log, 0.25)
    first = kept[log[kept] == 0]
    assert len(first) == 10
    assert first.min() < 10
    assert first.max() > 30
    assert len(np.flatnonzero(np.diff(first) > 1)) == 2  # three blocks
    assert (log[kept] == 1).sum() == 2  # no fewer
    np.testing.assert_array_equal(spread_blocks(log, 1.0), np.arange(43))
    np.testing.assert_array_equal(spread_blocks(log, 7.0), np.arange(43))
