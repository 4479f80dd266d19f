"""A moving picture inside a page."""

from __future__ import annotations

import base64
from dataclasses import dataclass


@dataclass(frozen=True)
class Clip:
    """An animated WebP file and what is to be seen in it; without content, why there is none."""

    text: str
    content: bytes = b""

    @property
    def source(self) -> str:
        """It inside a page."""
        return "data:image/webp;base64," + base64.b64encode(self.content).decode("ascii")
