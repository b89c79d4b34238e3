"""``t4nmtd evaluate``: plays episodes of an exported policy."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from t4nmtd_dist.core.action_modes import ActionMode
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.environments.trust import require_trust
from t4nmtd_dist.policy.loading import load
from t4nmtd_dist.policy.many_episodes import play_many


def evaluate(
    path: Path,
    *,
    episodes: int,
    seed: int,
    perturb: int,
    as_json: bool,
    actions: ActionMode | None = None,
    trust: bool = False,
) -> int:
    """Play episodes and print the results; ``actions`` defaults to the export's mode.

    Raises:
        ConfigError: if ``episodes`` or ``perturb`` is out of range.
        TrustError: if the policy names untrusted code.
    """
    if episodes < 1 or perturb < 0:
        raise ConfigError(f"expected at least one episode and --perturb of 0 or more; got {episodes} and {perturb}")
    policy = load(path)
    require_trust(policy.config.environment, f"the policy in {path}", given=trust)
    found = play_many(policy, episodes, seed=seed, perturb=perturb, actions=actions)
    found |= {"actions": actions or policy.mode}
    if as_json:
        print(json.dumps({"task": policy.config.name, **found}))
    else:
        _print_sentence(policy.config.name, found, perturb)
    return 0


def _print_sentence(task: str, found: dict[str, Any], perturb: int) -> None:
    starts = f" from starts perturbed by up to {perturb} random actions ({found['redrawn']} redrawn)" if perturb else ""
    print(
        f"{task}: {found['success_rate']:.1%} of {found['episodes']} episodes succeeded with {found['actions']} actions"
        f"{starts}; "
        f"mean length {found['mean_length']:.1f}, mean return {found['mean_return']:.1f}"
    )
