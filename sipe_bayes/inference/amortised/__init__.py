"""Estimators that learn from simulations of the prior, and keep what they learned."""
