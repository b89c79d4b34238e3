"""SAC in plain torch, for other devices: the same updates as those written by hand, and states that go both ways."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from devices import EVERYWHERE, GPU
from small_sac import AT_G1, small_sac
from test_sac_update import random_batch

from t4nmtd_dist.agents.common.peer_values import NoPeers
from t4nmtd_dist.agents.sac import agent as sac
from t4nmtd_dist.agents.sac.agent import updater_on
from t4nmtd_dist.agents.sac.fast_cpu.update import SACUpdater
from t4nmtd_dist.agents.sac.soft_critic import SoftCritic
from t4nmtd_dist.agents.sac.torch_update import TorchSACUpdater
from t4nmtd_dist.agents.sac.updater import PeerSoftValues, SACSettings, SoftActorCritic

STATES, ACTIONS, ROWS = 7, 2, 16
SMALL = SACSettings(hidden=(32, 24))
CLOSE = {"rtol": 1e-5, "atol": 1e-5}


def train(updater: SoftActorCritic, steps: range, *, peers: bool = True) -> None:
    """Updates whose batches, noise and peers' values depend on nothing but the number of the step."""
    for step in steps:
        rng = np.random.default_rng(step)
        noise = rng.standard_normal((ACTIONS, 2 * ROWS), np.float32)
        answers = PeerSoftValues(np.array([1, 6]), *rng.standard_normal((2, 2), np.float32))
        updater.update_with_noise(random_batch(ROWS, STATES, ACTIONS, step), noise, answers if peers else None)


def both(device: str, settings: SACSettings = SMALL) -> tuple[SACUpdater, TorchSACUpdater]:
    return SACUpdater(STATES, ACTIONS, settings, 1), TorchSACUpdater(STATES, ACTIONS, settings, 1, device)


def assert_alike(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    assert list(found) == list(expected)
    for name, array in expected.items():
        assert found[name].dtype == array.dtype, name
        np.testing.assert_allclose(found[name], array, **CLOSE, err_msg=name)


@pytest.mark.parametrize("device", EVERYWHERE)
@pytest.mark.parametrize("peers", [False, True])
@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize("actor_every", [1, 3])
def test_updates_are_those_written_by_hand(device: str, peers: bool, layer_norm: bool, actor_every: int) -> None:
    chosen = dataclasses.replace(SMALL, layer_norm=layer_norm, actor_every=actor_every, learning_rate=3e-3)
    by_hand, plain = both(device, chosen)
    before = by_hand.weights()
    for step in range(7):
        for updater in (by_hand, plain):
            train(updater, range(step, step + 1), peers=peers)
        np.testing.assert_allclose(plain.targets, by_hand.targets, **CLOSE)
        assert plain.losses() == pytest.approx(by_hand.losses(), rel=1e-4, abs=1e-5)
    assert_alike(plain.weights(), by_hand.weights())
    assert_alike(plain.optimiser_state(), by_hand.optimiser_state())
    assert all((before[name] != array).any() for name, array in plain.weights().items() if "weight" in name)


def test_peers_values_matter_to_that_test() -> None:
    with_peers, without = both("cpu")[1], both("cpu")[1]
    train(with_peers, range(3))
    train(without, range(3), peers=False)
    assert np.abs(with_peers.targets - without.targets).max() > 0.1


@pytest.mark.parametrize("device", EVERYWHERE)
def test_actions_and_soft_values_are_those_written_by_hand(device: str) -> None:
    states = random_batch(9, STATES, ACTIONS).states.numpy()
    for step, (by_hand, plain) in enumerate([both(device), both(device)]):
        for updater in (by_hand, plain):
            train(updater, range(4 * step))
        for deterministic in (True, False, False):
            expected = by_hand.act(states, deterministic=deterministic)
            found = plain.act(states, deterministic=deterministic)
            assert (found.shape, found.dtype, found.flags.c_contiguous) == (expected.shape, expected.dtype, True)
            np.testing.assert_allclose(found, expected, **CLOSE)
        for mine, theirs in zip(plain.soft_values(states), by_hand.soft_values(states), strict=True):
            assert (mine.shape, mine.dtype) == (theirs.shape, theirs.dtype)
            np.testing.assert_allclose(mine, theirs, **CLOSE)


@pytest.mark.parametrize("device", EVERYWHERE)
def test_a_resumed_updater_goes_on_bit_for_bit(device: str) -> None:
    first, resumed = both(device, dataclasses.replace(SMALL, actor_every=2))[1], both(device)[1]
    resumed.settings = first.settings
    train(first, range(5))
    resumed.load(first.weights())
    resumed.load_optimiser_state(first.optimiser_state())
    for updater in (first, resumed):
        updater.act(np.zeros((3, STATES), np.float32), deterministic=False)
        updater.update(random_batch(ROWS, STATES, ACTIONS, 9))
        train(updater, range(5, 8))
    for state, again in ((first.weights(), resumed.weights()), (first.optimiser_state(), resumed.optimiser_state())):
        assert all(array.tobytes() == again[name].tobytes() for name, array in state.items())


@pytest.mark.parametrize("device", EVERYWHERE)
@pytest.mark.parametrize("to_the_cpu", [False, True])
def test_a_training_may_change_its_device(device: str, to_the_cpu: bool) -> None:
    by_hand, plain = both(device)
    there, back = (plain, by_hand) if to_the_cpu else (by_hand, plain)
    expected = SACUpdater(STATES, ACTIONS, SMALL, 1)
    train(expected, range(4))
    train(there, range(4))
    back.load(there.weights())
    back.load_optimiser_state(there.optimiser_state())
    for updater in (expected, back):
        updater.update(random_batch(ROWS, STATES, ACTIONS, 9))  # with noise of its own
    assert_alike(back.weights(), expected.weights())


def test_an_update_never_waits_for_the_device() -> None:
    """Tensors of the meta device have no numbers: to read one, or to mix it with another device's, is an error."""
    updater = TorchSACUpdater(STATES, ACTIONS, dataclasses.replace(SMALL, actor_every=2), 1, "meta")
    train(updater, range(3))
    updater.keep_alpha_above(0.1)
    assert updater._optimisers["critics"].steps == 3
    with pytest.raises((NotImplementedError, RuntimeError)):
        updater.losses()


def test_losses_and_targets_before_the_first_update() -> None:
    for updater in both("cpu"):
        assert updater.losses() == {}
        with pytest.raises(RuntimeError, match="no update yet"):
            _ = updater.targets


@pytest.mark.parametrize("device", ["cpu as any other", GPU])
def test_a_learner_on_another_device_learns_the_same(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It goes on from a state of a learner on the CPU, and one there from its own."""
    starts = ((0, AT_G1),)
    first, unmoved, back = (small_sac("g1", starts=starts) for _ in range(3))
    place = device.split()[0]
    monkeypatch.setattr(sac, "updater_on", lambda _, *shape: TorchSACUpdater(*shape, place))
    moved = small_sac("g1", starts=starts)
    for _ in range(8):
        first.iterate(NoPeers())
    for learner in (unmoved, moved):
        learner.load_state_dict(first.state_dict())
        learner.iterate(NoPeers())
    assert moved.gradient_steps == unmoved.gradient_steps > first.gradient_steps
    assert type(moved.published._critic) is SoftCritic  # what answers peers is on the CPU
    for learner in (moved, moved.published):
        found = learner.weights() if learner is moved else learner.weights()[0]
        for name, array in found.items():
            np.testing.assert_allclose(array, unmoved.weights()[name], rtol=1e-3, atol=1e-4, err_msg=name)
    back.load_state_dict(moved.state_dict())
    assert back.iterate(NoPeers())


def test_the_cpu_takes_the_updates_written_by_hand() -> None:
    assert isinstance(updater_on("cpu", STATES, ACTIONS, SMALL, 0), SACUpdater)
    assert isinstance(updater_on("meta", STATES, ACTIONS, SMALL, 0), TorchSACUpdater)


torch.set_num_threads(1)  # a second thread waits for the other tests' processes
