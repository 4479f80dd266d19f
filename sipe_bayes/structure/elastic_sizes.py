"""The sizes of a gear or link that gives way, from those of a joint's motion.

Between a motor without inertia and its joint nothing can give way that shows: where the model has no armature there,
the extension ``armature`` is found first, and these beside it.
"""

from __future__ import annotations

from dataclasses import dataclass

from sipe_bayes.core.parameters import Parameter
from sipe_bayes.envs.internal.elastic import Elastic
from sipe_bayes.structure.machine import Machine

_ROTOR = 0.2  # of the inertia that the joint moves, taken for the motor's where the model has none
_SOFTEST = 2.0  # times the motion's own frequency: the lowest resonance
_LEAST_RANGE = 20.0  # of the softest spring to the stiffest that the physics step resolves
_START = 0.05  # of the softest spring's usual twist, where windows may start
_LOSSES = 0.005, 0.3  # time constants, of the motion's own


@dataclass(frozen=True)
class ElasticSizes:
    """Of a joint with a motor.

    Args:
        elastic: what the elastic joint begins with.
        most: compliance, rad/(N m) or m/N.
        losses: shortest and longest time constant of the loss, in seconds.
    """

    elastic: Elastic
    most: float
    losses: tuple[float, float]

    def loss(self, joint: str, site: str) -> Parameter:
        """The loss of the elastic ``joint``, named after the ``site`` of the extension."""
        low, high = self.losses
        return Parameter(
            f"{site}_loss",
            low,
            high,
            scale="log",
            targets=(f"joint:{joint}.compliance_loss",),
            description="damping over stiffness",
        )


def elastic_sizes(machine: Machine, site: str) -> ElasticSizes | None:
    """Sizes at a joint; None where no motor drives it or the physics step is too long for any spring."""
    if all(machine.joint_of(actuator) != site for actuator in machine.environment.actuators):
        return None
    sizes, model = machine.joints[site], machine.model
    own = float(model.dof_armature[int(model.joint(site).dofadr[0])])
    rotor = own or _ROTOR * sizes.inertia
    link = max(sizes.inertia - own, 0.1 * sizes.inertia)
    reduced, frequency = rotor * link / (rotor + link), sizes.velocity / sizes.position
    stiffest, softest = reduced / machine.timestep**2, reduced * (_SOFTEST * frequency) ** 2
    if stiffest < _LEAST_RANGE * softest:
        return None
    twist = _START * sizes.force / softest
    start = (min(twist, sizes.position), min(twist * _SOFTEST * frequency, sizes.velocity))
    low, high = (share / frequency for share in _LOSSES)
    elastic = Elastic(stiffest, reduced, start, loss=(low * high) ** 0.5)
    return ElasticSizes(elastic, 1 / softest, (low, high))
