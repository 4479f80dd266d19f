"""The likelihood of residuals with the windows' starts integrated out (the model: ``sipe_bayes.likelihood.noise``)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sipe_bayes.likelihood.noise import Moments, Noise, eliminate

FloatArray = NDArray[np.float64]


def marginal(moments: Moments, noise: Noise, starts: FloatArray, precision: FloatArray) -> tuple[float, FloatArray]:
    """Log-likelihood, up to a constant, and the change (W, D) of the starts that minimises the squares.

    moments: of residuals at ``starts`` (W, D) and their Jacobian by the starts alone; precision (D,) of the starts' prior.
    """
    arrow = eliminate(moments.normal(noise), 0, precision, -precision * starts)
    pull = float((starts**2 @ precision).sum())
    total = moments.log_determinant(noise) + arrow.log_determinant + arrow.square - arrow.explained + pull
    return -0.5 * total, arrow.start_offset
