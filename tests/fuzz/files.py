"""Readers of files, each with sound files that are changed.

A target makes its sound files in a folder, once; asked with a generator it changes them and gives what reads them.
"""

from __future__ import annotations

import random
import shutil
import tomllib
from pathlib import Path

import numpy as np

from tests.fuzz import mutations
from tests.fuzz.mutations import Change, Read, Target

EXAMPLES = Path(__file__).parents[2] / "examples"


def of_log(kind: str) -> Target:
    """A log of one format, whole files or the folder's."""

    def make(folder: Path) -> Change:
        from sipe_bayes.calibration.logs import load_logs
        from sipe_bayes.calibration.readers.tables import read_table
        from tests.problems import log_files
        from tests.problems.log_tables import regular

        writers = {**log_files.WRITERS, "7.3": log_files.matlab_7_3_file}
        if kind == "v3":
            written = log_files.lerobot_folder(folder, regular(30), "v3.0")
        else:
            written = writers[kind](folder, regular(30))
        config = log_files.configured(written, folder)
        files = (
            [written.path] if written.path.is_file() else [f for f in sorted(written.path.rglob("*")) if f.is_file()]
        )
        whole = {file: file.read_bytes() for file in files}

        def change(chance: random.Random) -> Read:
            for file, data in whole.items():
                file.write_bytes(data)
            file = chance.choice(files)
            if kind == ".npz" and chance.random() < 0.5:
                with np.load(file) as data:
                    np.savez(file, **mutations.of_arrays(dict(data), chance))
            else:
                file.write_bytes(mutations.of_bytes(whole[file], chance))
            if chance.random() < 0.3:
                return lambda: read_table(written.path)
            return lambda: load_logs(config, config.logs)

        return change

    return make


CONFIGURATIONS = ("arm", "cube", "drive", "furuta_pendulum", "quadruped", "servo", "double_pendulum")
EVERY_TABLE = {
    "structure": {"only": ["dry_friction"], "without": ["delay"], "budget": 100},
    "search": {"restarts": 2, "candidates": 3},
    "prior": {"source": "runs/x/posterior"},
    "resample": {"rate": 100.0},
    "seed": 1,
    "budget": 100,
}


def configurations(folder: Path) -> Change:
    """The examples' configurations, each beside its model and logs."""
    from sipe_bayes.calibration.config import load_config
    from sipe_bayes.core.toml import to_toml

    texts = {}
    for name in CONFIGURATIONS:
        shutil.copytree(EXAMPLES / name, folder / name)
        texts[name] = (folder / name / "calibrate.toml").read_text(encoding="utf-8")

    def change(chance: random.Random) -> Read:
        name = chance.choice(CONFIGURATIONS)
        path = folder / name / "fuzzed.toml"
        text = texts[name]
        if chance.random() < 0.4:
            path.write_bytes(mutations.of_bytes(text.encode(), chance))
        else:
            plain = tomllib.loads(text)
            if chance.random() < 0.3:
                plain |= EVERY_TABLE
            try:
                content = to_toml(mutations.of_data(plain, chance))
            except (TypeError, AttributeError):  # TOML has no None
                content = mutations.of_text(text, chance)
            path.write_bytes(mutations.written(content))
        return lambda: load_config(path)

    return change


def problems(folder: Path) -> Change:
    """Configuration, model and log of a pendulum, bound to a simulator."""
    from sipe_bayes.calibration.problem import prepare
    from sipe_bayes.core.toml import to_toml
    from tests.problems.swings import write_case

    path = write_case(folder)
    whole = {file: file.read_bytes() for file in (path, folder / "log.csv")}
    plain = tomllib.loads(whole[path].decode())

    def change(chance: random.Random) -> Read:
        for file, data in whole.items():
            file.write_bytes(data)
        if chance.random() < 0.3:
            (folder / "log.csv").write_bytes(mutations.of_bytes(whole[folder / "log.csv"], chance))
        else:
            try:
                content = to_toml(mutations.of_data(plain, chance))
            except (TypeError, AttributeError):
                content = mutations.of_text(whole[path].decode(), chance)
            path.write_bytes(mutations.written(content))
        return lambda: prepare(path, 1)

    return change


RICH = """\
<mujoco>
  <compiler angle="radian" boundmass="0.001" boundinertia="0.001"/>
  <size memory="1M" nuserdata="1" nkey="1" nuser_body="1" nuser_sensor="1"/>
  <option timestep="0.002" iterations="10" ls_iterations="5" noslip_iterations="2" tolerance="1e-8" density="1"/>
  <include file="part.xml"/>
  <asset>
    <texture name="t" type="2d" builtin="checker" width="8" height="8"/>
    <hfield name="h" nrow="3" ncol="3" size="1 1 0.1 0.1"/>
    <mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1" scale="1 1 1"/>
  </asset>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <geom type="hfield" hfield="h" pos="0 0 -1"/>
    <body name="b" pos="0 0 0.1"><joint name="j" range="-1 1" damping="0.1" stiffness="1"/><geom size="0.1" mass="1"/>
      <body pos="0.3 0 0"><joint name="k" axis="0 1 0"/><geom type="mesh" mesh="m"/><site name="s"/></body>
    </body>
    <replicate count="2" offset="1 0 0"><geom type="box" size="0.1 0.1 0.1" pos="3 0 0"/></replicate>
    <flexcomp name="f" type="grid" count="3 3 1" spacing="0.1 0.1 0.1" dim="2" pos="0 0 3" mass="1"/>
  </worldbody>
  <tendon><fixed name="n" range="0 1"><joint joint="j" coef="1"/></fixed></tendon>
  <equality><joint joint1="j" joint2="k" polycoef="0 1 0 0 0"/></equality>
  <actuator><general name="a" joint="j" dyntype="integrator" dynprm="1" delay="0.01" nsample="8"/></actuator>
  <sensor><rangefinder site="s" cutoff="1"/><jointpos joint="j" noise="0.1" delay="0.01" nsample="4"/></sensor>
  <custom><numeric name="z" size="3" data="1 2 3"/></custom>
  <keyframe><key time="0"/></keyframe>
</mujoco>
"""


def models(folder: Path) -> Change:
    """MJCF of the examples, as they come, and with the values of one attribute for another's."""
    import mujoco

    from sipe_bayes.envs.foreign.load import compile_spec, load_spec
    from sipe_bayes.envs.foreign.quiet import quiet

    texts = [f.read_text(encoding="utf-8") for f in sorted(EXAMPLES.glob("*/*.xml"))]
    texts += [RICH] * 5
    part = "<mujoco><worldbody><body><freejoint/><geom size='0.1'/></body></worldbody></mujoco>"
    values = (
        "1000000000",
        "1e-9",
        "0",
        "-1",
        "nan",
        "1e300",
        "1e-300",
        "",
        "x",
        "0 0 0",
        "inf",
        "4294967297",
        "../x",
        "2147483647",
    )

    def change(chance: random.Random) -> Read:
        text = chance.choice(texts)
        (folder / "part.xml").write_text(part)
        how = chance.random()
        if how < 0.7:
            for _ in range(chance.choice([1, 1, 2])):
                pieces = text.split('"')
                if len(pieces) > 2:
                    pieces[chance.randrange(1, len(pieces) - 1, 2)] = chance.choice(values)
                text = '"'.join(pieces)
        elif how < 0.8:
            (folder / "part.xml").write_bytes(mutations.of_bytes(part.encode(), chance))
            text = RICH
        else:
            text = mutations.of_bytes(text.encode(), chance).decode("utf-8", "ignore")
        path = folder / "model.xml"
        path.write_text(text, encoding="utf-8")

        def read() -> None:
            model = compile_spec(load_spec(str(path)), str(path))
            data = mujoco.MjData(model)
            with quiet:
                for _ in range(3):
                    mujoco.mj_step(model, data)

        return read

    return change


LOGS = (
    *(".csv", ".parquet", ".npz", ".h5", ".mat", "7.3", "meta/info.json", "v3", ".mcap", ".db3", "metadata.yaml"),
    ".ulg",
)
TARGETS: dict[str, tuple[Target, int]] = {
    **{f"log {kind}": (of_log(kind), 4) for kind in LOGS},
    "configuration": (configurations, 24),
    "problem": (problems, 4),
    "model": (models, 2),
}
"""By name, and how often of all."""
