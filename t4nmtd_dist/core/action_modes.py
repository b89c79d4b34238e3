"""Action selection modes of a policy, and the modes of an evaluation."""

from __future__ import annotations

from typing import Literal, get_args

from t4nmtd_dist.core.errors import PolicyError

ActionMode = Literal["greedy", "sampled"]
EvaluationActions = Literal["greedy", "sampled", "best"]


def action_mode(text: object) -> ActionMode:
    """Validate the name of an action mode.

    Raises:
        PolicyError: if it is unknown.
    """
    for mode in get_args(ActionMode):
        if text == mode:
            found: ActionMode = mode
            return found
    raise PolicyError(f"a policy cannot act in mode {text!r}; expected one of {', '.join(get_args(ActionMode))}")


def modes_to_play(setting: EvaluationActions, row_mode: ActionMode | None) -> tuple[ActionMode, ...]:
    """Modes of the next evaluation: the first is always played, another only if those before fall short.

    With ``best``, the mode of the current row of evaluations (``row_mode``) comes first, so that a row uses one mode.
    Without a row, greedy comes first.
    """
    if setting != "best":
        return (setting,)
    return ("sampled", "greedy") if row_mode == "sampled" else ("greedy", "sampled")
