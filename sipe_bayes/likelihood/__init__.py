"""log p(trajectory | theta): segments of logs (multiple shooting), chains of states, their noise and their algebra.

The names below are all that other rooms import from this one; each is loaded when it is first used. ``bind`` holds logs
against a simulator by the settings of a likelihood: a ``BoundLikelihood`` simulates, linearises and compares, and
estimates noise and initial states in the linear model. A ``FitResult`` is what a search hands over.
"""

from typing import TYPE_CHECKING

from sipe_bayes.core.lazy import exports

if TYPE_CHECKING:
    from sipe_bayes.likelihood.binding import BoundLikelihood as BoundLikelihood
    from sipe_bayes.likelihood.binding import BoundStates as BoundStates
    from sipe_bayes.likelihood.binding import bind as bind
    from sipe_bayes.likelihood.binding import default_likelihood as default_likelihood
    from sipe_bayes.likelihood.block_tridiagonal import Eliminated as Eliminated
    from sipe_bayes.likelihood.block_tridiagonal import damped_box_step as damped_box_step
    from sipe_bayes.likelihood.fit_result import FitResult as FitResult
    from sipe_bayes.likelihood.noise import Noise as Noise
    from sipe_bayes.likelihood.noise import noise_level as noise_level
    from sipe_bayes.likelihood.quadratic_prior import FLAT_PRECISION as FLAT_PRECISION
    from sipe_bayes.likelihood.quadratic_prior import UNIFORM_PRECISION as UNIFORM_PRECISION
    from sipe_bayes.likelihood.quadratic_prior import QuadraticPrior as QuadraticPrior
    from sipe_bayes.likelihood.replicas import Replicas as Replicas
    from sipe_bayes.likelihood.replicas import observation_noise as observation_noise
    from sipe_bayes.likelihood.settings import Segments as Segments
    from sipe_bayes.likelihood.settings import StateSpace as StateSpace
    from sipe_bayes.likelihood.starts.estimates import estimate_states as estimate_states
    from sipe_bayes.likelihood.starts.estimates import first_states as first_states
    from sipe_bayes.likelihood.starts.estimates import tied_joints as tied_joints
    from sipe_bayes.likelihood.starts.estimates import unmeasured_joints as unmeasured_joints
    from sipe_bayes.likelihood.state_space.process_noise import process_noise_findings as process_noise_findings
    from sipe_bayes.likelihood.wild_samples import wild_residuals as wild_residuals
    from sipe_bayes.likelihood.windows import Linearisation as Linearisation
else:
    __getattr__, __dir__ = exports(__name__)
