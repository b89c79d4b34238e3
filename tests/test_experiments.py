"""The paper's experiments: what their arms differ in, the queue of runs, and tables from stored results alone."""

from __future__ import annotations

import json
import signal
import time
from pathlib import Path
from typing import Any

import pytest
from processes import Processes

from t4nmtd_dist.cli.experiment import parse_seeds, plot_curves, print_tables
from t4nmtd_dist.core.errors import ConfigError, RunError
from t4nmtd_dist.core.registry import METHODS
from t4nmtd_dist.core.setting_sources import settings_from_flags
from t4nmtd_dist.environments.timed import make_task_env
from t4nmtd_dist.experiments.arms import CAPS, EXPERIMENTS, PAIRS, applies, check_tasks, experiment
from t4nmtd_dist.experiments.final_evaluation import read_evaluation
from t4nmtd_dist.experiments.jobs import Job, JobQueue, make_jobs
from t4nmtd_dist.experiments.results import keep, read_results
from t4nmtd_dist.experiments.tables import run_table, tables
from t4nmtd_dist.tasks import load_task, task_names

END_S = 100.0
CAP = 10_000


def differences(one: Any, other: Any, path: str = "") -> set[str]:
    if isinstance(one, dict) and isinstance(other, dict):
        return {
            found
            for key in one.keys() | other.keys()
            for found in differences(one.get(key), other.get(key), f"{path}.{key}" if path else key)
        }
    return set() if one == other else {path}


@pytest.mark.parametrize("name", ["decomposition", "intervention"])
@pytest.mark.parametrize("task", task_names())
def test_arms_differ_in_one_setting(name: str, task: str) -> None:
    changed = {"decomposition": {"learner.method"}, "intervention": {"learner.intervention"}}[name]
    first, second, *plain = EXPERIMENTS[name].arms
    assert [arm.name for arm in plain] == [f"{first.name}-plain", f"{second.name}-plain"]
    for one, other in ((first, second), plain):
        configs = [load_task(task, flags=arm.settings, preset=arm.preset).to_dict() for arm in (one, other)]
        assert differences(*configs) == changed


@pytest.mark.parametrize("task", task_names())
def test_plain_arms_are_without_relabelling_and_peers_experience_where_there_is_any(task: str) -> None:
    for each in EXPERIMENTS.values():
        for arm in each.arms:
            config = load_task(task, flags=arm.settings, preset=arm.preset, method=arm.method)
            if not applies(arm, load_task(task)) or config.learner.algorithm == "ppo":
                continue
            plain = arm.name.endswith("-plain") or arm.preset == "paper"
            assert plain == (config.agent.relabel_share == config.agent.peer_share == 0), arm.name


@pytest.mark.parametrize("task", ["task5", "task7"])
def test_the_comparison_has_every_method_and_t4nmtd_with_each_of_their_agents(task: str) -> None:
    arms = [arm for arm in EXPERIMENTS["comparison"].arms if applies(arm, load_task(task))]
    configs = [load_task(task, flags=arm.settings, preset=arm.preset, method=arm.method) for arm in arms]
    assert {config.learner.method for config in configs} == set(METHODS.names()) - {"random"}
    used = {config.learner.algorithm for config in configs}
    assert used == {config.learner.algorithm for config in configs if config.learner.method == "t4nmtd"}


def test_every_arms_settings_are_known_and_every_task_has_a_cap() -> None:
    assert sorted(CAPS) == task_names()
    for each in EXPERIMENTS.values():
        for arm in each.arms:
            assert settings_from_flags(arm.settings) is not None
            load_task("task5", flags=arm.settings, preset=arm.preset, method=arm.method)


@pytest.mark.parametrize("task", task_names())
def test_transfer_changes_where_networks_come_from_and_nothing_else(task: str, tmp_path: Path) -> None:
    chosen = EXPERIMENTS["transfer"]
    jobs = make_jobs(chosen, chosen.chosen(["transfer"]), [task], [4], tmp_path)
    source, job = jobs
    assert (source.arm.name, source.task, source.source) == ("scratch", PAIRS[task], None)
    assert (job.arm.name, job.task, job.source) == ("transfer", task, source.folder)
    scratch = next(each for each in make_jobs(chosen, chosen.arms, [task], [4], tmp_path) if each.task == task)
    assert scratch.settings == job.settings
    config = load_task(task, flags=job.settings)
    assert config.evaluation.until == "converged"
    sizes = [make_task_env(load_task(each.task, flags=each.settings), 1).observation_size for each in (source, scratch)]
    assert sizes[0] == sizes[1]


def test_a_transfer_waits_for_its_source_and_is_given_up_if_that_was_not_solved(tmp_path: Path) -> None:
    chosen = EXPERIMENTS["transfer"]
    jobs = make_jobs(chosen, chosen.arms, ["task7"], [0], tmp_path)
    assert [(job.arm.name, job.task) for job in jobs] == [
        ("scratch", "task8"), ("scratch", "task7"), ("transfer", "task7")
    ]  # fmt: skip
    for job in jobs[:2]:
        job.folder.mkdir(parents=True)
        summary = {"outcome": "budget spent", "interactions_total": 1}
        (job.folder / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
        (job.folder / "evaluation.json").touch()
    queue = JobQueue(jobs, parallel=1, tell=lambda _: None)
    assert not queue.turn()
    assert "was not solved" in queue.failed["transfer task7 seed 0"]


def test_every_run_has_a_folder_of_its_own_and_seeds_are_paired(tmp_path: Path) -> None:
    jobs = [
        job
        for each in EXPERIMENTS.values()
        for job in make_jobs(each, each.arms, task_names(), range(3), tmp_path, quick=True)
    ]
    assert len({job.folder for job in jobs}) == len(jobs)
    assert {job.cap for job in jobs if job.task == "task7"} == {16_000}
    assert [job.seed for job in jobs if "intervention/" in str(job.folder)][:5] == [0] * 5


@pytest.mark.parametrize(
    ("text", "seeds"), [("0-3", (0, 1, 2, 3)), ("7", (7,)), ("0,3,2-4", (0, 3, 2, 4)), (" 1 , 2 ", (1, 2))]
)
def test_seeds_are_numbers_and_ranges(text: str, seeds: tuple[int, ...]) -> None:
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize("text", ["", "a", "3-1", "1-", "-1", "1,,2", "1.5"])
def test_malformed_seeds_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="expected numbers and ranges"):
        parse_seeds(text)


def test_unknown_names_are_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="unknown experiment 'trnsfer'; known: tasks, comparison"):
        experiment("trnsfer")
    with pytest.raises(ConfigError, match="unknown arm 'lstm'; known: t4nmtd"):
        experiment("comparison").chosen(["lstm"])
    with pytest.raises(ConfigError, match="'mine': experiments know the caps of task1"):
        check_tasks(["mine"])


def stored(root: Path, arm: str, seed: int, *, solved: int | None, success: float = 1.0, task: str = "task7") -> Path:
    """A run's small files: evaluated after 2,000, 4,000 ... interactions, successful from ``solved`` on."""
    folder = root / "intervention" / arm / f"{task}-s{seed}"
    (folder / "metrics").mkdir(parents=True)
    spent = CAP if solved is None else solved
    summary = {
        "task": task,
        "seed": seed,
        "outcome": "budget spent" if solved is None else "solved",
        "solved": solved is not None,
        "converged": solved is not None,
        "interactions": spent,
        "interactions_total": spent,
        "wall_s": 3.0,
    }
    (folder / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    (folder / "config.toml").write_text(f'name = "{task}"\nmax_interactions = {CAP}\n', encoding="utf-8")
    (folder / "versions.json").write_text("{}", encoding="utf-8")
    rows = ["interactions,elapsed_s,success_rate,mean_length,mean_return"]
    rows += [
        f"{at},{at / 100},{success if solved is not None and at >= solved else 0.0},9.0,1.0"
        for at in range(2000, spent + 1, 2000)
    ]
    (folder / "metrics" / "evaluations.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    return folder


@pytest.fixture
def results(tmp_path: Path) -> Path:
    root = tmp_path / "runs"
    for seed, (on, off) in enumerate([(2000, 4000), (4000, 8000), (2000, None)]):
        stored(root, "intervention", seed, solved=on)
        stored(root, "off", seed, solved=off)
    return root


def cells(text: str) -> list[list[str]]:
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_the_tables_have_the_numbers_of_the_runs(results: Path) -> None:
    chosen = EXPERIMENTS["intervention"]
    rows = cells(tables(chosen, read_results(chosen, results)))
    on = next(row for row in rows if row[:2] == ["task7", "intervention"])
    off = next(row for row in rows if row[:2] == ["task7", "off"])
    assert on[2:6] == ["3/3", "29% to 100%", "3/3", "2,000"]
    assert off[2:6] == ["2/3", "9% to 99%", "2/3", "8,000"]
    assert off[6].startswith("7,333 (")
    assert on[9:11] == ["-", "-"], "not evaluated"
    assert (on[8], off[8]) == (f"{(0.8 + 0.6 + 0.8) / 3:.2f}", f"{(0.6 + 0.2 + 0.0) / 3:.2f}")
    assert ["off", "task7", "4.00", "2.00 to inf"] in rows
    overall = next(row for row in rows if row[0] == "off" and row[-1] in ("better", "worse", "undecided"))
    assert overall[4].startswith(f"{(3 + 2.5 + 3) / 9:.2f} (")


def test_the_same_results_make_the_same_tables_and_copies_of_the_small_files_do_too(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    chosen = EXPERIMENTS["intervention"]
    assert keep(chosen, results, tmp_path / "kept") == 6
    assert print_tables("intervention", results, None) == 0
    first = capsys.readouterr().out
    assert print_tables("intervention", tmp_path / "kept", None) == 0
    assert capsys.readouterr().out == first
    assert first.startswith("# Experiment 3")


def test_there_is_a_row_for_every_run_and_their_means(results: Path) -> None:
    chosen = EXPERIMENTS["intervention"]
    for seed, (success, perturbed) in enumerate([(1.0, 0.5), (1.0, 0.7)]):
        found = {"plain": {"success_rate": success, "mean_length": 10 + seed}, "perturbed": {"success_rate": perturbed}}
        path = results / "intervention" / "intervention" / f"task7-s{seed}" / "evaluation.json"
        path.write_text(json.dumps(found), encoding="utf-8")
    rows = cells(run_table(read_results(chosen, results)))
    assert rows[1] == ["task7", "intervention", "0", "yes", "2,000", "0.0%", "3", "0", "10", "100%", "50%", "-"]
    assert rows[4] == ["task7", "intervention", "mean", "3 of 3", "2,667", "0.1%", "3", "0", "10", "100%", "60%", "-"]
    assert rows[7] == ["task7", "off", "2", "no", *["-"] * 8]
    (results / "intervention" / "off" / "task7-s0" / "evaluation.json").write_text("{", encoding="utf-8")
    with pytest.raises(RunError, match=r"evaluation.json is damaged"):
        read_results(chosen, results)


@pytest.mark.slow
def test_every_task_gets_a_picture(results: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / "figures"
    assert plot_curves("intervention", results, out) == 0
    assert (out / "intervention-task7.svg").read_text(encoding="utf-8").startswith("<?xml")
    with pytest.raises(ConfigError, match=r"--out .*svg: .*; give a folder"):
        plot_curves("intervention", results, out / "intervention-task7.svg")


def test_no_results_and_mixed_budgets_are_refused(results: Path, tmp_path: Path) -> None:
    chosen = EXPERIMENTS["intervention"]
    with pytest.raises(RunError, match="no finished run of experiment intervention"):
        read_results(chosen, tmp_path / "nothing")
    folder = stored(results, "off", 3, solved=None)
    (folder / "config.toml").write_text('name = "task7"\nmax_interactions = 20000\n', encoding="utf-8")
    with pytest.raises(RunError, match="different budgets"):
        tables(chosen, read_results(chosen, results))


def test_runs_that_have_not_ended_count_for_nothing(results: Path) -> None:
    chosen = EXPERIMENTS["intervention"]
    folder = stored(results, "off", 4, solved=None)
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    (folder / "summary.json").write_text(json.dumps({**summary, "outcome": "stopped"}), encoding="utf-8")
    assert len(read_results(chosen, results)) == 6


@pytest.mark.command
def test_a_run_that_cannot_start_is_told_with_its_last_words_and_the_others_go_on(tmp_path: Path) -> None:
    arm = EXPERIMENTS["comparison"].arms[0]
    told: list[str] = []
    jobs = [
        Job(arm, "task7", 0, 500, tmp_path / "wrong", ("learner.method=nope",)),
        Job(arm, "task7", 1, 4000, tmp_path / "right", ("evaluation.every=1000",)),
    ]
    queue = JobQueue(jobs, parallel=1, tell=told.append)
    while queue.turn():
        time.sleep(0.1)
    assert queue.ended == 1
    assert list(queue.failed) == ["t4nmtd task7 seed 0"]
    assert "exit code 2; t4nmtd: " in queue.failed["t4nmtd task7 seed 0"]
    assert "unknown method 'nope'" in told[0]
    assert jobs[1].ended
    plain, perturbed = read_evaluation(jobs[1].folder) or ({}, {})
    assert (plain["episodes"], perturbed["episodes"]) == (100, 100)


@pytest.mark.training
@pytest.mark.timeout(300)
def test_an_experiment_that_was_stopped_goes_on_and_ends_with_tables(commands: Processes, tmp_path: Path) -> None:
    root = tmp_path / "experiments"
    command = ["experiment", "run", "decomposition", "--quick", "--tasks", "task7", "--root", str(root)]
    first = commands.start("t4nmtd", *command)
    commands.until(lambda: list(root.glob("quick/decomposition/*/*/checkpoints/run.json")), "a run has begun", END_S)
    first.send(signal.SIGINT)
    assert first.wait(END_S) == 130, first.story()
    assert "the same command goes on" in first.err
    again = commands.start("t4nmtd", *command)
    assert again.wait(2 * END_S) == 0, again.story()
    assert "4 of 4 runs have ended" in again.err
    table = commands.start("t4nmtd", "experiment", "table", "decomposition", "--root", str(root / "quick"))
    assert table.wait(END_S) == 0, table.story()
    assert {row[1] for row in cells(table.out) if row[0] == "task7"} == {"objective", "random"}
    third = commands.start("t4nmtd", *command)
    assert third.wait(END_S) == 0
    assert "4 of 4 runs have ended" in third.err
