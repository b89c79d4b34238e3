"""What is true of every registered agent: its folder's modules, and what may be known of it without torch."""

from __future__ import annotations

import subprocess
import sys

import pytest

from t4nmtd_dist.agents.modules import actor_module, shapes_module
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.core.registry import AGENTS

WITHOUT_TORCH = ("agents.weight_checks", "agents.actors", "agents.protocol", "wire.task_size")


@pytest.mark.parametrize(
    "module", [*WITHOUT_TORCH, *(f"agents.{name}.shapes" for name in AGENTS.names())], ids=lambda name: str(name)
)
def test_what_the_coordinator_reads_of_agents_imports_no_torch(module: str) -> None:
    code = f"import sys, t4nmtd_dist.{module}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-P", "-c", code], timeout=60).returncode == 0


@pytest.mark.parametrize("module_of", [shapes_module, actor_module])
def test_an_unknown_algorithm_is_refused_with_the_known_ones(module_of: object) -> None:
    with pytest.raises(ConfigError, match=r"learner.algorithm: unknown agent 'sacc'; did you mean 'sac'.*ppo, sac"):
        module_of("sacc")  # type: ignore[operator]


@pytest.mark.parametrize("module_of", [shapes_module, actor_module])
def test_an_undecided_algorithm_is_refused(module_of: object) -> None:
    with pytest.raises(ConfigError, match="not decided yet"):
        module_of("auto")  # type: ignore[operator]
