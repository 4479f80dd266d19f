"""The search of ``laplace`` over a chain of states (``likelihood.state_space``).

Steps of an iterated Kalman smoother (``smoother``) and estimates of the noise (``noise``) in turn (``search``);
``target`` is what ``mcmc`` samples at the optimum.
"""
