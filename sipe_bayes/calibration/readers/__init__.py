"""Log readers: one file for each format; ``sipe_bayes.calibration.tables`` lists them."""
