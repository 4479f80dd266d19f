"""The only list of laws."""

from __future__ import annotations

from sipe_bayes.envs.laws.base import Law
from sipe_bayes.envs.laws.drive import Cogging, DeadZone, DirectionGain, ForceDrop, Power, SupplySag
from sipe_bayes.envs.laws.friction import DirectionDamping, DirectionFriction, LoadFriction, Stribeck
from sipe_bayes.envs.laws.memory import Hysteresis, Presliding
from sipe_bayes.envs.laws.residual import Residual

LAWS: dict[str, Law] = {
    law.name: law
    for law in (
        LoadFriction(),
        DirectionFriction(),
        DirectionDamping(),
        Stribeck(),
        Presliding(),
        Hysteresis(),
        Cogging(),
        ForceDrop(),
        DirectionGain(),
        Power(),
        DeadZone(),
        SupplySag(),
        Residual(),
    )
}
LAW_OF = {(law.kind, number.attribute): (law, k) for law in LAWS.values() for k, number in enumerate(law.numbers)}
