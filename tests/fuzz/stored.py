"""Files that this package writes itself, changed: posteriors, policies, records, trajectories, checkpoints."""

from __future__ import annotations

import hashlib
import json
import random
import zipfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.numpy import save

from tests.fuzz import mutations
from tests.fuzz.mutations import Change, Read, changed_json, text_of


def posteriors(folder: Path) -> Change:
    """A posterior of every family: both files, the checksum made to fit, and it is asked for moments and draws."""
    from sipe_bayes.posterior import Dirac, load_posterior, uniform
    from sipe_bayes.posterior.storage import pair_paths
    from tests.problems.posteriors import example_flow, example_particles, random_mixture, space_of
    from tests.problems.surrogates import example_surrogate

    made = [
        *(Dirac([0.5, 0.2], space_of(2)), uniform(space_of(2)), random_mixture(2), example_particles(2)),
        *(example_flow(1), example_surrogate(space_of(1), 400)),
    ]
    held = []
    for k, posterior in enumerate(made):
        posterior.save(folder / f"sound{k}")
        tensors, header = pair_paths(folder / f"sound{k}")
        from safetensors.numpy import load

        held.append((json.loads(header.read_text()), load(tensors.read_bytes()), tensors.read_bytes()))

    def change(chance: random.Random) -> Read:
        plain, arrays, content = held[chance.randrange(len(held))]
        how = chance.random()
        if how < 0.4:
            plain = mutations.of_data(plain, chance)
        elif how < 0.8:
            content = save(mutations.of_arrays(arrays, chance)) if arrays else content
        else:
            content = mutations.of_bytes(content, chance)
        if isinstance(plain, dict) and chance.random() < 0.9:
            plain = {**plain, "sha256": hashlib.sha256(content).hexdigest()}
        tensors, header = pair_paths(folder / "fuzzed")
        tensors.write_bytes(content)
        text = text_of(plain)
        header.write_bytes(mutations.of_bytes(text, chance) if chance.random() < 0.1 else text)

        def read() -> object:
            with torch.no_grad():
                posterior = load_posterior(folder / "fuzzed")
                draws = posterior.sample((3,))
                return posterior.mean, draws, posterior.log_prob(draws) if posterior.has_density else None

        return read

    return change


def policies(folder: Path) -> Change:
    """An actor's file, the checksum of its arrays made to fit."""
    from safetensors import safe_open

    from sipe_bayes.models import policy as policies
    from tests.problems.policies import policy

    path = folder / "policy.safetensors"
    policy().save(path)
    whole = path.read_bytes()
    with safe_open(path, framework="numpy") as file:
        header = json.loads(file.metadata()["policy"])
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118

    def change(chance: random.Random) -> Read:
        how = chance.random()
        if how < 0.3:
            content = mutations.of_bytes(whole, chance)
        else:
            some = mutations.of_arrays(arrays, chance) if how < 0.7 else arrays
            plain = mutations.of_data(header, chance) if how > 0.6 else header
            digest = hashlib.sha256()
            for name in sorted(some):
                digest.update(name.encode() + some[name].tobytes())
            if isinstance(plain, dict):
                plain = {**plain, "sha256": digest.hexdigest()}
            content = save(some, {"policy": text_of(plain).decode("utf-8", "replace")})
        path.write_bytes(content)

        def read() -> object:
            actor = policies.load_policy(path)
            return actor(np.zeros((1, actor.observation_size)))

        return read

    return change


def records(folder: Path) -> Change:
    """A folder of the benchmark: records, plan and runs; asked for its state and its report's numbers."""
    from sipe_bayes.benchmark.records import PLAN, plan, record_path
    from sipe_bayes.benchmark.run_log import RUNS, Run, Took, write_runs
    from sipe_bayes.benchmark.status import summary
    from tests.problems.benchmark_records import make

    every = [make(seed=k) for k in range(2)]
    for record in every:
        record.write(folder)
    plan(folder, [record.id for record in every])
    write_runs(folder, [Run("sipe benchmark run --suite quick", "2026-01-01", 2, 2, 3.0, 2.0, Took(1.0, 1.0))])
    files = [record_path(folder, every[0].id), folder / PLAN, folder / RUNS]
    whole = {file: file.read_bytes() for file in files}

    def change(chance: random.Random) -> Read:
        for file, data in whole.items():
            file.write_bytes(data)
        file = chance.choice([files[0], *files])
        file.write_bytes(changed_json(json.loads(whole[file]), chance))
        return lambda: summary(folder).lines()

    return change


def trajectories(folder: Path) -> Change:
    """Npz files of the package's own: trajectories, a replay buffer, simulations, fits of a check."""
    from sipe_bayes.calibration.check import Fit
    from sipe_bayes.core.trajectory import Trajectories, Trajectory
    from sipe_bayes.rl.replay import Replay

    rng = np.random.default_rng(0)
    items = [Trajectory(rng.random((5, 2)), rng.random((4, 1)), 0.1, rng.random((5, 3)), "a", ("x", "y"))] * 2
    Trajectories.stack(items).save(folder / "sound.npz")
    buffer = Replay(2, 1, 20)
    buffer.save(folder / "replay.npz")
    Fit(rng.random(2), rng.random((5, 2)), 3, 0.1).save(folder / "fit.npz")
    readers: dict[str, Callable[[Path], object]] = {
        "sound.npz": lambda path: list(Trajectories.load(path)),
        "replay.npz": lambda path: Replay(2, 1, 20).load(path),
        "fit.npz": Fit.load,
    }
    whole = {name: (folder / name).read_bytes() for name in readers}
    arrays = {}
    for name in readers:
        with np.load(folder / name) as data:
            arrays[name] = dict(data)

    def change(chance: random.Random) -> Read:
        name, path = chance.choice(["sound.npz", *readers]), folder / "fuzzed.npz"
        if chance.random() < 0.5:
            path.write_bytes(mutations.of_bytes(whole[name], chance))
        else:
            np.savez(path, **mutations.of_arrays(arrays[name], chance))
        return lambda: readers[name](path)

    return change


def trajectory_sets(folder: Path) -> Change:
    """A set of demonstrations and its manifest, whose checksums are made to fit."""
    from sipe_bayes.datasets import trajectory_sets as sets

    arrays = {
        "start": np.zeros(3),
        "states": np.zeros((1, 4, 3)),
        "actions": np.zeros((1, 3, 1), np.float32),
        "rewards": np.zeros((1, 3)),
        "dt": np.array(0.05),
    }
    np.savez(folder / "a.npz", **arrays)
    whole = (folder / "a.npz").read_bytes()

    def change(chance: random.Random) -> Read:
        content = whole
        if chance.random() < 0.7:
            content = mutations.of_bytes(whole, chance)
        (folder / "a.npz").write_bytes(content)
        entry = asdict(sets.Entry(hashlib.sha256(content).hexdigest(), len(content), 1, 3, (0.1, 0.2)))
        plain: Any = {"format": sets.FORMAT, "sets": {"a.npz": entry}}
        if chance.random() < 0.4:
            plain = mutations.of_data(plain, chance)
        (folder / sets.MANIFEST).write_bytes(text_of(plain))
        return lambda: sets.verify(folder)

    return change


@dataclass(frozen=True)
class _Inner:
    values: np.ndarray
    rate: float


@dataclass(frozen=True)
class _State:
    theta: torch.Tensor
    inner: _Inner | None
    names: tuple[str, ...]
    count: int
    by_name: dict[str, float]
    done: bool = False


def checkpoints(folder: Path) -> Change:
    """A search's state."""
    from sipe_bayes.core.checkpoint import load_state

    path = folder / "state.safetensors"
    state = _State(torch.zeros(2, 3), _Inner(np.arange(3.0), 0.1), ("a", "b"), 3, {"x": 1.0})
    return of_state(path, state, lambda: load_state(path, _State, "mine"))


def of_state(path: Path, state: Any, read: Read) -> Change:
    """A state's checkpoint, with a checksum that fits."""
    from safetensors import safe_open

    from sipe_bayes.core import checkpoint
    from sipe_bayes.core.checkpoint import save_state

    save_state(path, state, "mine")
    whole = path.read_bytes()
    with safe_open(path, framework="numpy") as file:
        plain = json.loads(file.metadata()["plain"])
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118

    def change(chance: random.Random) -> Read:
        if chance.random() < 0.4:
            path.write_bytes(mutations.of_bytes(whole, chance))
        else:
            some = mutations.of_arrays(arrays, chance) if chance.random() < 0.5 else arrays
            text = text_of(mutations.of_data(plain, chance)).decode("utf-8", "replace")
            checksum = checkpoint.checksum(some, text)
            path.write_bytes(save(some, {"plain": text, "fingerprint": "mine", "sha256": checksum}))
        return read

    return change


def descriptions(folder: Path) -> Change:
    """Small files beside others: randomisation, card, counts, learning curve, facts, shards, a run's record."""
    from sipe_bayes.benchmark import bank
    from sipe_bayes.calibration.output import claimed
    from sipe_bayes.rl.demonstrate import facts_of
    from sipe_bayes.rl.evaluation import read_card
    from sipe_bayes.rl.randomization import load_randomization
    from sipe_bayes.rl.train import COUNTS, read_counts, read_curve

    row = {"name": "m", "low": 0.0, "high": 1.0, "unit": "kg", "targets": {"body:b.mass": 1.0}, "mean": 0.5}
    evaluation = {"episodes": 3, "seed": 0, "mean": 1.0, "sd": 0.1, "standard_error": 0.1, "diverged": 0}
    counts = {"steps": 1, "updates": 1, "redrawn": 0, "diverged": 0, "asked": 1, "fingerprint": "x"}
    which = bank.Bank("Pendulum", "default", 0, 5)
    run = {"config_sha256": "a", "seed": 0}

    def come_back() -> None:
        with claimed(folder / "run", run, keys=tuple(run)):
            pass

    kinds: dict[str, tuple[Any, Callable[[], object]]] = {
        "d.json": (
            {"parameters": [row], "covariance": [[0.01]], "observation_noise": 0.1, "action_delay": 1},
            lambda: load_randomization(folder / "d.json").posterior.mean,
        ),
        "agent.json": ({"evaluation": evaluation}, lambda: read_card(folder / "agent.safetensors")),
        COUNTS: (counts, lambda: read_counts(folder)),
        "shown.json": ({"task": "Door", "count": 3}, lambda: facts_of(folder / "shown.npz")),
        f"{bank.FOLDER}/k/shard-000000.json": (
            {"bank": which.id, "cpu_seconds": 1.0},
            lambda: (bank.known_place(which, folder), bank.cost(folder / bank.FOLDER, "k")),
        ),
        "run/run.json": (run, come_back),
    }
    columns = "step,return_mean,return_sd,success_rate,wall_seconds,updates_per_second"
    curve = f"{columns}\n1,0.5,0.1,,0.1,5.0\n2,0.7,0.2,0.5,0.2,5.0\n"
    (folder / "run").mkdir()
    (folder / bank.FOLDER / "k").mkdir(parents=True)

    def change(chance: random.Random) -> Read:
        name = chance.choice([*kinds, "curve.csv"])
        if name == "curve.csv":
            (folder / name).write_bytes(mutations.of_bytes(curve.encode(), chance))
            return lambda: read_curve(folder)
        plain, read = kinds[name]
        (folder / name).write_bytes(changed_json(plain, chance))
        return read

    return change


def learned_rewards(folder: Path) -> Change:
    """A discriminator's state, as a search's checkpoint holds it."""
    from sipe_bayes.core.checkpoint import load_state
    from sipe_bayes.models.discriminator import Discriminator, Training, TrainingState

    def load() -> None:
        Training(Discriminator(3, 0, 4), 1e-3).load(load_state(path, TrainingState, "mine"))

    path = folder / "state.safetensors"
    return of_state(path, Training(Discriminator(3, 0, 4), 1e-3).state(), load)


def archives(folder: Path) -> Change:
    """An archive of trajectory sets; nothing is stored, as none has what the manifest says."""
    from sipe_bayes.datasets import archive, trajectory_sets

    path, (name, *_) = folder / "sets.zip", sorted(trajectory_sets.manifest(trajectory_sets.IN_PACKAGE))
    with zipfile.ZipFile(path, "w") as opened:
        opened.writestr(name, b"content", zipfile.ZIP_DEFLATED)
    whole = path.read_bytes()

    def change(chance: random.Random) -> Read:
        path.write_bytes(mutations.of_bytes(whole, chance))
        return lambda: archive.install(path)

    return change


def entries(folder: Path) -> Change:
    """An entry of the leaderboard: what made it, and its answers to a task."""
    from sipe_bayes.benchmark.leaderboard import entry as board
    from sipe_bayes.benchmark.leaderboard.registry import TASKS
    from sipe_bayes.benchmark.leaderboard.scoring import made

    task = TASKS["two_moons"]
    problem = made(task.name)
    board.Entry("mine", "command", [0], {"numpy": "2"}).write(folder)
    answers = {case.name: board.Answer([[0.1, 0.2], [0.3, 0.1]], 3, 0.1) for case in problem.cases[:2]}
    board.Answers(task.name, task.definition(problem), list(problem.space.names), answers).write(folder)
    files = {
        path: json.loads(path.read_text()) for path in (folder / board.ENTRY, board.answers_path(folder, task.name))
    }

    def change(chance: random.Random) -> Read:
        changed = chance.choice(list(files))
        for path, plain in files.items():
            path.write_bytes(changed_json(plain, chance) if path == changed else text_of(plain))
        return lambda: (board.Entry.read(folder), board.read_answers(folder, task, problem))

    return change


def minari_sets(folder: Path) -> Change:
    """A Minari data set: what it says of itself, and its HDF5."""
    import h5py

    from sipe_bayes.datasets.minari_data import from_minari

    def box(size: int) -> str:
        return json.dumps(
            {"type": "Box", "dtype": "float64", "shape": [size], "low": [-9.0] * size, "high": [9.0] * size}
        )

    spec = {"id": "Pendulum-v1", "entry_point": None, "additional_wrappers": [], "kwargs": {}}
    plain = {
        **{"total_episodes": 1, "total_steps": 3, "dataset_id": "tests/own-v0", "minari_version": "0.5.4"},
        **{"data_format": "hdf5", "observation_space": box(2), "action_space": box(1), "env_spec": json.dumps(spec)},
    }
    data, metadata = folder / "set" / "data" / "main_data.hdf5", folder / "set" / "data" / "metadata.json"
    data.parent.mkdir(parents=True)
    with h5py.File(data, "w") as file:
        group = file.create_group("episode_0")
        group.attrs.update(id=0, total_steps=3)
        group["observations"], group["actions"], group["rewards"] = np.zeros((4, 2)), np.zeros((3, 1)), np.zeros(3)
        group["terminations"], group["truncations"] = np.zeros(3, bool), np.ones(3, bool)
    whole = data.read_bytes()

    def change(chance: random.Random) -> Read:
        data.write_bytes(whole)
        metadata.write_bytes(text_of(plain))
        if chance.random() < 0.5:
            data.write_bytes(mutations.of_bytes(whole, chance))
        else:
            metadata.write_bytes(changed_json(plain, chance))
        return lambda: from_minari(folder / "set", dt=0.1)

    return change


STORED = {
    "posterior": (posteriors, 20),
    "policy": (policies, 10),
    "records": (records, 20),
    "trajectories": (trajectories, 12),
    "trajectory sets": (trajectory_sets, 8),
    "checkpoint": (checkpoints, 8),
    "descriptions": (descriptions, 16),
    "learned reward": (learned_rewards, 6),
    "archive": (archives, 4),
    "minari": (minari_sets, 8),
    "leaderboard": (entries, 8),
}
"""By name, and how often of all."""
