r"""What sensors make of what they measure: a delay, a first-order low-pass filter, a scale and a bias, in this order.

With tau a filter's time constant and y between samples taken as linear, from sample to sample

.. math:: z_{k+1} = a z_k + (1 - a) y_k + (y_{k+1} - y_k) (1 - (1 - a) \tau / dt), \quad a = e^{-dt / \tau}.

Before its first sample a signal is taken to have gone on as it does between the first two: the delayed one is read off
that ramp, and the filter begins in its steady state, tau behind. What a window starts with is the state itself.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.rotations import added, between

if TYPE_CHECKING:
    from sipe_bayes.envs.channels import Channel

NEUTRAL = {"bias": 0.0, "scale": 1.0, "delay": 0.0, "filter": 0.0}
LEAST = {"delay": 0.0, "filter": 0.0}
UNITS = {"scale": "1", "delay": "s", "filter": "s"}  # a bias has its channel's
_SENSED = re.compile(rf"^sensor:(.+)\.({'|'.join(NEUTRAL)})$")


@dataclass(frozen=True)
class Sensing:
    """What O channels' sensors do, of one simulation (O,) or of B (B, O).

    Args:
        bias: added.
        scale: multiplies.
        delay: in seconds.
        filter: time constants of low-pass filters, in seconds.
    """

    bias: FloatArray
    scale: FloatArray
    delay: FloatArray
    filter: FloatArray

    @classmethod
    def of_bias(cls, bias: FloatArray) -> Sensing:
        """Nothing but a bias (O,)."""
        return cls(bias, np.ones_like(bias), np.zeros_like(bias), np.zeros_like(bias))

    @classmethod
    def stack(cls, every: Sequence[Sensing]) -> Sensing:
        """Of B simulations."""
        if all(one is every[0] for one in every):
            alike = (every[0].bias, every[0].scale, every[0].delay, every[0].filter)
            return cls(*(np.broadcast_to(row, (len(every), len(row))) for row in alike))
        rows = zip(*((s.bias, s.scale, s.delay, s.filter) for s in every), strict=True)
        return cls(*(np.stack(row) for row in rows))

    def seen(
        self, observations: FloatArray, dt: FloatArray, rotations: Sequence[tuple[int, int, int]] = ()
    ) -> FloatArray:
        """What is measured.

        Args:
            observations: (B, T+1, O), of the sensors' inputs.
            dt: (B,) seconds between them.
            rotations: channels that are together a rotation vector.

        Returns:
            Observations (B, T+1, O).
        """
        if self.delay.any():
            late = delayed(observations, self.delay[:, None] / dt[:, None, None], rotations)
            observations = np.where(self.delay[:, None] > 0, late, observations)
        if self.filter.any():
            observations = _filtered(observations, self.filter, dt[:, None])
        if (self.scale != 1.0).any():
            observations = self.scale[:, None] * observations
        return observations + self.bias[:, None] if self.bias.any() else observations


def delayed(y: FloatArray, samples: FloatArray, rotations: Sequence[tuple[int, int, int]] = ()) -> FloatArray:
    """``y`` (B, T+1, O) as it was ``samples`` (B, 1, O) earlier, linear between, before and after its samples.

    Rotation vectors, of which ``rotations`` has the channels, turn about axes that stay.
    """
    place = np.arange(y.shape[1])[:, None] - samples
    before = np.clip(np.floor(place), 0, y.shape[1] - 2).astype(int)
    here, there = np.take_along_axis(y, before, 1), np.take_along_axis(y, before + 1, 1)
    share, out = place - before, np.empty_like(y)
    out[...] = here + share * (there - here)
    for triple in map(list, rotations):
        out[..., triple] = added(here[..., triple], share[..., triple] * between(there[..., triple], here[..., triple]))
    return out


def _filtered(y: FloatArray, tau: FloatArray, dt: FloatArray) -> FloatArray:
    """``y`` (B, T+1, O) through low-pass filters tau (B, O); dt (B, 1)."""
    with np.errstate(divide="ignore"):
        decay = np.exp(-dt / tau)
    step = 1 - (1 - decay) * tau / dt
    out = np.empty_like(y)
    out[:, 0] = y[:, 0] - tau * (y[:, 1] - y[:, 0]) / dt
    for k in range(y.shape[1] - 1):
        out[:, k + 1] = decay * out[:, k] + (1 - decay) * y[:, k] + step * (y[:, k + 1] - y[:, k])
    return np.where(tau[:, None] > 0, out, y)


def sensed_channels(target: str, channels: Sequence[Channel]) -> tuple[str, list[int]] | None:
    """What of a sensor a target ``sensor:NAME.bias`` writes, and the channels; None for another kind of target.

    They are those called NAME, or those that read the sensor NAME, or the three of a vector NAME. Beside ``bias`` there
    are ``scale``, ``delay`` and ``filter``.
    """
    match = _SENSED.match(target)
    if not match:
        return None
    name, attribute = match.groups()
    sensor = re.compile(rf"^sensor:{re.escape(name)}(\[\d+\])?$")
    own = [k for k, c in enumerate(channels) if c.label == name or sensor.match(c.target)]
    return attribute, own or [k for k, c in enumerate(channels) if vector_of(c.label) == name]


def vector_of(label: str) -> str:
    """NAME of a channel that is called NAME_x or NAME[0] and so on; nothing for others."""
    match = re.match(r"^(.+)(?:_[xyz]|\[[012]\])$", label)
    return match.group(1) if match else ""


def of_sensor(target: str) -> str | None:
    """NAME of a target ``sensor:NAME.bias`` and its like; None for another kind of target."""
    match = _SENSED.match(target)
    return match.group(1) if match else None
