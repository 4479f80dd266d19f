"""log p(trajectory | theta) of noisy, partly observed trajectories whose states are unknown at every sample.

    x_k+1 = f(x_k, a_k, theta) + w_k,     y_k = h(x_k, theta) + v_k,

with independent normal process noise w (a sd per state coordinate) and measurement noise v (a sd per channel), both
inferred, and all states marginalised. f is the simulation of a whole control step; ``differences`` linearises it by
finite differences, all of them, of every sample and every log, in one batch. The algebra is in ``linearisation``, the
searches in ``sipe_bayes.inference.laplace.state_space``. This is the weak-constraint formulation of data assimilation
(Y. Tremolet, "Accounting for an imperfect model in 4D-Var", 2006, https://doi.org/10.1256/qj.05.224) and the iterated
Kalman smoother (B. M. Bell, "The iterated Kalman smoother as a Gauss-Newton method", 1994,
https://doi.org/10.1137/0804035).

The state's coordinates are tangents (dq (nv), dv (nv), dact (na)), so quaternions stay of length one; a difference of
two states is MuJoCo's mj_differentiatePos. The first state of a log has a normal prior about the measured one whose sd
is far wider than any measurement, or, where it is known, about the recorded one with an sd far narrower; command
histories of delayed actuators are taken as commanded. What a controller remembers (``memory_size``) is computed from
each state, as positions and velocities tell it.

Deviations from the textbooks:

- A sensor with an unknown delay or filter that may be longer than a control step is refused: a state knows nothing
  of the steps before it.
- Measurement channels that the environment reads one physics step late (``derived_late``) are predicted by the step
  that led to the sample, so that process noise does not reach them.
"""

from __future__ import annotations

import math
from dataclasses import replace

import mujoco
import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.budget import BudgetExhausted, Deadline
from sipe_bayes.core.rotations import written_near
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.likelihood.noise import chosen_sd, noise_scales
from sipe_bayes.likelihood.settings import StateSpace, check_prompt, check_seen, chosen_channels, fitted_rotations
from sipe_bayes.likelihood.starts.estimates import estimate_states, start_sd
from sipe_bayes.likelihood.starts.history import past_commands, with_history
from sipe_bayes.simulation.simulator import Simulator
from sipe_bayes.simulation.tangents import moved, tangents

KNOWN_SD = (1e-6, 1e-5, 1e-6)  # of a start that is known, beyond rounding: position, velocity, activation


class Chain:
    """Recorded trajectories as K unknown states in a row, T + 1 of each log; those of different logs are not linked.

    Attributes:
        log, sample: (K,), where a state belongs.
        measured, observed: (K, C), what the simulation that starts there predicts, and whether it was recorded.
        first: (K,), of a log. linked: (K-1,), whether the next state is of the same log.
        reference: (K, S), a first guess of the states.
        determined: (D,), coordinates of a degree of freedom or an activation that a channel tells.
        irrelevant: (D,), positions on which nothing that is measured depends.
        prior_precision: (K, D), of first states, else zero.
        rollouts, budget: as ``likelihood.windows.Windows`` counts them.
        uncounted: part of a rollout, not counted yet.
        setup_rollouts: what placing the states took, which a search counts when it starts.
    """

    deadline = Deadline()  # of a fit; never by default

    def __init__(self, settings: StateSpace, simulator: Simulator, trajectories: Trajectories) -> None:
        simulator = simulator.on_processor  # one-step differences are below float32's rounding
        self.settings, self.simulator, self.trajectories = settings, simulator, trajectories
        self.rollouts, self.uncounted, self.budget, self.short = 0, 0.0, math.inf, False
        self.channels = chosen_channels(simulator, trajectories, settings.fit)
        check_prompt(self.fitted, simulator.environment.remembers[self.channels], float(trajectories.dt.min()))
        self.rotations = fitted_rotations(simulator.environment.rotations, self.channels)
        self.scales = noise_scales(len(self.channels), self.rotations)
        steps = trajectories.length
        self.log = np.repeat(np.arange(len(trajectories)), steps + 1)
        self.sample = np.concatenate([np.arange(n + 1) for n in steps])
        self.first, self.linked = self.sample == 0, self.log[1:] == self.log[:-1]
        self.dt = trajectories.dt[self.log]
        names = trajectories.names or (None,) * len(trajectories)
        self.names = [names[k] for k in self.log]
        last = np.minimum(self.sample, steps[self.log] - 1)
        self.actions = trajectories.actions[self.log, last][:, None]
        self._measure(trajectories)
        environment, model = simulator.environment, simulator.model
        known = settings.starts == "recorded"
        if known and trajectories.states is None:
            raise ValueError("starts: 'recorded' needs trajectories with states; use 'estimated' for a measured log")
        self.goals = environment.recorded_goals(trajectories.observations[self.log, 0])
        measured = [replace(t, states=None) for t in trajectories]
        reference = np.concatenate([estimate_states(simulator, t, raw=True) for t in measured])
        if known:
            reference[self.first] = trajectories.states[:, 0]  # type: ignore[index]
        past = past_commands(simulator, trajectories, self.log, self.sample, self.dt)
        self.reference = with_history(simulator, reference, past, self.dt, self.sample, self.first & known)
        self.sizes = (model.nv, model.nv, model.na)
        sd = np.repeat(KNOWN_SD, self.sizes) if known else start_sd(simulator, trajectories)
        self.prior_precision = np.where(self.first[:, None], sd**-2.0, 0.0)

    def _measure(self, trajectories: Trajectories) -> None:
        """Assign to each state what the simulation that starts there predicts."""
        environment = self.simulator.environment
        columns = environment.state_columns(self.simulator.model)
        late = np.array([environment.derived_late and columns[c] is None for c in self.channels])
        rows = trajectories.observations[self.log, self.sample][:, self.channels]
        ahead = np.concatenate([rows[1:], np.full((1, len(late)), np.nan)])
        ahead[:-1][~self.linked] = np.nan
        self.late, self.measured = late, np.where(late, ahead, rows)
        self.observed = np.isfinite(self.measured)
        check_seen(self.fitted, np.asarray(self.observed.any(0)))

    def place(self, reference: FloatArray, indirect: BoolArray, irrelevant: BoolArray) -> None:
        """Say which coordinates a channel tells, and put positions there that one tells only indirectly.

        Args:
            reference: states (K, S) with such positions.
            indirect: which positions (nv,) these are.
            irrelevant: positions (nv,) on which no fitted channel depends.
        """
        nv, first, direct = self.sizes[0], self.reference[self.first], self.measured_directly
        self.reference = reference
        if self.settings.starts == "recorded":
            self.reference[self.first] = first
        moving = direct[nv : 2 * nv]
        position = direct[:nv] | indirect | (moving & irrelevant)
        rest = np.zeros(self.num_start - nv, bool)
        self.irrelevant = np.concatenate([irrelevant & ~direct[:nv] & ~indirect, rest])
        self.determined = np.concatenate([position, position | moving, direct[2 * nv :]])
        self.setup_rollouts, self.rollouts, self.uncounted = math.ceil(self.rollouts + self.uncounted), 0, 0.0

    @property
    def measured_directly(self) -> BoolArray:
        """Which coordinates (D,) a channel measures directly."""
        return np.isin(np.arange(self.num_start), [c for c in self.coordinates if c is not None])

    @property
    def fitted(self) -> list[str]:
        """Names of the C fitted channels."""
        return [self.simulator.environment.channels[c] for c in self.channels]

    @property
    def num_theta(self) -> int:
        """N."""
        return len(self.simulator.space)

    @property
    def num_start(self) -> int:
        """D, coordinates of a state."""
        return self.prior_precision.shape[1]

    @property
    def coordinates(self) -> list[int | None]:
        """For each fitted channel the state coordinate that it measures directly, if it does.

        Of a quaternion's numbers, and of an orientation's, that is one of its joint's turns.
        """
        model, environment = self.simulator.model, self.simulator.environment
        columns = environment.state_columns(model)
        owner = np.searchsorted(model.jnt_qposadr, np.arange(model.nq), side="right") - 1
        last = np.append(model.jnt_dofadr[1:], model.nv)[owner] - 1
        turn = np.minimum(model.jnt_dofadr[owner] + np.arange(model.nq) - model.jnt_qposadr[owner], last)

        def coordinate(column: int | None) -> int | None:
            if column is None:
                return None
            return int(turn[column - 1]) if column <= model.nq else column - 1 - model.nq + model.nv

        of_channels = [coordinate(column) for column in columns]
        for reading in environment.poses:
            if reading.quantity == "acceleration":
                continue
            turns = reading.quantity in ("orientation", "angular_velocity")
            first = int(model.jnt_dofadr[reading.joint]) + model.nv * ("velocity" in reading.quantity)
            free = int(model.jnt_type[reading.joint]) == int(mujoco.mjtJoint.mjJNT_FREE)
            for i, channel in enumerate(reading.channels if turns or free else ()):
                of_channels[channel] = first + 3 * (turns and free) + i
        return [of_channels[c] for c in self.channels]

    @property
    def labels(self) -> list[str]:
        """Of the D coordinates: position and velocity of joints, activations."""
        model, nv = self.simulator.model, self.sizes[0]
        joints = [model.joint(int(k)).name or f"joint {k}" for k in model.dof_jntid[:nv]]
        kinds = [f"{what} of {name}" for what in ("position", "velocity") for name in joints]
        return [*kinds, *(f"activation {k}" for k in range(self.sizes[2]))]

    @property
    def fixed_sd(self) -> FloatArray:
        """Given noise sd (C,) of the fitted channels, NaN where it is inferred."""
        return chosen_sd(self.settings.noise_sd, self.channels, self.simulator.environment.channels)

    @property
    def least(self) -> tuple[FloatArray, FloatArray]:
        """Noise sds (C,) and (D,) below which rounding rules."""
        sizes = np.sqrt(np.nanmean(np.where(self.observed, self.measured, np.nan) ** 2, axis=0))
        spread = self.difference(self.reference, self.reference[:1])
        states = np.sqrt((spread**2).mean(0))
        return _floor(sizes), _floor(states)

    def predicted(self, theta: FloatArray) -> FloatArray | None:
        """States (K, S) that the commands lead to at theta (N,) from where each log begins; None if that diverges."""
        logs, first = self.trajectories, self.reference[self.first]
        theta, names = np.tile(theta, (len(logs), 1)), list(logs.names) or None
        goals = None if self.goals is None else self.goals[self.first]
        self._spend(len(logs))
        result = self.simulator.rollout(theta, logs.actions, first, logs.dt, names, goals=goals)
        assert result.states is not None
        if not result.valid[self.log, self.sample].all():
            return None
        return self.moved(self.reference, self.difference(result.states[self.log, self.sample], self.reference))

    def movement(self, states: FloatArray) -> FloatArray:
        """How far (D,) states (K, S) move in a control step: root mean squares.

        At least a hundredth of the largest of positions, velocities or activations.
        """
        steps = self.difference(states[1:], states[:-1])[self.linked]
        size = np.sqrt((steps**2).mean(0))
        kinds = [part for part in np.split(size, np.cumsum(self.sizes)[:-1]) if len(part)]
        usual = np.concatenate([np.full(len(part), part.max()) for part in kinds])
        return np.maximum(np.maximum(size, 1e-2 * usual), self.least[1])

    def moved(self, states: FloatArray, tangent: FloatArray) -> FloatArray:
        """States (..., S) moved by tangents (..., D)."""
        return moved(self.simulator.model, states, tangent)

    def difference(self, after: FloatArray, before: FloatArray) -> FloatArray:
        """Tangents (..., D) that lead from states ``before`` (..., S) to ``after``."""
        return tangents(self.simulator.model, after, before)

    def simulate(
        self, theta: FloatArray, states: FloatArray, at: IntArray | None = None
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """One control step from every state.

        Args:
            theta: (B, N).
            states: (B, K, S).
            at: which of the chain's states these are (K,), default all.

        Returns:
            Predictions (B, K, C), ends (B, K, S), and which are valid (B, K).

        Raises:
            BudgetExhausted: instead of simulating beyond the budget.
        """
        at = np.arange(len(self.log)) if at is None else at
        batch = len(theta)
        self._spend(batch * len(self.trajectories) * len(at) / len(self.log))
        result = self.simulator.rollout(
            np.repeat(theta, len(at), axis=0),
            np.tile(self.actions[at], (batch, 1, 1)),
            self.with_memory(states.reshape(batch * len(at), -1), np.tile(self.dt[at], batch)),
            np.tile(self.dt[at], batch),
            [self.names[k] for k in at] * batch,
            goals=None if self.goals is None else np.tile(self.goals[at], (batch, 1)),
        )
        assert result.states is not None
        shape, observations = (batch, len(at)), result.observations[..., self.channels]
        goes_on = np.append(self.linked, False)[at]
        valid = result.valid[:, 0] & (result.valid[:, 1] | ~np.tile(goes_on, batch))
        predicted = np.where(self.late, observations[:, 1], observations[:, 0]).reshape(*shape, -1)
        predicted = written_near(predicted, self.measured[at], self.rotations)
        return predicted, result.states[:, 1].reshape(*shape, -1), valid.reshape(shape)

    def with_memory(self, states: FloatArray, dt: FloatArray) -> FloatArray:
        """States (B, S) with the memory that a controller comes to them with.

        Positions and velocities tell it: a physics step ago the positions were less by these velocities.
        """
        simulator, environment = self.simulator, self.simulator.environment
        if not environment.memory_size:
            return states
        nq, nv = simulator.model.nq, simulator.model.nv
        back = np.zeros((len(states), self.num_start))
        timestep = np.array([simulator.physics_steps(float(d))[1] for d in dt])
        back[:, :nv] = -timestep[:, None] * states[:, 1 + nq : 1 + nq + nv]
        earlier = environment.probe(simulator.model, self.moved(states, back), states)
        memory = environment.remember(simulator.engine.sensors([simulator.model] * len(earlier), earlier))
        return np.concatenate([states[:, : simulator.engine.physics_size], memory], axis=1)

    def _spend(self, cost: float) -> None:
        self.deadline.check()
        cost += self.uncounted
        if self.rollouts + math.ceil(cost) > self.budget:
            raise BudgetExhausted(f"{self.rollouts} of {self.budget:g} rollouts used, the next step takes {cost:.0f}")
        self.rollouts, self.uncounted = self.rollouts + int(cost), cost % 1.0


def _floor(sizes: FloatArray) -> FloatArray:
    """A millionth of each size: noise below is not told from rounding; one that is all but zero has a size, too."""
    usual = float(np.median(sizes[sizes > 0])) if (sizes > 0).any() else 1.0
    return np.asarray(1e-6 * np.maximum(sizes, 1e-3 * usual))
