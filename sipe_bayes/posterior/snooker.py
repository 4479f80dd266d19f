r"""The snooker proposal of chains that share their walkers: along the line to another walker.

C. ter Braak, J. Vrugt, "Differential evolution Markov chain with snooker updater and fewer chains", Statistics and
Computing 18 (2008), 435-446, https://doi.org/10.1007/s11222-008-9104-9, section 2.3: with u the unit vector from a
walker z to the one that moves, x, and two further walkers z1 and z2,

.. math:: x' = x + \gamma u u' (z_1 - z_2), \qquad \gamma \sim U(1.2, 2.2),

accepted with the density's ratio times (|x' - z| / |x - z|)^(N - 1). emcee 3.1.6 has a move of this name with u not of
unit length and the root of that ratio, so that its draws are not the density's; this one stands in its place.
"""

from __future__ import annotations

import numpy as np
from emcee.moves.red_blue import RedBlueMove

from sipe_bayes.core.arrays import FloatArray

_LENGTHS = 1.2, 2.2


class SnookerMove(RedBlueMove):
    """A move for ``emcee.EnsembleSampler``, of at least eight walkers."""

    def __init__(self) -> None:
        super().__init__(nsplits=4)  # one set moves, each of the others gives a walker

    def get_proposal(
        self, moving: FloatArray, others: list[FloatArray], random: np.random.RandomState
    ) -> tuple[FloatArray, FloatArray]:
        """Proposals for walkers (W, N), and the logarithms (W,) of their Hastings ratios."""
        count, n = moving.shape
        drawn = [walkers[random.randint(len(walkers), size=count)] for walkers in others]
        z, one, two = (drawn[k] for k in random.permutation(3))
        away = moving - z
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-300)
        unit = away / distance[:, None]
        step = random.uniform(*_LENGTHS, count) * (unit * (one - two)).sum(1)
        reached = np.maximum(np.abs(distance + step), 1e-300)
        return moving + step[:, None] * unit, (n - 1) * np.log(reached / distance)
