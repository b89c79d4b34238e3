"""`--device`: refused at once where there is none, passed on to the learners, and PPO on another device."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from devices import GPU, needs_no_gpu
from small_tasks import START, TO_PASSENGER_2, small_learner, small_task, snapshot_after

from t4nmtd_dist.agents.common.flat_adam import FlatAdam
from t4nmtd_dist.agents.common.peer_values import NoPeers
from t4nmtd_dist.agents.ppo.networks import ActorCritic
from t4nmtd_dist.agents.ppo.update import PPOUpdate
from t4nmtd_dist.agents.registry import build_learner
from t4nmtd_dist.cli import train as train_module
from t4nmtd_dist.cli.commands import Train
from t4nmtd_dist.cli.worker import WorkerCommand
from t4nmtd_dist.cli.worker import run as run_worker
from t4nmtd_dist.core.devices import Device, check_device
from t4nmtd_dist.core.errors import ConfigError, RunError
from t4nmtd_dist.method.start_states import InitialStateBuffer

torch.set_num_threads(1)


@pytest.fixture
def no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


@pytest.mark.parametrize(("built_for", "advice"), [(None, "a build without CUDA"), ("12.8", "nvidia-smi")])
@pytest.mark.usefixtures("no_gpu")
def test_a_missing_gpu_is_told_with_what_to_do(
    built_for: str | None, advice: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.version, "cuda", built_for)
    check_device("cpu")
    with pytest.raises(ConfigError, match=f"--device cuda: .*{advice}.* or leave --device out"):
        check_device("cuda")


@pytest.mark.usefixtures("no_gpu")
def test_a_worker_without_the_device_ends_before_it_claims_anything(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_worker(WorkerCommand(device="cuda", wait=0.1)) == 2
    assert "t4nmtd-worker: --device cuda: PyTorch" in capsys.readouterr().err


def test_an_evaluator_takes_no_device(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_worker(WorkerCommand(device="cuda", evaluate=True)) == 2
    assert "plays on the CPU" in capsys.readouterr().err


@pytest.mark.parametrize("serial", [False, True])
@pytest.mark.usefixtures("no_gpu")
def test_a_training_without_the_device_starts_and_writes_nothing(serial: bool, tmp_path: Path) -> None:
    command = Train(task="task7", device="cuda", serial=serial, run_dir=tmp_path / "run", no_dashboard=True)
    with pytest.raises(ConfigError, match="--device cuda"):
        command.run()
    assert not (tmp_path / "run").exists()


@needs_no_gpu
@pytest.mark.command
def test_train_passes_the_device_on_to_its_learners(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With its own check left out, the workers that it starts refuse the device."""
    monkeypatch.setattr(train_module, "check_device", lambda device: None)
    command = Train(task="task7", device="cuda", workers=1, run_dir=tmp_path / "run", no_dashboard=True)
    with pytest.raises(RunError, match=r"(?s)ended with code 2.*--device cuda: PyTorch"):
        command.run()
    assert "--device" not in (tmp_path / "run/logs/evaluator.log").read_text(encoding="utf-8")


def test_adam_of_a_module_is_torchs_adam_bit_for_bit() -> None:
    networks = []
    for _ in range(2):
        torch.manual_seed(3)
        networks.append(ActorCritic(5, 4, (9, 7)))
    mine, theirs = networks
    adam = FlatAdam.of_module(mine, 0.01, epsilon=1e-5)
    reference = torch.optim.Adam(theirs.parameters(), lr=0.01, eps=1e-5, fused=True)
    for step in range(20):
        states = torch.sin(torch.arange(30.0) * (step + 1)).view(6, 5)
        adam.gradient.zero_()
        reference.zero_grad()
        for network in networks:
            (network.value(states).square().mean() + network.actor(states).exp().mean()).backward()
        adam.step()
        reference.step()
    for name, tensor in theirs.state_dict().items():
        assert torch.equal(mine.state_dict()[name], tensor), name


def test_ppo_computes_gradients_where_its_network_is() -> None:
    """Tensors of the meta device have no numbers: to read one, or to mix it with another device's, is an error."""
    learner = small_learner("p2")
    update = PPOUpdate(learner.network.to("meta"), small_task().config.agent, "meta", np.random.default_rng(0))
    update.epochs(learner.trajectory, *np.zeros((2, learner.trajectory.rewards.size), np.float32), 0.1)
    assert update.gradient_steps == 4


@pytest.mark.parametrize("device", [GPU])
def test_ppo_learns_the_same_on_another_device(device: Device) -> None:
    task, start = small_task("learner.attempt_steps=6"), snapshot_after(*TO_PASSENGER_2)
    learners = []
    for place in ("cpu", device):
        buffer = InitialStateBuffer(10)
        buffer.add(START, start)
        learners.append(build_learner(task, "p2", buffer, task.method(), seed=0, device=place))
        for _ in range(2):
            learners[-1].iterate(NoPeers())
    here, there = learners
    assert there.gradient_steps == here.gradient_steps
    published, _ = there.published.weights()
    for name, array in here.weights().items():
        np.testing.assert_allclose(there.weights()[name], array, rtol=1e-3, atol=1e-4, err_msg=name)
        if name.startswith("critic."):
            assert np.array_equal(published[name.removeprefix("critic.")], there.weights()[name])
