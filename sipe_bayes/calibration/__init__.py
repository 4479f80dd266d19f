"""The user's machine: configuration, logs, the calibration's run, its checks and its output folder."""
