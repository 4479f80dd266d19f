"""Reinforcement learning: agents for the benchmark's tasks."""
