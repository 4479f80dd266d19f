r"""Laplace's approximation of the posterior: search its optima, take the curvature there.

**Objective.** With theta in the unit cube, x the initial states of segments (or all states), r the residual of the
simulation, V(noise) its covariance, P_x the prior of x and N(mu, P^{-1}) the prior's normal, the search minimises

.. math::

    E(\theta, x; \text{noise}) = \tfrac12\, r(\theta, x)^\top V^{-1} r(\theta, x)
        + \tfrac12\, x^\top P_x\, x + \tfrac12\, (\theta - \mu)^\top P\, (\theta - \mu),
    \qquad 0 \le \theta \le 1,

and the noise maximises its restricted likelihood, with theta and x integrated out (``likelihood.restricted``). At an
optimum x is marginalised,

.. math::

    p(\theta \mid y) \approx \mathcal N\bigl(\theta;\ \hat\theta + H^{-1} g,\ H^{-1}\bigr)\ \text{on}\ [0, 1]^N,
    \qquad H = A_{\theta\theta} - A_{\theta x} A_{xx}^{-1} A_{x\theta} + P,

with A = J' V^{-1} J + diag(0, P_x) and g what still pulls on theta. Where a parameter sits at a bound, the normal's
mean lies beyond it, and the truncated density is right up to the bound.

**Steps** (``estimator.Laplace``):

1. Fit segments (``solver.SegmentSolver``, whose docstring has the phases) or a ``StateSpace`` (``state_space``), from
   the nominal model and from further starting points where the fit is poor. Where initial states are not measured and
   the logs are not followed, go on from where longer segments lead (``longer_windows``).
2. Keep the optima that are not the same and within ten nats of the best (``strategy.distinct``). They become components
   of a mixture, weighted by their restricted likelihood.
3. Ask whether their normals are the posterior. Where they are not, importance draws and kernels on them take their
   place (``draws``). Where the budget has no room for it, a finding says so.

**Deviations** from the textbook:

- Directions that the data leave open get a normal of sd 10 about the cube's centre, flat within the cube to half a
  percent, so that the covariance exists and the result does not depend on the start.
- The uncertainty of the noise widens the normal.
- Where plain and generalised least squares differ by more than coloured noise allows (Hausman's test, ``solver``), and
  with ``noise="sandwich"``, the optimum is that of plain least squares and its width the sandwich. Where the model is
  wrong at low frequencies, the full likelihood puts the misfit down to slow noise and may leave parameters behind it
  undetermined; plain least squares keeps what predicts best.
- Residuals below what the simulation's own rounding leaves are no independent evidence: such a channel counts as one
  sample, not as many.
- Whether the posterior is normal is not asked of segments through impacts, where residuals are as small as rounding,
  or where the fit did not converge. Where initial states are estimated it is only asked whether it is wider.
"""

from typing import TYPE_CHECKING

from sipe_bayes.core.lazy import exports

if TYPE_CHECKING:
    from sipe_bayes.inference.laplace.estimator import Laplace as Laplace
    from sipe_bayes.inference.laplace.estimator import TargetFit as TargetFit
    from sipe_bayes.inference.laplace.estimator import noise_diagnostics as noise_diagnostics
    from sipe_bayes.inference.laplace.estimator import target_fit as target_fit
    from sipe_bayes.inference.laplace.estimator import target_of as target_of
    from sipe_bayes.inference.laplace.options import EVIDENCE_TUNING as EVIDENCE_TUNING
    from sipe_bayes.inference.laplace.target import Target as Target
else:
    __getattr__, __dir__ = exports(__name__)
