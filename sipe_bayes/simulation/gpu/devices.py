"""Which devices there are; Warp's words about them are held back before mujoco-warp is imported."""

from __future__ import annotations

import re

import warp


def warp_name(device: str) -> str:
    """Warp's name of a Simulator's device; raises ValueError for one that is not there."""
    if not isinstance(device, str) or not re.fullmatch(r"cuda(:\d+)?|warp:cpu", device):
        raise ValueError(f"device: expected 'cpu', 'cuda', 'cuda:1' or 'warp:cpu', got {device!r}")
    name = device.removeprefix("warp:")
    warp.config.log_level = warp.LOG_ERROR if name == "cpu" else warp.LOG_WARNING
    warp.init()
    if name not in map(str, warp.get_devices()) and not (name == "cuda" and warp.is_cuda_available()):
        seen = ", ".join(str(one) for one in warp.get_devices() if one.is_cuda) or "no GPU"
        raise ValueError(
            f"device: Warp sees {seen}, and not {device!r}; look at nvidia-smi, or leave device out, which "
            "simulates on the processor"
        )
    return name
