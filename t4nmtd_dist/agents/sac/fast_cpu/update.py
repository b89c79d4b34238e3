"""SAC's gradient step with hand-written gradients, tested against autograd of ``losses``.

Every step names the loss it descends. Peers' values replace the own ones as in ``losses.critic_target``.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from t4nmtd_dist.agents.common.batches import Batch
from t4nmtd_dist.agents.sac.fast_cpu.acting import FastActing
from t4nmtd_dist.agents.sac.fast_cpu.backward import chosen_input_gradient, weight_gradients
from t4nmtd_dist.agents.sac.fast_cpu.forward import Activations, evaluate
from t4nmtd_dist.agents.sac.fast_cpu.squashed_gaussian import SquashedSample, output_gradient, squashed_sample
from t4nmtd_dist.agents.sac.networks import layers_of
from t4nmtd_dist.agents.sac.parameters import NO_UPDATE, LastUpdate, SACParameters
from t4nmtd_dist.agents.sac.shapes import StackShape
from t4nmtd_dist.agents.sac.updater import Floats, PeerSoftValues, Reals, SACSettings


class _Workspace:
    """Buffers for one batch size; names ending in ``array`` are numpy views of tensors.

    ``inputs`` [2 B, d + A] holds <s, a> above <s', a'>; the first d columns are the actor's inputs.
    """

    def __init__(self, rows: int, state_size: int, actor: StackShape, critics: StackShape) -> None:
        self.rows = rows
        self.inputs = torch.zeros(2 * rows, critics.inputs)
        self.states = self.inputs[:, :state_size]
        self.current, self.following = self.inputs[:rows], self.inputs[rows:]
        self.current_array: Floats = self.current.numpy()
        self.following_array: Floats = self.following.numpy()
        self.actor = Activations(actor, 2 * rows)
        self.critics = Activations(critics, rows)
        self.values_array: Floats = self.critics.outputs[:, 0].numpy()
        self.d_values = torch.zeros(critics.count, 1, rows)
        self.d_values_array: Floats = self.d_values[:, 0].numpy()


class SACUpdater(SACParameters):
    """``SoftActorCritic`` for the CPU, with hand-written gradients.

    Args:
        state_size: d, the length of a product state.
        action_size: A.
    """

    def __init__(self, state_size: int, action_size: int, settings: SACSettings, seed: int) -> None:
        super().__init__(state_size, action_size, settings, seed)
        self._log_alpha_array: Floats = self._log_alpha.numpy()
        actor, critics = self._actor.shape, self._critics.shape
        self._actor_gradients = layers_of(self._optimisers["actor"].gradient, actor)
        self._critic_gradients = layers_of(self._optimisers["critics"].gradient, critics)
        self._acting = FastActing(self._actor, self._targets, self._generator)
        self._workspace: _Workspace | None = None
        self._last: LastUpdate | None = None

    def act(self, states: Floats, *, deterministic: bool) -> Floats:
        """See ``SoftActorCritic.act``."""
        return self._acting.act(states, deterministic=deterministic)

    def soft_values(self, states: Floats) -> tuple[Floats, Floats]:
        """See ``SoftActorCritic.soft_values``."""
        return self._acting.soft_values(states)

    def update(self, batch: Batch, peers: PeerSoftValues | None = None) -> None:
        """See ``SoftActorCritic.update``."""
        self.update_with_noise(batch, self._noise(2 * len(batch.rewards)), peers)

    @torch.no_grad()
    def update_with_noise(self, batch: Batch, noise: Floats, peers: PeerSoftValues | None = None) -> None:
        """See ``SoftActorCritic.update_with_noise``."""
        workspace = self._load(batch)
        alpha = math.exp(self._log_alpha_array[0])
        if not self._actor_is_due:
            following = self._sample_from(workspace, noise, slice(workspace.rows, None))
            targets = self._soft_targets(batch, workspace, following, alpha, peers)
            self._step_critics(workspace, targets)
        else:
            sample = self._sample_from(workspace, noise, slice(None))
            own = sample.part(slice(workspace.rows))
            self._step_alpha(own.log_probs)
            targets = self._soft_targets(batch, workspace, sample.part(slice(workspace.rows, None)), alpha, peers)
            errors = self._step_critics(workspace, targets)
            values = self._step_actor(workspace, own, alpha)
            self._last = LastUpdate(errors, targets, own.log_probs, values, alpha)
        self._targets.flat.lerp_(self._critics.flat, self.settings.tau)

    def _sample_from(self, workspace: _Workspace, noise: Floats, rows: slice) -> SquashedSample:
        states = workspace.states[rows]
        outputs = evaluate(self._actor.layers, states, workspace.actor.first(len(states)))
        return squashed_sample(outputs[0].numpy(), noise[:, rows])

    def _load(self, batch: Batch) -> _Workspace:
        rows, size = len(batch.rewards), self._state_size
        if self._workspace is None or self._workspace.rows != rows:
            self._workspace = _Workspace(rows, size, self._actor.shape, self._critics.shape)
        workspace = self._workspace
        workspace.current_array[:, :size] = batch.states.numpy()
        workspace.current_array[:, size:] = batch.actions.numpy()
        workspace.following_array[:, :size] = batch.next_states.numpy()
        return workspace

    def _step_alpha(self, log_probs: Reals) -> None:
        """Descend ``losses.alpha_loss``."""
        optimiser = self._optimisers["alpha"]
        optimiser.gradient.fill_(-float(log_probs.mean()) - self._target_entropy)
        optimiser.step()

    def _soft_targets(
        self,
        batch: Batch,
        workspace: _Workspace,
        following: SquashedSample,
        alpha: float,
        peers: PeerSoftValues | None,
    ) -> Reals:
        """See ``losses.critic_target``."""
        workspace.following_array[:, self._state_size :] = following.actions.T
        evaluate(self._targets.layers, workspace.following, workspace.critics)
        values: Reals = workspace.values_array.min(0)
        log_probs = following.log_probs
        if peers is not None:
            values[peers.rows], log_probs[peers.rows] = peers.values, peers.log_probs
        values -= alpha * log_probs
        values *= batch.discounts.numpy()
        values += batch.rewards.numpy()
        return values

    def _step_critics(self, workspace: _Workspace, targets: Reals) -> Reals:
        """Descend ``losses.critic_loss``; returns the errors Q_i - y [2, B]."""
        evaluate(self._critics.layers, workspace.current, workspace.critics)
        errors: Reals = workspace.values_array - targets
        np.divide(errors, workspace.rows, out=workspace.d_values_array)
        weight_gradients(
            self._critics.layers, self._critic_gradients, workspace.current, workspace.critics, workspace.d_values
        )
        self._optimisers["critics"].step()
        return errors

    def _step_actor(self, workspace: _Workspace, sample: SquashedSample, alpha: float) -> Reals:
        """Descend ``losses.actor_loss``; returns min_i Q_i(s, a) [B]."""
        rows, layers = workspace.rows, self._critics.layers
        workspace.current_array[:, self._state_size :] = sample.actions.T
        evaluate(layers, workspace.current, workspace.critics)
        d_actions = chosen_input_gradient(layers, workspace.critics, workspace.values_array.argmin(0), self._state_size)
        d_actions /= -rows
        d_outputs = torch.from_numpy(output_gradient(sample, d_actions, alpha / rows))[None]
        states, activations = workspace.states[:rows], workspace.actor.first(rows)
        weight_gradients(self._actor.layers, self._actor_gradients, states, activations, d_outputs)
        self._optimisers["actor"].step()
        self._average_actor()
        values: Reals = workspace.values_array.min(0)
        return values

    def losses(self) -> dict[str, float]:
        """See ``SoftActorCritic.losses``."""
        return {} if self._last is None else self._last.losses(self._target_entropy)

    @property
    def targets(self) -> Reals:
        """See ``SoftActorCritic.targets``."""
        if self._last is None:
            raise RuntimeError(NO_UPDATE)
        return self._last.targets
