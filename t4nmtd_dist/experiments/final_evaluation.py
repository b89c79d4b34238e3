"""Evaluates the policy of a run that has ended: ``python -m t4nmtd_dist.experiments.final_evaluation RUN``.

It plays 100 episodes from the environment's reset and 100 from perturbed starts, the same for all runs, and writes
``evaluation.json`` into the run.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

from t4nmtd_dist.core.errors import PolicyError, RunError

EVALUATION_FILE = "evaluation.json"
EPISODES, PERTURB, SEED = 100, 20, 0


def evaluate_run(run: Path) -> None:
    """Write the evaluation of a run's policy; of a run without one, that nothing was learned."""
    from t4nmtd_dist.policy.loading import load
    from t4nmtd_dist.policy.many_episodes import play_many

    found: dict[str, Any] = {"perturb": PERTURB}
    try:
        policy = load(run)
    except PolicyError:
        found |= {name: {"success_rate": 0.0, "mean_length": 0.0, "episodes": 0} for name in ("plain", "perturbed")}
    else:
        found["plain"] = play_many(policy, EPISODES, seed=SEED)
        found["perturbed"] = play_many(policy, EPISODES, seed=SEED, perturb=PERTURB)
    fresh = run / f"{EVALUATION_FILE}.new"
    fresh.write_text(json.dumps(found, indent=1), encoding="utf-8")
    os.replace(fresh, run / EVALUATION_FILE)


def read_evaluation(run: Path) -> tuple[dict[str, Any], dict[str, Any]] | None:
    """What episodes from the reset and from perturbed starts came to; None if the run was not evaluated.

    Raises:
        RunError: if the file is damaged.
    """
    path = run / EVALUATION_FILE
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        return found["plain"], found["perturbed"]
    except FileNotFoundError:
        return None
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise RunError(f"{path} is damaged: {error}; delete it, and run the experiment again") from None


if __name__ == "__main__":
    evaluate_run(Path(sys.argv[1]))
