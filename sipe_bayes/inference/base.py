"""The Estimator contract: ``posterior = Estimator(simulator, budget=..., seed=...).fit(trajectories)``.

A budget counts rollouts: one theta simulated over the horizon of one recorded log; finite differences count.
"""

from __future__ import annotations

import copy
import hashlib
import inspect
import json
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Self, TypeVar, cast

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.budget import BudgetExhausted, BudgetTooSmall, Deadline
from sipe_bayes.core.checkpoint import SearchState, Snapshot, Stored, load_state
from sipe_bayes.core.findings import Code, Findings, finding
from sipe_bayes.core.options import Options
from sipe_bayes.core.telling import silent
from sipe_bayes.core.trajectory import Trajectories, Trajectory
from sipe_bayes.core.validation import MOST_ROLLOUTS, flag, path, whole
from sipe_bayes.inference.recorded import Progress, Recorded, at_bounds, digest

if TYPE_CHECKING:
    from sipe_bayes.likelihood import BoundLikelihood, BoundStates, FitResult, Segments, StateSpace
    from sipe_bayes.posterior import Posterior
    from sipe_bayes.simulation.callable_simulator import CallableSimulator
    from sipe_bayes.simulation.simulator import Simulator

S = TypeVar("S", bound=SearchState)


class Estimator(ABC, Generic[S]):
    """Infers a posterior over theta from trajectories.

    Args:
        simulator: what is calibrated.
        prior: a posterior with a density over ``simulator.space``; default the one its parameters state.
        budget: rollouts it may use.
        seed: the same seed gives the same posterior.
        likelihood: how trajectories are compared, for the methods that use one.
        checkpoint: a file to go on from and to keep up to date; the same call after an interruption gives the posterior
            of an undisturbed run.
        progress: called along the way.
        **options: the fields of the method's ``options_type``.

    **Adding a method** takes one file and one line in ``inference.registry.ESTIMATORS``. Write a frozen dataclass of
    its state with a field ``done``, and three functions; the base class checks, seeds, counts the budget, keeps the
    checkpoint and resumes:

    - ``start(trajectories) -> State``.
    - ``step(state, trajectories) -> State``: a new state, one affordable piece of work further; ``done=True`` ends.
      When the budget runs out in mid-step, BudgetExhausted ends the fit with the last whole state.
    - ``posterior(state, trajectories) -> Posterior``: of any state, without simulating.

    Arguments of its own are the fields of a frozen dataclass of ``core.options``, set as ``options_type``, and come as
    ``self.options``. The simplest method draws from the prior and keeps the best::

        from dataclasses import dataclass, replace
        import numpy as np
        from sipe_bayes.core.arrays import FloatArray
        from sipe_bayes.core.findings import Code
        from sipe_bayes.core.options import Options, option
        from sipe_bayes.core.seeding import torch_generator
        from sipe_bayes.inference.base import Estimator
        from sipe_bayes.inference.search.discrepancy import StateDifference, channel_scale
        from sipe_bayes.posterior import Dirac

        @dataclass(frozen=True)
        class RandomSearchState:
            theta: FloatArray
            cost: FloatArray
            done: bool = False

        @dataclass(frozen=True)
        class RandomSearchOptions(Options):
            batch: int = option(1, "draws of a step", least=1)

        class RandomSearch(Estimator[RandomSearchState]):
            name = "random_search"
            options_type = RandomSearchOptions
            state_type = RandomSearchState
            options: RandomSearchOptions

            def start(self, trajectories):
                return RandomSearchState(np.empty((0, len(self.space))), np.empty(0))

            def step(self, state, trajectories):
                generator = torch_generator([self.seed, len(state.theta)])  # other draws with every seed
                theta = self.prior.sample((self.options.batch,), generator=generator).numpy()
                windows = self.windows(trajectories)
                predicted = windows.simulate(theta)  # raises BudgetExhausted
                cost = StateDifference(windows, channel_scale(windows, predicted))(predicted)
                return replace(
                    state, theta=np.concatenate([state.theta, theta]), cost=np.concatenate([state.cost, cost])
                )

            def posterior(self, state, trajectories):
                lost = int(np.isinf(state.cost).sum())
                if lost:
                    failure = self.simulator.failure
                    self.find(Code.DIVERGED_COUNT_AS_WORST, count=lost, total=len(state.cost), failure=failure)
                return Dirac(state.theta[state.cost.argmin()], self.space)

    ``find`` notes a finding, whose code and text stand in ``core.finding_texts``. What else a class may say of itself:

    - ``uses_prior = False``: the prior plays no part, or only at the beginning.
    - ``uncertain = False``: the spread is that of a search, not an uncertainty.
    - ``searches = True``: it looks for optima of a likelihood: takes ``StateSpace``, ``restarts`` and ``candidates``,
      and simulates in float64 on the processor.
    - ``amortised = True``: what one fit learned serves another; ``goes_on = True``: a larger budget goes on where a
      smaller one ended; ``default_budget``: rollouts.
    """

    name: ClassVar[str]
    amortised: ClassVar[bool] = False
    searches: ClassVar[bool] = False
    uses_prior: ClassVar[bool] = True
    uncertain: ClassVar[bool] = True
    default_budget: ClassVar[int] = 1000
    goes_on: ClassVar[bool] = False
    checkpoint_seconds: float = 1.0
    time_limit: float = math.inf  # s, after which a fit ends with its best estimate; no part of what a run is
    options_type: ClassVar[type[Options]] = Options
    state_type: ClassVar[type[SearchState]]  # the frozen dataclass of a method's state
    options: Options

    def __init__(
        self,
        simulator: Simulator | CallableSimulator,
        *,
        prior: Posterior | None = None,
        budget: int | None = None,
        seed: int = 0,
        likelihood: Segments | StateSpace | None = None,
        checkpoint: str | Path | None = None,
        progress: Progress | None = None,
        **options: object,
    ) -> None:
        from sipe_bayes.datasets.demonstrations import Given
        from sipe_bayes.inference.arguments import check_comparison, check_simulator, differentiable, stated_prior
        from sipe_bayes.likelihood import default_likelihood

        self.options = self.options_type.of(options, self.name)
        check_simulator(simulator)
        self.simulator, self.space = differentiable(simulator) if self.searches else simulator, simulator.space
        self._given_simulator = simulator
        self.prior = stated_prior(prior, self.space)
        self.budget = self.default_budget if budget is None else whole("budget", budget, 1, "rollouts", MOST_ROLLOUTS)
        self._own_budget = budget is None
        check_comparison(simulator, likelihood, progress, self.name, self.searches)
        self.seed = whole("seed", seed, 0)
        self.likelihood: Segments | StateSpace = likelihood or default_likelihood(simulator)  # the latter for searches
        self._own_likelihood = likelihood is None and self.searches
        self.checkpoint, self.progress = self.stored("checkpoint", checkpoint), progress
        self.rollouts, self.findings = 0, Findings()
        self.diagnostics: dict[str, Any] = {}
        self.announce: Callable[[str], None] = silent  # gets a first estimate in words, as soon as there is one
        self._last: Snapshot[S] | None = None
        self._run = ""  # fingerprint of the run that it belongs to
        self._bound: tuple[Trajectories, BoundLikelihood | BoundStates] | None = None
        self._deadline = Deadline()
        self._given = Given()
        self._observed: Trajectory | None = None
        self.prepare()

    def prepare(self) -> None:
        """For a subclass: what it makes once."""
        self.check_options()

    def check_options(self) -> None:
        """Hold the options against simulator and likelihood, once all are set; raises ValueError."""

    def stored(self, name: str, given: object) -> Path | None:
        """The path that an argument gives; raises ValueError for a simulator that others there cannot be told from."""
        from sipe_bayes.inference.arguments import check_named

        check_named(self.simulator, name, given)
        return path(name, given)

    def __init_subclass__(cls) -> None:
        """Show the fields of a method's own options in the signature of its constructor."""
        super().__init_subclass__()
        if "options_type" in vars(cls) and "__init__" not in vars(cls):
            *common, _ = list(inspect.signature(Estimator.__init__).parameters.values())[1:]  # without self and options
            cls.__signature__ = inspect.Signature(common + cls.options_type.parameters())  # type: ignore[attr-defined]

    @abstractmethod
    def start(self, trajectories: Trajectories) -> S:
        """The first state."""

    @abstractmethod
    def step(self, state: S, trajectories: Trajectories) -> S:
        """One affordable piece of work further."""

    @abstractmethod
    def posterior(self, state: S, trajectories: Trajectories) -> Posterior:
        """Of a state, without simulating."""

    def fit(self, trajectories: Recorded, *, retrain: bool = False) -> Posterior:
        """Infer. Afterwards ``rollouts`` is what this fit simulated, with what a checkpoint of it had counted.

        Args:
            trajectories: one or several, or an environment, which stands for its reference demonstrations.
            retrain: begin from nothing: an amortised method forgets what it learned, and the checkpoint is replaced.

        Returns:
            The posterior given them.

        Raises:
            ValueError: for trajectories that do not fit the simulator.
            BudgetTooSmall: for a budget without an estimate.
            CheckpointError: for a checkpoint that is damaged or of another run.
        """
        batch, deadline = self._given.stack(self._recorded(trajectories), anew=True), self._set_deadline()
        self.choose_likelihood(batch)
        self.budget = self.budget_for(batch) if self._own_budget else self.budget
        fingerprint = self._fingerprint(batch)
        self.findings, self.diagnostics, self.rollouts, self._bound = Findings(), {}, 0, None
        last = None if flag("retrain", retrain) else self._resumed(batch, fingerprint)
        self._last, self._run = None, fingerprint
        if last is not None:
            self.go_on_from(last)
        first = last = last or self._started(batch)
        stored = Stored(self.checkpoint, fingerprint, last, self.checkpoint_seconds)
        try:
            while not last.state.done:
                last = self._keep(self.step(last.state, batch))
                stored.offer(last, last.state.done, self._is_short)
                self.tell(self.describe(last.state), self.rollouts)
                if deadline.hit or (time.monotonic() > deadline.ends and not last.state.done):
                    with suppress(BudgetTooSmall):  # there is no estimate yet
                        return self._ended_early(last.state, batch, stored)
        except BudgetExhausted:
            if deadline.hit:
                return self._ended_early(last.state, batch, stored)
            stored.write()
            self.find(Code.BUDGET_SPENT, budget=self.budget)
        except BaseException:  # whatever interrupts it; an earlier checkpoint outlives a failure in the first step
            self._set_deadline(math.inf)
            if self.checkpoint is not None and (last is not first or not self.checkpoint.exists()):
                with suppress(OSError):
                    stored.write()
            raise
        self._set_deadline(math.inf)
        return self._finished(last.state, batch)

    def _set_deadline(self, seconds: float | None = None) -> Deadline:
        """A time from now, by default ``time_limit``, after which nothing is simulated."""
        self._deadline = Deadline(time.monotonic() + (self.time_limit if seconds is None else seconds))
        if self._bound is not None:
            self._bound[1].deadline = self._deadline
        return self._deadline

    @property
    def _is_short(self) -> bool:
        """Whether there would have been more with a larger budget or more time."""
        return self._deadline.hit or (self._bound is not None and self._bound[1].short)

    def _ended_early(self, state: S, batch: Trajectories, stored: Stored[Snapshot[S]]) -> Posterior:
        """The posterior when the time limit has passed."""
        self._set_deadline(math.inf)
        posterior = self._finished(state, batch)
        stored.write()
        self.find(Code.TIME_LIMIT, seconds=self.time_limit)
        return posterior

    def tell(self, what: str, rollouts: int) -> None:
        """Progress, where it is wanted."""
        if self.progress is not None:
            self.progress(what, rollouts, self.budget)

    def budget_for(self, trajectories: Trajectories) -> int:
        """Where the user names none."""
        return self.default_budget

    def update_parameter_estimate(self, trajectories: Recorded) -> None:
        """One step of the method, as the paper's interface names it.

        Args:
            trajectories: as of ``fit``; they may differ from step to step.
        """
        batch, last = self._given.stack(self._recorded(trajectories)), self._last
        if last is None:
            self.choose_likelihood(batch)
            self._run, last = self._fingerprint(batch), self._started(batch)
        if not last.state.done:
            self.go_on_from(last)
            try:
                self._keep(self.step(last.state, batch))
            except BudgetExhausted:
                self.find(Code.BUDGET_SPENT, budget=self.budget)
                self._keep(replace(last.state, done=True))

    def get_parameter_estimate(self, trajectories: Recorded) -> Posterior:
        """The posterior of the present state."""
        if self._last is None:
            raise ValueError("get_parameter_estimate: nothing is fitted yet; call update_parameter_estimate first")
        self.go_on_from(self._last)
        return self._finished(self._last.state, self._given.stack(self._recorded(trajectories)))

    def choose_likelihood(self, batch: Trajectories) -> None:
        """The likelihood that suits the logs, where none was given."""
        from sipe_bayes.likelihood import default_likelihood

        if self._own_likelihood:
            self.likelihood = default_likelihood(self.simulator, batch)

    def _started(self, batch: Trajectories) -> Snapshot[S]:
        """The first state, kept."""
        try:
            return self._keep(self.start(batch))
        except BudgetExhausted as error:
            raise BudgetTooSmall(f"budget: {error}; raise it") from None

    def _resumed(self, trajectories: Trajectories, fingerprint: str) -> Snapshot[S] | None:
        """Where a fit goes on: at its checkpoint; amortised methods also where an earlier fit ended."""
        if self.checkpoint is None or not self.checkpoint.exists():
            return None
        return load_state(self.checkpoint, Snapshot[self.state_type], fingerprint)  # type: ignore[name-defined]

    def _finished(self, state: S, trajectories: Trajectories) -> Posterior:
        """The posterior, after a look at its bounds: a truth outside the prior must raise suspicion, not confidence."""
        from sipe_bayes.inference.arguments import device_findings

        posterior = self.posterior(state, trajectories)
        if at_bound := at_bounds(posterior, self.prior):
            self.find(Code.AT_BOUND, parameters=at_bound)
        self.findings.drop(Code.FLOAT32_AGREES, Code.FLOAT32_DIFFERS)  # of fewer rollouts
        again = partial(self.simulate_again, posterior.mean.numpy()[None], trajectories)
        self.findings.extend(device_findings(self.name, self._given_simulator, self.simulator, again))
        return posterior

    def simulate_again(self, theta: FloatArray, trajectories: Trajectories) -> None:
        """Simulate theta (n, N) as the method does, uncounted."""
        windows = copy.copy(self.windows(trajectories))
        windows.budget = math.inf
        windows.predict(theta, np.tile(windows.no_starts(), (len(theta), 1, 1)))

    def _recorded(self, given: Recorded) -> Any:
        """``given``, or the trajectory that an observed x (D,) of a CallableSimulator stands for."""
        from sipe_bayes.simulation.callable_simulator import CallableSimulator

        several = isinstance(given, list | tuple) and given and isinstance(given[0], Trajectory)
        if several or not isinstance(self.simulator, CallableSimulator) or isinstance(given, Trajectory | Trajectories):
            return given
        made = self.simulator.trajectory(given)
        if self._observed is None or not np.array_equal(made.observations, self._observed.observations, equal_nan=True):
            self._observed = made
        return self._observed

    def fresh(self) -> Self:
        """A copy that shares what was learned, and neither files, progress, findings nor the logs in hand."""
        again = copy.copy(self)
        again.checkpoint = again.progress = None
        again.findings, again.diagnostics = Findings(), {}
        again._given, again._bound = type(self._given)(), None
        return again

    @property
    def snapshot(self) -> Snapshot[S] | None:
        """The present state with what was counted and found, or None before the first."""
        return self._last

    @property
    def ended(self) -> bool:
        """Whether the search is over."""
        return self._last is not None and self._last.state.done

    @property
    def state(self) -> S | None:
        """The present state, or None before the first."""
        return None if self._last is None else self._last.state

    def go_on_from(self, last: Snapshot[S]) -> None:
        """Take up a search where a snapshot left it; what an estimate in between found is forgotten."""
        self._last, self.rollouts, self.findings = last, last.rollouts, Findings(last.findings)
        self.diagnostics = json.loads(last.diagnostics)

    def find(self, code: Code, *, parameters: Iterable[str] = (), log: str | None = None, **values: object) -> None:
        """Note a finding, once; as of ``core.findings.finding``."""
        self.findings.add(finding(code, parameters=parameters, log=log, severity=None, **values))

    @property
    def warnings(self) -> list[str]:
        """The texts of what was found."""
        return self.findings.warnings

    @property
    def doubts(self) -> list[str]:
        """Of the warnings those for which no interval is to be trusted."""
        return self.findings.doubts

    def describe(self, state: S) -> str:
        """What is being done, in a few words, for the progress bar."""
        return self.name

    @property
    def result(self) -> FitResult | None:
        """The best optimum of ``fit``, where the method searches for such."""
        return None

    def usual_rest(self) -> float | None:
        """Rollouts that the fit still takes as a rule; None where nothing is known of that."""
        return None

    def windows(self, trajectories: Trajectories) -> BoundLikelihood:
        """``bound``, for a method that takes no ``StateSpace``."""
        return cast("BoundLikelihood", self.bound(trajectories))  # as the constructor checks

    def bound(self, trajectories: Trajectories) -> BoundLikelihood | BoundStates:
        """The trajectories bound to the likelihood, budget counted; a ``StateSpace`` if the method ``searches``."""
        from sipe_bayes.likelihood import bind

        if self._bound is None or self._bound[0] is not trajectories:
            bound = bind(self.likelihood, self.simulator, trajectories)
            bound.budget, bound.rollouts = self.budget, self.rollouts
            self._bound = (trajectories, bound)
        return self._bound[1]

    def _keep(self, state: S) -> Snapshot[S]:
        """Count and remember a state with what was found until now."""
        if self._bound is not None:
            self.rollouts = self._bound[1].rollouts
        self._last = Snapshot(state, self.rollouts, tuple(self.findings), json.dumps(self.diagnostics))
        return self._last

    def settings(self) -> dict[str, object]:
        """Whatever changes the result besides the trajectories, as plain data; subclasses add theirs."""
        return {
            "estimator": self.name,
            "seed": self.seed,
            **({} if self.goes_on else {"budget": self.budget}),
            "likelihood": repr(self.likelihood),
            "space": self.space.to_dict(),
            "prior": [x.tolist() for x in self.prior.gaussian_moments()],
            "model": self.simulator.checksum(),
            **self.options.plain(),
        }

    def _fingerprint(self, trajectories: Trajectories) -> str:
        """What tells runs apart: all settings, and the trajectories."""
        return hashlib.sha256(f"{self.settings()!r}{digest(trajectories)}".encode()).hexdigest()
