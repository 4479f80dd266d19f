r"""Laplace's approximation of the posterior: search its optima, take the curvature there.

**Objective.** With theta in the unit cube, x the windows' starts (or all states), r the residual of the simulation,
V(noise) its covariance, P_x the weak prior of the starts and N(mu, P^{-1}) the prior's normal, the search minimises

.. math::

    E(\theta, x; \text{noise}) = \tfrac12\, r(\theta, x)^\top V^{-1} r(\theta, x)
        + \tfrac12\, x^\top P_x\, x + \tfrac12\, (\theta - \mu)^\top P\, (\theta - \mu),
    \qquad 0 \le \theta \le 1,

and the noise maximises its restricted likelihood, in which theta and x are integrated out
(``sipe_bayes.likelihood.restricted``). At an optimum the starts are marginalised,

.. math::

    p(\theta \mid y) \approx \mathcal N\bigl(\theta;\ \hat\theta + H^{-1} g,\ H^{-1}\bigr)\ \text{on}\ [0, 1]^N,
    \qquad H = A_{\theta\theta} - A_{\theta x} A_{xx}^{-1} A_{x\theta} + P,

with A = J' V^{-1} J + diag(0, P_x) and g what still pulls on theta: where a parameter sits at a bound, the normal's
mean lies beyond it, and the truncated density is right up to the bound.

**Two fits** share this energy, the noise by restricted likelihood and the optimum's normal:

- ``solver.SegmentSolver`` fits segments, which is the everyday case: plain least squares first, then theta, initial
  states and noise together, on ever more segments. Its docstring has the phases.
- ``state_space`` fits models whose state is unknown at every sample (``StateSpace``): through impacts, and where not
  every state is measured.

**Steps** (``estimator.Laplace``):

1. Fit, from the nominal model, and from further starting points where the fit is poor. Where it is good, look for other
   optima. Where initial states are not measured and the logs are not followed, go on from where longer segments lead
   (``longer_windows``).
2. Keep the optima that are not the same and within ten nats of the best (``strategy.distinct``); they become components
   of a mixture, weighted by their restricted likelihood.
3. Probe whether the optima's normals are the posterior (``inference.importance``), and whether that goes on beyond a
   single one (``inference.stretches``); where they do not stand, importance draws and kernels on them take the normals'
   place, each optimum's on its own draws (``draws``).

All are a ``strategy.Strategy``: made of a ``SearchProblem`` and the bound logs, with a frozen state of their own.

**To change how steps are damped**, change ``levenberg_marquardt.DampingRule.after``: every search but ``solver`` asks
it and nothing else. ``tests/inference/laplace/test_levenberg_marquardt.py`` tells. Other numbers of the search are the
fields of ``options.LaplaceTuning``, each with its reason: ``Laplace(simulator, tuning=LaplaceTuning(...))``.

**Deviations** from the textbook:

- Directions that the data leave open get a normal of sd 10 about the cube's centre, flat within the cube to half a
  percent, so that the covariance exists and the result does not depend on the start.
- The uncertainty of the noise widens the normal (not with ``StateSpace``).
- Where plain and generalised least squares differ by more than coloured noise allows (Hausman's test, ``solver``), the
  optimum is that of plain least squares and its width the sandwich, as with ``noise="sandwich"``.
- Residuals below what the simulation's own rounding leaves are no independent evidence: such a channel counts as one
  sample, not as many.
- With ``noise="sandwich"`` the optimum is that of plain least squares and only the width comes from autoregressive
  noise (``likelihood.noise_spread.sandwich``). Where the model is wrong at low frequencies, the full likelihood puts
  the misfit down to slow noise and may leave the parameters behind it undetermined; plain least squares keeps what
  predicts best.
- Whether the posterior is normal is not asked through impacts, where several optima have starts of their own, where
  residuals are as small as the simulation's rounding or intervals as small as the search resolves, where the intervals
  are guessed; where starts are estimated it is only asked whether it is wider, and where states are inferred by draws
  from the normal. Where the budget has no room for it (6 N + 2 rollouts to ask of windows from known starts, 8 N + 2
  and the unknowns of a start from estimated ones, up to 16 N + 2 of chains, and some hundreds for draws where it is
  none), a finding says so.
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
