"""Laplace's approximation of the posterior by windowed least squares.

Theta and the windows' starts minimise the whitened squares of the residuals plus the prior (``least_squares``), the
noise maximises its restricted likelihood (``sipe_bayes.likelihood.noise``); the two alternate, after a rough search with white
noise of the size of the present residuals. At the optimum the starts are marginalised and the curvature gives a normal in
theta, truncated to the unit cube. Where a parameter sits at a bound, the normal's mean lies beyond it, at the optimum
of the quadratic model: the truncated density is right up to the bound.

With ``noise="sandwich"`` the optimum is that of plain least squares and only the width comes from the autoregressive
noise (``noise_spread.sandwich``). Where the model is wrong at low frequencies, the full likelihood puts the misfit down to slow
noise and may leave the parameters behind it undetermined; plain least squares keeps what predicts best.

Several starting points (the model as given and the best of a few draws from the prior) are followed; optima that are
not the same become components of a mixture, weighted by their restricted likelihood; with ``StateSpace`` also by the prior of the
process noise and the price of jumps let go.

The curvature at the optimum need not be that of the posterior. Where a few points around a single optimum say that it is not, the normal gives way to
kernels on importance draws, or a warning (``importance``, which costs 2 N + 1 rollouts, and some hundreds where the normal is wrong). It is not asked where the starts are
estimated or states inferred, where there are several optima, where residuals are as small as the simulation's rounding or intervals as small as the search resolves, where the
intervals are guessed, or where the budget has no room left for draws.

How the search spares simulations, follows ridges and looks around an optimum is said in ``window_search``. With ``StateSpace`` every
sample's state is unknown and the search is that of ``state_space_search``, or where the first ones are known of ``known_start_search``.

Deviations from the textbook: directions that the data leave open get a normal of sd 10 about the cube's centre, flat
within the cube to half a percent, so that the covariance exists and the result does not depend on the start; the
uncertainty of the noise widens the normal by the moments over a handful of weighted noise values (not with ``StateSpace``). Residuals below what the
simulation's own rounding leaves are no independent evidence: such a channel counts as one sample, not as many.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from sipe_bayes.core.arrays import FloatArray
from sipe_bayes.core.findings import Code
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.laplace import importance
from sipe_bayes.inference.laplace.chain_state import ChainOptimum, ChainState, process_diagnostics
from sipe_bayes.inference.laplace.importance import Draws
from sipe_bayes.inference.laplace.known_start_search import KnownStartSearch
from sipe_bayes.inference.laplace.least_squares import FLAT_PRECISION, QuadraticPrior
from sipe_bayes.inference.laplace.options import LaplaceOptions
from sipe_bayes.inference.laplace.pattern_search import SHORTEST
from sipe_bayes.inference.laplace.state_space_search import StateSpaceSearch
from sipe_bayes.inference.laplace.strategy import Optimum, SearchProblem, Strategy, distinct, mixture
from sipe_bayes.inference.laplace.window_search import WindowSearch
from sipe_bayes.inference.laplace.window_state import WindowOptimum, WindowState
from sipe_bayes.inference.laplace.window_target import WindowFit, WindowTarget
from sipe_bayes.likelihood.settings import BudgetTooSmall
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.posterior import GaussianMixture

_SHARP = 10 * SHORTEST  # an sd that the look around the optimum may have set
_RANK = 1e-9  # of the largest eigenvalue of the data's information: below it a direction is open


@dataclass(frozen=True)
class LaplaceState:
    """A fit of ``laplace``.

    Args:
        search: the state of its ``Strategy``.
        draws: those that take the normal's place; None before them, and where it stands.
        done: whether both have ended.
    """

    search: WindowState | ChainState
    draws: Draws | None = None
    done: bool = False


class Laplace(Estimator[LaplaceState]):
    """Mixture of truncated normals at the optima of the likelihood; see the package's docstring.

    Args:
        restarts: starting points followed, at most.
        candidates: points among which they are chosen: draws from the prior and, of 40 or more, later ones around the
            best; without effect where ``known_start_search`` finds them.
        initial: (R, N), the starting points themselves instead.
        tuning: numbers of the search itself.
    """

    name: ClassVar[str] = "laplace"
    searches: ClassVar[bool] = True
    default_budget: ClassVar[int] = 5000
    options_type = LaplaceOptions
    state_type = LaplaceState
    options: LaplaceOptions

    def check_options(self) -> None:
        """Hold the starting points against the parameters, and into the cube."""
        initial = self.options.initial
        if initial is not None:
            inside = np.clip(np.atleast_2d(self.space.check_shape(initial)), 0, 1)
            self.options = replace(self.options, initial=inside)

    @property
    def problem(self) -> SearchProblem:
        """What its search is given."""
        return SearchProblem(self.space, self.prior, self.seed, self.options, self.options.initial, self.findings.add)

    def start(self, trajectories: Trajectories) -> LaplaceState:
        """The first state of the search that fits the likelihood."""
        return LaplaceState(self._strategy(self.windows(trajectories)).start())

    def describe(self, state: LaplaceState) -> str:
        """Starting point and step, or draws."""
        if state.draws is not None:
            return f"laplace: {len(state.draws.values)} importance draws"
        return f"laplace: {state.search.describe()}"

    def step(self, state: LaplaceState, trajectories: Trajectories) -> LaplaceState:
        """A step of the search, or, where it has ended, one more batch of draws."""
        windows = self.windows(trajectories)
        if state.draws is not None:
            return self._drawn(windows, state, state.draws)
        search = self._strategy(windows).step(state.search)
        state = replace(state, search=search)
        return self._probed(windows, state) if search.done else state

    def _strategy(self, windows: Windows | Chain) -> Strategy[Any]:
        """The search that fits the likelihood."""
        if not isinstance(windows, Chain):
            return WindowSearch(self.problem, windows)
        known = windows.settings.starts == "recorded"
        return KnownStartSearch(self.problem, windows) if known else StateSpaceSearch(self.problem, windows)

    def _probed(self, windows: Windows | Chain, state: LaplaceState) -> LaplaceState:
        """The state of a finished search; not done where the posterior is no normal and draws are to take its place."""
        ended, tuning, n = replace(state, done=True), self.options.tuning.importance, len(self.space)
        if isinstance(windows, Chain) or windows.num_start or windows.settings.noise == "sandwich":
            return ended
        kept = _kept(state)
        batches = tuning.hopeless_after * importance.batch_size(n, tuning)
        least = (importance.probe_size(n) + batches) * len(windows.trajectories)
        if len(kept) != 1 or not isinstance(kept[0], WindowOptimum) or kept[0].guessed:
            return ended
        if windows.rollouts + least > windows.budget or np.sqrt(np.diag(kept[0].covariance)).min() < _SHARP:
            return ended
        target = self._target(windows, kept[0])
        if target.silent or importance.is_normal(target, kept[0].theta, kept[0].mean, kept[0].covariance, tuning):
            return ended
        return replace(state, draws=Draws.none(n))

    def _drawn(self, windows: Windows, state: LaplaceState, draws: Draws) -> LaplaceState:
        """One more batch of draws, as long as they promise something and the budget lasts."""
        kept, tuning, n = _kept(state), self.options.tuning.importance, len(self.space)
        normal, target = mixture(kept, self.space), self._target(windows, kept[0])
        draws = importance.draw(draws, target, normal, self.prior, self.seed, tuning)
        effective = importance.effective(importance.weights(draws, self.prior))
        hopeless = draws.batches >= tuning.hopeless_after and effective < draws.batches
        room = windows.rollouts + importance.batch_size(n, tuning) * len(windows.trajectories) <= windows.budget
        done = effective >= tuning.enough or draws.batches >= tuning.most_batches or hopeless or not room
        return replace(state, draws=draws, done=done)

    def _target(self, windows: Windows, optimum: Optimum) -> WindowTarget:
        assert isinstance(optimum, WindowOptimum)
        return WindowTarget(self.prior, windows, WindowFit.at(windows, optimum))

    def posterior(self, state: LaplaceState, trajectories: Trajectories) -> GaussianMixture:
        """The optima's normals, or kernels on the draws that take their place.

        Args:
            state: of a fit.
            trajectories: the logs.

        Raises:
            BudgetTooSmall: where there is no optimum yet.
        """
        kept = _kept(state)
        if not kept:
            step = self._strategy(self.windows(trajectories)).step_rollouts
            raise BudgetTooSmall(
                f"budget: {self.budget} rollouts were not enough for one optimum; "
                f"one step takes {step} rollouts, so raise the budget"
            )
        self._report(kept)
        normals = mixture(kept, self.space)
        if state.draws is None:
            return normals
        tuning, weight = self.options.tuning.importance, importance.weights(state.draws, self.prior)
        effective = importance.effective(weight)
        self.diagnostics["draws"] = {"draws": len(weight), "effective": effective}
        if effective >= tuning.least:
            return importance.kernels(state.draws.points, weight, self.space, self.seed, tuning)
        if state.done:
            self.find(Code.TOO_FEW_DRAWS, draws=len(weight), effective=effective)
        return normals

    def _report(self, kept: list[Optimum]) -> None:
        """Diagnostics of the best optimum, and what is to be said against any that is kept."""
        best = kept[0]
        self.diagnostics = {"modes": len(kept), "noise_sd": best.sd.tolist(), "noise_tau": best.tau.tolist()}
        if isinstance(best, ChainOptimum):
            self.diagnostics |= process_diagnostics(best.process, best.movement, best.loose)
            if not best.settled:
                self.find(Code.PROCESS_NOISE_UNSETTLED)
        for optimum in kept:
            if isinstance(optimum, WindowOptimum) and optimum.finding is not None:
                self.findings.add(optimum.finding)
        if len(kept) > 1:
            self.find(Code.SEPARATE_OPTIMA, count=len(kept))

    def information(self) -> tuple[FloatArray, FloatArray]:
        """Optimum (N,), perhaps outside the cube, and information (N, N) of the data alone, after ``fit``."""
        kept = [] if self.state is None else _kept(self.state)
        if not kept:
            raise ValueError("information: nothing has been fitted yet; call fit first")
        prior, mean, total = QuadraticPrior.of(self.prior), kept[0].mean, np.linalg.inv(kept[0].covariance)
        flat = FLAT_PRECISION * np.eye(len(mean))
        eigenvalues, axes = np.linalg.eigh(total - prior.precision - flat)
        information = (axes * np.maximum(eigenvalues, 0.0)) @ axes.T
        right = total @ mean - prior.precision @ prior.mean - flat @ np.full(len(mean), 0.5)
        return np.linalg.pinv(information, rcond=_RANK, hermitian=True) @ right, information


def _kept(state: LaplaceState) -> list[Optimum]:
    """The optima worth keeping, best first."""
    return [state.search.optima[k] for k in distinct(state.search.optima)]
