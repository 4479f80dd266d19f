"""Neural posterior estimation: a normalising flow, conditioned on what was observed, trained on simulations of the prior.

D. Greenberg, M. Nonnenmacher, J. Macke 2019, "Automatic Posterior Transformation for Likelihood-Free Inference"
(https://arxiv.org/abs/1905.07488); A. Tejero-Cantero et al. 2020, "sbi" (https://doi.org/10.21105/joss.02505), whose
trainer is used. With theta_i from the prior and x_i simulated, the flow q and an embedding network f maximise

    sum_i log q(theta_i | f(x_i)),

whose maximum over all q is the posterior p(theta | x), of whatever prior theta came from: one round needs no correction,
and the trained flow conditions on other logs without training again.

``rounds`` > 1: truncated proposals, see ``inference.rounds``.

Trajectories enter as sets of control steps (s, a, s' - s) through ``models.transitions.StepEmbedding``, or as they are
(``embedding="none"``).

Deviations. theta goes through Phi^-1 before the flow (see ``posterior.flow``): support is the cube, so that there is no
leakage to correct and no rejection. Simulations lose the samples that the log
lacks.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sipe_bayes.core.checkpoint import State
from sipe_bayes.core.trajectory import Trajectories
from sipe_bayes.core.validation import one_of, positive, share, whole
from sipe_bayes.inference.amortised.rounds import Rounds
from sipe_bayes.inference.amortised.simulations import Simulations
from sipe_bayes.models.sbi_tools import NoTracker, import_sbi, seeded
from sipe_bayes.models.training import check_device
from sipe_bayes.models.transitions import MOST_STEPS, Standardise, StepEmbedding, control_steps
from sipe_bayes.posterior import Posterior
from sipe_bayes.posterior.flow import Flow, spline_flow, to_line

FloatArray = NDArray[np.float64]

_TABLE = 2**26  # numbers: control steps of all simulations that are held at once


class NPE(Rounds):
    """A Flow; see the module's docstring.

    embedding: "transitions", for trajectories of any length, or "none", every finite sample as it is, for functions with few
    outputs. embedding_features: numbers it summarises a log in. rounds: more than one conditions on the log in hand and
    is not amortised. transforms, hidden, bins: layers of the spline flow, units in each of its two hidden layers, bins of a
    spline. batch_size (None: a twentieth of the simulations, 200 to 500), learning_rate, patience (epochs without a better
    validation loss; None: a tenth of batch_size, at least 20), max_epochs, held_out (share of the simulations that
    validates): of the training.
    device: "cpu" or "cuda", for the training alone.
    """

    name: ClassVar[str] = "npe"

    def __init__(
        self,
        simulator: Any,
        *,
        embedding: str = "transitions",
        embedding_features: int = 32,
        transforms: int = 5,
        hidden: int = 64,
        bins: int = 8,
        batch_size: int | None = None,
        learning_rate: float = 1e-3,
        patience: int | None = None,
        max_epochs: int = 1000,
        held_out: float = 0.1,
        device: str = "cpu",
        **settings: Any,
    ) -> None:
        super().__init__(simulator, **settings)
        self.embedding = one_of("embedding", embedding, ("transitions", "none"))
        self.embedding_features = whole("embedding_features", embedding_features)
        self.architecture = {
            "transforms": whole("transforms", transforms),
            "hidden": whole("hidden", hidden),
            "bins": whole("bins", bins, 2),
        }
        self.batch_size = None if batch_size is None else whole("batch_size", batch_size)
        self.learning_rate, self.held_out = positive("learning_rate", learning_rate), share("held_out", held_out)
        self.patience = None if patience is None else whole("patience", patience)
        self.max_epochs, self.device = whole("max_epochs", max_epochs), check_device(device)

    def settings(self) -> dict[str, Any]:
        return {
            **super().settings(),
            "embedding": self.embedding,
            "embedding_features": self.embedding_features,
            **self.architecture,
            "batch_size": self.batch_size,
            "learning_rate": self.learning_rate,
            "patience": self.patience,
            "max_epochs": self.max_epochs,
            "held_out": self.held_out,
            "device": self.device,
        }

    def start(self, trajectories: Trajectories) -> State:
        if self.embedding == "none" and not np.isfinite(trajectories.observations[_inside(trajectories)]).all():
            raise ValueError("trajectories: samples are missing, which embedding='none' cannot take; use 'transitions'")
        return super().start(trajectories)

    def train(self, simulations: Simulations, trajectories: Trajectories) -> State:
        line = to_line(torch.from_numpy(simulations.theta))
        mean, sd = line.mean(0), line.std(0).clamp_min(1e-6)
        x = torch.from_numpy(self._features(simulations.observations, trajectories))
        with seeded(_number(self.seed, 4)), warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            net, summary = self._optimise(((line - mean) / sd).float(), x)
        epochs = int(summary["epochs_trained"][-1])
        converged = epochs <= self.max_epochs
        self.still_improving(converged, self.max_epochs, "epochs", "max_epochs")
        weights = {f"weights.{key}": value.numpy() for key, value in net.state_dict().items()}
        told: State = {
            "simulations": len(x),
            "epochs": epochs,
            "validation_loss": float(summary["best_validation_loss"][-1]),
            "converged": converged,
        }
        return {**weights, **told, "features": x.shape[-1], "line_mean": mean.numpy(), "line_sd": sd.numpy()}

    def infer(self, state: State, trajectories: Trajectories) -> Posterior:
        x = torch.from_numpy(self._features(trajectories.observations[None].astype(np.float32), trajectories))
        if x.shape[-1] != state["features"]:
            raise ValueError(
                f"trajectories: expected {state['features']} numbers as in training, got {x.shape[-1]}; "
                "embedding='none' takes logs of one length only"
            )
        if self.embedding == "transitions" and not x.isfinite().any():
            raise ValueError("trajectories: no control step has all channels measured at both ends; resample the log")
        self.diagnostics.update(
            {name: state[name] for name in ("simulations", "epochs", "validation_loss", "converged")}
        )
        embedding = self._embedding(x.shape[-1])
        weights = {
            k.removeprefix("weights."): torch.from_numpy(v) for k, v in state.items() if k.startswith("weights.")
        }
        embedding.load_state_dict(_part(weights, "_embedding_net."))
        with torch.no_grad():
            context = embedding(x)[0].double()
        flow_weights = _part(weights, "net.")
        return Flow(flow_weights, context, state["line_mean"], state["line_sd"], self.space, **self.architecture)

    def _features(self, observations: NDArray[np.float32], trajectories: Trajectories) -> NDArray[np.float32]:
        """What the embedding takes: control steps (n, M, F), or all samples (n, F); without what the log lacks."""
        if self.embedding == "none":
            return np.ascontiguousarray(observations[:, _inside(trajectories)]).reshape(len(observations), -1)
        actions = trajectories.actions
        size = self.budget * (2 * observations.shape[-1] + actions.shape[-1])
        most = max(10, min(MOST_STEPS, _TABLE // size))
        seen = np.where(np.isfinite(trajectories.observations), observations, np.float32(np.nan))
        return control_steps(seen, actions, trajectories.length, most)

    def _embedding(self, features: int) -> Standardise | StepEmbedding:
        return Standardise(features) if self.embedding == "none" else StepEmbedding(features, self.embedding_features)

    def _optimise(self, u: Tensor, x: Tensor) -> tuple[Any, dict[str, Any]]:
        """sbi's trained density estimator, on the CPU, and its summary of the training."""
        estimators = import_sbi("neural_nets.estimators")

        def build(theta: Tensor, x: Tensor) -> Any:
            embedding = self._embedding(x.shape[-1])
            (embedding if isinstance(embedding, Standardise) else embedding.standardise).fit(x)
            context = embedding(x[:1]).shape[1]
            flow = spline_flow(theta.shape[1], context, **self.architecture)
            return estimators.ZukoFlow(flow, embedding, theta[0].shape, x[0].shape)

        trainer = import_sbi("inference").NPE(
            density_estimator=build, device=self.device, show_progress_bars=False, tracker=NoTracker()
        )
        trainer.append_simulations(u, x, exclude_invalid_x=False)
        validation = len(x) - int((1 - self.held_out) * len(x))
        batch = min(500, max(200, len(x) // 20)) if self.batch_size is None else self.batch_size
        net = trainer.train(
            # sbi drops the validation set's last, smaller batch: cut it evenly
            training_batch_size=max(1, validation // max(1, round(validation / batch)))
            if validation > batch
            else batch,
            learning_rate=self.learning_rate,
            validation_fraction=self.held_out,
            stop_after_epochs=max(20, batch // 10) if self.patience is None else self.patience,
            max_num_epochs=self.max_epochs,
        )
        return net.to("cpu").eval(), trainer.summary


def _inside(trajectories: Trajectories) -> NDArray[np.bool_]:
    """(R, T+1): samples that are not padding."""
    inside: NDArray[np.bool_] = np.arange(trajectories.observations.shape[1]) <= trajectories.length[:, None]
    return inside


def _part(weights: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {key.removeprefix(prefix): value for key, value in weights.items() if key.startswith(prefix)}


def _number(*seed: int) -> int:
    return int(np.random.SeedSequence(seed).generate_state(1)[0])
