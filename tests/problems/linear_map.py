"""A linear function of two parameters in physical units, without noise."""

from __future__ import annotations

import numpy as np

import sipe_bayes as sipe

SPACE = sipe.ParameterSpace([sipe.Parameter("a", low=0.0, high=2.0), sipe.Parameter("b", low=-1.0, high=1.0)])
MATRIX = np.array([[1.0, 0.5], [0.0, 1.0], [1.0, -1.0]])
TRUTH = np.array([1.9, -0.9])
