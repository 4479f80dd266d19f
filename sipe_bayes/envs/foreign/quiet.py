"""MuJoCo's own messages, held back: nothing on the terminal, no MUJOCO_LOG.TXT."""

from __future__ import annotations

import threading

import mujoco


class _Quiet:
    """Holds MuJoCo's process-wide log back while any thread is inside; no callback, so no wait for the GIL."""

    def __init__(self) -> None:
        self._lock, self._inside, self._before = threading.Lock(), 0, mujoco.MjLogConfig.get()

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                self._before, silent = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
                silent.logto_console = silent.logto_file = False
                silent.set()
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                self._before.set()


quiet = _Quiet()
