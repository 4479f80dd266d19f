"""Neural posterior estimation: a normalising flow, given what was observed, trained on simulations of the prior.

D. Greenberg, M. Nonnenmacher, J. Macke 2019, "Automatic Posterior Transformation for Likelihood-Free Inference"
(https://arxiv.org/abs/1905.07488); A. Tejero-Cantero et al. 2020, "sbi" (https://doi.org/10.21105/joss.02505), whose
trainer is used. With theta_i from the prior and x_i simulated, the flow q and an embedding network f maximise

    sum_i log q(theta_i | f(x_i)),

whose maximum over all q is the posterior p(theta | x), of whatever prior theta came from: one round needs no
correction, and the trained flow conditions on other logs without training again.

``rounds`` > 1: truncated proposals, see ``inference.amortised.rounds``.

Trajectories enter as theta that a regression on the simulations makes of them (``embedding="regressed"`` and "robust",
``inference.amortised.summaries``), as sets of control steps (s, a, s' - s) through ``models.transitions.StepEmbedding``
("transitions"), or as they are ("none"). By default motions are regressed, which says more for the same simulations;
of a function, of which two values may explain the same x, their mean would say nothing.

Deviations:

- theta goes through Phi^-1 before the flow (see ``posterior.flow``): support is the cube, so that there is no leakage
  to correct and no rejection.
- The flow is of z less what is linear in a regression's summaries, which is most of it: what a network would have to
  learn to a fraction of the posterior's width it is given.
- Simulations lose the samples that the log lacks.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, from_numpy

from sipe_bayes.core.arrays import BoolArray, Float32Array, FloatArray
from sipe_bayes.core.options import Options, option
from sipe_bayes.core.seeding import seed_integer
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.inference.amortised.rounds import Rounds, RoundsOptions, RoundsState
from sipe_bayes.inference.amortised.summaries import REGRESSED
from sipe_bayes.models.sbi_tools import NoTracker, import_sbi, seeded
from sipe_bayes.models.training import Weights, check_device, weights
from sipe_bayes.models.transitions import MOST_STEPS, Standardise, StepEmbedding, control_steps
from sipe_bayes.posterior import Posterior
from sipe_bayes.posterior.flow import Flow, spline_flow, to_line
from sipe_bayes.simulation.callable_simulator import CallableSimulator

_INSIDE = (0.01, 0.99)  # where summaries, which may leave the cube, have a z
_TABLE = 2**26  # numbers: control steps of all simulations that are held at once, ten of each at least


@dataclass(frozen=True)
class NPEOptions(RoundsOptions):
    """Options of ``NPE``."""

    embedding: str | None = option(
        None,
        '"transitions": of control steps, of any number, default for functions; '
        '"regressed": theta as regressed on the simulations, default for motions; '
        '"robust": the same, of which the log\'s is by minimum distance; '
        '"none": every finite sample as it is, for functions with few outputs',
        among=("transitions", *REGRESSED, "none"),
    )
    embedding_features: int = option(32, "numbers that the embedding summarises a log in", least=1)
    transforms: int = option(5, "layers of the spline flow", least=1)
    hidden: int = option(64, "units in each of its two hidden layers", least=1)
    bins: int = option(8, "of a spline", least=2)
    batch_size: int | None = option(None, "default a twentieth of the simulations, 200 to 500", "simulations", least=1)
    learning_rate: float = option(1e-3, "of Adam", above=0)
    patience: int | None = option(
        None, "without a better validation loss; default a tenth of batch_size, at least 20", "epochs", least=1
    )
    max_epochs: int = option(1000, "passes over the simulations at most", "epochs", least=1)
    held_out: float = option(0.1, "share of the simulations that validates", above=0, below=1)
    device: str = option("cpu", 'or "cuda", for the training alone')

    def __post_init__(self) -> None:
        """Check, also the device."""
        super().__post_init__()
        check_device(self.device)

    @property
    def architecture(self) -> dict[str, int]:
        """The flow's."""
        return {"transforms": self.transforms, "hidden": self.hidden, "bins": self.bins}


@dataclass(frozen=True)
class TrainedFlow:
    """A flow with its embedding.

    Attributes:
        weights: of both.
        line: (P, N), what ``NPE.line_terms`` are multiplied by for the expected z = Phi^-1(theta).
        line_sd: (N,), of z about that; both standardise it.
        span: (2, P), least and largest of these terms in training: a log beyond them is taken for the nearest.
        features: numbers of a control step, or of a log, that the embedding takes.
        simulations: that it was trained on and validated with.
        epochs: that were made.
        validation_loss: of the best.
        converged: whether the training ended by itself.
    """

    weights: Weights
    line: FloatArray
    line_sd: FloatArray
    span: FloatArray
    features: int
    simulations: int
    epochs: int
    validation_loss: float
    converged: bool


class NPE(Rounds[TrainedFlow]):
    """Normalising flow (sbi) behind an embedding or a regression of logs; amortised, or in rounds. A Flow."""

    name: ClassVar[str] = "npe"
    options_type: ClassVar[type[Options]] = NPEOptions
    state_type: ClassVar = RoundsState[TrainedFlow]
    options: NPEOptions

    def start(self, trajectories: Trajectories) -> RoundsState[TrainedFlow]:
        """As the base's; raises ValueError for missing samples that the embedding cannot take."""
        whole = np.isfinite(trajectories.observations[_inside(trajectories)]).all()
        if self.options.embedding == "none" and not whole:
            raise ValueError("trajectories: samples are missing, which embedding='none' cannot take; use 'transitions'")
        return super().start(trajectories)

    @property
    def summary(self) -> str:
        """See the base's."""
        functions = isinstance(self.simulator, CallableSimulator)
        return self.options.embedding or ("transitions" if functions else "regressed")

    def train_network(self, inputs: Float32Array, theta: FloatArray, member: tuple[int, ...]) -> TrainedFlow:
        """The flow with its embedding, of greatest likelihood of held-out simulations."""
        z, terms = to_line(from_numpy(theta)), from_numpy(self.line_terms(inputs))
        line = torch.linalg.lstsq(terms, z, driver="gelsd").solution
        left = z - terms @ line
        sd = left.std(0).clamp_min(1e-6)
        x, seed = from_numpy(inputs), seed_integer([self.seed, 4, *member])
        with seeded(seed), warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            net, summary = self._optimise((left / sd).float(), x)
        epochs = int(summary["epochs_trained"][-1])
        converged = epochs <= self.options.max_epochs
        self.still_improving(converged, self.options.max_epochs, "epochs", "max_epochs")
        loss = float(summary["best_validation_loss"][-1])
        fitted, span = line.contiguous().numpy(), torch.stack([terms.amin(0), terms.amax(0)]).numpy()
        return TrainedFlow(weights(net), fitted, sd.numpy(), span, x.shape[-1], len(x), epochs, loss, converged)

    def infer_network(self, trained: TrainedFlow, inputs: Float32Array) -> Posterior:
        """The flow given the log; raises ValueError for one of another size, or without a whole control step."""
        x = from_numpy(inputs)
        if x.shape[-1] != trained.features:
            raise ValueError(
                f"trajectories: expected {trained.features} numbers as in training, got {x.shape[-1]}; "
                "embedding='none' takes logs of one length only"
            )
        if self.summary == "transitions" and not x.isfinite().any():
            raise ValueError("trajectories: no control step has all channels measured at both ends; resample the log")
        names = ("simulations", "epochs", "validation_loss", "converged")
        self.diagnostics |= {name: getattr(trained, name) for name in names}
        embedding = self._embedding(x.shape[-1])
        embedding.load_state_dict(_part(trained.weights, "_embedding_net."))
        with torch.no_grad():
            context = embedding(x)[0].double()
        flow = _part(trained.weights, "net.")
        mean = (np.clip(self.line_terms(inputs), *trained.span) @ trained.line)[0]
        return Flow(flow, context, mean, trained.line_sd, self.space, **self.options.architecture)

    def line_terms(self, inputs: Float32Array) -> FloatArray:
        """What z is linear in (n, P): the mean alone, or also a regression's summaries, as they are and as z."""
        constant = np.ones((len(inputs), 1))
        if self.summary not in REGRESSED:
            return constant
        summaries = inputs.astype(float)
        return np.hstack([constant, summaries, to_line(from_numpy(np.clip(summaries, *_INSIDE))).numpy()])

    def inputs(self, observations: NDArray[np.floating], trajectories: Trajectories) -> Float32Array:
        """What the embedding takes: control steps (n, M, F), or all samples (n, F); without what the log lacks."""
        observations = observations.astype(np.float32, copy=False)
        if self.options.embedding == "none":
            return np.ascontiguousarray(observations[:, _inside(trajectories)]).reshape(len(observations), -1)
        actions = trajectories.actions
        size = self.budget * (2 * observations.shape[-1] + actions.shape[-1])
        most = max(10, min(MOST_STEPS, _TABLE // size))
        seen = np.where(np.isfinite(trajectories.observations), observations, np.float32(np.nan))
        return control_steps(seen, actions, trajectories.length, most)

    def _embedding(self, features: int) -> Standardise | StepEmbedding:
        if self.summary != "transitions":
            return Standardise(features)
        return StepEmbedding(features, self.options.embedding_features)

    def _optimise(self, u: Tensor, x: Tensor) -> tuple[Any, dict[str, Any]]:
        """The density estimator that sbi has trained, on the CPU, and its summary of the training."""
        estimators, options = import_sbi("neural_nets.estimators"), self.options

        def build(theta: Tensor, x: Tensor) -> Any:
            embedding = self._embedding(x.shape[-1])
            (embedding if isinstance(embedding, Standardise) else embedding.standardise).fit(x)
            context = embedding(x[:1]).shape[1]
            flow = spline_flow(theta.shape[1], context, **options.architecture)
            return estimators.ZukoFlow(flow, embedding, theta[0].shape, x[0].shape)

        trainer = import_sbi("inference").NPE(
            density_estimator=build, device=options.device, show_progress_bars=False, tracker=NoTracker()
        )
        trainer.append_simulations(u, x, exclude_invalid_x=False)
        validation = len(x) - int((1 - options.held_out) * len(x))
        batch = options.batch_size or min(500, max(200, len(x) // 20))
        # sbi drops the validation set's last, smaller batch: cut it evenly
        even = max(1, validation // max(1, round(validation / batch)))
        net = trainer.train(
            training_batch_size=even if validation > batch else batch,
            learning_rate=options.learning_rate,
            validation_fraction=options.held_out,
            stop_after_epochs=options.patience or max(20, batch // 10),
            max_num_epochs=options.max_epochs,
        )
        return net.to("cpu").eval(), trainer.summary


def _inside(trajectories: Trajectories) -> BoolArray:
    """(R, T+1): samples that are not padding."""
    return np.asarray(np.arange(trajectories.observations.shape[1]) <= trajectories.length[:, None])


def _part(stored: Weights, prefix: str) -> dict[str, Tensor]:
    return {key.removeprefix(prefix): from_numpy(value) for key, value in stored.items() if key.startswith(prefix)}
