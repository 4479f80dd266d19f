"""Environments: immutable descriptions of what is simulated and which of its parameters are unknown."""
