"""log p(trajectory | theta) of noisy, partly observed trajectories whose states are unknown at every sample.

    x_k+1 = f(x_k, a_k, theta) + w_k,     y_k = h(x_k, theta) + v_k,

with independent normal process noise w (a sd per state coordinate) and measurement noise v (a sd per channel), both
inferred, and all states marginalised. f is the simulation of a whole control step; it is linearised by finite
differences, all of them, of every sample and every log, in one batch (``Chain.linearise``); the algebra is in
``sipe_bayes.likelihood.block_tridiagonal``, the searches in ``sipe_bayes.inference.laplace.state_space_search`` and, where the first states are known,
``known_start_search``. This is the weak-constraint formulation of
data assimilation (Y. Tremolet, "Accounting for an imperfect model in 4D-Var", 2006, https://doi.org/10.1256/qj.05.224)
and the iterated Kalman smoother (B. M. Bell, "The iterated Kalman smoother as a Gauss-Newton method", 1994,
https://doi.org/10.1137/0804035).

The state's coordinates are tangents (dq (nv), dv (nv), dact (na)), so quaternions stay of length one; a difference of two
states is MuJoCo's mj_differentiatePos. The first state of a log has a normal prior about the measured one whose sd is far
wider than any measurement, or, where it is known, about the recorded one with an sd far narrower; command histories of
delayed actuators are taken as commanded. What a controller remembers (``memory_size``) is computed from each state, as positions and
velocities tell it.

Deviations from the textbooks: measurement channels that the environment reads one physics step late (``derived_late``)
are predicted by the step that led to the sample, so that process noise does not reach them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.likelihood.noise import chosen_sd
from sipe_bayes.likelihood.settings import BudgetExhausted, StateSpace
from sipe_bayes.likelihood.state_space.linearisation import ChainLinearisation
from sipe_bayes.likelihood.windows import (
    START_SD,
    chosen_channels,
    estimate_states,
    moved,
    past_commands,
)
from sipe_bayes.simulation.simulator import Simulator

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_THETA_STEP = 1e-4  # finite differences, of the unit cube
_STATE_STEP = 1e-5  # rad or m, rad/s or m/s
KNOWN_SD = (1e-6, 1e-5, 1e-6)  # of a start that is known: position, velocity, activation
_LEAST_MOVEMENT = 1e-2  # of the largest among the positions, the velocities or the activations
_MUCH_PROCESS = 0.1  # of a movement
_NAMED = 4  # steps that a sentence names
_LEAST_SD = 1e-6  # of a channel's or coordinate's size: noise below it is not told from rounding


class Chain:
    """Recorded trajectories as K unknown states in a row, T + 1 of each log; states of different logs are not linked.

    log, sample (K,): where a state belongs. measured, observed (K, C): what the simulation that starts there predicts. reference (K, S): a
    first guess of the states; placed (D,): which of their coordinates belong to a degree of freedom or an activation that a channel tells;
    idle (D,): positions on which nothing that is measured depends.
    rollouts, budget: as ``likelihood.Windows`` counts them; part: of a rollout, not counted yet;
    prepared: rollouts that placing them took, which a search counts when it starts."""

    def __init__(self, settings: StateSpace, simulator: Simulator, trajectories: Trajectories) -> None:
        self.settings, self.simulator, self.trajectories = settings, simulator, trajectories
        self.rollouts, self.part, self.budget = 0, 0.0, math.inf
        self.channels = chosen_channels(simulator, trajectories, settings.fit)
        steps = trajectories.length
        self.log = np.repeat(np.arange(len(trajectories)), steps + 1)
        self.sample = np.concatenate([np.arange(n + 1) for n in steps])
        self.first, self.linked = self.sample == 0, self.log[1:] == self.log[:-1]
        self.dt = trajectories.dt[self.log]
        names = trajectories.names or (None,) * len(trajectories)
        self.names = [names[k] for k in self.log]
        last = np.minimum(self.sample, steps[self.log] - 1)
        self.actions = trajectories.actions[self.log, last][:, None]
        self._read(trajectories)
        environment, model = simulator.environment, simulator.model
        known = settings.starts == "recorded"
        if known and trajectories.states is None:
            raise ValueError("starts: 'recorded' needs trajectories with states; use 'estimated' for a measured log")
        self.goals = environment.recorded_goals(trajectories.observations[self.log, 0])
        reference = np.concatenate([_measured_states(simulator, replace(t, states=None)) for t in trajectories])
        if known:
            reference[self.first] = trajectories.states[:, 0]  # type: ignore[index]
        reference[:, 0] = 0.0
        timestep = np.array([simulator.physics_steps(float(d))[1] for d in self.dt])
        past = past_commands(simulator, trajectories, self.log, self.sample, self.dt) if model.nhistory else []
        self.reference = environment.history(model, reference, past, timestep)
        self.sizes = (model.nv, model.nv, model.na)
        start_sd = KNOWN_SD if known else START_SD
        self.prior_precision = np.where(self.first[:, None], np.repeat(start_sd, self.sizes) ** -2.0, 0.0)

    @property
    def measured_directly(self) -> BoolArray:
        """Which coordinates (D,) a channel measures directly."""
        return np.isin(np.arange(self.num_start), [c for c in self.coordinates if c is not None])

    def place(self, reference: FloatArray, told: BoolArray, idle: BoolArray) -> None:
        """Say which coordinates a channel tells, and put positions there that one tells only indirectly.

        Args:
            reference: states (K, S) with such positions.
            told: which positions (nv,) these are.
            idle: positions (nv,) on which no fitted channel depends.
        """
        nv, first, direct = self.sizes[0], self.reference[self.first], self.measured_directly
        self.reference = reference
        if self.settings.starts == "recorded":
            self.reference[self.first] = first
        moving = direct[nv : 2 * nv]
        position = direct[:nv] | told | (moving & idle)
        self.idle = np.concatenate([idle & ~direct[:nv] & ~told, np.zeros(self.num_start - nv, bool)])
        self.placed = np.concatenate([position, position | moving, direct[2 * nv :]])
        self.prepared, self.rollouts, self.part = math.ceil(self.rollouts + self.part), 0, 0.0

    def _read(self, trajectories: Trajectories) -> None:
        environment = self.simulator.environment
        columns = environment.state_columns(self.simulator.model)
        late = np.array([environment.derived_late and columns[c] is None for c in self.channels])
        rows = trajectories.observations[self.log, self.sample][:, self.channels]
        ahead = np.concatenate([rows[1:], np.full((1, len(late)), np.nan)])
        ahead[:-1][~self.linked] = np.nan
        self.late, self.measured = late, np.where(late, ahead, rows)
        self.observed = np.isfinite(self.measured)
        for name, seen in zip(self.fitted, self.observed.T, strict=True):
            if not seen.any():
                raise ValueError(
                    f"trajectories: the fitted channel {name!r} has no sample at all; leave it out of `fit`"
                )

    @property
    def fitted(self) -> list[str]:
        """Names of the C fitted channels."""
        return [self.simulator.environment.channels[c] for c in self.channels]

    @property
    def num_theta(self) -> int:
        return len(self.simulator.space)

    @property
    def num_start(self) -> int:
        """D, coordinates of a state."""
        return self.prior_precision.shape[1]

    @property
    def coordinates(self) -> list[int | None]:
        """For each fitted channel the state coordinate that it measures directly, if it does; of a quaternion's numbers one
        of its joint's turns."""
        model = self.simulator.model
        columns = self.simulator.environment.state_columns(model)
        owner = np.searchsorted(model.jnt_qposadr, np.arange(model.nq), side="right") - 1
        last = np.append(model.jnt_dofadr[1:], model.nv)[owner] - 1
        turn = np.minimum(model.jnt_dofadr[owner] + np.arange(model.nq) - model.jnt_qposadr[owner], last)

        def coordinate(column: int | None) -> int | None:
            if column is None:
                return None
            return int(turn[column - 1]) if column <= model.nq else column - 1 - model.nq + model.nv

        return [coordinate(columns[c]) for c in self.channels]

    @property
    def labels(self) -> list[str]:
        """Of the D coordinates: position and velocity of joints, activations."""
        model, nv = self.simulator.model, self.sizes[0]
        joints = [model.joint(int(k)).name or f"joint {k}" for k in model.dof_jntid[:nv]]
        kinds = [f"{what} of {name}" for what in ("position", "velocity") for name in joints]
        return [*kinds, *(f"activation {k}" for k in range(self.sizes[2]))]

    def lacking(self, process: FloatArray, movement: FloatArray, loose: Sequence[int] = ()) -> str:
        """What inferred process noise (D,) says of the model, held against how far states move in a control step (D,): a hint, no test.
        loose: after which samples of the chain a jump was let go."""
        share = np.where(self.idle, 0.0, process / movement)
        worst = int(share.argmax())
        percent = f"{100 * share[worst]:.0f}" if share[worst] > 0.1 else f"{100 * share[worst]:.2g}"
        found = (
            f"Process noise is largest in the {self.labels[worst]}: its sd is {process[worst]:.2g}, {percent} % of how far "
            "that moves in a control step."
        )
        if len(loose):
            found += f" {self._let_go(loose)}"
        if share[worst] < _MUCH_PROCESS:
            return f"{found} The model follows the logs closely{' elsewhere' if len(loose) else ''}."
        return f"{found} A model that lacks nothing needs next to none: look for what it lacks there before you trust the values."

    def _let_go(self, loose: Sequence[int]) -> str:
        """How many jumps are loose, and when the first ones happen."""
        many = len(self.trajectories) > 1
        when = [
            f"{self.sample[k] * self.dt[k]:.3g} s" + (f" of {self.names[k] or f'log {self.log[k]}'}" if many else "")
            for k in loose[:_NAMED]
        ]
        rest = ", ..." if len(loose) > _NAMED else ""
        return (
            f"{len(loose)} of {int(self.linked.sum())} control steps stand out and count for little, as where a contact is "
            f"missed: at {', '.join(when)}{rest}."
        )

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
        """States (K, S) that the commands lead to at theta (N,) from where each log begins; None where that diverges."""
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
        """How far (D,) states (K, S) move in a control step: root mean squares, at least a hundredth of the largest of positions,
        velocities or activations."""
        steps = self.difference(states[1:], states[:-1])[self.linked]
        found = np.sqrt((steps**2).mean(0))
        kinds = [part for part in np.split(found, np.cumsum(self.sizes)[:-1]) if len(part)]
        usual = np.concatenate([np.full(len(part), part.max()) for part in kinds])
        return np.maximum(np.maximum(found, _LEAST_MOVEMENT * usual), self.least[1])

    def moved(self, states: FloatArray, tangent: FloatArray) -> FloatArray:
        """States (..., S) moved by tangents (..., D)."""
        return moved(self.simulator.model, states, tangent)

    def difference(self, after: FloatArray, before: FloatArray) -> FloatArray:
        """Tangents (..., D) that lead from states ``before`` (..., S) to ``after``."""
        model = self.simulator.model
        nq, nv, end = model.nq, model.nv, 1 + model.nq + model.nv + model.na
        after, before = np.broadcast_arrays(after, before)
        rest = after[..., 1 + nq : end] - before[..., 1 + nq : end]
        if nq == nv:
            return np.concatenate([after[..., 1 : 1 + nq] - before[..., 1 : 1 + nq], rest], axis=-1)
        turn = np.empty((*after.shape[:-1], nv))
        rows = (turn.reshape(-1, nv), before.reshape(-1, before.shape[-1]), after.reshape(-1, after.shape[-1]))
        for out, one, two in zip(*rows, strict=True):
            mujoco.mj_differentiatePos(model, out, 1.0, one[1 : 1 + nq].copy(), two[1 : 1 + nq].copy())
        return np.concatenate([turn, rest], axis=-1)

    def simulate(
        self, theta: FloatArray, states: FloatArray, at: NDArray[np.int64] | None = None
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """One control step from states (B, K, S) at theta (B, N): predictions (B, K, C), ends (B, K, S), and which are
        valid (B, K). at (K,): which of the chain's states these are, default all."""
        at = np.arange(len(self.log)) if at is None else at
        batch = len(theta)
        self._spend(batch * len(self.trajectories) * len(at) / len(self.log))
        lanes, names = np.repeat(theta, len(at), axis=0), [self.names[k] for k in at] * batch
        result = self.simulator.rollout(
            lanes,
            np.tile(self.actions[at], (batch, 1, 1)),
            self._recalled(states.reshape(batch * len(at), -1), np.tile(self.dt[at], batch)),
            np.tile(self.dt[at], batch),
            names,
            goals=None if self.goals is None else np.tile(self.goals[at], (batch, 1)),
        )
        shape = (batch, len(at))
        seen = result.observations[..., self.channels]
        assert result.states is not None
        goes_on = np.append(self.linked, False)[at]
        sound = result.valid[:, 0] & (result.valid[:, 1] | ~np.tile(goes_on, batch))
        predicted = np.where(self.late, seen[:, 1], seen[:, 0]).reshape(*shape, -1)
        return predicted, result.states[:, 1].reshape(*shape, -1), sound.reshape(shape)

    def _recalled(self, states: FloatArray, dt: FloatArray) -> FloatArray:
        """States (B, S) with the memory that a controller comes to them with, which their positions and velocities tell: a physics step ago
        the positions were less by these velocities."""
        simulator, environment = self.simulator, self.simulator.environment
        if not environment.memory_size:
            return states
        nq, nv = simulator.model.nq, simulator.model.nv
        back = np.zeros((len(states), self.num_start))
        timestep = np.array([simulator.physics_steps(float(d))[1] for d in dt])
        back[:, :nv] = -timestep[:, None] * states[:, 1 + nq : 1 + nq + nv]
        late = environment.probe(simulator.model, self.moved(states, back), states)
        memory = environment.remember(simulator.engine.sensors([simulator.model] * len(late), late))
        return np.concatenate([states[:, : simulator.engine.physics_size], memory], axis=1)

    def _spend(self, cost: float) -> None:
        cost += self.part
        if self.rollouts + math.ceil(cost) > self.budget:
            raise BudgetExhausted(f"{self.rollouts} of {self.budget:g} rollouts used, the next step takes {cost:.0f}")
        self.rollouts, self.part = self.rollouts + int(cost), cost % 1.0

    def compared(self, theta_states: FloatArray, predicted: FloatArray, ends: FloatArray) -> dict[str, Any]:
        """Residual, jump and offset of states (K, S), and the masks."""
        linked = self.linked[:, None]
        return {
            "residual": np.where(self.observed, self.measured - predicted, 0.0),
            "jump": np.where(linked, self.difference(theta_states[1:], ends[:-1]), 0.0),
            "offset": np.where(self.first[:, None], self.difference(theta_states, self.reference), 0.0),
            "observed": self.observed,
            "linked": self.linked,
            "precision": self.prior_precision,
        }

    def compare(
        self, theta: FloatArray, states: FloatArray, slopes: ChainLinearisation | None = None
    ) -> list[ChainLinearisation | None]:
        """What theta (B, N) and states (B, K, S) predict, compared with the log; None where a simulation diverged. The
        Jacobians and their error are those of ``slopes``, else empty and none."""
        predicted, ends, valid = self.simulate(theta, states)
        names = ("measurement", "measurement_theta", "transition", "transition_theta")
        kept: dict[str, Any] = {n: np.empty(0) if slopes is None else getattr(slopes, n) for n in names}
        kept["error"] = np.zeros((1, 1)) if slopes is None else slopes.error
        return [
            ChainLinearisation(**self.compared(s, p, e), **kept) if v.all() else None
            for s, p, e, v in zip(states, predicted, ends, valid, strict=True)
        ]

    def linearise(self, theta: FloatArray, states: FloatArray, with_states: bool = True) -> ChainLinearisation | None:
        """Everything at theta (N,), states (K, S), in one batch of 1 + N + D control steps a state; None where it diverged.

        A finite difference whose simulation diverges counts as zero. with_states: else their Jacobians are zero."""
        n, d = self.num_theta, self.num_start
        count = 1 + n + d * with_states
        size = np.maximum(_THETA_STEP, self.simulator.environment.least_steps(theta))
        sign = np.where(theta + size <= 1, 1.0, -1.0)
        thetas, all_states = np.tile(theta, (count, 1)), np.tile(states, (count, 1, 1))
        thetas[np.arange(1, n + 1), np.arange(n)] += sign * size
        for j in range(count - 1 - n):
            tangent = np.zeros(d)
            tangent[j] = _STATE_STEP
            all_states[1 + n + j] = self.moved(states, np.broadcast_to(tangent, (len(states), d)))
        predicted, ends, valid = self.simulate(thetas, all_states)
        if not valid[0].all():
            return None
        scale = np.concatenate([sign * size, np.full(count - 1 - n, _STATE_STEP)])[:, None, None]
        sound = valid[1:, :, None]
        seen = np.where(sound & self.observed, (predicted[1:] - predicted[0]) / scale, 0.0)
        reached = np.where(sound, self.difference(ends[1:], ends[0]) / scale, 0.0)[:, :-1]
        reached = np.where(self.linked[:, None], reached, 0.0)
        seen, reached = np.moveaxis(seen, 0, -1), np.moveaxis(reached, 0, -1)
        by_state = (seen[..., n:], reached[..., n:])
        if not with_states:
            by_state = (np.zeros((*seen.shape[:-1], d)), np.zeros((*reached.shape[:-1], d)))
        return ChainLinearisation(
            **self.compared(states, predicted[0], ends[0]),
            measurement=by_state[0],
            measurement_theta=seen[..., :n],
            transition=by_state[1],
            transition_theta=reached[..., :n],
            error=np.zeros((len(self.linked), d)),
        )


def _floor(sizes: FloatArray) -> FloatArray:
    usual = float(np.median(sizes[sizes > 0])) if (sizes > 0).any() else 1.0
    return np.asarray(_LEAST_SD * np.maximum(sizes, 1e-3 * usual))


def _measured_states(simulator: Simulator, trajectory: Any) -> FloatArray:
    """A first guess of the states (T+1, S) of a trajectory without recorded ones: what each sample measured, the rest as
    ``estimate_states`` has it. Unlike there nothing is smoothed: the chain does that."""
    states = estimate_states(simulator, trajectory).copy()
    for channel, column in enumerate(simulator.environment.state_columns(simulator.model)):
        seen = np.isfinite(trajectory.observations[:, channel])
        if column is not None:
            states[seen, column] = trajectory.observations[seen, channel]
    return states
