"""The search of ``laplace`` over windows of the logs (``likelihood.windows``).

``search`` goes from starting point to recorded optimum over ``state``s, of bodies that tumble, strike or slip;
``optimum`` is what is recorded, also by ``laplace.solver``. Starting points come from ``contact_starts``, and from
``longer_windows`` where no start is measured; ``growing_windows`` is for bodies that tumble or strike, and
``followed_posterior`` makes their posterior of what is ``followed`` of them; ``pattern_search`` looks around an
optimum, ``draws`` takes the normal's place, and ``target`` is what ``mcmc`` samples.
"""
