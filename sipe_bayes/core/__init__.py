"""What every room uses: parameters, trajectories, units, checks, findings, options, checkpoints, seeds and files."""

__version__ = "0.2.0"
