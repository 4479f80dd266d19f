"""Posteriors: probability distributions over a simulator's normalised parameters theta in [0, 1]^N."""

from typing import TYPE_CHECKING

from sipe_bayes.core.lazy import exports

if TYPE_CHECKING:
    from sipe_bayes.posterior.averaged import Averaged as Averaged
    from sipe_bayes.posterior.base import NoDensityError as NoDensityError
    from sipe_bayes.posterior.base import Posterior as Posterior
    from sipe_bayes.posterior.dirac import Dirac as Dirac
    from sipe_bayes.posterior.flow import Flow as Flow
    from sipe_bayes.posterior.independent import IndependentPrior as IndependentPrior
    from sipe_bayes.posterior.independent import prior as prior
    from sipe_bayes.posterior.independent import uniform as uniform
    from sipe_bayes.posterior.mixture import GaussianMixture as GaussianMixture
    from sipe_bayes.posterior.particles import Particles as Particles
    from sipe_bayes.posterior.quantile_mapped import QuantileMapped as QuantileMapped
    from sipe_bayes.posterior.registry import FAMILIES as FAMILIES
    from sipe_bayes.posterior.registry import load_posterior as load_posterior
    from sipe_bayes.posterior.surrogate import SurrogatePosterior as SurrogatePosterior
else:
    __getattr__, __dir__ = exports(__name__)
