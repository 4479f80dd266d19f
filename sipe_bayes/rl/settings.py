"""How an agent learns: the one list of DDPG's settings, from which the options of ``sipe train`` are made."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, fields
from typing import Any


def _setting(default: Any, help: str, low: float = 0.0, high: float = math.inf) -> Any:
    return field(default=default, metadata={"help": help, "low": low, "high": high})


@dataclass(frozen=True)
class Settings:
    """The defaults are the algorithm as ``sipe_bayes.rl.ddpg`` has it from the papers; whatever differs from them is a
    deviation, which an agent's card names."""

    discount: float = _setting(0.99, "Of a reward one control step later.", high=1)
    tau: float = _setting(0.005, "How far the targets follow their networks in an update.", high=1)
    batch: int = _setting(256, "Transitions of an update.", 1)
    hidden: tuple[int, ...] = field(
        default=(256, 256), metadata={"help": "Units of each hidden layer, of actor and critic."}
    )
    learning_rate: float = _setting(3e-4, "Of Adam, for actor and critic.")
    exploration: float = _setting(0.1, "Sd of the noise on actions, in half ranges.")
    start_steps: int = _setting(25_000, "Steps with uniformly random actions, before any update.")
    capacity: int = _setting(1_000_000, "Steps that the replay buffer holds.", 2)
    hindsight: int = _setting(4, "Transitions with a goal reached later to one with its own; tasks with goals only.")
    normalise: bool = _setting(False, "Shift and scale observations by their running mean and spread.")
    layer_norm: bool = _setting(False, "Normalise the critic's hidden layers.")
    n_step: int = _setting(1, "Rewards that a return sums before the critic is asked.", 1)
    demonstration_share: float = _setting(0.0, "Of each batch, from the demonstrations.", high=1)
    cloning: float = _setting(
        0.0, "Weight of the squared distance from the demonstrations' actions in the actor's loss, in mean |Q|."
    )
    end_hopeless: bool = _setting(
        False, "End an episode of the training where the robot has fallen, if the task knows."
    )
    lanes: int = _setting(1, "Environments stepped together, before their updates.", 1)
    updates_per_step: float = _setting(1.0, "Updates for each control step.")
    clip_targets: bool = _setting(False, "Clip targets to what rewards from -1 to 0 allow.")
    action_penalty: float = _setting(0.0, "Weight of the mean squared action, in half ranges, in the actor's loss.")
    random_share: float = _setting(0.0, "Of steps, with a uniformly random action.", high=1)

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if "low" in f.metadata and not f.metadata["low"] <= value <= min(f.metadata["high"], 1e15):
                bounds = f"at least {f.metadata['low']:g}"
                if f.metadata["high"] < math.inf:
                    bounds = f"from {f.metadata['low']:g} to {f.metadata['high']:g}"
                raise ValueError(f"{f.name}: expected a number {bounds}, got {value}")
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"hidden: expected the sizes of one or more layers, got {self.hidden}")
        if self.cloning and not self.demonstrated:
            raise ValueError(
                f"cloning: {self.cloning} needs demonstrations; raise demonstration_share, or leave it out"
            )
        if self.clip_targets and self.discount == 1:
            raise ValueError("clip_targets: expected a discount below 1, got 1; leave one of them out")

    @property
    def demonstrated(self) -> int:
        """Transitions of a batch that come from the demonstrations, its last ones."""
        return round(self.demonstration_share * self.batch)

    def deviations(self) -> dict[str, Any]:
        """The settings that are not at their defaults, as JSON reads them back."""
        return {
            f.name: list(value) if isinstance(value, tuple) else value
            for f in fields(self)
            if (value := getattr(self, f.name)) != f.default
        }

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)
