"""Before a fit takes minutes: which columns the model explains nothing of, whatever its gains and friction."""

from __future__ import annotations

import mujoco

from sipe_bayes.calibration.init.regression import Regression
from sipe_bayes.calibration.machine import Drive
from sipe_bayes.calibration.problem import Problem
from sipe_bayes.core.findings import Code, Finding, finding

_LEFT = 0.9  # of a joint's forces, from which nothing of them is explained
_TIMES = 2.0  # what is left with commands of any sign


def not_followed(problem: Problem) -> tuple[Finding, ...]:
    """One for each fitted joint's column that moves, and whose forces the model hardly explains.

    Args:
        problem: a configuration read and bound.
    """
    regression = Regression(problem.environment, list(problem.train))
    model, other = regression.simulator.model, regression.fit(regression.given)
    regression.one_way[:] = True  # signs are those of the configuration
    outcome = regression.fit(regression.given)
    held = [i for i, drive in zip(regression.actuators, regression.drives, strict=True) if drive == Drive.POSITION]
    held = [i for i in held if int(model.actuator_trntype[i]) == int(mujoco.mjtTrn.mjTRN_JOINT)]
    served = {int(model.jnt_dofadr[model.actuator_trnid[i, 0]]) for i in held}  # by gains that few models have right
    fitted, out = problem.likelihood.fit or problem.environment.channels, []
    for channel in problem.environment.measurements:
        if channel.label in fitted and channel.target.startswith("joint:") and channel.target.endswith(".position"):
            dof = int(model.joint(channel.target[6:].rpartition(".")[0]).dofadr[0])
            least = _TIMES * other.miss[dof]
            lost = outcome.miss[dof] > (least if dof in served else min(_LEFT, least))
            if regression.known[dof] and lost:
                out.append(finding(Code.COLUMN_NOT_FOLLOWED, channel=channel.label, times=float(outcome.miss[dof])))
    return tuple(out)
