"""``t4nmtd record``: films of policies, and clear words where there can be none."""

from __future__ import annotations

import importlib.util
from functools import cache
from pathlib import Path
from typing import Any

import imageio.v3
import numpy as np
import pytest
from small_tasks import own_task

from t4nmtd_dist.cli import record as command
from t4nmtd_dist.cli.record import record
from t4nmtd_dist.core.action_modes import ActionMode
from t4nmtd_dist.core.errors import ConfigError, EnvError, T4NMTDError
from t4nmtd_dist.environments.trusted_code import remember
from t4nmtd_dist.method.compiled import compile_task
from t4nmtd_dist.policy.export import export_policy
from t4nmtd_dist.policy.global_policy import GlobalPolicy
from t4nmtd_dist.policy.loading import load
from t4nmtd_dist.policy.recording import BANNER_HEIGHT, LEAST_WIDTH, captioned, open_for_recording, play
from t4nmtd_dist.tasks import load_task

HERE = Path(__file__).parent
HORIZON = 4
CORRIDOR = f"""
name = "corridor"
formula = "F(left & X(F(right))) & G(!again)"
propositions = ["left", "right", "again"]
acceptance = "first"
[environment]
id = "own_environments:Corridor"
path = "{HERE}"
horizon = {HORIZON}
[learner]
hidden = [2]
"""


def exported(
    folder: Path, text: str = CORRIDOR, bias: tuple[float, float] = (1.0, 0.0), mode: ActionMode = "greedy"
) -> Path:
    """A policy that always goes left (or right, by ``bias``), of a user who has trained it."""
    task = compile_task(load_task(str(own_task(folder, text)), flags=["learner.algorithm=ppo"]), translator="python")
    remember(task.config.environment)
    width = 7 + task.dfa.states
    weights = {
        "actor.0.weight": np.zeros((2, width), np.float32),
        "actor.0.bias": np.array(bias, np.float32),
        "actor.2.weight": np.eye(2, dtype=np.float32),
        "actor.2.bias": np.zeros(2, np.float32),
    }
    export_policy(folder / "policy", task, [], dict.fromkeys(task.decomposition.pids, weights), {}, mode=mode)
    return folder / "policy"


def test_a_film_has_a_frame_for_every_step_and_lingers_on_the_last(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "film.gif"
    assert record(exported(tmp_path), out, episodes=2, seed=0, fps=5) == 0
    film = imageio.v3.improps(out, index=...)
    height, width = 20 * 3 + BANNER_HEIGHT, 140 * 3
    assert film.shape[1:3] == (height, width)
    assert LEAST_WIDTH <= 140 * 3
    assert "0 of 2 episodes accepted" in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def test_an_episode_tells_labels_state_and_subtask(tmp_path: Path) -> None:
    policy = load(exported(tmp_path))
    copy = open_for_recording(policy)
    moments = list(play(policy, copy, 0))
    assert [moment.step for moment in moments] == list(range(HORIZON + 1))
    assert [sorted(moment.labels) for moment in moments] == [[], [], [], ["left"], ["again", "left"]]
    assert [moment.pid for moment in moments] == ["left"] * 3 + ["right", None]
    assert [moment.outcome for moment in moments] == [""] * 4 + ["error state"]
    assert moments[3].q != moments[2].q
    frames = [captioned(moment, policy, copy.propositions) for moment in moments]
    banners = {frame[-BANNER_HEIGHT:].tobytes() for frame in frames}
    assert len(banners) == len(moments), "every caption says something of its own"
    assert all(side % 2 == 0 for frame in frames for side in frame.shape[:2])


def test_a_policy_that_was_evaluated_with_sampled_actions_is_filmed_so(tmp_path: Path) -> None:
    text = CORRIDOR.replace(f"horizon = {HORIZON}", "horizon = 30").replace(" & G(!again)", "")
    policy = load(exported(tmp_path, text, bias=(0.0, 0.1), mode="sampled"))
    copy = open_for_recording(policy)

    def places(seed: int) -> list[bytes]:
        return [moment.frame.tobytes() for moment in play(policy, copy, seed)]

    assert places(1) == places(1) != places(2), "greedily, every episode is alike: always to the right"


def test_an_episode_that_takes_too_long_says_so(tmp_path: Path) -> None:
    policy = load(exported(tmp_path, bias=(0.0, 1.0)))
    moments = list(play(policy, open_for_recording(policy), 0))
    assert moments[-1].step == HORIZON
    assert moments[-1].outcome in ("time is up", "error state")


def test_our_own_worlds_can_be_filmed(tmp_path: Path) -> None:
    moments = list(play(lake_policy(), open_for_recording(lake_policy()), 0))
    assert moments[0].frame.shape[2] == 3
    assert moments[-1].outcome == "nothing was learned here"


@cache
def lake_policy() -> GlobalPolicy:
    task = compile_task(load_task("task7"), translator="python")
    return GlobalPolicy(task, [], {})


@pytest.mark.skipif(importlib.util.find_spec("imageio_ffmpeg") is None, reason="mp4 needs the extra `record`")
def test_films_can_be_mp4(tmp_path: Path) -> None:
    out = tmp_path / "film.mp4"
    assert record(exported(tmp_path), out, episodes=1, seed=0, fps=None) == 0
    assert out.stat().st_size > 500


@pytest.mark.parametrize(
    ("out", "settings", "message"),
    [
        ("film.avi", {}, r"ends in \.mp4 or \.gif"),
        ("nowhere/film.gif", {}, "no folder"),
        ("film.gif", {"episodes": 0}, "at least one episode"),
        ("film.gif", {"fps": 0}, "--fps of at least 1"),
    ],
)
def test_wrong_usage_is_named(out: str, settings: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=message):
        record(tmp_path, tmp_path / out, **{"episodes": 1, "seed": 0, "fps": None, **settings})


def test_a_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(command.FORMATS, ".mp4", ("imageio", "no_such_package"))
    with pytest.raises(ConfigError, match=r"a \.mp4 film needs no_such_package: pip install 't4nmtd-dist\[record\]'"):
        record(tmp_path, tmp_path / "film.mp4", episodes=1, seed=0, fps=None)


def test_a_missing_policy_leaves_no_film(tmp_path: Path) -> None:
    with pytest.raises(T4NMTDError, match="no policy in"):
        record(tmp_path, tmp_path / "film.gif", episodes=1, seed=0, fps=None)
    assert list(tmp_path.iterdir()) == []


def test_an_environment_that_draws_nothing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import own_environments

    policy = exported(tmp_path)
    monkeypatch.setattr(own_environments.Corridor, "render", lambda _: None)
    with pytest.raises(EnvError, match="drew NoneType; expected an rgb_array"):
        record(policy, tmp_path / "film.gif", episodes=1, seed=0, fps=None)
    assert not (tmp_path / "film.gif").exists()


@pytest.mark.parametrize("make", ["always_drawn", "handed_on", "timed"])
def test_callables_of_every_form_can_be_filmed(make: str, tmp_path: Path) -> None:
    out = tmp_path / "film.gif"
    policy = exported(tmp_path, CORRIDOR.replace("Corridor", make))
    assert record(policy, out, episodes=1, seed=0, fps=5) == 0
    assert len(imageio.v3.improps(out, index=...).shape) == 4


def test_a_callable_that_cannot_draw_is_told_what_to_add(tmp_path: Path) -> None:
    policy = exported(tmp_path, CORRIDOR.replace("Corridor", "undrawn"))
    with pytest.raises(EnvError, match=r"undrawn\(\) takes no keyword render_mode.* add .* and pass it on"):
        record(policy, tmp_path / "film.gif", episodes=1, seed=0, fps=None)
    assert not (tmp_path / "film.gif").exists()
