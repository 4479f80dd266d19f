"""Joint forces that the model asks for along a log, against those that its actuators give: one linear regression.

Measured positions are smoothed and differentiated, and inverse dynamics tells the forces of the nominal model. They are
regressed on the forces of the actuators, delayed by a number of samples, and on friction: the coefficient of an
actuator tells the sign and the size of its command, and what is left tells which reading of the positions is right.
All is smoothed with one kernel, which leaves linear equations as they are (M. Gautier 1997, Dynamic identification of
robots with power model, ICRA; J. Swevers et al. 2007, https://doi.org/10.1109/MCS.2007.904659).
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import mujoco
import numpy as np
import scipy.optimize
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from sipe_bayes.calibration.machine import Drive, drive_of
from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.rotations import bridged
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood import estimate_states
from sipe_bayes.simulation.contacts import may_touch
from sipe_bayes.simulation.simulator import Simulator

_ROWS = 300  # of all logs, at which inverse dynamics is asked
_LONGEST = 6000  # samples of a log that are looked at
_WIDEST = 12.0  # parts of the time in which the motion goes to and fro, of the kernel
_NOISY = 0.1  # of the acceleration, what may be noise
_PERIODS = 2.0  # independent numbers in the time in which the motion goes to and fro
_OFF = np.log(3.0)  # sd of the logarithm of a gain that the model has
_OFF_SERVO = np.log(10.0)  # likewise of a servo, whose gains few models have right
_BEST = 1e-3  # of the forces, the least that is left
_ROUNDING = 1e-10  # of a column's size
_LATE_GYRO = 0.06  # s, that a gyro may be late
_STOP = 0.01  # of a joint's range, within which it is at its end
_GAP = 0.7  # of the gap between measured samples, the least kernel
_FREE = 0.2  # of the rows, so few of which are no better than all
WORST = 10.0  # and the most
_ZERO = 0.1  # rad of a zero's error, or a tenth of a constant force
_DRY = 0.1  # of the usual speed, up to which dry friction turns round


@dataclass(frozen=True)
class Assumption:
    """How columns are read in place of what the configuration says.

    Args:
        observed: (O,) what each channel is multiplied by.
        driven: (A,) what each command is multiplied by.
        zeros: (O,) SI, what is taken off each channel once it is multiplied; none where empty.
        minus: pairs of channels, the second of which is taken off the first.
        rests: (A,) SI, what is taken off each command once it is multiplied; none where empty.
    """

    observed: tuple[float, ...]
    driven: tuple[float, ...]
    zeros: tuple[float, ...] = ()
    minus: tuple[tuple[int, int], ...] = ()
    rests: tuple[float, ...] = ()


@dataclass(frozen=True)
class Gyro:
    """A rate gyro: its site, its rates (n, 3) in each log as they are read, and the factors that its unit may have."""

    site: int
    rates: tuple[FloatArray, ...]
    factors: tuple[float, ...]


@dataclass(frozen=True)
class Motion:
    """Rows of all logs under an assumption: what the model asks for, and what its actuators give.

    Args:
        asked: (R, V) forces of inverse dynamics without friction.
        inertial: (R, V) the part of them that accelerates.
        speed: (R, V) that damping acts on.
        given: (D, R, V, A) forces of each actuator at each delay, feedback included.
        states: (R, nq + 3 nv) positions, velocities, accelerations, and the velocities that damping acts on.
        usable: (V,) degrees of freedom that are measured and move.
        free: (R,) rows at which nothing touches, and that are measured.
        rates: of each gyro, (R, 3) rad/s in its own axes.
    """

    asked: FloatArray
    inertial: FloatArray
    speed: FloatArray
    given: FloatArray
    states: FloatArray
    usable: BoolArray
    free: BoolArray
    rates: tuple[FloatArray, ...] = ()


@dataclass(frozen=True)
class Outcome:
    """A regression at its best delay.

    Args:
        miss: (V,) what is left of the forces, as a share of how much they change; 1 of what is not measured.
        gains: (A,) of the actuators' forces.
        errors: (A,) standard errors of these.
        damping: (V,) force per velocity.
        friction: (V,) level of dry friction.
        delay: samples, between those that were tried.
        behind: (D,) of each delay that was tried, by how much more is left than at the best: sum of logarithms.
        unexplained: the sum of the logarithms of what is left: the smaller the better.
        far_off: nats against gains that are far from the model's.
        left: (R, V) forces that are left, as shares.
        size: (V,) of the forces.
        gyros: of each gyro what is left of its rates, as a share, in each unit that it may have.
    """

    miss: FloatArray
    gains: FloatArray
    errors: FloatArray
    damping: FloatArray
    friction: FloatArray
    delay: float
    behind: FloatArray
    unexplained: float
    far_off: float
    left: FloatArray
    size: FloatArray
    gyros: tuple[FloatArray, ...] = ()


class Regression:
    """Logs with the model that is to explain them.

    Args:
        environment: the model, what the logs drive and measure.
        logs: in SI, as the configuration reads them.
        delays: samples that commands may come late.
    """

    def __init__(self, environment: MjcfEnvironment, logs: Sequence[Trajectory], delays: Sequence[int] = (0,)) -> None:
        self.environment, self.simulator = environment, Simulator(environment, num_threads=1)
        parts = [log.slice(0, min(len(log), _LONGEST)) for log in logs]
        self.logs, gaps = tuple(_bridged(log, environment) for log in parts), [_gaps(log) for log in parts]
        self._seen = [seen for seen, _ in gaps]
        self.delays = tuple(delays)
        self.given = Assumption((1.0,) * len(environment.channels), (1.0,) * logs[0].actions.shape[1])
        model = self.simulator.model
        self.plain = _without_friction(model)
        self.columns = environment.state_columns(model)
        self._data = mujoco.MjData(self.plain)
        self.states = [estimate_states(self.simulator, log, raw=True) for log in self.logs]
        self._rated = _rated(model, self.columns)
        for log, states in zip(self.logs, self.states, strict=True):
            for channel, place in self._rated:  # of a wheel whose speed alone is measured
                states[:, 1 + place] = _integrated(log.observations[:, channel], log.dt)
        self.actuators = [model.actuator(name).id for name in environment.actuators]
        self.drives = [drive_of(model, index) for index in self.actuators]
        self.period = _period(self.logs)  # samples
        self.count = sum(map(len, self.logs)) / self.period * _PERIODS
        some = zip(self.logs, self.states, gaps, strict=True)
        self.widths = [max(self._width(log, states), _GAP * gap) for log, states, (_, gap) in some]
        for k, (states, width) in enumerate(zip(self.states, self.widths, strict=True)):
            stopped = _stopped(model, states[:, 1 : 1 + model.nq])  # whose forces no regression knows
            self._seen[k] = self._seen[k] & ~maximum_filter1d(stopped, int(6 * width) + 1)
        self.rows = self._chosen()
        self.known = self._measured()
        self.scales: list[tuple[float, ...]] = [(1.0,)] * len(self.actuators)
        self.one_way = np.zeros(len(self.actuators), bool)
        self.springs = False
        self.gyros: list[Gyro] = []
        kinds, at = model.jnt_type, zip(model.jnt_dofadr.tolist(), model.jnt_qposadr.tolist(), strict=True)
        self._places = np.full(model.nv, -1)
        for kind, (dof, place) in zip(kinds, at, strict=True):
            self._places[dof] = place if int(kind) in (2, 3) else -1

    def motion(self, assumption: Assumption) -> Motion:
        """What the model asks for and its actuators give under an assumption."""
        model, data = self.plain, self._data
        states, given = [], []
        for log, own, width, rows in zip(self.logs, self.states, self.widths, self.rows, strict=True):
            read = self._read(log, own, assumption)
            states.append(_derived(model, read, log.dt, width, self.simulator.physics_steps(log.dt)[0])[rows])
            commands = self.driven(log, assumption, width, self.simulator.model)
            given.append(np.stack([commands[np.maximum(rows - self.late(d, log), 0)] for d in self.delays]))
        flat, commands = np.concatenate(states), np.concatenate(given, axis=1)  # (R, S), (D, R, A)
        count, nq, nv = len(flat), model.nq, model.nv
        asked, inertial = np.zeros((2, count, nv))
        moments = np.zeros((count, len(self.actuators), nv))
        lengths, rates = np.zeros((2, count, len(self.actuators)))
        dense, turned, spin = np.zeros((model.nu, nv)), np.zeros((len(self.gyros), count, 3)), np.zeros(6)
        for k, row in enumerate(flat):
            data.qpos[:], data.qvel[:], data.qacc[:] = row[:nq], row[nq : nq + nv], row[nq + nv : nq + 2 * nv]
            mujoco.mj_inverse(model, data)
            asked[k] = data.qfrc_inverse
            inertial[k] = data.qfrc_inverse - data.qfrc_bias + data.qfrc_passive
            if model.nu:
                mujoco.mju_sparse2dense(
                    dense, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
                )
                moments[k], lengths[k] = dense[self.actuators], data.actuator_length[self.actuators]
                rates[k] = moments[k] @ data.qvel
            for g, gyro in enumerate(self.gyros):
                mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, gyro.site, spin, 1)
                turned[g, k] = spin[:3]
        forces = self._forces(commands, lengths, rates)
        seen = [own[rows] for own, rows in zip(self._seen, self.rows, strict=True)]
        free = np.concatenate(seen)
        if may_touch(self.simulator.model):
            free &= ~_touches(self.simulator.model, flat[:, :nq])
        free |= free.mean() < _FREE
        speed, given_by = flat[:, nq + 2 * nv :], forces[..., None, :] * np.moveaxis(moments, 1, 2)
        return Motion(asked, inertial, speed, given_by, flat, self.known, free, tuple(turned))

    def fit(self, assumption: Assumption, every: bool = True) -> Outcome:
        """The regression at every delay, or at some and those near the best of these, and its best."""
        motion = self.given_motion if assumption == self.given else self.motion(assumption)
        free = motion.free
        size = np.sqrt(motion.inertial[free].var(0) + (motion.asked - motion.inertial)[free].var(0))
        dofs = np.flatnonzero(motion.usable & (size > 0))
        if not len(dofs):
            none, gains = np.ones(motion.usable.shape), np.zeros(len(self.actuators))
            rest = 0.0, np.zeros(len(self.delays)), 0.0, 0.0, np.zeros_like(motion.asked), size
            return Outcome(none, gains, gains + np.inf, 0 * none, 0 * none, *rest)
        costs, last = np.full(len(self.delays), np.inf), len(self.delays) - 1
        left = list(range(0, last + 1, 1 if every else 3))
        while left:  # down to the best of its neighbours
            for d in left:
                one = self._solved(motion, d, dofs, size)
                costs[d] = one.unexplained + one.far_off / self.count
            near = int(np.argmin(costs))
            left = [d for d in (near - 1, near + 1) if 0 <= d <= last and np.isinf(costs[d])]
        best = int(np.argmin(costs))
        gyros = tuple(self._turned(*pair) for pair in zip(self.gyros, motion.rates, strict=True))
        done, delay = self._solved(motion, best, dofs, size, True), _finer(self.delays, costs)
        unexplained = done.unexplained + sum(float(np.log(left.min())) for left in gyros)
        return replace(done, delay=delay, behind=costs - costs[best], unexplained=unexplained, gyros=gyros)

    def _turned(self, gyro: Gyro, rates: FloatArray) -> FloatArray:
        """What is left (F,) of a gyro's rates with each factor, whichever is late, and whatever its constant error."""
        left = []
        for late in range(int(_LATE_GYRO / self.logs[0].dt) + 1):
            some = zip(gyro.rates, self.rows, self.widths, strict=True)
            own = [gaussian_filter1d(x, w, axis=0)[np.minimum(r + late, len(x) - 1)] for x, r, w in some]
            seen, model = (x - x.mean(0) for x in (np.concatenate(own), rates))
            sizes = [max(f * np.sqrt((seen**2).mean()), np.sqrt((model**2).mean()), 1e-12) for f in gyro.factors]
            away = [np.sqrt(((f * seen - model) ** 2).mean()) for f in gyro.factors]
            left.append(np.divide(away, sizes))
        return np.clip(np.min(left, axis=0), _BEST, WORST)

    def _solved(self, motion: Motion, delay: int, dofs: IntArray, sizes: FloatArray, told: bool = False) -> Outcome:
        """At one delay, gains of any sign, friction of none but its own; told: with errors."""
        size, free = sizes[dofs], motion.free
        count, n, actuators = len(motion.asked), len(dofs), len(self.actuators)
        usual = np.sqrt((motion.speed[:, dofs] ** 2).mean(0)) + 1e-12
        columns = np.zeros((count, n, actuators + (5 if self.springs else 3) * n))
        columns[..., :actuators] = motion.given[delay][:, dofs] / size[:, None]
        turning = turning_of(motion.speed[:, dofs])
        for k in range(n):
            columns[:, k, actuators + k] = -motion.speed[:, dofs[k]] / usual[k]
            columns[:, k, actuators + n + k] = -turning[:, k]
            columns[:, k, actuators + 2 * n + k] = 1.0
            if self.springs and (place := self._places[dofs[k]]) >= 0:
                own = motion.states[:, place] - motion.states[:, place].mean()
                columns[:, k, actuators + 3 * n + k] = -own / (own.std() + 1e-12)
                columns[:, k, actuators + 4 * n + k] = 1.0  # it rests anywhere
        wanted = (motion.asked[:, dofs] / size * free[:, None]).ravel()
        columns *= free[:, None, None]
        design = columns.reshape(count * n, -1)
        loose = np.array([drive not in (Drive.POSITION, Drive.VELOCITY) for drive in self.drives], bool)
        held = motion.asked - motion.inertial
        rest = _ZERO * np.sqrt((held[:, dofs] ** 2).mean(0)) / size  # what a zero that is a little off changes
        kinds = self.simulator.model.actuator_dyntype[self.actuators] == int(mujoco.mjtDyn.mjDYN_INTEGRATOR)
        rest[motion.given[delay][:, dofs][..., kinds].any(axis=(0, 2))] = np.inf  # where integrators begin
        least = np.where(loose & ~self.one_way, -np.inf, 0.0)
        low = np.concatenate([least, np.zeros(2 * n), -rest - 1e-9])
        high = np.concatenate([np.full(actuators + 2 * n, np.inf), rest + 1e-9])
        if self.springs:
            low, high = np.append(low, [0.0] * n + [-np.inf] * n), np.append(high, [np.inf] * 2 * n)
        scale = np.sqrt((design**2).sum(0)) + 1e-12
        short, rotated = _shortened(design / scale, wanted)
        found = scipy.optimize.lsq_linear(short, rotated, (low * scale, high * scale), method="bvls").x / scale
        left = (wanted - design @ found).reshape(count, n)
        miss = np.clip(np.sqrt((left**2).sum(0) / free.sum()), _BEST, None)
        whole, (damping, friction) = np.ones(motion.usable.shape), np.zeros((2, *motion.usable.shape))
        whole[dofs] = miss
        damping[dofs] = found[actuators : actuators + n] * size / usual
        friction[dofs] = found[actuators + n : actuators + 2 * n] * size
        shares = np.zeros_like(motion.asked)
        shares[:, dofs] = left
        gains = found[:actuators]
        errors = np.zeros(actuators)
        if told:
            weighted = (columns / miss[:, None]).reshape(count * n, -1) / scale
            alike = count / self._independent(left)
            spread = np.linalg.inv(weighted.T @ weighted + _ROUNDING * np.eye(len(scale))) * alike
            errors = np.sqrt(np.diag(spread)[:actuators]) / scale[:actuators]
        both = float(np.log(np.minimum(miss, WORST)).sum()), self._far_off(gains)
        return Outcome(whole, gains, errors, damping, friction, 0.0, np.zeros(0), *both, shares, sizes)

    def independent(self, outcome: Outcome) -> float:
        """How many independent numbers of each degree of freedom the rows hold, by the correlation of what is left."""
        dofs = np.flatnonzero(self.known & (outcome.miss < 1.0))
        return self._independent(outcome.left[:, dofs]) if len(dofs) else self.count

    def _independent(self, left: FloatArray) -> float:
        pairs, first, total = 0.0, 0, float((left**2).sum())
        for rows in self.rows:
            own = left[first : first + len(rows)]
            pairs, first = pairs + float((own[1:] * own[:-1]).sum()), first + len(rows)
        alike = float(np.clip(pairs / max(total, 1e-30), 0.0, 0.99))
        return float(np.clip(first * (1 - alike) / (1 + alike), min(self.count, first), first))

    def _far_off(self, gains: FloatArray) -> float:
        """Nats against gains (A,) that are far from the model's in every unit that they may have."""
        out = 0.0
        for gain, drive, scales in zip(gains, self.drives, self.scales, strict=True):
            sd = _OFF_SERVO if drive in (Drive.POSITION, Drive.VELOCITY) else _OFF
            off = [np.log(max(abs(gain) / scale, 1e-9)) for scale in scales]
            out += 0.5 * float(np.clip(min(np.abs(off)) / sd, 0, 6) ** 2) if off else 0.0
        return out

    def _forces(self, commands: FloatArray, lengths: FloatArray, rates: FloatArray) -> FloatArray:
        """Forces (D, R, A) of commands, with the feedback of servos."""
        model, out = self.simulator.model, np.zeros_like(commands)
        for k, (index, drive) in enumerate(zip(self.actuators, self.drives, strict=True)):
            gain = _gain_of(model, index)
            fixed = int(model.actuator_gaintype[index]) == int(mujoco.mjtGain.mjGAIN_FIXED)
            rest, by_length, by_rate = model.actuator_biasprm[index, :3] if fixed else (0.0, -gain, -gain)
            out[..., k] = gain * commands[..., k]
            if int(model.actuator_dyntype[index]) == int(mujoco.mjtDyn.mjDYN_INTEGRATOR):  # begun anywhere
                own = gain * (commands[..., k] - commands[..., k].mean())
                out[..., k] = own + by_length * (lengths[:, k] - lengths[:, k].mean())
            elif drive == Drive.POSITION:
                out[..., k] += rest + by_length * lengths[:, k]
            elif drive == Drive.VELOCITY:
                out[..., k] += by_rate * rates[:, k]
        return out

    def _read(self, log: Trajectory, states: FloatArray, assumption: Assumption) -> FloatArray:
        """Positions (n, nq) of a log under an assumption."""
        if assumption == self.given:
            return states[:, 1 : 1 + self.plain.nq]
        observed = log.observations * np.array(assumption.observed) - np.array(assumption.zeros or 0.0)
        for one, other in assumption.minus:
            observed[:, one] -= observed[:, other]
        out = states[:, 1 : 1 + self.plain.nq].copy()
        for channel, column in enumerate(self.columns):
            if column is not None and column - 1 < self.plain.nq:
                out[:, column - 1] = observed[:, channel]
        for channel, place in self._rated:
            out[:, place] = _integrated(observed[:, channel], log.dt)
        return out

    @cached_property
    def given_motion(self) -> Motion:
        """As the configuration reads the logs."""
        return self.motion(self.given)

    def driven(self, log: Trajectory, assumption: Assumption, width: float, model: mujoco.MjModel) -> FloatArray:
        """Commands (n + 1, A) that act at each sample, smoothed as the positions are."""
        actions = np.concatenate([log.actions, log.actions[-1:]]) * np.array(assumption.driven)
        actions -= np.array(assumption.rests or 0.0)
        for k, index in enumerate(self.actuators):
            actions[:, k] = _filtered(model, index, actions[:, k], log.dt)
        steps = self.simulator.physics_steps(log.dt)[0]  # Euler's, in which a command acts on the position at once
        before = np.concatenate([actions[:1], actions[:-1]])
        held = 0.5 * (1 + 1 / steps) * actions + 0.5 * (1 - 1 / steps) * before
        return gaussian_filter1d(held, width, axis=0)

    def _width(self, log: Trajectory, states: FloatArray) -> float:
        """Samples of the kernel: as few as keep noise out of the accelerations."""
        positions = _scalars(self.plain, states[:, 1 : 1 + self.plain.nq])
        noise = np.sqrt((np.diff(positions, 3, axis=0) ** 2).mean(0) / 20) + 1e-12
        most = max(1.0, self.period / _WIDEST)
        for width in (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0, 48.0, 64.0):
            if width > most:
                return most
            bent = np.gradient(np.gradient(gaussian_filter1d(positions, width, axis=0), axis=0), axis=0)
            share = noise * np.sqrt(3 / (8 * np.sqrt(np.pi))) * width**-2.5 / np.maximum(bent.std(0), 1e-15)
            if np.median(share) < _NOISY:
                return width
        return most

    def _chosen(self) -> list[IntArray]:
        """Rows of each log, away from its ends."""
        each, out = max(20, _ROWS // len(self.logs)), []
        for log, width in zip(self.logs, self.widths, strict=True):
            edge = min(int(3 * width) + self.late(max(self.delays), log) + 1, len(log) // 4)
            rows = np.arange(edge, len(log) + 1 - edge)
            out.append(rows[np.unique(np.linspace(0, len(rows) - 1, min(each, len(rows))).astype(int))])
        return out

    def late(self, delay: int, log: Trajectory) -> int:
        """Samples of a log that a delay in samples of the first one is."""
        return round(delay * self.logs[0].dt / log.dt)

    def _measured(self) -> BoolArray:
        """Degrees of freedom (V,) that the logs measure, and that move."""
        model, known = self.plain, np.zeros(self.plain.nv, bool)
        columns = {column - 1 for column in self.columns if column is not None} | {place for _, place in self._rated}
        for joint in range(model.njnt):
            first, dof, size = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint]), 1
            size = {0: 6, 1: 3}.get(int(model.jnt_type[joint]), 1)
            moves = any(np.ptp(own[:, 1 + first]) > 0 for own in self.states)
            known[dof : dof + size] = moves and (first in columns or size > 1)
        known[_tied_dofs(model)] = False
        return known


def _shortened(design: FloatArray, wanted: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A least-squares problem (R, N) of columns of length one as one of N rows."""
    triangle = np.linalg.cholesky(design.T @ design + _ROUNDING * np.eye(design.shape[1]))
    return np.asarray(triangle.T), np.asarray(np.linalg.solve(triangle, design.T @ wanted))


def turning_of(speed: FloatArray) -> FloatArray:
    """The direction (R, V) in which dry friction is overcome, smooth where a joint turns round."""
    return np.tanh(speed / (_DRY * np.sqrt((speed**2).mean(0)) + 1e-12))


def _without_friction(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy whose inverse dynamics has neither friction nor contacts, limits or ties."""
    out = copy(model)
    out.dof_damping[:], out.dof_frictionloss[:] = 0.0, 0.0
    out.tendon_damping[:], out.tendon_frictionloss[:] = 0.0, 0.0
    out.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    return out


def _gain_of(model: mujoco.MjModel, index: int) -> float:
    """Force for each unit of the command, before the gear."""
    kind = int(model.actuator_gaintype[index])
    if kind == int(mujoco.mjtGain.mjGAIN_DCMOTOR):
        return float(model.actuator_gainprm[index, 1] / max(model.actuator_gainprm[index, 0], 1e-12))
    return float(model.actuator_gainprm[index, 0]) or 1.0


def _filtered(model: mujoco.MjModel, index: int, commands: FloatArray, dt: float) -> FloatArray:
    """Commands (n,) behind the actuator's own filter or integrator."""
    kind, constant = int(model.actuator_dyntype[index]), float(model.actuator_dynprm[index, 0])
    if kind == int(mujoco.mjtDyn.mjDYN_INTEGRATOR):
        return np.concatenate([[0.0], np.cumsum(commands[:-1]) * dt])
    if kind in (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT)) and constant > 0:
        keep, out = np.exp(-dt / constant), commands.copy()
        for k in range(1, len(out)):
            out[k] = keep * out[k - 1] + (1 - keep) * commands[k - 1]
        return out
    return commands


def _scalars(model: mujoco.MjModel, positions: FloatArray) -> FloatArray:
    """Of positions (n, nq) those of hinges, slides and free bodies' places (n, k)."""
    keep = np.ones(model.nq, bool)
    for joint in range(model.njnt):
        first, kind = int(model.jnt_qposadr[joint]), int(model.jnt_type[joint])
        if kind in (0, 1):
            keep[first + 3 * (kind == 0) : first + 3 * (kind == 0) + 4] = False
    moving = keep & (np.ptp(positions, axis=0) > 0)
    return positions[:, moving if moving.any() else keep]


def _derived(model: mujoco.MjModel, positions: FloatArray, dt: float, width: float, steps: int) -> FloatArray:
    """Positions, velocities, accelerations (n, nq + 3 nv), smoothed, and the velocities that damping acts on.

    As MuJoCo's Euler steps have them: a position moves with the velocity after the step, damping acts on that one too.
    """
    if model.nq == model.nv:
        moved = np.diff(positions, axis=0) / dt
        positions = gaussian_filter1d(positions, width, axis=0)
    else:
        moved, row = np.zeros((len(positions) - 1, model.nv)), np.zeros(model.nv)
        for k in range(len(moved)):
            mujoco.mj_differentiatePos(model, row, dt, positions[k], positions[k + 1])
            moved[k] = row
    moved = gaussian_filter1d(moved, width, axis=0)
    before, after = np.concatenate([moved[:1], moved]), np.concatenate([moved, moved[-1:]])
    shift = 0.0 if int(model.opt.integrator) == int(mujoco.mjtIntegrator.mjINT_RK4) else 0.5 / steps
    rates, damped = ((0.5 + x) * before + (0.5 - x) * after for x in (shift, -shift))
    return np.concatenate([positions, rates, (after - before) / dt, damped], axis=1)


def _touches(model: mujoco.MjModel, positions: FloatArray) -> BoolArray:
    """Whether anything touches in positions (n, nq)."""
    data, out = mujoco.MjData(model), np.zeros(len(positions), bool)
    for k, row in enumerate(positions):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        out[k] = data.ncon > 0
    return out


def _tied_dofs(model: mujoco.MjModel) -> list[int]:
    """Degrees of freedom that equality constraints tie: inverse dynamics knows no forces of these."""
    out = set[int]()
    for k in np.flatnonzero(model.eq_active0):
        kind, pair = int(model.eq_type[k]), (int(model.eq_obj1id[k]), int(model.eq_obj2id[k]))
        if kind == int(mujoco.mjtEq.mjEQ_JOINT):
            out |= {int(model.jnt_dofadr[joint]) for joint in pair if joint >= 0}
            continue
        sites = int(model.eq_objtype[k]) == int(mujoco.mjtObj.mjOBJ_SITE)
        for body in (int(model.site_bodyid[one]) if sites else one for one in pair):
            while body > 0:
                out |= set(range(model.body_dofadr[body], model.body_dofadr[body] + model.body_dofnum[body]))
                body = int(model.body_parentid[body])
    return sorted(out)


def _stopped(model: mujoco.MjModel, positions: FloatArray) -> BoolArray:
    """Whether a hinge or slide is at an end of its range in positions (n, nq)."""
    joints = np.flatnonzero(model.jnt_limited & (model.jnt_type > 1))
    low, high = model.jnt_range[joints].T
    room, own = _STOP * (high - low), positions[:, model.jnt_qposadr[joints]]
    return np.asarray(((own < low + room) | (own > high - room)).any(axis=1))


def _gaps(log: Trajectory) -> tuple[BoolArray, float]:
    """Which samples (T+1,) are near to measured ones in all channels, and the usual gap between these, in samples."""
    known, sample = np.isfinite(log.observations), np.arange(len(log) + 1)
    spaces = [float(np.median(np.diff(np.flatnonzero(own)))) for own in known.T if own.sum() > 1]
    usual, seen = max(spaces, default=1.0), np.ones(len(log) + 1, bool)
    for own in known.T:
        at = np.flatnonzero(own)
        if len(at):
            after = np.clip(np.searchsorted(at, sample), 0, len(at) - 1)
            away = np.minimum(np.abs(at[after] - sample), np.abs(sample - at[np.maximum(after - 1, 0)]))
            seen &= away <= usual
    return seen, usual if usual > 1 else 0.0


def _period(logs: Sequence[Trajectory]) -> float:
    """Samples in which the motion goes to and fro."""
    spans = []
    for log in logs:
        for series in log.observations.T:
            known = series[np.isfinite(series)]
            if len(known) > 8 and np.ptp(known) > 0:
                smooth = np.convolve(known, np.ones(5) / 5, mode="valid")
                speed = np.sqrt(np.mean(np.gradient(smooth) ** 2))
                spans.append(2 * np.pi * float(smooth.std()) / max(float(speed), 1e-12))
    longest = max(map(len, logs))
    return float(np.clip(np.median(spans), 8.0, longest)) if spans else float(longest)


def _finer(delays: Sequence[int], costs: FloatArray) -> float:
    """Where a parabola through the best delay and its neighbours is least."""
    i = int(np.argmin(costs))
    if 0 < i < len(delays) - 1:
        curve = np.polyfit(np.array(delays[i - 1 : i + 2], float), costs[i - 1 : i + 2], 2)
        if curve[0] > 0:
            return float(np.clip(-curve[1] / (2 * curve[0]), delays[i - 1], delays[i + 1]))
    return float(delays[i])


def _rated(model: mujoco.MjModel, columns: Sequence[int | None]) -> list[tuple[int, int]]:
    """Channels of velocities of hinges and slides whose position no channel measures, with the place of that."""
    places = {int(model.jnt_dofadr[j]): int(model.jnt_qposadr[j]) for j in range(model.njnt) if model.jnt_type[j] > 1}
    rated = ((k, places.get(column - 1 - model.nq)) for k, column in enumerate(columns) if column is not None)
    return [(k, place) for k, place in rated if place is not None and 1 + place not in columns]


def _integrated(rates: FloatArray, dt: float) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum(0.5 * (rates[1:] + rates[:-1]) * dt)])


def _bridged(log: Trajectory, environment: MjcfEnvironment) -> Trajectory:
    """The log with missing samples put between their neighbours."""
    if np.isfinite(log.observations).all():
        return log
    observations, sample = log.observations.copy(), np.arange(len(log) + 1)
    for series in observations.T:
        known = np.isfinite(series)
        if known.any():
            series[:] = np.interp(sample, sample[known], series[known])
    for triple in map(list, environment.rotations):
        if np.isfinite(log.observations[:, triple]).all(-1).any():
            observations[:, triple] = bridged(log.observations[:, triple])
    return Trajectory(observations, log.actions, log.dt)
