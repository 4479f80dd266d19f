"""Which unknowns `sipe init` asks for: what the logs tell well enough, though another one does nearly the same."""

from __future__ import annotations

import numpy as np
import pytest

from sipe_bayes.calibration.init.draft import Unknown
from sipe_bayes.calibration.init.fits import Fit
from sipe_bayes.calibration.init.unknowns import told_apart


@pytest.mark.parametrize(
    ("share", "size", "kept"),
    [
        (0.09, 600.0, True),  # dry friction at a usual speed is nearly viscous, but the logs tell it to a fiftieth
        (0.09, 60.0, False),  # told to a fifth of its range
        (0.02, 600.0, False),  # the same but for rounding
        (0.4, 20.0, True),
        (0.3, 8.0, True),  # weakly told, but what it would do is in others if it is left out
        (1.0, 2.0, False),
    ],
)
def test_what_is_nearly_the_same_is_asked_for_where_the_logs_tell_it(share: float, size: float, kept: bool) -> None:
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.standard_normal((400, 2)))[0]
    both = np.stack([500 * basis[:, 0], size * (np.sqrt(1 - share**2) * basis[:, 0] + share * basis[:, 1])], axis=1)
    unknowns = [Unknown(name, (), 0.0, 1.0, False, "") for name in ("damping", "friction")]
    fit = Fit((0,), np.ones(1), np.full(2, 0.5), both, np.ones(1))
    first, second = told_apart(unknowns, fit)
    assert not first.left_out
    assert (not second.left_out) is kept, second.left_out
