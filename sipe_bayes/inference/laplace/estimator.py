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

from types import ModuleType
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from sipe_bayes.core.checkpoint import State
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.core.validation import whole
from sipe_bayes.inference.base import Estimator
from sipe_bayes.inference.laplace import importance, known_start_search, state_space_search, window_search
from sipe_bayes.inference.laplace.chain_state import process_diagnostics
from sipe_bayes.inference.laplace.least_squares import FLAT_PRECISION, QuadraticPrior
from sipe_bayes.inference.laplace.optima import distinct_modes
from sipe_bayes.inference.laplace.poll import SHORTEST
from sipe_bayes.inference.laplace.window_target import WindowTarget, at_optimum
from sipe_bayes.likelihood.settings import BudgetTooSmall
from sipe_bayes.likelihood.state_space.chain import Chain
from sipe_bayes.likelihood.windows import Windows
from sipe_bayes.posterior import GaussianMixture

FloatArray = NDArray[np.float64]

_LEAST_EIGENVALUE = 1e-12  # of a precision scaled to ones on its diagonal
_SHARP = 10 * SHORTEST  # an sd that the look around the optimum may have set
_LEAST_BATCHES = 6  # of importance draws for which the budget must have room, and before they are called hopeless
UNSETTLED = "the process noise had not settled: do not rely on the intervals; more restarts may help"


class Laplace(Estimator):
    """Mixture of truncated normals at the optima of the windowed likelihood; see the module's docstring.

    restarts: starting points followed, at most. candidates: points among which they are chosen: draws from the prior and, of 40 or more,
    later ones around the best; without effect where ``known_start_search`` finds them. initial (R, N): the starting points themselves instead.
    """

    name: ClassVar[str] = "laplace"
    searches: ClassVar[bool] = True
    default_budget: ClassVar[int] = 5000

    def __init__(
        self,
        simulator: Any,
        *,
        restarts: int = 2,
        candidates: int = 8,
        initial: FloatArray | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(simulator, **settings)
        self.restarts, self.candidates = whole("restarts", restarts), whole("candidates", candidates, 0)
        self.initial = None if initial is None else np.clip(np.atleast_2d(self.space.check_shape(initial)), 0, 1)

    def settings(self) -> dict[str, Any]:
        initial = None if self.initial is None else self.initial.tolist()
        return {
            **super().settings(),
            "restarts": self.restarts,
            "candidates": self.candidates,
            "initial": initial,
        }

    @property
    def quadratic_prior(self) -> QuadraticPrior:
        """The prior's normal, before truncation."""
        return QuadraticPrior.of(self.prior)

    def start(self, trajectories: Trajectories) -> State:
        windows = self.windows(trajectories)
        return self._how(windows).start(self, windows)

    def describe(self, state: State) -> str:
        if "draws_share" in state:
            return f"laplace: {len(state['draws_values'])} importance draws"
        return f"laplace: start {state['point'] + 1} of {len(state['points'])}, step {state['iteration']}"

    def step(self, state: State, trajectories: Trajectories) -> State:
        windows = self.windows(trajectories)
        if "draws_share" in state:
            return self._draw(windows, state)
        state = self._how(windows).step(self, windows, state)
        return self._probed(windows, state) if state["done"] else state

    def _probed(self, windows: Any, state: State) -> State:
        """The state of a finished search; not done where the posterior is no normal and draws are to take its place."""
        if isinstance(windows, Chain) or windows.num_start or windows.settings.noise == "sandwich":
            return state
        kept, n, count = distinct_modes(state), len(self.space), len(windows.trajectories)
        least = (importance.cost(n) + _LEAST_BATCHES * importance.batch(n)) * count
        if len(kept) != 1 or state["mode_guessed"][kept[0]] or windows.rollouts + least > windows.budget:
            return state
        if np.sqrt(np.diag(state["mode_covariance"][kept[0]])).min() < _SHARP:
            return state
        target = self._target(windows, state, kept[0])
        optimum = (state[f"mode_{k}"][kept[0]] for k in ("theta", "mean", "covariance"))
        if target.silent or importance.normal(target, *optimum):
            return state
        return {**state, "done": False, **importance.begin(n)}

    def _draw(self, windows: Windows, state: State) -> State:
        """One more batch of draws, as long as they promise something and the budget lasts."""
        kept = distinct_modes(state)
        found, n = self._normals(state, kept), len(self.space)
        state = importance.draw(state, self._target(windows, state, kept[0]), found, self.prior, self.seed)
        batches, effective = len(state["draws_share"]), importance.effective(importance.weights(state, self.prior))
        hopeless = batches >= _LEAST_BATCHES and effective < batches
        room = windows.rollouts + importance.batch(n) * len(windows.trajectories) <= windows.budget
        done = effective >= importance.ENOUGH or batches >= importance.MOST or hopeless or not room
        return {**state, "done": done}

    def _target(self, windows: Windows, state: State, mode: int) -> WindowTarget:
        picked = {k[5:]: v[mode] for k, v in state.items() if k.startswith("mode_")}
        return WindowTarget(self.prior, windows, at_optimum(windows, picked))

    def _how(self, windows: Any) -> ModuleType:
        """The search that fits the likelihood: its functions ``start`` and ``step``."""
        if not isinstance(windows, Chain):
            return window_search
        return known_start_search if windows.settings.starts == "recorded" else state_space_search

    def posterior(self, state: State, trajectories: Trajectories) -> GaussianMixture:
        if not len(state["mode_theta"]):
            raise BudgetTooSmall(
                f"budget: {self.budget} rollouts were not enough for one optimum; "
                f"one step takes {self._cost(trajectories)} rollouts, so raise the budget"
            )
        kept = distinct_modes(state)
        self.diagnostics = {
            "modes": len(kept),
            "noise_sd": state["mode_sd"][kept[0]].tolist(),
            "noise_tau": state["mode_tau"][kept[0]].tolist(),
        }
        if "mode_process" in state:
            noise = (state[f"mode_{name}"][kept[0]] for name in ("process", "movement", "loose"))
            self.diagnostics |= process_diagnostics(*noise)
            if not state["mode_settled"][kept[0]]:
                self.doubt(UNSETTLED)
        for reason in (state["mode_reason"][k] for k in kept if "mode_reason" in state):
            if reason:
                self.doubt(reason)
        if len(kept) > 1:
            self.warn(f"the search found {len(kept)} separate optima; the posterior is a mixture of them")
        found = self._normals(state, kept)
        if "draws_share" not in state:
            return found
        weight = importance.weights(state, self.prior)
        effective = importance.effective(weight)
        self.diagnostics["draws"] = {"draws": len(weight), "effective": effective}
        if effective >= importance.LEAST:
            return importance.kernels(state, weight, self.space, self.seed)
        if state["done"]:
            self.doubt(
                f"the posterior is no normal, and {len(weight)} draws from it came to {effective:.1f} effective ones: compare with mcmc before you "
                "trust the intervals"
            )
        return found

    def _normals(self, state: State, kept: list[int]) -> GaussianMixture:
        """Those of the optima, weighted by their evidence."""
        evidence = state["mode_evidence"][kept]
        weights = torch.from_numpy(evidence - evidence.max())
        return GaussianMixture(weights, state["mode_mean"][kept], state["mode_covariance"][kept], self.space)

    def normal(self, theta: FloatArray, precision: FloatArray, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance, before truncation, of the quadratic model of data and prior at theta."""
        prior = self.quadratic_prior
        covariance = _inverse(precision + prior.precision + FLAT_PRECISION * np.eye(len(theta)))
        pull = gradient + prior.pull(theta) + FLAT_PRECISION * (0.5 - theta)
        return theta + covariance @ pull, 0.5 * (covariance + covariance.T)

    def information(self) -> tuple[FloatArray, FloatArray]:
        """Optimum (N,), perhaps outside the cube, and information (N, N) of the data alone, after ``fit``."""
        if self.state is None or not len(self.state["mode_theta"]):
            raise ValueError("information: nothing has been fitted yet; call fit first")
        best, prior = distinct_modes(self.state)[0], self.quadratic_prior
        mean, total = self.state["mode_mean"][best], np.linalg.inv(self.state["mode_covariance"][best])
        flat = FLAT_PRECISION * np.eye(len(mean))
        eigenvalues, axes = np.linalg.eigh(total - prior.precision - flat)
        information = (axes * np.maximum(eigenvalues, 0.0)) @ axes.T
        right = total @ mean - prior.precision @ prior.mean - flat @ np.full(len(mean), 0.5)
        return np.linalg.pinv(information, rcond=1e-9, hermitian=True) @ right, information

    def _cost(self, trajectories: Trajectories) -> int:
        windows = self.windows(trajectories)
        sides = 2 if self._how(windows) is known_start_search else 1
        return (sides * (windows.num_theta + windows.num_start) + 2) * len(trajectories)


def _inverse(precision: FloatArray) -> FloatArray:
    """Positive definite also where rounding leaves a precision that is not, between parameters that do the same."""
    sd = 1 / np.sqrt(np.diag(precision))
    eigenvalues, axes = np.linalg.eigh(sd[:, None] * precision * sd)
    return sd[:, None] * ((axes / np.maximum(eigenvalues, _LEAST_EIGENVALUE)) @ axes.T) * sd
