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
from scipy.ndimage import distance_transform_edt, gaussian_filter1d, maximum_filter1d
from scipy.signal import lfilter

from sipe_bayes.calibration.machine import Drive, drive_of
from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.rotations import bridged
from sipe_bayes.core.smoothing import filled
from sipe_bayes.core.trajectory import Trajectory
from sipe_bayes.envs.mjcf import MjcfEnvironment
from sipe_bayes.likelihood import estimate_states
from sipe_bayes.simulation.contacts import may_touch
from sipe_bayes.simulation.simulator import Simulator

BEST, WORST = 1e-3, 10.0
"""Of the forces, the least and the most that is left."""
SERVOS = (Drive.POSITION, Drive.VELOCITY)


@dataclass(frozen=True)
class Assumption:
    """How columns are read in place of what the configuration says.

    Args:
        observed: (O,) what each channel is multiplied by.
        driven: (A,) what each command is multiplied by.
        zeros: (O,) SI, what is taken off each channel once it is multiplied.
        rests: (A,) SI, what is taken off each command once it is multiplied.
        minus: pairs of channels, the second of which is taken off the first.
    """

    observed: tuple[float, ...]
    driven: tuple[float, ...]
    zeros: tuple[float, ...]
    rests: tuple[float, ...]
    minus: tuple[tuple[int, int], ...] = ()


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
        given: (D, R, V, A) forces of each actuator at each delay, feedback included.
        states: (R, nq + 3 nv) positions, velocities, accelerations, and the velocities that damping acts on.
        free: (R,) rows at which nothing touches, and that are measured.
        rates: of each gyro, (R, 3) rad/s in its own axes.
    """

    asked: FloatArray
    inertial: FloatArray
    given: FloatArray
    states: FloatArray
    free: BoolArray
    rates: tuple[FloatArray, ...] = ()

    @property
    def speed(self) -> FloatArray:
        """The velocities (R, V) that damping acts on."""
        return self.states[:, -self.asked.shape[1] :]

    @property
    def resisting(self) -> FloatArray:
        """What viscous friction, dry friction and rotors are multiples of, (3, R, V): speeds, signs, accelerations."""
        count = self.asked.shape[1]
        return np.stack([self.speed, turning_of(self.speed), self.states[:, -2 * count : -count]])


@dataclass(frozen=True)
class Outcome:
    """A regression at its best delay.

    Args:
        miss: (V,) what is left of the forces, as a share of how much they change; 1 of what is not measured.
        gains: (A,) of the actuators' forces.
        errors: (A,) standard errors of these.
        damping: (V,) force per velocity.
        friction: (V,) level of dry friction.
        rotor: (V,) inertia beyond the model's, of rotors and gears.
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
    rotor: FloatArray
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
        model, parts = self.simulator.model, [log.slice(0, min(len(log), 6000)) for log in logs]
        self.logs, gaps = tuple(_bridged(log, environment) for log in parts), [_gaps(log) for log in parts]
        self.delays = tuple(delays)
        channels, commands = len(environment.channels), logs[0].actions.shape[1]
        self.given = Assumption((1.0,) * channels, (1.0,) * commands, (0.0,) * channels, (0.0,) * commands)
        self.plain, self._data = _without_friction(model), mujoco.MjData(model)
        self.columns = environment.state_columns(model)
        self.states = [estimate_states(self.simulator, log, raw=True) for log in self.logs]
        self._rated = _rated(model, self.columns)
        for log, states in zip(self.logs, self.states, strict=True):
            for channel, place in self._rated:  # of a wheel whose speed alone is measured
                states[:, 1 + place] = _integrated(log.observations[:, channel], log.dt)
        self.actuators = [model.actuator(name).id for name in environment.actuators]
        self.drives = [drive_of(model, index) for index in self.actuators]
        self.period = _period(self.logs)  # samples
        self.count = 2 * sum(map(len, self.logs)) / self.period
        self.widths, self._seen = [], []
        for states, (seen, gap) in zip(self.states, gaps, strict=True):
            self.widths.append(max(_width(model, states[:, 1 : 1 + model.nq], max(1.0, self.period / 12)), 0.7 * gap))
            stopped = _stopped(model, states[:, 1 : 1 + model.nq])  # whose forces no regression knows
            self._seen.append(seen & ~maximum_filter1d(stopped, int(6 * self.widths[-1]) + 1))
        self.rows = [self._chosen(log, width) for log, width in zip(self.logs, self.widths, strict=True)]
        self.known = self._measured()
        self.scales: list[tuple[float, ...]] = [(1.0,)] * len(self.actuators)
        self.one_way = np.zeros(len(self.actuators), bool)
        self.springs = False
        self.gyros: list[Gyro] = []

    @cached_property
    def given_motion(self) -> Motion:
        """As the configuration reads the logs."""
        return self.motion(self.given)

    def motion(self, assumption: Assumption) -> Motion:
        """What the model asks for and its actuators give under an assumption."""
        model, data, nq, nv = self.plain, self._data, self.plain.nq, self.plain.nv
        some = zip(self.logs, self.states, self.widths, self.rows, strict=True)
        states = np.concatenate([
            _derived(model, self._read(log, own, assumption), log.dt, width, self.simulator.physics_steps(log.dt)[0])[r]
            for log, own, width, r in some
        ])  # fmt: skip
        asked, inertial = np.zeros((2, len(states), nv))
        moments = np.zeros((len(states), len(self.actuators), nv))
        lengths, rates = np.zeros((2, len(states), len(self.actuators)))
        dense, turned, spin = np.zeros((model.nu, nv)), np.zeros((len(self.gyros), len(states), 3)), np.zeros(6)
        for k, row in enumerate(states):
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
        forces = self._forces(self.commands(assumption, self.delays, self.simulator.model), lengths, rates)
        free = np.concatenate([own[rows] for own, rows in zip(self._seen, self.rows, strict=True)])
        if may_touch(self.simulator.model):
            free &= ~touches(self.simulator.model, states[:, :nq])
        free |= free.mean() < 0.2  # so few are no better than all
        given = forces[..., None, :] * np.moveaxis(moments, 1, 2)
        return Motion(asked, inertial, given, states, free, tuple(turned))

    def fit(self, assumption: Assumption, every: bool = True) -> Outcome:
        """The regression at every delay, or at some and those near the best of these, and its best."""
        motion = self.given_motion if assumption == self.given else self.motion(assumption)
        size = np.sqrt(motion.inertial[motion.free].var(0) + (motion.asked - motion.inertial)[motion.free].var(0))
        dofs = np.flatnonzero(self.known & (size > 0))
        if not len(dofs):
            none, gains = np.ones(self.known.shape), np.zeros(len(self.actuators))
            rest = 0.0, np.zeros(len(self.delays)), 0.0, 0.0, np.zeros_like(motion.asked), size
            return Outcome(none, gains, gains + np.inf, 0 * none, 0 * none, 0 * none, *rest)
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
        """What is left (F,) of a gyro's rates with each factor, up to .06 s late, and whatever its constant error."""
        left, model, factors = [], rates - rates.mean(0), np.array(gyro.factors)[:, None, None]
        for late in range(int(0.06 / self.logs[0].dt) + 1):
            some = zip(gyro.rates, self.rows, self.widths, strict=True)
            own = [gaussian_filter1d(x, w, axis=0)[np.minimum(r + late, len(x) - 1)] for x, r, w in some]
            seen = factors * (np.concatenate(own) - np.concatenate(own).mean(0))
            sizes = np.maximum(np.sqrt((seen**2).mean((1, 2))), np.sqrt((model**2).mean()) + 1e-12)
            left.append(np.sqrt(((seen - model) ** 2).mean((1, 2))) / sizes)
        return np.clip(np.min(left, axis=0), BEST, WORST)

    def _design(self, motion: Motion, delay: int, dofs: IntArray, size: FloatArray) -> tuple[FloatArray, ...]:
        """Columns (R, V, N) at one delay, and the bounds (N,) of their coefficients.

        Of the actuators, of viscous and dry friction, of a constant, and where springs are believed of each joint's
        and of where that rests. Gains of forces may have any sign, friction none but its own.
        """
        count, n, actuators = len(motion.asked), len(dofs), len(self.actuators)
        resisting, given = motion.resisting[:, :, dofs], motion.given[delay][:, dofs]
        usual = np.sqrt((resisting**2).mean(1, keepdims=True)) + 1e-12
        parts = [*(-resisting / usual), np.ones((count, n))]
        held = (motion.asked - motion.inertial)[:, dofs]
        rest = 0.1 * np.sqrt((held**2).mean(0)) / size  # what a zero that is a little off changes
        kinds = self.simulator.model.actuator_dyntype[self.actuators] == int(mujoco.mjtDyn.mjDYN_INTEGRATOR)
        rest[given[..., kinds].any(axis=(0, 2))] = np.inf  # where integrators begin
        loose = np.array([drive not in SERVOS for drive in self.drives], bool) & ~self.one_way
        low = [np.where(loose, -np.inf, 0.0), np.zeros(3 * n), -rest - 1e-9]
        high = [np.full(actuators + 3 * n, np.inf), rest + 1e-9]
        if self.springs:
            places = _places(self.plain)[dofs]
            own = motion.states[:, places] - motion.states[:, places].mean(0)
            parts += [-own / (own.std(0) + 1e-12) * (places >= 0), np.ones((count, n)) * (places >= 0)]
            low, high = [*low, np.zeros(n), np.full(n, -np.inf)], [*high, np.full(2 * n, np.inf)]
        columns = np.zeros((count, n, actuators + len(parts) * n))
        columns[..., :actuators] = given / size[:, None]
        for p, part in enumerate(parts):
            columns[:, np.arange(n), actuators + p * n + np.arange(n)] = part
        return columns * motion.free[:, None, None], np.concatenate(low), np.concatenate(high)

    def _solved(self, motion: Motion, delay: int, dofs: IntArray, sizes: FloatArray, told: bool = False) -> Outcome:
        """The coefficients at one delay; told: with standard errors."""
        size, count, n, actuators = sizes[dofs], len(motion.asked), len(dofs), len(self.actuators)
        columns, low, high = self._design(motion, delay, dofs, size)
        wanted = (motion.asked[:, dofs] / size * motion.free[:, None]).ravel()
        design = columns.reshape(count * n, -1)
        scale = np.sqrt((design**2).sum(0)) + 1e-12
        triangle = np.linalg.cholesky((design / scale).T @ (design / scale) + 1e-10 * np.eye(len(scale)))
        rotated = np.linalg.solve(triangle, (design / scale).T @ wanted)  # as many rows as columns
        found = scipy.optimize.lsq_linear(triangle.T, rotated, (low * scale, high * scale), method="bvls").x / scale
        left = (wanted - design @ found).reshape(count, n)
        miss = np.clip(np.sqrt((left**2).sum(0) / motion.free.sum()), BEST, None)
        whole, resistance = np.ones(self.known.shape), np.zeros((3, *self.known.shape))
        whole[dofs], shares = miss, np.zeros_like(motion.asked)
        usual = np.sqrt((motion.resisting[:, :, dofs] ** 2).mean(1)) + 1e-12
        resistance[:, dofs] = found[actuators : actuators + 3 * n].reshape(3, n) * size / usual
        shares[:, dofs], gains, errors = left, found[:actuators], np.zeros(actuators)
        if told:
            weighted = (columns / miss[:, None]).reshape(count * n, -1) / scale
            spread = np.linalg.inv(weighted.T @ weighted + 1e-10 * np.eye(len(scale)))
            errors = np.sqrt(np.diag(spread)[:actuators] * count / self._independent(left)) / scale[:actuators]
        both = float(np.log(np.minimum(miss, WORST)).sum()), self._far_off(gains)
        damping, friction, rotor = resistance
        return Outcome(whole, gains, errors, damping, friction, rotor, 0.0, np.zeros(0), *both, shares, sizes)

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
        """Nats against gains (A,) that are far from the model's in every unit that they may have.

        The logarithm of a gain has an sd of log 3, that of a servo, which few models have right, one of log 10.
        """
        out = 0.0
        for gain, drive, scales in zip(gains, self.drives, self.scales, strict=True):
            off = [abs(np.log(max(abs(gain) / scale, 1e-9))) for scale in scales]
            sd = np.log(10.0 if drive in SERVOS else 3.0)
            out += 0.5 * float(np.clip(min(off) / sd, 0, 6) ** 2) if off else 0.0
        return out

    def _forces(self, commands: FloatArray, lengths: FloatArray, rates: FloatArray) -> FloatArray:
        """Forces (D, R, A) of commands, with the feedback of servos."""
        model, out = self.simulator.model, np.zeros_like(commands)
        for k, (index, drive) in enumerate(zip(self.actuators, self.drives, strict=True)):
            kind, prm = int(model.actuator_gaintype[index]), model.actuator_gainprm[index]
            motor, fixed = kind == int(mujoco.mjtGain.mjGAIN_DCMOTOR), kind == int(mujoco.mjtGain.mjGAIN_FIXED)
            gain = float(prm[1] / max(prm[0], 1e-12) if motor else prm[0] or 1.0)  # before the gear
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
        out = states[:, 1 : 1 + self.plain.nq].copy()
        if assumption == self.given:
            return out
        observed = log.observations * np.array(assumption.observed) - np.array(assumption.zeros)
        for one, other in assumption.minus:
            observed[:, one] -= observed[:, other]
        for channel, column in enumerate(self.columns):
            if column is not None and column - 1 < self.plain.nq:
                out[:, column - 1] = observed[:, channel]
        for channel, place in self._rated:
            out[:, place] = _integrated(observed[:, channel], log.dt)
        return out

    def commands(self, assumption: Assumption, delays: Sequence[int], model: mujoco.MjModel) -> FloatArray:
        """Commands (D, R, A) that act at each row, so many samples late, smoothed as the positions are."""
        out = []
        for log, width, rows in zip(self.logs, self.widths, self.rows, strict=True):
            actions = np.concatenate([log.actions, log.actions[-1:]]) * np.array(assumption.driven)
            actions -= np.array(assumption.rests)
            for k, index in enumerate(self.actuators):
                actions[:, k] = _filtered(model, index, actions[:, k], log.dt)
            steps = self.simulator.physics_steps(log.dt)[0]  # Euler's, in which a command acts on the position at once
            before = np.concatenate([actions[:1], actions[:-1]])
            held = gaussian_filter1d(0.5 * (actions + before) + 0.5 / steps * (actions - before), width, axis=0)
            out.append(np.stack([held[np.maximum(rows - self._late(d, log), 0)] for d in delays]))
        return np.concatenate(out, axis=1)

    def _late(self, delay: int, log: Trajectory) -> int:
        """Samples of a log that a delay in samples of the first one is."""
        return round(delay * self.logs[0].dt / log.dt)

    def _chosen(self, log: Trajectory, width: float) -> IntArray:
        """Rows of a log, 300 of all logs, away from its ends."""
        edge = min(int(3 * width) + self._late(max(self.delays), log) + 1, len(log) // 4)
        rows = np.arange(edge, len(log) + 1 - edge)
        count = min(max(20, 300 // len(self.logs)), len(rows))
        return rows[np.unique(np.linspace(0, len(rows) - 1, count).astype(int))]

    def _measured(self) -> BoolArray:
        """Degrees of freedom (V,) that the logs measure, and that move."""
        model, known = self.plain, np.zeros(self.plain.nv, bool)
        columns = {column - 1 for column in self.columns if column is not None} | {place for _, place in self._rated}
        for joint in range(model.njnt):
            first, dof = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
            size = {0: 6, 1: 3}.get(int(model.jnt_type[joint]), 1)
            moves = any(np.ptp(own[:, 1 + first]) > 0 for own in self.states)
            known[dof : dof + size] = moves and (first in columns or size > 1)
        known[_tied_dofs(self.simulator.model)] = False
        return known


def turning_of(speed: FloatArray) -> FloatArray:
    """The direction (R, V) in which dry friction is overcome, smooth where a joint turns round."""
    return np.tanh(speed / (0.1 * np.sqrt((speed**2).mean(0)) + 1e-12))  # of the usual speed


def _without_friction(model: mujoco.MjModel) -> mujoco.MjModel:
    """A copy whose inverse dynamics has neither friction nor contacts, limits or ties."""
    out = copy(model)
    out.dof_damping[:], out.dof_frictionloss[:] = 0.0, 0.0
    out.tendon_damping[:], out.tendon_frictionloss[:] = 0.0, 0.0
    out.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    return out


def _filtered(model: mujoco.MjModel, index: int, commands: FloatArray, dt: float) -> FloatArray:
    """Commands (n,) behind the actuator's own filter or integrator."""
    kind, constant = int(model.actuator_dyntype[index]), float(model.actuator_dynprm[index, 0])
    if kind == int(mujoco.mjtDyn.mjDYN_INTEGRATOR):
        return np.concatenate([[0.0], np.cumsum(commands[:-1]) * dt])
    if kind in (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT)) and constant > 0:
        keep = np.exp(-dt / constant)
        return np.asarray(lfilter([0.0, 1 - keep], [1.0, -keep], commands, zi=commands[:1])[0])
    return commands


def _places(model: mujoco.MjModel) -> IntArray:
    """Of each degree of freedom (V,) the place of its hinge's or slide's position; -1 of others."""
    out = np.full(model.nv, -1)
    scalar = model.jnt_type > 1
    out[model.jnt_dofadr[scalar]] = model.jnt_qposadr[scalar]
    return out


def _width(model: mujoco.MjModel, positions: FloatArray, most: float) -> float:
    """Samples of the kernel: as few as keep noise out of the accelerations."""
    own = _scalars(model, positions)
    noise = np.sqrt((np.diff(own, 3, axis=0) ** 2).mean(0) / 20) + 1e-12
    for width in (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0, 48.0, 64.0):
        if width > most:
            break
        bent = np.gradient(np.gradient(gaussian_filter1d(own, width, axis=0), axis=0), axis=0)
        share = noise * np.sqrt(3 / (8 * np.sqrt(np.pi))) * width**-2.5 / np.maximum(bent.std(0), 1e-15)
        if np.median(share) < 0.1:
            return width
    return most


def _scalars(model: mujoco.MjModel, positions: FloatArray) -> FloatArray:
    """Of positions (n, nq) those of hinges, slides and free bodies' places (n, k)."""
    keep = np.ones(model.nq, bool)
    for first, kind in zip(model.jnt_qposadr, model.jnt_type, strict=True):
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


def touches(model: mujoco.MjModel, positions: FloatArray) -> BoolArray:
    """Whether anything touches in positions (n, nq)."""
    data, out = mujoco.MjData(model), np.zeros(len(positions), bool)
    for k, row in enumerate(positions):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        out[k] = data.ncon > 0
    return out


def _tied_dofs(model: mujoco.MjModel) -> IntArray:
    """Degrees of freedom that equality constraints tie: inverse dynamics knows no forces of these."""
    model = copy(model)
    model.opt.jacobian, data = int(mujoco.mjtJacobian.mjJAC_DENSE), mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    jacobian = np.abs(data.efc_J.reshape(-1, model.nv)[: data.ne])
    return np.flatnonzero((jacobian > 1e-9 * jacobian.max(initial=0.0)).any(0))


def _stopped(model: mujoco.MjModel, positions: FloatArray) -> BoolArray:
    """Whether a hinge or slide is at an end of its range in positions (n, nq)."""
    joints = np.flatnonzero(model.jnt_limited & (model.jnt_type > 1))
    low, high = model.jnt_range[joints].T
    room, own = 0.01 * (high - low), positions[:, model.jnt_qposadr[joints]]
    return np.asarray(((own < low + room) | (own > high - room)).any(axis=1))


def _gaps(log: Trajectory) -> tuple[BoolArray, float]:
    """Which samples (T+1,) are near to measured ones in all channels, and the usual gap between these, in samples."""
    known = [own for own in np.isfinite(log.observations).T if own.any()]
    usual = max((float(np.median(np.diff(np.flatnonzero(own)))) for own in known if own.sum() > 1), default=1.0)
    near = [distance_transform_edt(~own) <= usual for own in known]
    return np.all(near, axis=0) | np.zeros(len(log) + 1, bool), usual if usual > 1 else 0.0


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
    if not 0 < i < len(delays) - 1:
        return float(delays[i])
    bend, slope, _ = np.polyfit(delays[i - 1 : i + 2], costs[i - 1 : i + 2], 2)
    return float(np.clip(-slope / (2 * bend), delays[i - 1], delays[i + 1])) if bend > 0 else float(delays[i])


def _rated(model: mujoco.MjModel, columns: Sequence[int | None]) -> list[tuple[int, int]]:
    """Channels of velocities of hinges and slides whose position no channel measures, with the place of that."""
    places = [-1] * (1 + model.nq) + _places(model).tolist()  # of each number of a state
    rated = [(k, places[column]) for k, column in enumerate(columns) if column is not None and column < len(places)]
    return [(k, place) for k, place in rated if place >= 0 and 1 + place not in columns]


def _integrated(rates: FloatArray, dt: float) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum(0.5 * (rates[1:] + rates[:-1]) * dt)])


def _bridged(log: Trajectory, environment: MjcfEnvironment) -> Trajectory:
    """The log with missing samples put between their neighbours."""
    if np.isfinite(log.observations).all():
        return log
    observations = filled(log.observations)
    for triple in map(list, environment.rotations):
        if np.isfinite(log.observations[:, triple]).all(-1).any():
            observations[:, triple] = bridged(log.observations[:, triple])
    return Trajectory(observations, log.actions, log.dt)
