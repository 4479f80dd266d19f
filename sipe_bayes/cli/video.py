"""The command ``sipe video``."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from sipe_bayes.cli.errors import exit_on_error
from sipe_bayes.core.validation import positive, whole


def video(
    config: Annotated[Path, typer.Argument(help="TOML file of `sipe calibrate`.")],
    posterior: Annotated[
        Path | None, typer.Option(help="RUN/posterior of `sipe calibrate`; default that of runs/NAME-ESTIMATOR.")
    ] = None,
    log: Annotated[str | None, typer.Option(help="Its name; default the first held-out one.")] = None,
    window: Annotated[
        float | None,
        typer.Option(help="Seconds after which the simulation starts anew as measured; default the log's."),
    ] = None,
    channel: Annotated[str | None, typer.Option(help="Measurement drawn below; default the first.")] = None,
    camera: Annotated[str | None, typer.Option(help="Of the model; default one that holds all that moves.")] = None,
    width: Annotated[int, typer.Option(help="Pixels of each of the two machines.")] = 400,
    fps: Annotated[float, typer.Option(help="Pictures a second.")] = 25.0,
    speed: Annotated[float, typer.Option(help="1 is as fast as it was.")] = 1.0,
    out: Annotated[Path, typer.Option(help="A .gif, .webp or .mp4.")] = Path("video.gif"),
) -> None:
    """The log beside its simulations: the machine as measured (grey), model as given, calibrated model.

    MuJoCo renders: without a screen through EGL, or what MUJOCO_GL names.
    """
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")
    with exit_on_error():
        from dataclasses import replace

        _load_mujoco()
        from sipe_bayes.calibration.problem import prepare
        from sipe_bayes.calibration.run import run_name
        from sipe_bayes.posterior import load_posterior
        from sipe_bayes.report import video as drawing
        from sipe_bayes.report.interactive.motion import motion
        from sipe_bayes.simulation.rendering import Stage, with_sky

        whole("--width", width, 16)
        positive("--fps", fps)
        positive("--speed", speed)
        problem = prepare(config)
        name = problem.config.estimator
        path = posterior or Path("runs") / f"{run_name(config)}-{name}" / "posterior"
        if not path.with_suffix(".json").is_file():
            raise ValueError(f"--posterior {path}: no such posterior; run `sipe calibrate {config}` first")
        known = load_posterior(path)
        difference = known.space.difference(problem.simulator.space)
        if difference:
            raise ValueError(f"--posterior {path}: {difference} in {config}; give that of a run of it")
        logs = [*(problem.holdout or ()), *problem.train]
        chosen = next((one for one in logs if log in (None, one.name)), None)
        if chosen is None:
            raise ValueError(f"--log {log}: expected one of {', '.join(one.name for one in logs)}")
        channels = problem.environment.channels
        if channel is not None and channel not in channels:
            raise ValueError(f"--channel {channel}: expected one of {', '.join(channels)}")
        settings = problem.segments
        if window is not None:
            settings = replace(settings, window=positive("--window", window), windows=())
        theta = {"model as given": problem.environment.space.default_theta, "calibrated": known.mode.numpy()}
        at = 0 if channel is None else channels.index(channel)
        label = f"{channels[at]} ({problem.environment.channel_units[at]})"
        shown = motion(problem.simulator, settings, chosen, theta, at, label)
        stage = Stage(with_sky(problem.environment.spec()), width, width, camera)
        try:
            drawing.save(drawing.pictures(stage, shown, fps, speed), out, fps)
        finally:
            stage.close()
    print(f"{out}: log {chosen.name}, {chosen.dt * len(chosen):.3g} s, {out.stat().st_size / 2**20:.2g} MiB")


def _load_mujoco() -> None:
    """Import MuJoCo, which loads what MUJOCO_GL names; raises ImportError with the remedy where that fails."""
    try:
        import mujoco  # noqa: F401
    except Exception as error:  # each backend has its own
        backend, remedy = os.environ.get("MUJOCO_GL"), "install libegl1 or libosmesa6, or set another backend"
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ImportError(f"MUJOCO_GL={backend}: OpenGL cannot be loaded ({reason}); {remedy}") from None
