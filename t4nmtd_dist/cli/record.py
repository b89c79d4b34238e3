"""``t4nmtd record``: records a video of an exported policy."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from t4nmtd_dist.core.errors import ConfigError

FORMATS = {".mp4": ("imageio", "imageio_ffmpeg"), ".gif": ("imageio",)}
USUAL_FPS = 10
LAST_FRAME_S = 1.0


def record(path: Path, out: Path, *, episodes: int, seed: int, fps: int | None, trust: bool = False) -> int:
    """Record episodes of the policy in ``path`` into ``out``; returns the exit code.

    Raises:
        ConfigError: if the format is unknown, a package for it is missing, or a number is out of range.
        TrustError: if the policy names untrusted code.
        EnvError: if the environment does not render.
    """
    _check_format(out)
    if episodes < 1 or (fps is not None and fps < 1):
        raise ConfigError(f"expected at least one episode and --fps of at least 1; got {episodes} and {fps}")
    from t4nmtd_dist.environments.trust import require_trust
    from t4nmtd_dist.policy.loading import load
    from t4nmtd_dist.policy.recording import open_for_recording

    policy = load(path)
    require_trust(policy.config.environment, f"the policy in {path}", given=trust)
    copy = open_for_recording(policy)
    rate = fps or int(copy.env.metadata.get("render_fps") or USUAL_FPS)
    with _writer(out, rate) as film:
        outcomes = _film(policy, copy, film, episodes, seed, max(1, round(rate * LAST_FRAME_S)))
    accepted = outcomes.count("accepted")
    print(f"{policy.config.name}: {accepted} of {episodes} episodes accepted; film in {out}")
    return 0


def _check_format(out: Path) -> None:
    if out.suffix not in FORMATS:
        raise ConfigError(f"--out {out}: expected a name that ends in {' or '.join(FORMATS)}")
    missing = [name for name in FORMATS[out.suffix] if importlib.util.find_spec(name) is None]
    if missing:
        raise ConfigError(
            f"a {out.suffix} film needs {' and '.join(missing)}: pip install 't4nmtd-dist[record]'"
            + (", or choose a .gif" if missing == ["imageio_ffmpeg"] else "")
        )
    if not out.parent.is_dir():
        raise ConfigError(f"--out {out}: no folder {out.parent}")


@contextmanager
def _writer(out: Path, fps: int) -> Iterator[Any]:
    """A video writer that renames its file to ``out`` on success."""
    import imageio.v2 as imageio

    fresh = out.with_name(f".{out.stem}.new{out.suffix}")
    options: dict[str, Any] = {"duration": 1000 / fps, "loop": 0}
    if out.suffix == ".mp4":
        options = {"fps": fps, "macro_block_size": 2}
    try:
        with imageio.get_writer(fresh, **options) as film:
            yield film
        os.replace(fresh, out)
    finally:
        fresh.unlink(missing_ok=True)


def _film(policy: Any, copy: Any, film: Any, episodes: int, seed: int, last_frames: int) -> list[str]:
    from t4nmtd_dist.policy.recording import captioned, play

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    outcomes = []
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        for episode in range(episodes):
            horizon = policy.config.environment.horizon
            bar = progress.add_task(f"episode {episode + 1} of {episodes}, steps", total=horizon)
            for moment in play(policy, copy, seed + episode):
                picture = captioned(moment, policy, copy.propositions)
                for _ in range(last_frames if moment.outcome else 1):
                    film.append_data(picture)
                progress.update(bar, completed=moment.step)
            outcomes.append(moment.outcome)
            progress.update(bar, total=moment.step)
    return outcomes
