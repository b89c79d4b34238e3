"""SAC's gradient step in plain torch, for any device: autograd of ``losses``.

On the CPU, ``fast_cpu`` takes two thirds of the time; tests compare the two. An update never waits for the device: a
batch is sent as one array, results are fetched on demand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from t4nmtd_dist.agents.common.batches import Batch
from t4nmtd_dist.agents.sac.losses import NextValues, actor_loss, alpha_loss, critic_loss, critic_target
from t4nmtd_dist.agents.sac.networks import Layers, Stack, evaluate_plainly, layers_of
from t4nmtd_dist.agents.sac.parameters import NO_UPDATE, LastUpdate, SACParameters
from t4nmtd_dist.agents.sac.squashed_gaussian import squashed
from t4nmtd_dist.agents.sac.updater import Floats, PeerSoftValues, Reals, SACSettings


@dataclass(frozen=True)
class _Given:
    """A batch on the device, with noise and peers' answers [B, ..]."""

    states: Tensor
    actions: Tensor
    rewards: Tensor
    discounts: Tensor
    next_states: Tensor
    noise: Tensor
    next_noise: Tensor
    answered: Tensor
    peer_values: Tensor
    peer_log_probs: Tensor


@dataclass(frozen=True)
class _Last:
    """``LastUpdate`` on the device."""

    errors: Tensor
    targets: Tensor
    log_probs: Tensor
    values: Tensor
    alpha: Tensor

    def fetched(self) -> LastUpdate:
        """Fetch it as numpy arrays; waits for the device."""
        errors, targets, log_probs, values = (
            each.cpu().numpy() for each in (self.errors, self.targets, self.log_probs, self.values)
        )
        return LastUpdate(errors, targets, log_probs, values, float(self.alpha))


def _leaf(tensor: Tensor, gradient: Tensor) -> Tensor:
    """An autograd leaf on the same memory, with its gradient in ``gradient``."""
    leaf = tensor.detach().requires_grad_()
    leaf.grad = gradient
    return leaf


def _leaves(stack: Stack, gradient: Tensor) -> Layers:
    layers, gradients = layers_of(stack.flat.detach(), stack.shape), layers_of(gradient, stack.shape)
    for name, tensor in layers.named.items():
        tensor.requires_grad_().grad = gradients.named[name]
    return layers


class TorchSACUpdater(SACParameters):
    """``SoftActorCritic`` by autograd.

    Args:
        state_size: d, the length of a product state.
        action_size: A.
    """

    def __init__(self, state_size: int, action_size: int, settings: SACSettings, seed: int, device: str) -> None:
        super().__init__(state_size, action_size, settings, seed, device)
        self._device = device
        gradients = {name: optimiser.gradient for name, optimiser in self._optimisers.items()}
        self._trained_actor = _leaves(self._actor, gradients["actor"])
        self._trained_critics = _leaves(self._critics, gradients["critics"])
        self._trained_log_alpha = _leaf(self._log_alpha, gradients["alpha"])
        self._last: _Last | None = None

    def _values(self, layers: Layers, states: Tensor, actions: Tensor) -> Tensor:
        """Q_i(s, a) [2, rows]."""
        return evaluate_plainly(layers, torch.cat((states, actions), 1)).squeeze(-1)

    # Acting

    @torch.no_grad()
    def act(self, states: Floats, *, deterministic: bool) -> Floats:
        """See ``SoftActorCritic.act``."""
        outputs = evaluate_plainly(self._actor.layers, torch.from_numpy(states).to(self._device))[0]
        if deterministic:
            actions: Floats = outputs[:, : self._action_size].tanh().cpu().numpy()
        else:
            actions = squashed(outputs, self._drawn_noise(len(states)))[0].cpu().numpy()
        return actions

    def _drawn_noise(self, rows: int) -> Tensor:
        return torch.from_numpy(self._noise(rows)).t().to(self._device)

    @torch.no_grad()
    def soft_values(self, states: Floats) -> tuple[Floats, Floats]:
        """See ``SoftActorCritic.soft_values``."""
        inputs = torch.from_numpy(states).to(self._device)
        actions, log_probs = squashed(evaluate_plainly(self._actor.layers, inputs)[0], self._drawn_noise(len(states)))
        values = self._values(self._targets.layers, inputs, actions).amin(0)
        return values.cpu().numpy(), log_probs.cpu().numpy()

    # Learning

    def update(self, batch: Batch, peers: PeerSoftValues | None = None) -> None:
        """See ``SoftActorCritic.update``."""
        self.update_with_noise(batch, self._noise(2 * len(batch.rewards)), peers)

    def update_with_noise(self, batch: Batch, noise: Floats, peers: PeerSoftValues | None = None) -> None:
        """See ``SoftActorCritic.update_with_noise``."""
        given, alpha = self._load(batch, noise, peers), self._log_alpha.exp()
        if self._actor_is_due:
            actions, log_probs = squashed(evaluate_plainly(self._trained_actor, given.states)[0], given.noise)
            self._step_alpha(log_probs.detach())
            targets = self._soft_targets(given, alpha)
            errors = self._step_critics(given, targets)
            values = self._step_actor(given, actions, log_probs, alpha)
            self._average_actor()
            self._last = _Last(errors, targets, log_probs.detach(), values, alpha)
        else:
            self._step_critics(given, self._soft_targets(given, alpha))
        self._targets.flat.lerp_(self._critics.flat, self.settings.tau)

    def _load(self, batch: Batch, noise: Floats, peers: PeerSoftValues | None) -> _Given:
        rows, d, a = len(batch.rewards), self._state_size, self._action_size
        answers = np.zeros((rows, 3), np.float32)
        if peers is not None:
            answers[peers.rows] = np.stack((np.ones_like(peers.values), peers.values, peers.log_probs), 1)
        drawn = torch.from_numpy(noise).t()
        columns = (batch.states, batch.actions, batch.rewards[:, None], batch.discounts[:, None], batch.next_states)
        packed = torch.cat((*columns, drawn[:rows], drawn[rows:], torch.from_numpy(answers)), 1)
        parts = torch.split(packed.to(self._device, non_blocking=True), [d, a, 1, 1, d, a, a, 1, 1, 1], 1)
        return _Given(*(part if place in (0, 1, 4, 5, 6) else part.squeeze(1) for place, part in enumerate(parts)))

    def _step(self, part: str, loss: Tensor) -> None:
        optimiser = self._optimisers[part]
        optimiser.gradient.zero_()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()

    def _step_alpha(self, log_probs: Tensor) -> None:
        self._step("alpha", alpha_loss(self._trained_log_alpha, log_probs, self._target_entropy))

    @torch.no_grad()
    def _soft_targets(self, given: _Given, alpha: Tensor) -> Tensor:
        """Soft targets y [B]."""
        actions, log_probs = squashed(evaluate_plainly(self._actor.layers, given.next_states)[0], given.next_noise)
        values = self._values(self._targets.layers, given.next_states, actions).amin(0)
        own, peers = NextValues(values, log_probs), NextValues(given.peer_values, given.peer_log_probs)
        return critic_target(given.rewards, given.discounts, own, peers, given.answered > 0, alpha)

    def _step_critics(self, given: _Given, targets: Tensor) -> Tensor:
        """Step the critics; returns Q_i - y [2, B]."""
        errors = self._values(self._trained_critics, given.states, given.actions) - targets
        self._step("critics", critic_loss(errors))
        return errors.detach()

    def _step_actor(self, given: _Given, actions: Tensor, log_probs: Tensor, alpha: Tensor) -> Tensor:
        """Step the actor; returns min_i Q_i(s, a) of its actions [B]."""
        values = self._values(self._critics.layers, given.states, actions).amin(0)
        self._step("actor", actor_loss(alpha, log_probs, values))
        return values.detach()

    def losses(self) -> dict[str, float]:
        """See ``SoftActorCritic.losses``."""
        return {} if self._last is None else self._last.fetched().losses(self._target_entropy)

    @property
    def targets(self) -> Reals:
        """See ``SoftActorCritic.targets``."""
        if self._last is None:
            raise RuntimeError(NO_UPDATE)
        return self._last.fetched().targets
