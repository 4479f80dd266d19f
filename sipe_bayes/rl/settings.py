"""How an agent learns: the one list of DDPG's settings, from which the options of ``sipe train`` are made."""

from __future__ import annotations

from dataclasses import dataclass, fields

from sipe_bayes.core.options import Options, option

_LATER = ("cloning", "end_hopeless", "actor_waits")


@dataclass(frozen=True)
class Settings(Options):
    """The defaults are the algorithm as ``sipe_bayes.rl.ddpg`` has it from the papers.

    Whatever differs from them is a deviation, which an agent's card names.
    """

    discount: float = option(0.99, "Of a reward one control step later.", least=0, most=1)
    tau: float = option(0.005, "How far the targets follow their networks in an update.", least=0, most=1)
    batch: int = option(256, "Transitions of an update.", least=1)
    hidden: tuple[int, ...] = option((256, 256), "Units of each hidden layer, of actor and critic.")
    learning_rate: float = option(3e-4, "Of Adam, for actor and critic.", least=0)
    exploration: float = option(0.1, "Sd of the noise on actions, in half ranges.", "half ranges", least=0)
    start_steps: int = option(25_000, "Steps with uniformly random actions, before any update.", least=0)
    actor_waits: int = option(
        0,
        "Steps before the actor learns, too: of one that begins as a given policy, whose critic knows nothing yet.",
        least=0,
    )
    capacity: int = option(1_000_000, "Steps that the replay buffer holds.", least=2)
    hindsight: int = option(
        4, "Transitions with a goal reached later to one with its own; tasks with goals only.", least=0
    )
    normalise: bool = option(False, "Shift and scale observations by their running mean and spread.")
    layer_norm: bool = option(False, "Normalise the critic's hidden layers.")
    n_step: int = option(1, "Rewards that a return sums before the critic is asked.", least=1)
    demonstration_share: float = option(0.0, "Of each batch, from the demonstrations.", least=0, most=1)
    cloning: float = option(
        0.0,
        "Weight of the squared distance from the demonstrations' actions in the actor's loss, in mean |Q|.",
        least=0,
    )
    end_hopeless: bool = option(False, "End an episode of the training where the robot has fallen, if the task knows.")
    lanes: int = option(1, "Environments stepped together, before their updates.", least=1, most=100_000)
    updates_per_step: float = option(1.0, "Updates for each control step.", least=0)
    clip_targets: bool = option(False, "Clip targets to what rewards from -1 to 0 allow.")
    action_penalty: float = option(
        0.0, "Weight of the mean squared action, in half ranges, in the actor's loss.", least=0
    )
    random_share: float = option(0.0, "Of steps, with a uniformly random action.", least=0, most=1)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "hidden", tuple(self.hidden))
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

    def described(self) -> dict[str, object]:
        """As a run's fingerprint has them: what came later is left out where it is off, so that earlier runs go on."""
        return {name: value for name, value in self.plain().items() if value or name not in _LATER}

    def deviations(self) -> dict[str, object]:
        """The settings that are not at their defaults, as JSON reads them back."""
        plain = self.plain()
        return {f.name: plain[f.name] for f in fields(self) if getattr(self, f.name) != f.default}
