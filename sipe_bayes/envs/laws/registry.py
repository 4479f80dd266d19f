"""The laws by name, and by the target that writes one of their numbers: what each of these modules defines."""

from __future__ import annotations

from sipe_bayes.envs.laws import drive, friction, memory, residual
from sipe_bayes.envs.laws.base import Law

_MODULES = (friction, memory, drive, residual)
LAWS: dict[str, Law] = {
    kind.name: kind() for kind in Law.__subclasses__() if kind.__module__ in {module.__name__ for module in _MODULES}
}
LAW_OF = {(law.kind, number.attribute): (law, k) for law in LAWS.values() for k, number in enumerate(law.numbers)}
