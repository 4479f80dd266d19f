"""What is shown: figures, words and the page of a calibration."""
