"""One message of every kind, as it is written on the wire: body and arrays, every field given."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

SENDER, NUMBER = "sample", 77

INTERVENTION = {"asked": 9, "answered": 7, "late": 1, "own_used": 2, "lag_total": 5}
STATS = {
    "phase": "training",
    "interactions": 4096,
    "gradient_steps": 96,
    "attempts": 70,
    "successes": 3,
    "recent_success": 0.25,
    "episode_steps": 12.5,
    "entropy": 1.75,
    "value_loss": 0.125,
    "peer_rows": 11,
    "processor_s": 2.5,
    "intervention": INTERVENTION,
    "errors": 4,
    "timeouts": 5,
    "terminated": 58,
}
LEARNER = {
    "pid": "p1",
    "phase": "training",
    "worker": "w1",
    "epoch": 2,
    "version": 3,
    "starts_waiting": 6,
    "heartbeat_age_s": 0.5,
    "total": STATS,
    "rates": {"interactions": 512.5, "gradient_steps": 12.25},
    "hint": "no success yet",
}
EVALUATION = {
    "job": 4,
    "interactions": 20000,
    "elapsed_s": 33.5,
    "success_rate": 0.75,
    "mean_length": 40.5,
    "std_length": 2.25,
    "mean_return": 8.5,
    "dfa_path": [0, 1, 3],
    "actions": "sampled",
    "other_success_rate": 0.5,
}
MISSING = {"what": "a worker for p2", "command": "t4nmtd-worker --pid p2", "needed": False}

Q_TABLE = [[0, "p1", 7.5], [1, "g", -0.25]]

BODIES: dict[str, dict[str, Any]] = {
    "claim": {
        "role": "learner",
        "instance": "w1",
        "pid": "p1",
        "critic_endpoint": "tcp://127.0.0.1:5600",
        "stand_in": True,
    },
    "granted": {
        "role": "learner",
        "pid": "p1",
        "epoch": 2,
        "lease_s": 10.0,
        "seed": 5,
        "task": {"name": "task7"},
        "dfa": {"states": 3, "initial": 0},
        "decomposition": {"p1": [[0, 1]]},
        "rho": [50.0, 100.0],
        "version": 3,
        "run_id": "0123456789abcdef",
        "asked": "p1",
    },
    "refused": {
        "reason": "lease is live",
        "text": "p1 is taken",
        "final": False,
        "pid": "p1",
    },
    "sync": {
        "pid": "p1",
        "epoch": 2,
        "sequence": 8,
        "version": 3,
        "start_cursor": 6,
        "stats": STATS,
    },
    "sync_reply": {
        "pid": "p1",
        "epoch": 2,
        "accepted_sequence": 8,
        "start_cursor": 7,
        "q_table": Q_TABLE,
        "peers": {"g": {"endpoint": "tcp://127.0.0.1:5601", "version": 4, "epoch": 1, "key": "k"}},
        "evaluate": True,
    },
    "release": {"pid": "p1", "epoch": 2},
    "evaluation_poll": {"epoch": 1, "busy": True},
    "evaluation_job": {
        "job": 4,
        "interactions": 20000,
        "q_table": Q_TABLE,
        "versions": {"p1": 3, "g": 4},
        "actions": ["greedy", "sampled"],
    },
    "evaluation_report": {
        "epoch": 1,
        "job": 4,
        "success_rate": 0.75,
        "mean_length": 40.5,
        "std_length": 2.25,
        "mean_return": 8.5,
        "episodes": 20,
        "dfa_path": [0, 1, 3],
        "processor_s": 0.5,
        "actions": "sampled",
        "other_success_rate": 0.5,
    },
    "goodbye": {"reason": "solved"},
    "status_request": {},
    "status": {
        "program": "0.1.0",
        "clock": 1700000000.5,
        "task": "task7",
        "seed": 5,
        "run_dir": "runs/task7/run",
        "phase": "training",
        "elapsed_s": 33.5,
        "interactions": 20000,
        "max_interactions": 5000000,
        "success_rate": 0.75,
        "solved_in_a_row": 1,
        "solved_needed": 5,
        "evaluator": "w2",
        "learners": [LEARNER],
        "critics": {"p1": "tcp://127.0.0.1:5600"},
        "success_needed": 0.9,
        "solved_at": 19000,
        "policy": EVALUATION,
        "missing": [MISSING],
    },
    "notice": {"text": "a worker ended"},
    "failure": {"text": "unknown kind"},
    "value_request": {"pid": "p1"},
    "value_reply": {"version": 3},
    "weights_request": {"pid": "p1", "newer_than": 2},
    "weights_reply": {"version": 3},
    "experience_request": {"pid": "p1", "step": 100},
    "experience_reply": {"first": 100, "written": 140, "origin": "0123456789abcdef"},
    "dashboard_state": {
        "task": "task7",
        "title": "Carry any one passenger to the goal",
        "formula": "F(p1)",
        "run_dir": "runs/task7/run",
        "seed": 5,
        "phase": "training",
        "elapsed_s": 33.5,
        "interactions": 20000,
        "max_interactions": 5000000,
        "dfa_states": 3,
        "accepting": [2],
        "error": [1],
        "dist": [1.0, None, 0.0],
        "solved_in_a_row": 1,
        "solved_needed": 5,
        "learners": [LEARNER],
        "q_table": [{"q": 0, "pid": "p1", "value": 7.5, "greedy": True}],
        "evaluations": [EVALUATION],
        "events": [{"elapsed_s": 1.5, "text": "w1 takes p1"}],
        "acceptance": "end",
        "success_needed": 0.9,
        "solved_at": 19000,
        "policy": EVALUATION,
        "missing": [MISSING],
    },
}

WEIGHTS: dict[str, NDArray[Any]] = {
    "weights.actor.0.weight": np.arange(6, dtype=np.float32).reshape(2, 3) / 4,
    "weights.log_alpha": np.array(-1.5, np.float32),
}

STARTS: dict[str, NDArray[Any]] = {
    "starts.q": np.array([1, 2], np.int32),
    "starts.state": np.array([[1, 2], [3, 4]], np.int32),
}

ARRAYS: dict[str, dict[str, NDArray[Any]]] = {
    "granted": WEIGHTS,
    "sync": {
        "progress.q": np.array([[0, 1, 12], [1, -1, 60]], np.int32),
        "progress.reward": np.array([10.0, -0.5]),
        **STARTS,
        **WEIGHTS,
    },
    "sync_reply": STARTS,
    "evaluation_job": {f"{pid}/weights.actor.0.weight": np.full((1, 2), i, np.float32) for i, pid in enumerate("pg")},
    "value_request": {
        "observation": np.array([[0.5, -0.5], [1.0, 2.0]], np.float32),
        "q": np.array([1, 0], np.int32),
    },
    "value_reply": {"value": np.array([7.5, -0.25], np.float32)},
    "weights_reply": WEIGHTS,
    "experience_reply": {
        "experience.actions": np.ones((1, 2, 3), np.float32),
        "experience.ended": np.array([[True, False]]),
    },
}
