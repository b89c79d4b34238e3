"""State shared by both implementations of SAC's gradient step: parameters, optimisers and noise."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.flat_adam import FlatAdam
from t4nmtd_dist.agents.sac.networks import Stack, weights_of_stacks
from t4nmtd_dist.agents.sac.shapes import actor_shape, critics_shape
from t4nmtd_dist.agents.sac.updater import Floats, Reals, SACSettings
from t4nmtd_dist.agents.weights import Weights, part_of
from t4nmtd_dist.core.errors import PolicyError

NO_UPDATE = "no update yet: targets are those of the last one"


@dataclass(frozen=True)
class LastUpdate:
    """Data of the last update, from which losses are computed on demand.

    Attributes:
        errors: Q_i - y of both critics [2, B].
        targets: y [B].
        log_probs: log pi(a|s) of the actor's actions [B].
        values: their min_i Q_i(s, a) [B].
        alpha: entropy coefficient of the update.
    """

    errors: Reals
    targets: Reals
    log_probs: Reals
    values: Reals
    alpha: float

    def losses(self, target_entropy: float) -> dict[str, float]:
        """See ``SoftActorCritic.losses``."""
        log_prob = float(self.log_probs.mean())
        return {
            "critic_loss": float(0.5 * np.square(self.errors).mean(1).sum()),
            "actor_loss": float((self.alpha * self.log_probs - self.values).mean()),
            "alpha_loss": -math.log(self.alpha) * (log_prob + target_entropy),
            "alpha": self.alpha,
            "entropy": -log_prob,
            "value": float(self.values.mean()),
            "target": float(self.targets.mean()),
        }


class SACParameters:
    """Actor and its average, critics, targets, entropy coefficient, optimisers and noise generator.

    Initial weights and noise are drawn on the CPU, so a seed gives the same ones on every device.

    Args:
        state_size: d, the length of a product state.
        action_size: A.
    """

    def __init__(
        self, state_size: int, action_size: int, settings: SACSettings, seed: int, device: torch.device | str = "cpu"
    ) -> None:
        self.settings = settings
        self._state_size, self._action_size = state_size, action_size
        self._generator = torch.Generator().manual_seed(seed)
        actor = actor_shape(state_size, action_size, settings.hidden)
        critics = critics_shape(state_size, action_size, settings.hidden, layer_norm=settings.layer_norm)
        self._actor = Stack(actor, self._generator, device=device)
        self._average = Stack(actor, device=device)
        self._average.flat.copy_(self._actor.flat)
        self._averaged = 0  # number of actors in the average
        self._critics = Stack(critics, self._generator, device=device)
        self._targets = Stack(critics, device=device)
        self._targets.flat.copy_(self._critics.flat)
        self._log_alpha = torch.full((1,), math.log(settings.initial_alpha), device=device)
        rate = settings.learning_rate
        self._optimisers = {
            "actor": FlatAdam(self._actor.flat, rate),
            "critics": FlatAdam(self._critics.flat, rate),
            "alpha": FlatAdam(self._log_alpha, rate),
        }
        entropy = settings.target_entropy
        self._target_entropy = -float(action_size) if entropy is None else entropy

    def _noise(self, rows: int) -> Floats:
        noise: Floats = torch.randn(self._action_size, rows, generator=self._generator).numpy()
        return noise

    @property
    def _actor_is_due(self) -> bool:
        return self._optimisers["critics"].steps % self.settings.actor_every == 0

    def _average_actor(self) -> None:
        """Update the average; call after every actor step."""
        self._averaged += 1
        share = max(self.settings.actor_average, 1.0 / self._averaged)
        self._average.flat.lerp_(self._actor.flat, share)

    def scale_learning_rate(self, factor: float) -> None:
        """See ``SoftActorCritic.scale_learning_rate``."""
        for optimiser in self._optimisers.values():
            optimiser.learning_rate = factor * self.settings.learning_rate

    @torch.no_grad()
    def keep_alpha_above(self, floor: float) -> None:
        """See ``SoftActorCritic.keep_alpha_above``."""
        if floor > 0.0:
            self._log_alpha.clamp_(min=math.log(floor))

    def _stacks(self) -> dict[str, Stack]:
        return {"actor": self._actor, "average": self._average, "critics": self._critics, "targets": self._targets}

    def weights(self) -> Weights:
        """See ``SoftActorCritic.weights``."""
        return weights_of_stacks(self._stacks()) | {"log_alpha": self._log_alpha.cpu().numpy().copy()}

    def critic_weights(self) -> Weights:
        """See ``SoftActorCritic.critic_weights``."""
        return weights_of_stacks({"actor": self._actor, "targets": self._targets})

    def load(self, weights: Mapping[str, NDArray[Any]]) -> None:
        """See ``SoftActorCritic.load``."""
        if "log_alpha" not in weights:
            raise PolicyError("weights do not fit a SAC learner: log_alpha is missing")
        for part, stack in self._stacks().items():
            stack.load(part_of(weights, part))
        self._log_alpha.copy_(torch.from_numpy(np.asarray(weights["log_alpha"])))
        self._averaged = round(1.0 / self.settings.actor_average)  # weights lack the count; assume many

    def optimiser_state(self) -> Weights:
        """See ``SoftActorCritic.optimiser_state``."""
        named = {
            f"{part}.{name}": array
            for part, optimiser in self._optimisers.items()
            for name, array in optimiser.state_dict().items()
        }
        averaged = np.array(self._averaged, np.int64)
        return named | {"averaged": averaged, "generator": self._generator.get_state().numpy().copy()}

    def load_optimiser_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """See ``SoftActorCritic.load_optimiser_state``."""
        for part, optimiser in self._optimisers.items():
            optimiser.load_state_dict(part_of(state, part))
        self._averaged = int(state.get("averaged", state["actor.steps"]))  # earlier checkpoints lack "averaged"
        self._generator.set_state(torch.from_numpy(np.asarray(state["generator"], np.uint8)))
