"""The state of a search over windows: which phase it is in, where it stands, and what it has recorded."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum, auto
from typing import Self

import numpy as np

from sipe_bayes.core.arrays import BoolArray, FloatArray, IntArray
from sipe_bayes.core.findings import Code, Finding
from sipe_bayes.inference.laplace.levenberg_marquardt import DampingRule
from sipe_bayes.inference.laplace.strategy import Optimum, StrategyState
from sipe_bayes.likelihood.noise import Noise
from sipe_bayes.likelihood.quadratic_prior import UNIFORM_PRECISION, QuadraticPrior
from sipe_bayes.likelihood.windows import Windows


class Phase(StrEnum):
    """What the next step of a search does; ``WindowSearch`` has a function for each."""

    GROW = auto()
    """Of bodies that tumble: theta and the starts on beginnings of the windows, ever longer."""
    ROUGH = auto()
    """White noise of the size of the present residuals."""
    DESCEND = auto()
    """The noise as it was estimated last."""
    NOISE = auto()
    """The noise is estimated anew before the step."""
    FOLLOW = auto()
    """After groups of windows were fitted apart: towards the optimum of those that are followed; see ``followed``."""


@dataclass(frozen=True)
class Kept:
    """What is known at the present point and spares simulations.

    Args:
        residual: (W, L, C), of the simulation there; None where it was not made.
        jacobian: (W, L, C, N + D), of the last linearisation; None where none is to be kept.
        drift: nats by which what was foretold since the starts' columns were taken is wrong.
        keep_starts: whether those columns foretold the last gain.
        moved: whether theta or the starts have moved since the linearisation.
    """

    residual: FloatArray | None = None
    jacobian: FloatArray | None = None
    drift: float = 0.0
    keep_starts: bool = False
    moved: bool = True


@dataclass(frozen=True)
class Position:
    """Where the search from one starting point stands.

    Args:
        phase: what the next step does.
        theta: (N,), within the cube.
        starts: (W, D), of the windows.
        noise: as last estimated.
        damping: of the next step.
        iteration: steps until now; a new optimum begins again at zero.
        misfit: of the first residuals, in units of the channels' spread; zero before them.
        theta_step: of the finite differences, where the environment asks for no longer ones.
        refused: nats that the last linearisation promised and no simulation kept.
        kept: what spares simulations.
        centred: whether the search has gone to the middle of a ridge.
        patterns: pattern searches that have led on.
        horizon: control steps of the beginnings of windows that are looked at; zero for whole ones.
        group: which group of windows is fitted apart; None while all are searched.
        alone: whether theta moves alone, from the measured starts.
        slope: of the beginnings over the differences before these; zero where there is none to compare with.
        jumps: whether shorter differences than these measure jumps.
    """

    phase: Phase
    theta: FloatArray
    starts: FloatArray
    noise: Noise
    damping: float
    theta_step: float
    iteration: int = 0
    misfit: float = 0.0
    refused: float = 0.0
    kept: Kept = field(default_factory=Kept)
    centred: bool = False
    patterns: int = 0
    horizon: int = 0
    group: int | None = None
    alone: bool = False
    slope: float = 0.0
    jumps: bool = False

    @classmethod
    def at(cls, windows: Windows, theta: FloatArray, rule: DampingRule) -> Self:
        """At a starting point theta (N,), with a first guess of white noise, which the first step replaces."""
        fixed = windows.fixed_sd
        sd = np.where(np.isnan(fixed), np.maximum(0.1 * windows.spread, 1e-9), fixed)
        noise = Noise(sd, np.zeros(len(sd)))
        return cls(Phase.ROUGH, theta, windows.no_starts(), noise, rule.first, windows.theta_step)

    def afresh(self, rule: DampingRule) -> Self:
        """The same point without anything that was kept of earlier ones, and without a new noise."""
        phase = Phase.ROUGH if self.phase is Phase.ROUGH else Phase.DESCEND
        return replace(self, phase=phase, kept=Kept(), damping=rule.first)

    def following(self, optimum: WindowOptimum) -> Self:
        """Where the windows that are followed are looked for first: at an optimum of all."""
        at, noise = replace(self, phase=Phase.FOLLOW, group=None, iteration=0), Noise(optimum.sd, optimum.tau)
        return replace(at, theta=optimum.theta, starts=optimum.starts, noise=noise, kept=Kept())

    @property
    def revisits(self) -> bool:
        """Whether the search goes on from an optimum of this very starting point."""
        return self.patterns > 0


@dataclass(frozen=True)
class Followed:
    """Windows that are followed, and where.

    Args:
        counted: (W, L, C) samples that count, none in windows that are not followed.
        theta: (N,).
        starts: (W, D), of all windows.
        noise: (C,) of the samples that count.
    """

    counted: BoolArray
    theta: FloatArray
    starts: FloatArray
    noise: Noise

    @property
    def kept(self) -> IntArray:
        """Numbers (K,) of the windows that are followed."""
        return np.flatnonzero(self.counted.any((1, 2)))

    def of(self, windows: Windows) -> Windows:
        """Those of all windows, with nothing observed but what counts."""
        return windows.part(self.kept, self.counted[self.kept])

    def held(self, prior: QuadraticPrior) -> QuadraticPrior:
        """A prior beside which theta is held as by a uniform one where it stands, with the same pull there."""
        precision = prior.precision + UNIFORM_PRECISION * np.eye(len(self.theta))
        return QuadraticPrior(self.theta + np.linalg.solve(precision, prior.pull(self.theta)), precision)


@dataclass(frozen=True)
class WindowOptimum(Optimum):
    """An optimum of windows.

    Args:
        starts: (W, D).
        slope: (W, D, N): starts follow theta by minus this.
        guessed: whether the normal's width is only a guess.
        heavier: whether places that the normal all but excludes fit nearly as well.
        finding: why its intervals are not to be trusted; None where they may be.
        followed: windows that are followed through impacts, and where; None where that was not asked, or they are few.
        trims: whether the normal is that of these windows.
    """

    starts: FloatArray
    slope: FloatArray
    guessed: bool = False
    heavier: bool = False
    finding: Finding | None = None
    followed: Followed | None = None
    trims: bool = False

    @property
    def unsmooth(self) -> bool:
        """Whether the simulation does not follow its slope there."""
        return self.finding is not None and self.finding.code is Code.NOT_SMOOTH

    @property
    def scatters(self) -> bool:
        """Whether its normal is that of the scatter of groups of windows, or of windows that are not followed."""
        return self.finding is not None and self.finding.code in (Code.SCATTER, Code.WINDOWS_LOST)

    @property
    def judged_sd(self) -> FloatArray:
        """Noise (C,) that says whether the fit follows the logs: of the windows that its normal is of."""
        return self.followed.noise.sd if self.followed is not None and self.trims else self.sd

    @property
    def unexplained(self) -> bool:
        """Whether simulations leave more there than the noise of known starts."""
        return self.finding is not None and self.finding.code is Code.BEYOND_START_NOISE


@dataclass(frozen=True)
class WindowState(StrategyState[Position]):
    """A search over windows.

    Args:
        estimates: (N,) each, of groups of windows that were fitted apart.
        aside: the optima as they were recorded, while these are.
        wild: (k, 3), samples that are left out; see ``likelihood.wild_samples``.
        longer: whether the search has gone on from where longer windows led.
    """

    here: Position
    optima: tuple[WindowOptimum, ...] = ()
    estimates: tuple[FloatArray, ...] = ()
    aside: tuple[WindowOptimum, ...] = ()
    wild: IntArray = field(default_factory=lambda: np.zeros((0, 3), np.int64))
    longer: bool = False

    @property
    def known(self) -> bool:
        """Whether the search has come to one of the optima recorded earlier that explain the logs.

        In each principal direction of its normal within one sd, or within a tenth of the way that it had to come.
        """
        begin = self.points[self.point]
        for optimum in self.optima:
            if optimum.unexplained:
                continue
            eigenvalues, axes = np.linalg.eigh(optimum.covariance)
            sd = np.sqrt(eigenvalues)
            left = np.abs((self.here.theta - optimum.mean) @ axes) / sd
            whole = np.abs((begin - optimum.mean) @ axes) / sd
            if (left < np.maximum(1.0, 0.1 * whole)).all():
                return True
        return False

    def looked_around(self, optimum: Optimum) -> WindowState:
        """Where an optimum's normal stands: its budget left no room for a look around, and this was one."""
        if not isinstance(optimum, WindowOptimum) or optimum.finding is None:
            return self
        if optimum.finding.code is not Code.NOT_LOOKED_AROUND:
            return self
        optima = tuple(replace(one, finding=None) if one is optimum else one for one in self.optima)
        return replace(self, optima=optima)
