"""Rules of FrozenLake with passengers (tasks 7 and 8), as look-up tables and functions on states.

Gymnasium's FrozenLake, 8x8 and not slippery, with passengers to pick up and put down, as in the authors' experiments
(AAAI 2026).

A state, and so a snapshot, is a row of 7 integers: goals (1 or 2, selects the map), cell (8*row + column), ended (1
after termination), carrying (a passenger's number or 0), and the cell of each passenger (-1 if carried).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from envs.checks import checked_choice, checked_snapshots

Observation = Literal["features", "raw"]

# S start, F ice, H hole, P passenger (1, 2, 3 in reading order), G goal.
MAPS = {
    1: ("SFFFFFHF", "FFHFFFFP", "HFHFFHFF", "FFFPFFHF", "FFHFFFFH", "PHHFFGFF", "FHFFFFFH", "FFHFFHFF"),
    2: ("SFFFFFHF", "FFHFFFFP", "HFHFFHFF", "FFFPFFHF", "FFHFFFFH", "PFFFFGFF", "FHFFFFFH", "FFGFFHFF"),
}
SIDE = 8
CELLS = SIDE * SIDE
PASSENGERS = 3
LEFT, DOWN, RIGHT, UP, PICK, DROP = ACTIONS = range(6)

GOALS, CELL, ENDED, CARRYING, FIRST_PASSENGER = range(5)  # the columns of a state
STATE_SIZE = FIRST_PASSENGER + PASSENGERS
CARRIED = -1

_HANDS = PASSENGERS + 1
_AGENT_FEATURES = CELLS + _HANDS
_PASSENGER_FEATURES = 5
OBSERVATION_SIZE = {"features": _AGENT_FEATURES + PASSENGERS * _PASSENGER_FEATURES, "raw": 2 + 2 * PASSENGERS}
_NUMBERS = np.arange(1, PASSENGERS + 1)


@dataclass(frozen=True, eq=False)
class Lake:
    """The rules of one map as look-up tables; an *agent index* is 4*cell + carrying.

    Attributes:
        propositions: names of the label columns.
        tiles: the map as one string of 64 symbols.
        start: int64 (7,), the state after a reset.
        cell_after: flat table of the next cell, indexed by (64*ended + cell)*6 + action.
        ended_after: flat table of the next ``ended``, with the same index.
        hands_after: flat table of the next ``carrying``, indexed by ((6*ended + action)*4 + carrying)*4 + here, where
            ``here`` is the passenger on the agent's cell, or 0.
        labels: bool (256, P), indexed by the agent index.
    """

    goals: int
    propositions: tuple[str, ...]
    tiles: str
    start: NDArray[np.int64]
    cell_after: NDArray[np.int64]
    ended_after: NDArray[np.int64]
    hands_after: NDArray[np.int64]
    labels: NDArray[np.bool_]


@cache
def lake_with(goals: int) -> Lake:
    """The lake of task 7 (``goals=1``) or task 8 (``goals=2``).

    Raises:
        ValueError: for any other number of goals.
    """
    checked_choice("goals", goals, tuple(MAPS))
    tiles = "".join(MAPS[goals])
    passengers = [cell for cell, tile in enumerate(tiles) if tile == "P"]
    goal_cells = [cell for cell, tile in enumerate(tiles) if tile == "G"]
    carrying = tuple(f"p{i}" for i in range(1, PASSENGERS + 1))
    goal_names = ("g",) if goals == 1 else ("g1", "g2")
    cell_after, ended_after = _movement(tiles, goals)
    return Lake(
        goals=goals,
        propositions=carrying + goal_names,
        tiles=tiles,
        start=np.array([goals, tiles.index("S"), 0, 0, *passengers], dtype=np.int64),
        cell_after=cell_after,
        ended_after=ended_after,
        hands_after=_hands(),
        labels=_labels(goal_cells),
    )


def _movement(tiles: str, goals: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Tables ``cell_after`` and ``ended_after``."""
    cells = np.tile(np.arange(CELLS)[:, None], (2, 1, len(ACTIONS)))
    row, column = np.divmod(np.arange(CELLS), SIDE)
    for action, (down, right) in {LEFT: (0, -1), DOWN: (1, 0), RIGHT: (0, 1), UP: (-1, 0)}.items():
        cells[0, :, action] = SIDE * np.clip(row + down, 0, SIDE - 1) + np.clip(column + right, 0, SIDE - 1)
    ended = np.isin(cells, [cell for cell, tile in enumerate(tiles) if tile == "H"])
    ended[1] = True
    if goals == 1:
        # Quirk of task 7: reaching the goal does not end the episode, but any move from it does, even with empty hands.
        # The agent stays on the goal: in gymnasium's FrozenLake, goal cells are absorbing.
        goal = tiles.index("G")
        cells[0, goal, :PICK] = goal
        ended[0, goal, :PICK] = True
    return cells.ravel(), ended.astype(np.int64).ravel()


def _hands() -> NDArray[np.int64]:
    """Table ``hands_after``."""
    hands = np.empty((2, len(ACTIONS), _HANDS, _HANDS), dtype=np.int64)
    hands[:] = np.arange(_HANDS)[:, None]
    hands[0, PICK, 0, :] = np.arange(_HANDS)
    hands[0, DROP, :, 0] = 0
    return hands.ravel()


def _labels(goal_cells: list[int]) -> NDArray[np.bool_]:
    """Table ``labels``."""
    cell, carrying = np.divmod(np.arange(CELLS * _HANDS), _HANDS)
    return np.concatenate([carrying[:, None] == _NUMBERS, cell[:, None] == goal_cells], axis=1)


def advance(lake: Lake, states: NDArray[np.int64], actions: NDArray[np.intp]) -> None:
    """Take one action in each lake, in place.

    Args:
        lake: the rules.
        states: shape (N, 7).
        actions: shape (N,): 0..5 for left, down, right, up, pick, drop.
    """
    cell, ended, carrying = states[:, CELL], states[:, ENDED], states[:, CARRYING]
    acting = ended * len(ACTIONS) + actions
    here = (states[:, FIRST_PASSENGER:] == cell[:, None]) @ _NUMBERS
    hands = lake.hands_after[(acting * _HANDS + carrying) * _HANDS + here]
    move = (ended * CELLS + cell) * len(ACTIONS) + actions
    # A dropped passenger is on the cell, a carried one nowhere. Passenger k is column CARRYING + k, so empty hands (k =
    # 0) write to column CARRYING itself, which is set last.
    rows = np.arange(len(states))
    states[rows, CARRYING + carrying] = cell
    states[rows, CARRYING + hands] = CARRIED
    states[:, CARRYING] = hands
    states[:, CELL] = lake.cell_after[move]
    states[:, ENDED] = lake.ended_after[move]


def label_rows(lake: Lake, states: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Labels of states (N, 7): bool (N, P), columns as in ``lake.propositions``."""
    return lake.labels.take(states[:, CELL] * _HANDS + states[:, CARRYING], axis=0)


def _agent_features() -> NDArray[np.float32]:
    """One-hot cell and one-hot hands by agent index, shape (256, 68)."""
    cell, carrying = np.divmod(np.arange(CELLS * _HANDS), _HANDS)
    one_hots = [np.eye(CELLS)[cell], np.eye(_HANDS)[carrying]]
    return np.concatenate(one_hots, axis=1).astype(np.float32)


def _passenger_features() -> NDArray[np.float32]:
    """Five numbers by agent's and passenger's cell, (64, 65, 5); passenger cell -1 means carried."""
    agent = np.stack(np.divmod(np.arange(CELLS), SIDE), axis=-1)[:, None, :]
    passenger = np.concatenate([np.broadcast_to(agent[:, 0], (CELLS, CELLS, 2)), agent], axis=1)
    place = 2 * passenger / (SIDE - 1) - 1
    offset = (passenger - agent) / (SIDE - 1)
    here = (passenger == agent).all(axis=-1, keepdims=True)
    here[:, CARRIED] = False
    return np.concatenate([place, offset, here], axis=-1).astype(np.float32)


_AGENT_TABLE = _agent_features()
_PASSENGER_TABLE = _passenger_features()
_COORDINATES = np.array([*np.ndindex(SIDE, SIDE), (-1, -1)], dtype=np.float32)


def observe(states: NDArray[np.int64], observation: Observation) -> NDArray[np.float32]:
    """Observations of states (N, 7), see ``envs.frozenlake.FrozenLakeEnv``.

    Returns:
        A new array (N, 83) for features, (N, 8) for raw.
    """
    cell, carrying, passengers = states[:, CELL], states[:, CARRYING], states[:, FIRST_PASSENGER:]
    out = np.empty((len(states), OBSERVATION_SIZE[observation]), dtype=np.float32)
    if observation == "raw":
        out[:, 0], out[:, 1] = cell, carrying
        out[:, 2:] = _COORDINATES[passengers].reshape(len(states), 2 * PASSENGERS)
        return out
    out[:, :_AGENT_FEATURES] = _AGENT_TABLE.take(cell * _HANDS + carrying, axis=0)
    relative = _PASSENGER_TABLE[cell[:, None], passengers]
    out[:, _AGENT_FEATURES:] = relative.reshape(len(states), PASSENGERS * _PASSENGER_FEATURES)
    return out


def observation_space(observation: Observation) -> spaces.Box:
    """The observation space of one lake.

    Raises:
        ValueError: if ``observation`` is neither "features" nor "raw".
    """
    checked_choice("observation", observation, tuple(OBSERVATION_SIZE))
    if observation == "features":
        return spaces.Box(-1.0, 1.0, (OBSERVATION_SIZE["features"],), np.float32)
    low = [0, 0] + [-1] * 2 * PASSENGERS
    high = [CELLS - 1, PASSENGERS] + [SIDE - 1] * 2 * PASSENGERS
    return spaces.Box(np.array(low, dtype=np.float32), np.array(high, dtype=np.float32))


def checked_states(lake: Lake, snapshots: object, count: int) -> NDArray[np.int64]:
    """Validate snapshots and copy them to states, int64 (count, 7).

    Raises:
        ValueError: if they are not integers of shape (count, 7), or one is not a state of this lake.
    """
    states = checked_snapshots("FrozenLake", snapshots, count, STATE_SIZE, "i").astype(np.int64)
    cell, ended, carrying = states[:, CELL], states[:, ENDED], states[:, CARRYING]
    passengers = states[:, FIRST_PASSENGER:]
    tiles = np.array(list(lake.tiles + " "))
    on_tile = tiles[np.where((cell >= 0) & (cell < CELLS), cell, CELLS)]
    under = tiles[np.where((passengers >= 0) & (passengers < CELLS), passengers, CELLS)]
    may_end = (on_tile == "H") | ((on_tile == "G") & (lake.goals == 1))
    crowded = np.diff(np.sort(passengers, axis=1), axis=1) == 0
    wrong = {
        f"its number of goals is not {lake.goals}": states[:, GOALS] != lake.goals,
        f"its cell is not in 0..{CELLS - 1}": on_tile == " ",
        "its ended is neither 0 nor 1": (ended != 0) & (ended != 1),
        "it has ended where no episode ends, or goes on in a hole": (ended > may_end) | (ended < (on_tile == "H")),
        f"its carrying is not in 0..{PASSENGERS}": (carrying < 0) | (carrying > PASSENGERS),
        "not exactly the carried passenger is at -1": ((passengers == CARRIED) != (carrying[:, None] == _NUMBERS)).any(
            axis=1
        ),
        "a passenger is neither carried nor on ice": ((passengers != CARRIED) & ((under == " ") | (under == "H"))).any(
            axis=1
        ),
        "two passengers are on one cell": crowded.any(axis=1),
    }
    for reason, rows in wrong.items():
        if rows.any():
            row = int(np.argmax(rows))
            raise ValueError(f"row {row} is no snapshot of this FrozenLake: {reason}: {states[row].tolist()}")
    return states
