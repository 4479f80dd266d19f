"""Searches of ``laplace`` over a chain of states (``likelihood.state_space``), from measured or known starts.

``search`` looks for states in their measurements, ``known_starts`` follows the commands from known first states. Both
take steps of an iterated Kalman smoother (``smoother``) and estimates of the noise (``noise``) in turn; ``target`` is
what ``mcmc`` samples at the optimum.
"""
