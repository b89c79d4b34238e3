"""How a policy's actions are picked, and in which ways an evaluation plays."""

from __future__ import annotations

from typing import Literal, get_args

from t4nmtd_dist.core.errors import PolicyError

ActionMode = Literal["greedy", "sampled"]
EvaluationActions = Literal["greedy", "sampled", "best"]


def action_mode(text: object) -> ActionMode:
    """``text`` if it names an action mode.

    Raises:
        PolicyError: if it does not.
    """
    for mode in get_args(ActionMode):
        if text == mode:
            found: ActionMode = mode
            return found
    raise PolicyError(f"a policy cannot act in mode {text!r}; expected one of {', '.join(get_args(ActionMode))}")


def modes_to_play(setting: EvaluationActions, row_mode: ActionMode | None) -> tuple[ActionMode, ...]:
    """The modes of the next evaluation: the first is always played, another only where those before it fall short.

    With ``best``, the mode of the evaluations in a row comes first, so that every evaluation of a row was played in
    one and the same mode. Where there is no row, greedy actions come first.

    Args:
        setting: ``evaluation.actions``.
        row_mode: mode of the evaluations in a row so far; None if there is none.
    """
    if setting != "best":
        return (setting,)
    return ("sampled", "greedy") if row_mode == "sampled" else ("greedy", "sampled")
