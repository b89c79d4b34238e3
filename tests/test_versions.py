"""What a run writes down about the code that made it."""

from __future__ import annotations

import subprocess
from pathlib import Path

import torch

from t4nmtd_dist.runs.versions import commit_of, versions


def git(folder: Path, *arguments: str) -> str:
    name = ("-c", "user.name=a", "-c", "user.email=a@example.org")
    done = subprocess.run(["git", "-C", str(folder), *name, *arguments], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_a_checkout_has_a_commit_and_no_other_folder_has(tmp_path: Path) -> None:
    assert commit_of(tmp_path) is None
    git(tmp_path, "init", "-q")
    assert commit_of(tmp_path) is None, "nothing was committed yet"
    (tmp_path / "code.py").write_text("a = 1\n")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-q", "-m", "a")
    git(tmp_path, "tag", "-a", "v1", "-m", "1")
    commit = git(tmp_path, "rev-parse", "--short=12", "HEAD")
    assert commit_of(tmp_path) == commit
    (tmp_path / "code.py").write_text("a = 2\n")
    assert commit_of(tmp_path) == f"{commit}-dirty"


def test_versions_are_those_of_what_is_imported() -> None:
    assert versions()["torch"] == torch.__version__
