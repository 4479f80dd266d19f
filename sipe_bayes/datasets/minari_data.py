"""Trajectories to and from Minari, the Farama Foundation's format of offline data sets (https://minari.farama.org).

``sipe.from_minari("mujoco/halfcheetah/expert-v0")`` reads a data set that is installed, whoever made it;
``sipe data export --minari NAME`` writes one. It is looked for, and written, where Minari has them: in the folder of
``MINARI_DATASETS_PATH``, default ~/.minari/datasets. Nothing is downloaded, and no code that a data set names is run:
one that does not say its spaces, for which Minari would make the environment that it names, is refused.

An observation that is a dictionary or a tuple becomes one row: its parts in the space's order, but the achieved and the
desired goal of a goal-based environment last, as in this library's Fetch tasks. Minari has no place for the physics
states: those exported here are in each episode's ``infos["state"]``, and come back.
"""

from __future__ import annotations

import shutil
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.files import LOG_GIB, FileError, limit, read_json, reading
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.envs.registry import TASKS

_GOALS = ("achieved_goal", "desired_goal")
_STATE = "state"
_METADATA, _HDF5 = "metadata.json", "main_data.hdf5"
_WHAT, _REMEDY = "a Minari data set", "see `minari list local`"


def from_minari(dataset: str | Path, dt: float | None = None) -> Trajectories:
    """The episodes of a Minari data set; rewards are kept, and states where this library wrote them.

    Args:
        dataset: its id, or the folder that it lies in.
        dt: of a control step, s; by default that of the data set's environment where Gymnasium knows it by itself, and
            must be given otherwise.

    Raises:
        ValueError: for what cannot be read.
        ModuleNotFoundError: without Minari.
    """
    minari, folder = _minari(), _data_folder(dataset)
    with reading(dataset, _WHAT, _REMEDY):
        _check_said(folder)
        opened = minari.MinariDataset(folder)
        spec = opened.spec.env_spec
    if dt is None:
        dt = _dt(spec, dataset)
    with reading(dataset, _WHAT, _REMEDY):
        episodes = [_trajectory(episode, dt, str(dataset)) for episode in opened.iterate_episodes()]
    if not episodes:
        raise ValueError(f"dataset: {dataset} holds no episodes; take another")
    return Trajectories.stack(episodes)


def to_minari(trajectories: Trajectories, dataset: str, task: str, description: str = "", command: str = "") -> Path:
    """Write trajectories as a new Minari data set, actions in float32.

    Args:
        trajectories: with rewards.
        dataset: its id.
        task: of the trajectories.
        description: of the data set.
        command: that made it.

    Returns:
        Its folder.

    Raises:
        ValueError: for a name that is none, or is taken.
    """
    minari = _minari()
    if trajectories.rewards is None:
        raise ValueError("trajectories: they hold no rewards, which Minari needs; export them without noise")
    import gymnasium

    import sipe_bayes.simulation.gym  # registers the ids

    folder, env = _new_folder(dataset), sipe_bayes.simulation.gym.make(task)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of authors that are not named
            minari.create_dataset_from_buffers(
                dataset,
                _buffers(trajectories),
                gymnasium.spec(f"sipe/{task}-v0"),
                observation_space=env.observation_space,
                action_space=env.action_space,
                description=f"{description} Made by: {command}".strip(),
                requirements=["sipe-bayes"],
            )
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)  # no half of a data set
        raise
    return folder


def _new_folder(dataset: str) -> Path:
    """Where Minari will put a data set of that name; raises ValueError."""
    from minari.dataset.minari_dataset import parse_dataset_id
    from minari.storage.datasets_root_dir import get_dataset_path

    try:
        parse_dataset_id(dataset)
    except ValueError:
        raise ValueError(f"dataset: expected a name such as sipe/door/expert-v0, got {dataset!r}") from None
    folder = Path(get_dataset_path(dataset))
    if folder.exists():
        raise ValueError(f"dataset: {folder} exists; choose another name than {dataset}, or `minari delete {dataset}`")
    return folder


def _buffers(trajectories: Trajectories) -> list[Any]:
    """An EpisodeBuffer of each trajectory, cut off at its end."""
    from minari.data_collector.episode_buffer import EpisodeBuffer

    buffers = []
    for i, episode in enumerate(trajectories):
        ends = np.arange(len(episode)) == len(episode) - 1
        infos = None if episode.states is None else {_STATE: episode.states}
        actions = episode.actions.astype(np.float32)
        motion = (episode.observations, actions, episode.rewards)
        buffers.append(EpisodeBuffer(i, None, None, *motion, np.zeros_like(ends), ends, infos))
    return buffers


def _minari() -> Any:
    try:
        import minari
    except ImportError:
        raise ModuleNotFoundError("Minari is not installed: pip install 'minari[hdf5]'") from None
    return minari


def _data_folder(dataset: str | Path) -> Path:
    """Where a data set's files lie; raises ValueError where there is none."""
    from minari.storage.datasets_root_dir import get_dataset_path

    folder = Path(dataset)
    if not folder.is_dir():
        with reading(dataset, _WHAT, _REMEDY):
            folder = Path(get_dataset_path(str(dataset)))
    inside = folder / "data" if (folder / "data").is_dir() else folder
    if not (inside / _METADATA).is_file():
        raise ValueError(f"dataset: {dataset} cannot be read as {_WHAT} (no {_METADATA} in {inside}); {_REMEDY}")
    return inside


def _check_said(folder: Path) -> None:
    """See that nothing has to be run to read a data set, and that it claims no more than it may.

    Raises:
        ValueError: within ``reading``.
    """
    metadata = read_json(folder / _METADATA, "what a Minari data set says of itself", _REMEDY)
    missing = [name for name in ("observation_space", "action_space") if not isinstance(metadata.get(name), str)]
    if missing:
        raise FileError(f"{folder / _METADATA}: has no {missing[0]}, and what it names is not run; export it anew")
    if (folder / _HDF5).is_file():
        _check_size(folder / _HDF5)


def _check_size(path: Path) -> None:
    import h5py

    sizes: list[int] = []
    with h5py.File(path, "r") as file:
        file.visititems(lambda _, item: sizes.append(item.nbytes) if isinstance(item, h5py.Dataset) else None)
    if sum(sizes) > max(limit(LOG_GIB) * 2**30, path.stat().st_size):
        raise ValueError(f"claims {sum(sizes) / 2**30:.3g} GiB, the most is {limit(LOG_GIB):g} ({LOG_GIB})")


def _dt(spec: Any, dataset: str | Path) -> float:
    """Seconds of a control step of an environment that Gymnasium makes by its id."""
    import gymnasium

    import sipe_bayes.simulation.gym

    remedy = f"dataset: {dataset} does not say how long a control step is; pass dt in seconds"
    if spec is None or spec.id not in gymnasium.registry:
        raise ValueError(remedy)
    name = spec.id.removeprefix("sipe/").removesuffix("-v0")
    if name in TASKS:
        return sipe_bayes.simulation.gym.make(name).simulator.dt
    try:
        env = gymnasium.make(spec.id)
    except Exception as error:  # whatever a foreign environment raises
        raise ValueError(f"{remedy} ({spec.id}: {' '.join(str(error).split())})") from None
    dt = getattr(env.unwrapped, "dt", None)
    env.close()
    if not isinstance(dt, int | float) or not dt > 0:
        raise ValueError(remedy)
    return float(dt)


def _trajectory(episode: Any, dt: float, dataset: str) -> Trajectory:
    observations, actions = _rows(episode.observations, True), _rows(episode.actions, False)
    states = None if not isinstance(episode.infos, dict) else episode.infos.get(_STATE)
    try:
        return Trajectory(
            observations, actions, dt, states, str(episode.id), rewards=np.asarray(episode.rewards, float)
        )
    except ValueError as error:
        raise FileError(f"dataset: {dataset}, episode {episode.id}: {error}") from None


def _rows(values: Any, goals_last: bool) -> FloatArray:
    """(T, O) of arrays (T, ...), or of dictionaries and tuples of such."""
    if isinstance(values, dict):
        keys = list(values)
        if goals_last:
            keys = [k for k in keys if k not in _GOALS] + [k for k in _GOALS if k in values]
        return np.concatenate([_rows(values[key], goals_last) for key in keys], axis=1)
    if isinstance(values, tuple):
        return np.concatenate([_rows(part, goals_last) for part in values], axis=1)
    array = np.asarray(values)
    if not (np.issubdtype(array.dtype, np.number) or array.dtype == bool):
        raise FileError(f"dataset: expected numbers, got {array.dtype}; convert it first")
    return array.reshape(len(array), -1).astype(np.float64)
