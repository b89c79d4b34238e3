"""The subcommands of ``t4nmtd`` as dataclasses with lazy imports."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from t4nmtd_dist.cli.experiment_commands import Experiment
from t4nmtd_dist.cli.key_commands import Keys
from t4nmtd_dist.cli.options import RunFlags
from t4nmtd_dist.core.action_modes import ActionMode
from t4nmtd_dist.core.devices import Device
from t4nmtd_dist.wire.endpoints import CONTROL_PORT, DEFAULT_CONTROL, complete_endpoint


@dataclass(frozen=True)
class Train(RunFlags):
    """Train a task on this machine until it is solved or the budget is spent (exit code 0 or 3)."""

    no_dashboard: bool = False
    """Show nothing until the end."""
    serial: bool = False
    """One process, in lock-step, bit-reproducible from the seed (on the CPU); for debugging."""
    launcher: str | None = None
    """Where the processes run: `local`, on this machine, or another launcher that is registered; by default local.
    `serial` is --serial."""
    keys: Path | None = None
    """Folder made by `t4nmtd keys new`: keeps other users of this machine out; not needed otherwise."""
    workers: int | None = None
    """How many processes learn, with the sub-tasks divided among them in turn; by default one per sub-task."""
    device: Device = "cpu"
    """Where they train; with networks as small as these the CPU is expected to be faster."""
    parent: int | None = None
    """End when the process of this number, which started this one, has ended (used by `t4nmtd experiment`)."""

    def run(self) -> int:
        """Train."""
        from t4nmtd_dist.cli.train import train
        from t4nmtd_dist.core.errors import ConfigError
        from t4nmtd_dist.process.parent_watchdog import end_with_parent

        if self.parent is not None:
            end_with_parent(self.parent)

        launcher = self.launcher or ("serial" if self.serial else "local")
        if self.serial and launcher != "serial":
            raise ConfigError(f"--serial and --launcher {launcher} contradict each other: give one of them")
        if launcher == "serial" and self.workers is not None:
            raise ConfigError("--serial runs everything in one process, so it takes no --workers")
        return train(
            self,
            launcher=launcher,
            dashboard=not self.no_dashboard,
            keys=self.keys,
            workers=self.workers,
            device=self.device,
        )


@dataclass(frozen=True)
class Evaluate:
    """Evaluate the policy of a run, or an exported policy folder."""

    run_or_policy: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """A run directory or a folder with an exported policy."""
    episodes: int = 20
    """How many episodes."""
    seed: int = 1_000_000
    """Seed of the environment's resets and of perturbations."""
    perturb: int = 0
    """Begin each episode with k random actions, k uniform from 0 to this."""
    actions: ActionMode | None = None
    """The most likely actions (greedy) or sampled ones; by default as the policy was evaluated when it was exported."""
    trust: bool = False
    """Import the code that the policy names, whoever made it; without this, only what you have run here before."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print JSON instead of a sentence."""

    def run(self) -> int:
        """Evaluate."""
        from t4nmtd_dist.cli.evaluate import evaluate

        return evaluate(
            self.run_or_policy,
            episodes=self.episodes,
            seed=self.seed,
            perturb=self.perturb,
            as_json=self.as_json,
            actions=self.actions,
            trust=self.trust,
        )


@dataclass(frozen=True)
class Inspect:
    """Show a task's automaton and how it is split into sub-tasks."""

    task: str | None = None
    """Name of a task, or the path of a task file."""
    formula: str | None = None
    """An LTLf formula in place of a task."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print JSON for machines."""
    summary: bool = False
    """Print a summary that fits on a screen, as is done anyway for more than 60 states."""
    full: bool = False
    """Print every state and transition, however many there are."""
    svg: Path | None = None
    """Also draw the automaton into this file."""
    seed: int = 0
    """Seed of the run, which decides how decomposition.mode=random deals the transitions."""
    method: str = ""
    """Method laid over the task file, such as crm, with an agent that it can use."""
    preset: str = ""
    """Settings laid over the task file by name, such as paper."""
    translator: Literal["auto", "mona", "python"] = "auto"
    """How the formula becomes an automaton."""
    set: Annotated[list[str], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KEY=VALUE")] = field(
        default_factory=list
    )
    """One setting, such as decomposition.prune=false; may be repeated."""

    def run(self) -> int:
        """Inspect."""
        from rich.console import Console

        from t4nmtd_dist.cli.inspect import formula_task, run_inspect
        from t4nmtd_dist.core.errors import ConfigError
        from t4nmtd_dist.tasks import load_task

        if (self.task is None) == (self.formula is None):
            raise ConfigError("expected either --task NAME or --formula TEXT")
        if self.summary and (self.full or self.as_json):
            raise ConfigError("--summary leaves out what --full and --json print; give one of the three")
        if self.task is not None:
            config = load_task(self.task, flags=self.set, preset=self.preset, method=self.method)
        else:
            config = formula_task(self.formula or "", self.set)
        summary = True if self.summary else False if self.full else None
        run_inspect(
            config,
            console=Console(),
            translator=self.translator,
            as_json=self.as_json,
            svg=self.svg,
            summary=summary,
            seed=self.seed,
        )
        return 0


@dataclass(frozen=True)
class Config:
    """Print the settings of a task as TOML, each with where it comes from; --config reads them back."""

    task: str
    """Name of a task, or the path of a task file."""
    config: Annotated[list[Path], tyro.conf.UseAppendAction] = field(default_factory=list)
    """TOML file laid over the task file; may be repeated."""
    method: str = ""
    """Method laid over the task file, such as crm, with an agent that it can use."""
    preset: str = ""
    """Settings laid over the task file by name, such as paper."""
    set: Annotated[list[str], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KEY=VALUE")] = field(
        default_factory=list
    )
    """One setting, such as learner.gamma=0.98; may be repeated."""

    def run(self) -> int:
        """Print."""
        from t4nmtd_dist.cli.show_config import settings_text
        from t4nmtd_dist.tasks import from_layers, task_file
        from t4nmtd_dist.tasks.layers import setting_layers

        layers = setting_layers(task_file(self.task), self.config, self.set, preset=self.preset, method=self.method)
        print(settings_text(from_layers(self.task, layers), layers), end="")
        return 0


@dataclass(frozen=True)
class Check:
    """Try a task's environment with random actions: labels, spaces, snapshots, automaton (exit code 2: unusable)."""

    task: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TASK")]
    """Path of a task file, or name of a task."""
    steps: int = 2000
    """How many random steps."""
    seed: int = 0
    """Seed of resets and actions."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print JSON for machines."""
    set: Annotated[list[str], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="KEY=VALUE")] = field(
        default_factory=list
    )
    """One setting, such as environment.snapshots=replay; may be repeated."""

    def run(self) -> int:
        """Check."""
        from t4nmtd_dist.cli.check import check

        return check(self.task, steps=self.steps, seed=self.seed, flags=self.set, as_json=self.as_json)


@dataclass(frozen=True)
class Record:
    """Film episodes of a run's policy, with labels, DFA state and active sub-task in the picture."""

    run_or_policy: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """A run directory or a folder with an exported policy."""
    out: Path = Path("video.mp4")
    """The film: .mp4 or .gif."""
    episodes: int = 1
    """How many episodes, one after the other."""
    seed: int = 1_000_000
    """Seed of the environment's resets."""
    fps: int | None = None
    """Frames a second; by default what the environment says, else 10."""
    trust: bool = False
    """Import the code that the policy names, whoever made it; without this, only what you have run here before."""

    def run(self) -> int:
        """Record."""
        from t4nmtd_dist.cli.record import record

        return record(
            self.run_or_policy, self.out, episodes=self.episodes, seed=self.seed, fps=self.fps, trust=self.trust
        )


@dataclass(frozen=True)
class Plot:
    """Draw learning curves: of one run as it was, of several runs of a task as mean with 95 % interval."""

    runs: Annotated[list[Path], tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Run directories, or their copies in benchmarks/results."""
    out: Path = Path("curves.png")
    """The picture: .png or .svg."""
    x: Literal["interactions", "time", "both"] = "both"
    """What to draw against."""
    metrics: str = "success,length,return"
    """What to draw: some of success, length and return."""
    label: Annotated[list[str], tyro.conf.UseAppendAction] = field(default_factory=list)
    """Name of a curve: once for all runs, or once for each; runs of one label are one curve. By default the task's."""

    def run(self) -> int:
        """Draw."""
        from t4nmtd_dist.cli.plot import plot

        return plot(self.runs, self.out, x=self.x, metrics=self.metrics, labels=self.label)


@dataclass(frozen=True)
class Tasks:
    """List the tasks that come with the package, or the methods that can learn them."""

    methods: bool = False
    """List methods, for --method."""

    def run(self) -> int:
        """List."""
        from t4nmtd_dist.tasks import load_task, task_names
        from t4nmtd_dist.tasks.methods import method_titles

        if self.methods:
            for name, title in method_titles().items():
                print(f"{name:8} {title}")
            return 0
        for name in task_names():
            print(f"{name}  {load_task(name).title}")
        print("\nA task of your own: a TOML file like theirs; `t4nmtd check FILE` tries it out (docs/own-task.md).")
        return 0


@dataclass(frozen=True)
class Dashboard:
    """Attach a live dashboard to a running coordinator."""

    directory: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")] = None
    """Directory of the run; by default the newest below ./runs that is running."""
    connect: str | None = None
    """Endpoint on which the coordinator publishes its state; HOST alone will do. By default that of the run, or
    tcp://127.0.0.1:5571 where none is running below ./runs."""
    keys: Path | None = None
    """Folder of a client's keys, where the coordinator has keys."""
    wait: float = 60.0
    """Seconds without any state after which to give up."""
    svg: Path | None = None
    """Write the first page received as a picture into this file, and end."""
    width: int = 120
    """Width of the picture in characters."""
    height: int = 36
    """Height of the picture in lines."""

    def run(self) -> int:
        """Watch."""
        from t4nmtd_dist.cli.dashboard import follow, save_picture
        from t4nmtd_dist.cli.whereabouts import state_endpoint

        endpoint = state_endpoint(self.directory, self.connect)
        if self.svg is not None:
            return save_picture(endpoint, self.wait, self.svg, self.width, self.height, keys=self.keys)
        return follow(endpoint, self.wait, keys=self.keys)


@dataclass(frozen=True)
class Status:
    """Ask a coordinator how its run is (exit code 1: no answer)."""

    directory: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")] = None
    """Directory of the run; by default the newest below ./runs that is running."""
    connect: str | None = None
    """Endpoint on which the coordinator hears workers; HOST alone will do. By default that of the run, or
    tcp://127.0.0.1:5570 where none is running below ./runs."""
    keys: Path | None = None
    """Folder of a client's keys, where the coordinator has keys."""
    check: bool = False
    """Print nothing if all is well; for health checks."""
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False
    """Print JSON for machines."""
    wait: float = 5.0
    """Seconds to wait for an answer."""

    def run(self) -> int:
        """Ask."""
        from t4nmtd_dist.cli.status import show_status, tell_ending
        from t4nmtd_dist.cli.whereabouts import control_endpoint
        from t4nmtd_dist.runs.running import RunOverError

        try:
            endpoint = control_endpoint(self.directory, self.connect, quiet=self.check)
        except RunOverError as over:
            return tell_ending(over, for_people=not (self.check or self.as_json))
        return show_status(endpoint, self.keys, self.wait, check=self.check, as_json=self.as_json)


@dataclass(frozen=True)
class Doctor:
    """Find out why a coordinator cannot be reached: name, port, key, protocol version, clock, round trip."""

    connect: str = DEFAULT_CONTROL
    """The coordinator's endpoint, or its HOST alone."""
    keys: Path | None = None
    """Folder of a client's keys, where the coordinator has keys."""
    wait: float = 3.0
    """Seconds to wait for each answer."""

    def run(self) -> int:
        """Examine."""
        from t4nmtd_dist.cli.doctor import examine

        return examine(complete_endpoint(self.connect, CONTROL_PORT), self.keys, self.wait)


@dataclass(frozen=True)
class Completion:
    """Print a script that teaches a shell to complete commands; start a new shell after installing it.

    bash: t4nmtd completion bash > ~/.local/share/bash-completion/completions/t4nmtd

    zsh: t4nmtd completion zsh > ~/.zfunc/_t4nmtd (with fpath+=~/.zfunc before compinit in ~/.zshrc)

    fish: t4nmtd completion fish > ~/.config/fish/completions/t4nmtd.fish
    """

    shell: Annotated[Literal["bash", "zsh", "fish"], tyro.conf.Positional]
    """The shell."""
    program: Literal["t4nmtd", "t4nmtd-coordinator", "t4nmtd-worker"] = "t4nmtd"
    """The command to be completed; name the file after it."""

    def run(self) -> int:
        """Print."""
        from t4nmtd_dist.cli.completion import print_completion

        return print_completion(self.shell, self.program, verbs=Command)


Command = (
    Train
    | Evaluate
    | Record
    | Plot
    | Experiment
    | Inspect
    | Config
    | Check
    | Tasks
    | Dashboard
    | Keys
    | Status
    | Doctor
    | Completion
)
