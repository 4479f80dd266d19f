"""Function approximators that estimators learn (not MuJoCo models); each file names the estimator that uses it."""
