"""Acting and critic evaluation without autograd, on the CPU."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from t4nmtd_dist.agents.sac.fast_cpu.forward import GrowingWorkspace, evaluate
from t4nmtd_dist.agents.sac.fast_cpu.squashed_gaussian import SquashedSample, deterministic_actions, squashed_sample
from t4nmtd_dist.agents.sac.networks import Stack
from t4nmtd_dist.agents.sac.updater import Floats, Reals


class FastActing:
    """The actor's actions and their target-critic values.

    Args:
        actor: stack of one network.
        targets: the target critics.
    """

    def __init__(self, actor: Stack, targets: Stack, generator: torch.Generator) -> None:
        self._actor, self._targets, self._generator = actor, targets, generator
        self._acting, self._valuing = GrowingWorkspace(actor.shape), GrowingWorkspace(targets.shape)

    @torch.no_grad()
    def act(self, states: Floats, *, deterministic: bool) -> Floats:
        """See ``SoftActorCritic.act``."""
        outputs = self._outputs(torch.from_numpy(states))
        drawn = deterministic_actions(outputs) if deterministic else self._sample(outputs).actions
        return np.ascontiguousarray(drawn.T, np.float32)

    @torch.no_grad()
    def soft_values(self, states: Floats) -> tuple[Floats, Floats]:
        """See ``SoftActorCritic.soft_values``."""
        rows, size = states.shape
        inputs = torch.empty(rows, self._targets.shape.inputs)
        inputs[:, :size] = torch.from_numpy(states)
        sample = self._sample(self._outputs(inputs[:, :size]))
        inputs[:, size:] = torch.from_numpy(sample.actions.T)
        values = evaluate(self._targets.layers, inputs, self._valuing.of(rows))[:, 0].numpy()
        return values.min(0), sample.log_probs.astype(np.float32, copy=False)

    def _outputs(self, states: Tensor) -> Reals:
        outputs: Reals = evaluate(self._actor.layers, states, self._acting.of(len(states)))[0].numpy()
        return outputs

    def _sample(self, outputs: Reals) -> SquashedSample:
        size, rows = outputs.shape
        return squashed_sample(outputs, torch.randn(size // 2, rows, generator=self._generator).numpy())
