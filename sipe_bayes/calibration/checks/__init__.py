"""What a calibration asks of its fit: each question by itself, kept where a run was interrupted, and counted."""
