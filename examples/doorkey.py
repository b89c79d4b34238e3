"""MiniGrid's DoorKey: fetch the key, open the door, and reach the goal, in a new room every episode."""

from __future__ import annotations

from typing import Any

import gymnasium
from minigrid.core.grid import Grid
from minigrid.core.world_object import Key

ROOM = "MiniGrid-DoorKey-5x5-v0"


class Labelled(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Adds labels, and saves and restores the state."""

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Create a new room."""
        observation, info = self.env.reset(**options)
        return observation, {**info, "labels": set()}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Act; the environment terminates at ``goal``."""
        observation, reward, terminated, _, info = self.env.step(action)
        room: Any = self.env.unwrapped
        found = {"key": room.carrying is not None, "door": self._door_is_open(), "goal": terminated}
        return observation, float(reward), terminated, False, {**info, "labels": {k for k, v in found.items() if v}}

    def _door_is_open(self) -> bool:
        return any(
            thing is not None and thing.type == "door" and thing.is_open for thing in self.env.unwrapped.grid.grid
        )

    def get_state(self) -> Any:
        """The encoded grid, and the state outside it."""
        room: Any = self.env.unwrapped
        carried = "" if room.carrying is None else room.carrying.color
        return room.grid.encode(), tuple(map(int, room.agent_pos)), int(room.agent_dir), carried

    def set_state(self, state: Any) -> None:
        """Restore a state from ``get_state``."""
        room: Any = self.env.unwrapped
        encoded, room.agent_pos, room.agent_dir, carried = state
        room.grid, _ = Grid.decode(encoded)
        room.carrying = Key(carried) if carried else None


def make(render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
    """The room without its step limit, which the task's horizon replaces."""
    return Labelled(gymnasium.make(ROOM, render_mode=render_mode, max_steps=10**9).unwrapped)
