"""From logs to the set of structures that they support, with budget, checkpoint, resume and progress."""

from __future__ import annotations

import hashlib
import math
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sipe_bayes.core.checkpoint import fingerprint_of, load_state, save_state
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.core.validation import MOST_ROLLOUTS, cores, nearest_name, whole
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.inference.recorded import Progress, digest
from sipe_bayes.likelihood import BoundLikelihood, Segments
from sipe_bayes.posterior import Posterior
from sipe_bayes.posterior import prior as default_prior
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.structure.extension import placements
from sipe_bayes.structure.fitted import Fitting
from sipe_bayes.structure.machine import machine_of
from sipe_bayes.structure.registry import EXTENSIONS, get_extension
from sipe_bayes.structure.search import StructureSearch
from sipe_bayes.structure.state import BUDGET, DiscoverOptions, DiscoverState, Phase
from sipe_bayes.structure.structures import Structures

FEWEST_APART = 4  # windows or spans in which nothing touches, without which nothing is asked of logs with impacts
LEAST_SPAN = 10  # control steps of such a span


@dataclass(frozen=True)
class Restriction:
    """Which extensions may be tried, and where.

    Args:
        only: names of extensions, or import paths of the user's own; default all of the registry.
        without: names that are left out.
        extra: import paths of the user's own, beside the registry's.
        sites: joints, actuators and channels where they may be placed; default all.

    Raises:
        ValueError: for names that do not exist; one line with the remedy.
    """

    only: tuple[str, ...] | None = None
    without: tuple[str, ...] = ()
    extra: tuple[str, ...] = ()
    sites: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        for name in self.without:
            if name not in EXTENSIONS:
                hint = nearest_name(name, EXTENSIONS) or f"; known are {', '.join(EXTENSIONS)}"
                raise ValueError(f"structure.without: no extension {name!r}{hint}")

    @property
    def names(self) -> list[str]:
        """Those that may be tried."""
        usual = [name for name in EXTENSIONS if not get_extension(name).by_name]
        chosen = [*(usual if self.only is None else self.only), *self.extra]
        return [name for name in dict.fromkeys(chosen) if name not in self.without]

    @property
    def digests(self) -> dict[str, str]:
        """SHA-256 of the files that hold the user's own."""
        files = {name: Path(name.rpartition(":")[0]) for name in self.names}
        return {n: hashlib.sha256(f.read_bytes()).hexdigest() for n, f in files.items() if f.suffix == ".py"}

    def environment(self, simulator: Simulator) -> MjcfEnvironment:
        """The user's model, which has all sites.

        Raises:
            ValueError: where it has not, or is not an MJCF.
        """
        environment = simulator.environment
        if not isinstance(environment, MjcfEnvironment):
            raise ValueError("simulator: structures are looked for in a user's MJCF; give a Simulator of one")
        model = environment.compile()
        joints = [model.joint(j).name for j in range(model.njnt)]
        known = [name for name in (*joints, *environment.actuators, *environment.channels) if name]
        for site in self.sites or ():
            if site not in known:
                hint = nearest_name(site, known) or f"; the model has {', '.join(known)}"
                raise ValueError(f"structure.sites: no joint, actuator or channel {site!r}{hint}")
        return environment

    def check(self, simulator: Simulator, trajectories: Trajectories, likelihood: Segments) -> None:
        """See before a search that sites exist, that extensions load, and that each of the user's own finds a place.

        Raises:
            ValueError: where it is not so; one line with the remedy.
        """
        self.environment(simulator)
        own = [get_extension(name) for name in self.names if name not in EXTENSIONS]
        if not own:
            return
        windows = BoundLikelihood(likelihood, simulator, trajectories)
        machine = machine_of(windows, np.clip(simulator.space.default_theta, 0, 1), windows.no_starts())
        for extension in own:
            if not list(placements(extension, machine)):
                raise ValueError(
                    f"structure: extension {extension.name!r} finds no {extension.kind} that it applies to in this "
                    "model; give its parameters targets that the model has, or leave it out"
                )


def discover(
    simulator: Simulator,
    trajectories: Trajectories,
    *,
    holdout: Trajectories | None = None,
    prior: Posterior | None = None,
    likelihood: Segments | None = None,
    restriction: Restriction | None = None,
    options: DiscoverOptions | None = None,
    budget: int = BUDGET,
    seed: int = 0,
    time_limit: float = math.inf,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
) -> Structures:
    """Search the physics that a model lacks.

    Args:
        simulator: of an ``MjcfEnvironment``, the user's model with its unknowns.
        trajectories: the logs; where bodies strike along them, the spans in which nothing touches are searched.
        holdout: logs that no structure is fitted to; they count as held-out pieces do.
        prior: of the unknowns; default their own.
        likelihood: how logs are cut into windows; the noise is coloured whatever it says.
        restriction: which extensions may be tried, and where.
        options: of the search.
        budget: rollouts at most.
        seed: of the searches.
        time_limit: s, after which the search ends with what it has; not before the model as it is was fitted.
        checkpoint: a file to go on from and to keep up to date; the same call goes on to the same bits, and one with
            a larger budget where the smaller one was spent.
        progress: called along the way.

    Raises:
        ValueError: for a simulator of anything but an MJCF, unknown extensions, sites that the model does not have, or
            logs in which bodies touch nearly all the time.
        CheckpointError: for a checkpoint that is damaged or of another run.
        SearchInterrupted: with what the search has, where it is interrupted.
    """
    ends = time.monotonic() + time_limit
    restriction, options = restriction or Restriction(), options or DiscoverOptions()
    environment = restriction.environment(simulator)
    extensions = [get_extension(name) for name in restriction.names]
    memory = sum(extension.memory(float(trajectories.dt.max())) for extension in extensions)
    late = [(c, float(own) + memory) for c, own in zip(environment.channels, environment.remembers, strict=True)]
    # a linearisation of the plain model takes a few seconds at most
    columns = 1 + len(simulator.space) + len(environment.start_sd(simulator.model))
    seconds = min(options.physics_steps, 2.5e5 / columns) * float(simulator.model.opt.timestep)
    likelihood = replace(likelihood or Segments(), noise="ar1", seconds=seconds, late=tuple(late))
    prior = default_prior(environment.space) if prior is None else prior
    seed, threads = whole("seed", seed, 0), simulator.num_threads or cores()
    fitting = Fitting(environment, trajectories, holdout, likelihood, prior, seed, threads, ends)
    if fitting.windows(simulator).impacts:
        fitting = _between_contacts(fitting, simulator)
    budget = whole("budget", budget, 1, "rollouts", MOST_ROLLOUTS)
    search = StructureSearch(fitting, extensions, restriction.sites, budget, progress)
    logs = digest(fitting.trajectories), None if fitting.holdout is None else digest(fitting.holdout)
    model = simulator.checksum(), environment.space.to_dict(), fitting.prior.gaussian_moments()
    tried = restriction, list(EXTENSIONS), restriction.digests
    fingerprint = fingerprint_of(model, logs, fitting.likelihood, seed, options, tried)
    state = DiscoverState(budget=budget)
    if checkpoint is not None and checkpoint.exists():
        enough = fitting.enough([]) / search.plain_share
        state = load_state(checkpoint, DiscoverState, fingerprint).with_budget(budget, enough)
    saved = -math.inf
    try:
        while not state.done:
            before, state = state, search.step(state)
            if checkpoint is not None and (state.done or time.monotonic() - saved > 1.0):
                save_state(checkpoint, before if state.cut else state, fingerprint)  # larger budgets take it anew
                saved = time.monotonic()
        search.place(state)
    except KeyboardInterrupt:
        search.ended = "interrupted"
        ended = state if state.done else replace(state, phase=Phase.DONE, cut=state.phase)
        raise SearchInterrupted(Structures(search, ended)) from None
    return Structures(search, state)


class SearchInterrupted(KeyboardInterrupt):
    """A search that was interrupted, with what it has so far in words and as ``structures``."""

    def __init__(self, structures: Structures) -> None:
        super().__init__(structures.so_far)
        self.structures = structures


def _between_contacts(fitting: Fitting, simulator: Simulator) -> Fitting:
    """The same on the spans of the logs in which nothing touches, held-out ones too, short spans as one window each."""
    environment = fitting.environment
    if environment.added or any(parameter.log is not None for parameter in environment.parameters):
        raise ValueError(
            "logs: bodies strike or slip along them, so that only spans without contact are searched; leave out known "
            "loads and parameters of single logs, which these spans do not have"
        )
    train, held = fitting.windows(simulator).spans_apart(LEAST_SPAN), list[Trajectory]()
    if fitting.holdout is not None:
        held = BoundLikelihood(fitting.likelihood, simulator, fitting.holdout).spans_apart(LEAST_SPAN)
    if sum(len(span) for span in train) < FEWEST_APART * LEAST_SPAN:
        raise ValueError(
            "logs: bodies touch nearly all the time, and structures cannot be compared through impacts; add what you "
            "suspect as parameters, fit with likelihood = 'state_space', and compare held-out errors"
        )
    window = fitting.likelihood.window
    short = [(span.name, None) for span in (*train, *held) if window and len(span) * span.dt < window]
    return replace(
        fitting,
        trajectories=Trajectories.stack(train),
        holdout=Trajectories.stack(held) if held else None,
        likelihood=replace(fitting.likelihood, windows=tuple(short)),
        spans=True,
    )
