"""The agent protocol: learner, actor, and parameter shapes.

An agent is a folder with the same few modules: ``config`` (settings and defaults), ``shapes`` (``AgentShapes``),
``losses``, ``networks``, ``actor`` (``AgentActor``) and ``agent`` (``AgentBuilder``). ``core.registry.AGENTS`` lists
the folders. The coordinator imports ``config`` and ``shapes``, so these import no torch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.context import AgentContext
from t4nmtd_dist.agents.common.peer_values import PeerCritics, Values
from t4nmtd_dist.agents.common.rehearsal import GreedyActor
from t4nmtd_dist.agents.common.replay_buffer import ReplayBuffer
from t4nmtd_dist.agents.common.rollout import Rollout
from t4nmtd_dist.agents.weights import Shapes, Weights
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.environments.batched import Observations

if TYPE_CHECKING:
    from t4nmtd_dist.agents.common.off_policy import OffPolicyAgent  # imports torch

Actions = NDArray[Any]


class Actor(Protocol):
    """The trained policy of one sub-task.

    Intended loop::

        actor = make_actor(config.learner, weights)
        while not episode_is_over:
            observations, q = step(actor.act(product_states(observations, q, dfa.states)))
    """

    inputs: int
    """Length of a product state, d + |Q|."""

    def act(self, states: NDArray[np.float32], rng: np.random.Generator | None = None) -> Actions:
        """Actions for product states [N, inputs]: int64 [N], or float32 [N, A] within the action space's bounds.

        ``rng`` samples them from the policy; without it, they are the most likely ones.
        """


class AgentShapes(Protocol):
    """Module ``shapes`` of an agent: names and shapes of its parameters.

    The acting network is named ``actor.*``, or ``average.*`` if the agent acts with averaged weights.

    Intended check::

        inputs_of, actions_of = shapes.size_parameters(config.learner.hidden)
        inputs, actions = weights[inputs_of].shape[1], weights[actions_of].shape[0]
        expected = shapes.parameter_shapes(config, inputs, actions)
    """

    def parameter_shapes(self, config: TaskConfig, inputs: int, actions: int) -> Shapes:
        """Names and shapes of a learner's parameters, without observation statistics.

        Args:
            config: the task.
            inputs: length of a product state.
            actions: number of discrete actions, or length of a continuous one.
        """

    def size_parameters(self, hidden: Sequence[int]) -> tuple[str, str]:
        """Names of two parameters, one of shape [., inputs, ..] and one of shape [actions, ..] or [actions]."""


class AgentActor(Protocol):
    """Module ``actor`` of an agent."""

    def make_actor(self, hidden: tuple[int, ...], weights: Weights) -> Actor:
        """Build an actor; parameters are named without ``actor.`` or ``average.``.

        Raises:
            PolicyError: if parameters are missing or do not fit.
        """


class PublishedValues(Protocol):
    """A copy of the critic, for other threads or held by a peer."""

    def values(self, arrays: Mapping[str, NDArray[Any]]) -> tuple[Values, int]:
        """Values of the product states in a value request, and the copy's version.

        Raises:
            ProtocolError: if the arrays do not fit.
        """

    def weights(self) -> tuple[Weights, int]:
        """The copy's weights and version."""

    def load(self, weights: Mapping[str, NDArray[Any]], version: int) -> None:
        """Load another copy's ``weights``.

        Raises:
            PolicyError: if names or shapes differ; discard the copy then.
            ProtocolError: if they are not finite.
        """


class Learner(Protocol):
    """Learns one sub-task from its own attempts.

    Intended loop::

        while True:
            if not learner.iterate(peers):
                wait_for_start_states()
            tell(learner.rollout.take_progress(), learner.weights(), learner.version)
    """

    pid: str
    rollout: Rollout
    version: int
    value_shape: tuple[int, ...]
    peer_steps: int
    """How many steps of each peer in another process are worth keeping; 0 where peers' experience is not used."""

    @property
    def gradient_steps(self) -> int:
        """Updates so far."""

    @property
    def replay_buffer(self) -> ReplayBuffer | None:
        """The learner's replay buffer, also for peers; None for on-policy agents."""

    @property
    def peer_rows(self) -> int:
        """Number of peer transitions available to the learner now."""

    def learn_from(self, others: Mapping[str, ReplayBuffer]) -> None:
        """Also learn from these replay buffers, by pid; read at every draw, the own pid skipped."""

    @property
    def published(self) -> PublishedValues:
        """The critic copy that answers peers."""

    def replica(self) -> PublishedValues:
        """A critic copy of the same shape, to load a peer's weights into."""

    def iterate(self, peers: PeerCritics) -> bool:
        """Collect some steps and run the updates due; False while there is no start state."""

    def rehearse(self, actor: GreedyActor) -> bool:
        """One whole attempt of every copy by ``actor``, from which nothing is learned; False without a start state."""

    def critic_values(self, observations: Observations, q: NDArray[np.int32]) -> Values:
        """Values of product states, float32 [k] or [k, 2], for peers in this process."""

    def weights(self) -> Weights:
        """Copies of all parameters by name."""

    def load(self, weights: Mapping[str, NDArray[Any]], version: int) -> None:
        """Load trained weights."""

    def losses(self) -> tuple[float | None, float | None]:
        """Entropy (nats) and critic loss of the last update; None before the first."""

    def state_dict(self) -> State:
        """The complete training state between iterations, for a checkpoint.

        Arrays may be views: write or copy them before the next iteration.
        """

    def load_state_dict(self, state: State) -> None:
        """Resume exactly from the ``state_dict()`` of a learner with the same sub-task and settings.

        Raises:
            RunError, PolicyError: if the state has other shapes.
        """


class OffPolicyBuilder(Protocol):
    """Module ``agent`` of an off-policy agent, beside ``AgentBuilder``."""

    def algorithm(self, context: AgentContext, rng: np.random.Generator) -> OffPolicyAgent:
        """Build one of several networks of a learner, for methods whose roles share an environment.

        Raises:
            EnvError: if it cannot act in the environment's action space.
        """


class AgentBuilder(Protocol):
    """Module ``agent`` of an agent.

    Intended use::

        env = make_task_env(config, config.agent.num_envs)
        learner = agent.build(AgentContext(..., rollout=Rollout(env, ...)))
    """

    def build(self, context: AgentContext) -> Learner:
        """Build a learner.

        Raises:
            EnvError: if it cannot act in the environment's action space.
        """
