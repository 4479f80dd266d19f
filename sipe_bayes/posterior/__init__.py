"""Posteriors: probability distributions over a simulator's normalised parameters theta in [0, 1]^N."""

from sipe_bayes.posterior.averaged import Averaged
from sipe_bayes.posterior.base import NoDensityError, Posterior
from sipe_bayes.posterior.dirac import Dirac
from sipe_bayes.posterior.flow import Flow
from sipe_bayes.posterior.independent import IndependentPrior, prior, uniform
from sipe_bayes.posterior.mixture import GaussianMixture
from sipe_bayes.posterior.particles import Particles
from sipe_bayes.posterior.quantile_mapped import QuantileMapped
from sipe_bayes.posterior.registry import FAMILIES, load_posterior
from sipe_bayes.posterior.surrogate import SurrogatePosterior

__all__ = [
    "FAMILIES",
    "Averaged",
    "Dirac",
    "Flow",
    "GaussianMixture",
    "IndependentPrior",
    "NoDensityError",
    "Particles",
    "Posterior",
    "QuantileMapped",
    "SurrogatePosterior",
    "load_posterior",
    "prior",
    "uniform",
]
