"""Trajectories of the benchmark's tasks: demonstrations, the sets that are stored, and Minari."""
