"""Log readers: one file for each format; ``sipe_bayes.calibration.readers.tables`` lists them."""
