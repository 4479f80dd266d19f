"""What runs on the device between physics steps: commands stream in, and what is recorded streams out.

A counter on the device says which control step it is, so that one CUDA graph serves all of them.
"""

# mypy: ignore-errors
# Warp reads annotations and compiles bodies: what it makes of them no type checker knows.

import warp
from warp import array, array2d, array3d


@warp.kernel(enable_backward=False)
def stream_in(moment: array[int], commands: array3d[float], first: int, target: array2d[float]):
    """target[world, column] = commands[moment, world, first + column]."""
    world, column = warp.tid()
    target[world, column] = commands[moment[0], world, first + column]


@warp.kernel(enable_backward=False)
def stream_out(moment: array[int], shift: int, source: array2d[float], first: int, kept: array3d[float]):
    """kept[moment + shift, world, first + column] = source[world, column]."""
    world, column = warp.tid()
    kept[moment[0] + shift, world, first + column] = source[world, column]


@warp.kernel(enable_backward=False)
def stream_out_first(moment: array[int], source: array2d[float], first: int, kept: array3d[float]):
    """As ``stream_out`` without shift, in the first control step alone."""
    world, column = warp.tid()
    if moment[0] == 0:
        kept[0, world, first + column] = source[world, column]


@warp.kernel(enable_backward=False)
def keep_flags(moment: array[int], flags: array[int], kept: array2d[int]):
    """kept[moment + 1, world] = flags[world]."""
    world = warp.tid()
    kept[moment[0] + 1, world] = flags[world]


@warp.kernel(enable_backward=False)
def tick(moment: array[int]):
    """The next control step."""
    moment[0] = moment[0] + 1
