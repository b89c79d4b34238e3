"""Policies and runs as a stranger would make them: they name code that leaves a file behind when it is imported."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from t4nmtd_dist.core.config import EnvironmentConfig, TaskConfig
from t4nmtd_dist.method.compiled import compile_task
from t4nmtd_dist.policy.export import POLICY_FILE, export_policy
from t4nmtd_dist.runs.directory import RunDirectory
from t4nmtd_dist.runs.resuming import new_identity, write_identity
from t4nmtd_dist.tasks import load_task

PLANT = """
import pathlib
pathlib.Path({mark!r}).touch()
from own_environments import Corridor, ends
"""


@dataclasses.dataclass(frozen=True)
class Stranger:
    """A folder with a module ``planted`` in it; ``mark`` exists once anything of a stranger's has run."""

    folder: Path

    @property
    def mark(self) -> Path:
        return self.folder / "mark"

    @property
    def code(self) -> Path:
        return self.folder / "code"

    def plant(self, *names: str) -> None:
        """Write modules that leave the mark; each is a whole environment and a labelling function too."""
        for name in names:
            path = self.code / f"{name}.py"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(PLANT.format(mark=str(self.mark)), encoding="utf-8")

    def attacks(self) -> dict[str, dict[str, Any]]:
        """Sections ``[environment]`` that would run something."""
        self.plant("planted")
        own, path = ["planted:Corridor", "planted:ends"], str(self.code)
        return {
            "a function of Python's": {"id": "os:system", "options": {"command": f"touch {self.mark}"}},
            "a module of their own": {"id": own[0], "path": path},
            "several folders": {"id": own[0], "path": ["/nowhere", path]},
            "a labelling function": {"id": "CartPole-v1", "labels": own[1], "path": path},
            "a labelling function for a bundled environment": {
                "id": "envs:t4nmtd/FrozenLake-v0",
                "options": {"goals": 1},
                "labels": own[1],
                "path": path,
            },
            "an id that a module registers": {"id": "planted:CartPole-v1", "path": path},
        }

    def config(self, environment: dict[str, Any]) -> TaskConfig:
        """Task 7 with another environment."""
        settings = {"horizon": 20, **environment}
        if isinstance(settings.get("path"), list):
            settings["path"] = tuple(settings["path"])
        return dataclasses.replace(load_task("task7"), environment=EnvironmentConfig(**settings))

    def policy(self, environment: dict[str, Any]) -> Path:
        """An exported policy that names this environment, for observations of seven numbers."""
        task = compile_task(load_task("task7", flags=["learner.hidden=[2]"]), translator="python")
        weights = {
            "actor.0.weight": np.zeros((2, 7 + task.dfa.states), np.float32),
            "actor.0.bias": np.array([1.0, 0.0], np.float32),
            "actor.2.weight": np.eye(2, dtype=np.float32),
            "actor.2.bias": np.zeros(2, np.float32),
        }
        export_policy(self.folder / "policy", task, [], dict.fromkeys(task.decomposition.pids, weights), {})
        path = self.folder / "policy" / POLICY_FILE
        data = json.loads(path.read_text(encoding="utf-8"))
        data["task"]["environment"] = {"horizon": 20, **environment}
        path.write_text(json.dumps(data), encoding="utf-8")
        return path.parent

    def run(self, environment: dict[str, Any], *, serial: bool = False) -> Path:
        """A stopped run that names this environment."""
        run = RunDirectory(self.folder / "run")
        run.write_settings(self.config(environment), 0, 1000)
        write_identity(run.path, new_identity(serial=serial))
        return run.path
