"""States of Waterworld for tests: ponds by hand, drawn ponds, and steps in them."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from envs.waterworld import WaterworldEnv

COLOURS = {
    6: ("red", "green", "blue", "black", "white", "grey"),
    8: ("red", "blue", "green", "pink", "black", "white", "grey", "yellow"),
}
RED, GREEN, BLUE = 0, 3, 6  # first balls of the colours with 6 colours

colour_counts = st.sampled_from([6, 8])
command = st.one_of(st.floats(-3.5, 3.5), st.sampled_from([-3.5, -3.0, -1.0, -0.5, 0.0, 0.25, 1.0, 2.0, 3.5]))
commands = st.lists(st.tuples(command, command), min_size=1, max_size=25)


def pond(
    agent: tuple[float, float, float, float], balls: dict[int, tuple[float, ...]] | None = None
) -> NDArray[np.float64]:
    """A snapshot for 6 colours: balls by number; the others rest in the corner (0, 30)."""
    rows = np.tile([0.0, 30.0, 0.0, 0.0], (19, 1))
    rows[18] = agent
    for number, ball in (balls or {}).items():
        rows[number] = ball
    return rows.ravel()


@st.composite
def snapshots(draw: st.DrawFn, colours: int) -> NDArray[np.float64]:
    """Balls on whole numbers, often close to the agent, at walls, or a border's breadth from touching."""
    top = 2 if colours == 6 else 3
    x, y = (draw(st.one_of(st.integers(0, 30).map(float), st.floats(0, 30))) for _ in range(2))
    rows = []
    for _ in range(3 * colours):
        place = [
            min(max(round(at) + draw(st.integers(-2, 2)), 0), 30) if draw(st.booleans()) else draw(st.integers(0, 30))
            for at in (x, y)
        ]
        rows.append([*place, draw(st.integers(-top, top)), draw(st.integers(-top, top))])
    return np.array([*rows, [x, y, draw(command), draw(command)]], dtype=np.float64).ravel()


def run(env: WaterworldEnv, *actions: tuple[float, float]) -> tuple[list[float], frozenset[str]]:
    """The agent's x, y, vx, vy and the labels after some steps."""
    info: dict[str, Any] = {}
    for action in actions:
        *_, info = env.step(np.array(action))
    return env.get_state()[-4:].tolist(), info["labels"]
