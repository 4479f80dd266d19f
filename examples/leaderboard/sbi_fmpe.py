"""Flow matching, sbi called directly: FMPE with its default vector field, one round; all else as `sbi_npe.py`.

    python examples/leaderboard/sbi_fmpe.py --out runs/leaderboard/sbi_fmpe

J. Wildberger, M. Dax, S. Buchholz, S. Green, J. Macke, B. Schoelkopf 2023, "Flow Matching for Scalable Simulation-Based
Inference", https://arxiv.org/abs/2305.17161.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from sbi_npe import method

from sipe_bayes.benchmark.leaderboard.run import run_from_command_line
from sipe_bayes.models.sbi_tools import NoTracker, import_sbi


def fmpe(prior: torch.distributions.Distribution, embedding: torch.nn.Module) -> Any:
    field = import_sbi("neural_nets").posterior_flow_nn("mlp", embedding_net=embedding)
    return import_sbi("inference").FMPE(prior, vf_estimator=field, tracker=NoTracker(), show_progress_bars=False)


if __name__ == "__main__":
    about = "sbi's flow matching called directly, one round, mlp"
    run_from_command_line("sbi FMPE", about, ["sbi", "torch"], partial(method, train=fmpe))
