"""An early end of a calibration check: hardly ever for right posteriors, soon for wrong ones."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.diagnostics.coverage import FEWEST, clearly_wrong


def ended(ranks: FloatArray) -> int | None:
    """The number of logs after which it ends; None where it does not."""
    return next((n for n in range(FEWEST, len(ranks) + 1) if clearly_wrong(ranks[:n])), None)


def test_right_posteriors_are_looked_at_to_the_end() -> None:
    """However often one looks: 1 % at most, 200 checks of 100 logs; six ends or more in .3 % of cases at that."""
    rng = np.random.default_rng(0)
    ends = sum(ended(rng.random((100, 3))) is not None for _ in range(200))
    assert ends <= 5


@pytest.mark.parametrize(("width", "shift"), [(0.5, 0.0), (1.0, 1.0)])
def test_wrong_ones_end_it(width: float, shift: float) -> None:
    """Normal posteriors of half the width, or a sd off, in one of three parameters: in some 40 logs as a rule."""
    rng, ends = np.random.default_rng(1), list[int]()
    for _ in range(20):
        ranks = rng.random((200, 3))
        ranks[:, 1] = norm.cdf((rng.standard_normal(200) + shift) / width)
        end = ended(ranks)
        assert end is not None
        ends.append(end)
    assert np.median(ends) <= 50
