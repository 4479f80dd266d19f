"""Tests of models that others wrote."""
