"""``t4nmtd plot``: pictures of learning curves, and clear words where there can be none."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from t4nmtd_dist.cli.plot import draw, grouped, plot
from t4nmtd_dist.core.errors import ConfigError, RunError, T4NMTDError

RESULTS = Path(__file__).parent.parent / "benchmarks" / "results" / "tasks" / "t4nmtd"
TASK7 = [RESULTS / f"task7-s{seed}" for seed in range(3)]
TASK8 = [RESULTS / f"task8-s{seed}" for seed in range(2)]


def hidden(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir() if path.name.startswith(".")]


@pytest.mark.slow
def test_a_png_is_a_picture_of_curves(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "curves.png"
    assert plot([*TASK7, *TASK8], out) == 0
    with Image.open(out) as picture:
        assert picture.format == "PNG"
        colours = {tuple(colour) for colour in np.asarray(picture.convert("RGB")).reshape(-1, 3).tolist()}
    assert {(0x1F, 0x77, 0xB4), (0xFF, 0x7F, 0x0E)} <= colours  # the two curves
    assert capsys.readouterr().out == f"task7: 3 runs, task8: 2 runs; picture in {out}\n"
    assert hidden(tmp_path) == []


def test_an_svg_is_the_same_file_whenever_it_is_drawn(tmp_path: Path) -> None:
    for name in ("a.svg", "b.svg"):
        plot(TASK7, tmp_path / name, x="interactions", metrics="success")
    first, second = ((tmp_path / name).read_bytes() for name in ("a.svg", "b.svg"))
    assert first == second
    assert ElementTree.fromstring(first).tag.endswith("svg")


def test_a_row_for_every_metric_and_a_column_for_every_axis() -> None:
    figure = draw(grouped(TASK7, []), ("interactions", "time"), ["success", "length", "return"])
    assert len(figure.axes) == 6
    assert [panel.get_ylabel() for panel in figure.axes[::2]] == [
        "success rate", "episode length (steps)", "validation reward",
    ]  # fmt: skip
    assert [panel.get_xlabel() for panel in figure.axes[-2:]] == ["interactions of all learners", "time (s)"]


def test_only_means_have_an_interval_and_say_of_how_many_runs_they_are() -> None:
    [panel] = draw(grouped([*TASK7, TASK8[0]], []), ("interactions",), ["return"]).axes
    assert [line.get_label() for line in panel.get_lines()] == ["task7, mean of 3 runs with 95 % interval", "task8"]
    assert len(panel.collections) == 1


def test_a_single_evaluation_is_seen_as_a_point(tmp_path: Path) -> None:
    kept = (TASK7[0] / "evaluations.csv").read_text(encoding="utf-8").splitlines()[:2]
    (tmp_path / "evaluations.csv").write_text("\n".join(kept), encoding="utf-8")
    (tmp_path / "config.toml").write_text('name = "task7"', encoding="utf-8")
    [panel] = draw(grouped([tmp_path], []), ("time",), ["success"]).axes
    assert [line.get_marker() for line in panel.get_lines()] == ["o"]


def test_labels_say_which_runs_are_one_curve() -> None:
    groups = grouped([*TASK7, *TASK8], ["a", "b", "a", "b", "c"])
    found = {label: [run.path for run in runs] for label, runs in groups.items()}
    assert found == {"a": [TASK7[0], TASK7[2]], "b": [TASK7[1], TASK8[0]], "c": [TASK8[1]]}
    assert {label: len(runs) for label, runs in grouped([*TASK7, *TASK8], ["all"]).items()} == {"all": 5}


def test_a_run_that_is_named_twice_counts_once(tmp_path: Path) -> None:
    latest = tmp_path / "latest"
    latest.symlink_to(TASK7[0])
    groups = grouped([TASK7[0], latest, TASK7[1]], ["first", "again", "second"])
    assert {label: len(runs) for label, runs in groups.items()} == {"first": 1, "second": 1}


@pytest.mark.parametrize(
    ("paths", "out", "options", "kind", "text"),
    [
        (TASK7, "curves.pdf", {}, ConfigError, r"ends in \.png or \.svg"),
        (TASK7, "nowhere/curves.png", {}, ConfigError, "no folder"),
        (TASK7, "taken.png", {}, ConfigError, "cannot be written"),
        (TASK7, "curves.png", {"metrics": "success,lenght"}, ConfigError, "success, length, return"),
        (TASK7, "curves.png", {"labels": ["a", "b"]}, ConfigError, "2 labels for 3 runs"),
        ([], "curves.png", {}, ConfigError, "at least one RUN"),
        ([RESULTS], "curves.png", {}, RunError, "name them"),
    ],
)
def test_what_cannot_be_drawn_is_refused_and_leaves_nothing(
    paths: list[Path], out: str, options: dict[str, str], kind: type[T4NMTDError], text: str, tmp_path: Path
) -> None:
    (tmp_path / "taken.png").mkdir()
    with pytest.raises(kind, match=text):
        plot(paths, tmp_path / out, **options)  # type: ignore[arg-type]
    assert [path.name for path in tmp_path.iterdir()] == ["taken.png"]


def test_without_the_package_the_message_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install 't4nmtd-dist\[plot\]'"):
        plot(TASK7, tmp_path / "curves.png")
