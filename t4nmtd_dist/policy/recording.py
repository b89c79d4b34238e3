"""Renders a policy's episodes, with labels and DFA state in a caption."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from t4nmtd_dist.automata.acceptance import LAST
from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.environments.single_env import SingleEnv
from t4nmtd_dist.environments.snapshot_choice import with_snapshots
from t4nmtd_dist.environments.timed import ends_episode, remaining_share
from t4nmtd_dist.policy.global_policy import GlobalPolicy

Frame = NDArray[np.uint8]

LEAST_WIDTH = 360
BANNER_HEIGHT = 64
PAPER, INK, FAINT, GOOD, BAD = (245, 246, 248), (33, 37, 41), (173, 181, 189), (0, 128, 96), (200, 60, 30)


@dataclass(frozen=True)
class Moment:
    """One frame of an episode and its context.

    Attributes:
        frame: uint8 [h, w, 3], rendered by the environment.
        labels: names of the true propositions.
        q: the DFA state.
        pid: the active sub-task; None at the end.
        step: steps taken.
        outcome: "" during the episode; then "accepted" or the reason of failure.
    """

    frame: Frame
    labels: frozenset[str]
    q: int
    pid: str | None
    step: int
    outcome: str


def open_for_recording(policy: GlobalPolicy) -> SingleEnv:
    """The policy's environment with ``render_mode="rgb_array"``.

    Raises:
        EnvError: if it cannot be opened this way.
    """
    config = policy.config
    settings = with_snapshots(config.environment, config.propositions)
    return SingleEnv(settings, config.propositions, render_mode="rgb_array")


def play(policy: GlobalPolicy, env: SingleEnv, seed: int) -> Iterator[Moment]:
    """One episode from the environment's reset, in the policy's own action mode.

    Args:
        policy: the acting policy.
        env: from ``open_for_recording``.
        seed: for the reset and sampled actions.

    Raises:
        EnvError: if the environment renders no frames.
        PolicyError: if the policy was trained on observations of another size.
    """
    observation, q, labels, ended = env.reset(seed), policy.dfa.initial, frozenset[str](), ""
    horizon, timed = policy.config.environment.horizon, LAST in policy.dfa.propositions
    sampling = np.random.default_rng([seed, 4]) if policy.mode == "sampled" else None
    policy.begin(1)
    for step in range(horizon + 1):
        seen = observation[None]
        if timed:
            seen = np.column_stack([seen, remaining_share(step, horizon)])
        policy.check_fits(seen)
        ended = ended or _outcome(policy, q, step)
        if ended:
            yield Moment(_frame(env), labels, q, None, step, ended)
            return
        action = policy.actions(seen, np.array([q], np.int32), sampling)[0][0]
        yield Moment(_frame(env), labels, q, policy.active(q), step, ended)
        done = env.step(action)
        labels = frozenset(name for name, holds in zip(env.propositions, done.labels, strict=True) if holds)
        over = ends_episode(step + 1, horizon, terminated=done.terminated, truncated=done.truncated)
        observation, q = done.observation, policy.dfa.step(q, {*labels, LAST} if over else labels)
        if q not in policy.dfa.accepting | policy.dfa.error:
            ended = "the environment ended" if done.terminated else "time is up" if done.truncated else ""


def _outcome(policy: GlobalPolicy, q: int, step: int) -> str:
    if q in policy.dfa.accepting:
        return "accepted"
    if q in policy.dfa.error:
        return "error state"
    if q not in policy.subtask_of:
        return "nothing was learned here"
    return "time is up" if step == policy.config.environment.horizon else ""


def _frame(env: SingleEnv) -> Frame:
    drawn = env.render()
    if not isinstance(drawn, np.ndarray) or drawn.ndim != 3 or drawn.shape[2] != 3 or drawn.dtype != np.uint8:
        raise EnvError(f"{env.env} drew {type(drawn).__name__}; expected an rgb_array, uint8 [height, width, 3]")
    return drawn


def captioned(moment: Moment, policy: GlobalPolicy, propositions: tuple[str, ...]) -> Frame:
    """The frame with labels, DFA state and active sub-task below, uint8 [h, w, 3] with even sides."""
    height, width = moment.frame.shape[:2]
    scale = max(1, -(-LEAST_WIDTH // width))
    picture = Image.fromarray(moment.frame).resize((width * scale, height * scale), Image.Resampling.NEAREST)
    page = Image.new("RGB", (_even(picture.width), _even(picture.height + BANNER_HEIGHT)), PAPER)
    page.paste(picture)
    draw = ImageDraw.Draw(page)
    _draw_labels(draw, picture.height + 10, page.width, moment.labels, propositions)
    line = f"step {moment.step}   DFA state {moment.q}   "
    _text(draw, 10, picture.height + 38, line, INK)
    left = 10 + draw.textlength(line, _font())
    if moment.outcome:
        _text(draw, left, picture.height + 38, moment.outcome, GOOD if moment.outcome == "accepted" else BAD)
    else:
        _text(draw, left, picture.height + 38, f"sub-task {moment.pid}", INK)
    return np.asarray(page, np.uint8)


def _draw_labels(
    draw: ImageDraw.ImageDraw, top: float, width: float, labels: frozenset[str], propositions: tuple[str, ...]
) -> None:
    """True propositions dark, others faint or omitted if there is no room."""
    room = sum(draw.textlength(name, _font()) + 14 for name in propositions) < width - 10
    left = 10.0
    for name in propositions if room else sorted(labels):
        _text(draw, left, top, name, INK if name in labels else FAINT)
        right = left + draw.textlength(name, _font())
        if name in labels:
            draw.line((left, top + 19, right, top + 19), fill=GOOD, width=3)
        left = right + 14


def _text(draw: ImageDraw.ImageDraw, x: float, y: float, text: str, colour: tuple[int, int, int]) -> None:
    draw.text((x, y), text, colour, _font())


def _font() -> Any:
    return ImageFont.load_default(15)


def _even(side: int) -> int:
    return side + side % 2
