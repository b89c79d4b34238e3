"""Gymnasium environments that report true propositions and can be restored to any earlier state.

Importing this package registers them, so either of these makes an environment::

    import envs; gymnasium.make("t4nmtd/FrozenLake-v0", goals=1)
    gymnasium.make_vec("envs:t4nmtd/FrozenLake-v0", num_envs=64, goals=1)

Gymnasium 1.0 and later load no plugin entry points, so an id without ``envs:`` needs the import. The contract is in
``envs.protocol``.
"""

from __future__ import annotations

from gymnasium.envs.registration import register, registry

# id: (single environment, batched environment or None), as strings, so that physics engines are imported lazily.
_ENTRY_POINTS = {
    "t4nmtd/FrozenLake-v0": ("envs.frozenlake:FrozenLakeEnv", "envs.frozenlake:FrozenLakeVectorEnv"),
    "t4nmtd/Waterworld-v0": ("envs.waterworld:WaterworldEnv", "envs.waterworld:WaterworldVectorEnv"),
    "t4nmtd/Racecar-v0": ("envs.racecar:RacecarEnv", None),
    "t4nmtd/HalfCheetah-v0": ("envs.halfcheetah:HalfCheetahEnv", None),
}


def register_environments() -> None:
    """Register every environment with gymnasium; idempotent.

    No environment has a step limit: time limits belong to the learner and the evaluation.
    """
    for env, (entry_point, vector_entry_point) in _ENTRY_POINTS.items():
        if env not in registry:
            register(id=env, entry_point=entry_point, vector_entry_point=vector_entry_point)


register_environments()
