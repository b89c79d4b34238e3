"""What all three commands share: ``--version``, suggestions for misspelt verbs, shell completion."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from t4nmtd_dist import __version__

pytestmark = pytest.mark.command

MODULES = {
    "t4nmtd": "t4nmtd_dist.cli.main",
    "t4nmtd-coordinator": "t4nmtd_dist.cli.coordinator",
    "t4nmtd-worker": "t4nmtd_dist.cli.worker",
}


def run(program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", MODULES[program], *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize("program", MODULES)
def test_every_command_prints_its_version_and_says_so_in_its_help(program: str) -> None:
    done = run(program, "--version")
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{program} {__version__}\n", "")
    assert "--version" in run(program, "--help").stdout


def test_the_version_is_that_of_the_package() -> None:
    metadata = (Path(__file__).parent.parent / "pyproject.toml").read_text("utf-8")
    assert f'version = "{__version__}"' in metadata


@pytest.mark.parametrize(
    ("word", "verb"), [("trian", "train"), ("eval", "evaluate"), ("inspcet", "inspect"), ("Train", "train")]
)
def test_a_misspelt_verb_gets_a_suggestion(word: str, verb: str) -> None:
    done = run("t4nmtd", word, "--task", "task7")
    assert done.returncode == 2
    assert done.stderr.strip() == f"t4nmtd: unknown command {word!r}; did you mean {verb!r}?"


def test_a_verb_like_none_is_answered_with_all() -> None:
    done = run("t4nmtd", "xyzzy")
    assert done.returncode == 2
    assert done.stderr.startswith(
        "t4nmtd: unknown command 'xyzzy'; expected one of check, completion, config, dashboard"
    )


def complete(script: Path, shell: str, line: str) -> list[str]:
    """What bash offers at the end of a line once it has read a completion script."""
    words = line.split(" ")
    code = f"""
source {script}
COMP_WORDS=({" ".join(word or "''" for word in words)})
COMP_CWORD={len(words) - 1}
COMP_LINE='{line}'
COMP_POINT={len(line)}
function=$(complete -p t4nmtd | sed 's/.*-F \\([^ ]*\\) .*/\\1/')
$function t4nmtd '{words[-1]}' '{words[-2]}'
printf '%s\\n' "${{COMPREPLY[@]}}"
"""
    done = subprocess.run([shell, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    return [word.strip() for word in done.stdout.splitlines()]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
@pytest.mark.parametrize("program", MODULES)
def test_completion_scripts_are_printed_for_every_command(program: str, shell: str) -> None:
    done = run("t4nmtd", "completion", shell, "--program", program)
    assert (done.returncode, done.stderr) == (0, "")
    assert program in done.stdout
    assert ("inspect" if program == "t4nmtd" else "insecure") in done.stdout


def test_bash_completes_verbs_and_options(tmp_path: Path) -> None:
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("bash is not installed")
    script = tmp_path / "t4nmtd.bash"
    script.write_text(run("t4nmtd", "completion", "bash").stdout, "utf-8")
    assert complete(script, bash, "t4nmtd insp") == ["inspect"]
    assert "--summary" in complete(script, bash, "t4nmtd inspect --s")


def test_help_says_how_completion_is_installed() -> None:
    text = " ".join(run("t4nmtd", "completion", "--help").stdout.split())
    for shell in ("bash", "zsh", "fish"):
        assert f"t4nmtd completion {shell} >" in text


def test_a_shell_without_completion_is_refused() -> None:
    done = run("t4nmtd", "completion", "powershell")
    assert done.returncode == 2
    assert "bash" in done.stderr + done.stdout
