"""Using a trained policy in a program: ``python examples/use_policy.py runs/task7/latest``."""

from __future__ import annotations

import sys

import gymnasium

from t4nmtd_dist.policy import load


def play(path: str) -> bool:
    """Play one episode with the policy in ``path`` (a run or exported policy); returns whether it solved the task."""
    policy = load(path)
    env = gymnasium.make("envs:t4nmtd/FrozenLake-v0", goals=1, max_episode_steps=200)
    observation, info = env.reset()
    solved = over = False
    while not (solved or over):
        observation, _, terminated, truncated, info = env.step(policy.act(observation, info["labels"]))
        labels, ended = info["labels"], terminated or truncated
        solved, over = policy.accepts(labels, ended=ended), ended or policy.failed(labels, ended=ended)
    print("solved" if solved else "not solved")
    return solved


if __name__ == "__main__":
    play(sys.argv[1] if len(sys.argv) > 1 else "runs/task7/latest")
