"""What the tests let worker processes do; light to import, as each process imports it anew."""

import os

from sipe_bayes.benchmark.executors.work import ONE_THREAD, Done


def told(what: str) -> Done:
    """What a worker sees, a worker that dies, or one that raises."""
    if what == "die":
        os._exit(7)
    if what == "raise":
        raise LookupError("nothing here")
    import torch

    return Done((), f"{torch.get_num_threads()} {[os.environ.get(name) for name in ONE_THREAD]}", 0.0)


def gave_up(what: str, why: str) -> Done:
    return Done((), why, 0.0, failed=True)
