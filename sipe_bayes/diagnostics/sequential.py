"""When a calibration check may end early: a test of coverage that may look after every log.

Under right posteriors the truth lies in a 90 % interval, and below the median, as independent coins of .9 and of a half
fall. Against such a coin of chance p the mixture of all others is a martingale of mean one,

    e_n = B(k + 1/2, n - k + 1/2) / B(1/2, 1/2) / (p^k (1 - p)^(n - k)),    k of n intervals holding the truth,

so that it ever reaches 1 / alpha with probability alpha at most, however often one looks (J. Ville 1939; H. Robbins
1970, "Statistical methods related to the law of the iterated logarithm", Ann. Math. Stat. 41). alpha is shared out
among the 2 N coins of N parameters.

Deviation: there is no such end for posteriors that are right: to know that coverage lies within .05 of .9 takes a
thousand logs.
"""

from __future__ import annotations

import numpy as np
from scipy.special import betaln

from sipe_bayes.core.arrays import BoolArray, FloatArray
from sipe_bayes.core.thresholds import THRESHOLDS


def clearly_wrong(ranks: FloatArray) -> bool:
    """Whether ranks (R, N) of truths among their posteriors' draws leave no doubt that the posteriors are wrong.

    Where all are right, the probability that this is ever so is ``THRESHOLDS.miscalibrated`` at most.
    """
    inside, below = np.abs(2 * ranks - 1) <= THRESHOLDS.shown_interval, ranks < 0.5
    enough = np.log(2 * ranks.shape[1] / THRESHOLDS.miscalibrated)
    return any(
        max(_evidence(held, THRESHOLDS.shown_interval), _evidence(low, 0.5)) >= enough
        for held, low in zip(inside.T, below.T, strict=True)
    )


def _evidence(outcomes: BoolArray, chance: float) -> float:
    """Log e_n of outcomes (R,) against coins of a chance."""
    n, k = len(outcomes), int(np.count_nonzero(outcomes))
    mixture = betaln(k + 0.5, n - k + 0.5) - betaln(0.5, 0.5)
    return float(mixture - k * np.log(chance) - (n - k) * np.log1p(-chance))
