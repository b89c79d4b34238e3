"""FrozenLake with passengers: the single environment, and how it is drawn."""

from __future__ import annotations

from itertools import compress
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from envs.frozenlake_rules import (
    ACTIONS,
    CARRYING,
    CELL,
    CELLS,
    ENDED,
    FIRST_PASSENGER,
    PASSENGERS,
    SIDE,
    Lake,
    Observation,
    advance,
    checked_states,
    label_rows,
    lake_with,
    observation_space,
    observe,
)
from envs.protocol import checked_action, checked_choice

if TYPE_CHECKING:
    from envs.rendering import Canvas

_TILE = 48  # pixels


class FrozenLakeEnv(gymnasium.Env[NDArray[Any], Any]):
    """One lake; id ``t4nmtd/FrozenLake-v0``, contract in ``envs.protocol.SnapshotEnv``.

    Actions: 0 left, 1 down, 2 right, 3 up, 4 pick, 5 drop. Moving against the border stays put. Pick takes
    the passenger of the agent's cell into empty hands; drop leaves the carried one on a cell without another.

    Labels: ``p1``, ``p2``, ``p3`` while carrying that passenger; ``g`` (or ``g1``, ``g2``) on the goal.

    Termination: entering a hole; with one goal also any move made on the goal cell. Whoever has ended stays
    as they are, and ``terminated`` stays true, until the environment is reset or set.

    Observation ``"features"``, 83 numbers in [-1, 1]. A one-hot of the agent's 64 cells, so that a small
    network learns a cell's action without smoothing over holes; a one-hot of the hands (nobody, 1, 2, 3); and
    for each passenger, who may be put down anywhere, its row and column (-1 to 1), its offset from the agent
    in rows and columns (by 7), and 1 if it lies on the agent's cell, ready to be picked. A carried passenger
    is where the agent is, offset 0, not ready. No two states with different futures look the same.

    Observation ``"raw"``, the authors' 8 numbers: cell, carrying (0..3), and (row, column) of each passenger,
    (-1, -1) while carried.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012 - gymnasium's own convention

    def __init__(self, goals: int = 1, observation: Observation = "features", render_mode: str | None = None) -> None:
        """Make a lake in its start state.

        Args:
            goals: 1 for the lake of task 7, 2 for that of task 8.
            observation: "features" or "raw".
            render_mode: None or "rgb_array".

        Raises:
            ValueError: if an argument is none of these.
        """
        checked_choice("render_mode", render_mode, (None, "rgb_array"))
        self.lake = lake_with(goals)
        self.propositions: tuple[str, ...] = self.lake.propositions
        self.observation_space = observation_space(observation)
        self.action_space = self._actions = spaces.Discrete(len(ACTIONS))
        self.render_mode = render_mode
        self._observation = observation
        self._states = self.lake.start[None].copy()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Back to the start; the same for every seed. Options are ignored."""
        super().reset(seed=seed)
        self._states[0] = self.lake.start
        return self._observe(), self._info()

    def step(self, action: int) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Take one action.

        Raises:
            ValueError: if ``action`` is not an integer from 0 to 5.
        """
        number = checked_action(self._actions, action)
        advance(self.lake, self._states, np.array([number]))
        return self._observe(), 0.0, bool(self._states[0, ENDED]), False, self._info()

    def get_state(self) -> NDArray[np.int32]:
        """A snapshot: int32 array of shape (7,), see the module."""
        snapshot: NDArray[np.int32] = self._states[0].astype(np.int32)
        return snapshot

    def set_state(self, state: NDArray[Any]) -> NDArray[np.float32]:
        """Restore a snapshot; returns the observation there.

        Raises:
            ValueError: if ``state`` is no snapshot of this lake, and then nothing changes.
        """
        self._states = checked_states(self.lake, state[None] if isinstance(state, np.ndarray) else state, 1)
        return self._observe()

    def render(self) -> NDArray[np.uint8] | None:
        """The lake and its labels, uint8 array of shape (420, 384, 3); None without a render mode."""
        if self.render_mode is None:
            return None
        return render_lake(self.lake, self._states[0])

    def _observe(self) -> NDArray[np.float32]:
        observation: NDArray[np.float32] = observe(self._states, self._observation)[0]
        return observation

    def _info(self) -> dict[str, Any]:
        return {"labels": frozenset(compress(self.propositions, label_rows(self.lake, self._states)[0]))}


def render_lake(lake: Lake, state: NDArray[np.int64]) -> NDArray[np.uint8]:
    """A picture of one state with its labels: uint8 array of shape (420, 384, 3)."""
    from envs.rendering import LABEL_BAND_HEIGHT, WHITE, Canvas

    canvas = Canvas(SIDE * _TILE, SIDE * _TILE + LABEL_BAND_HEIGHT, WHITE)
    for cell in range(CELLS):
        _draw_tile(canvas, lake, cell)
    for number in range(1, PASSENGERS + 1):
        cell = int(state[FIRST_PASSENGER + number - 1])
        if cell >= 0:
            x, y = _centre(cell)
            _draw_passenger(canvas, x - 10, y + 10, number)
    _draw_agent(canvas, *_centre(int(state[CELL])), int(state[CARRYING]), bool(state[ENDED]))
    labels = set(compress(lake.propositions, label_rows(lake, state[None])[0]))
    canvas.label_band(lake.propositions, labels, "ended" if state[ENDED] else "")
    return canvas.to_array()


def _centre(cell: int) -> tuple[float, float]:
    row, column = divmod(cell, SIDE)
    return (column + 0.5) * _TILE, (row + 0.5) * _TILE


def _draw_tile(canvas: Canvas, lake: Lake, cell: int) -> None:
    """Ice; on it a hole, a flag with the goal's name, or the mark of the start."""
    from envs.rendering import DARK, GREEN, GREY, SKY, WHITE

    x, y = _centre(cell)
    half = _TILE / 2
    ice = (226, 240, 250)
    canvas.rectangle((x - half, y - half, x + half, y + half), fill=ice, outline=WHITE)
    tile = lake.tiles[cell]
    if tile == "H":
        canvas.disc(x, y, half - 5, fill=(16, 42, 67), outline=SKY, width=2)
    elif tile == "G":
        name = lake.propositions[PASSENGERS + lake.tiles[:cell].count("G")]
        canvas.rectangle((x - half + 2, y - half + 2, x + half - 2, y + half - 2), outline=GREEN, width=3)
        canvas.line([(x - 19, y + 17), (x - 19, y - 18)], DARK, 2)
        canvas.rectangle((x - 19, y - 19, x + 1, y - 4), fill=GREEN)
        canvas.text(x - 9, y - 11.5, name, WHITE, 13)
    elif tile == "S":
        canvas.text(x, y, "S", GREY, 20)


def _draw_passenger(canvas: Canvas, x: float, y: float, number: int) -> None:
    """A numbered disc, one colour per passenger."""
    from envs.rendering import BLACK, ORANGE, PURPLE, WHITE, YELLOW

    canvas.disc(x, y, 10, fill=(ORANGE, PURPLE, YELLOW)[number - 1], outline=WHITE, width=2)
    canvas.text(x, y, str(number), BLACK, 14)


def _draw_agent(canvas: Canvas, x: float, y: float, carrying: int, ended: bool) -> None:
    """A figure on the right of its cell, red once the episode has ended, its passenger above its head."""
    from envs.rendering import BLUE, VERMILION, WHITE

    colour = VERMILION if ended else BLUE
    x += 10
    canvas.polygon([(x - 11, y + 22), (x, y + 2), (x + 11, y + 22)], colour)
    canvas.disc(x, y + 3, 8, fill=colour, outline=WHITE, width=1.5)
    if carrying:
        _draw_passenger(canvas, x, y - 12, carrying)
