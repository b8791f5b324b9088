"""Checks of the arguments of algorithms, with each other and with the environment."""

from __future__ import annotations

from typing import Any, cast

from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

from sb3_maddpg.common.actions import Continuous
from sb3_maddpg.common.buffers import TeamReplayBuffer
from sb3_maddpg.common.policies import MADDPGPolicy
from sb3_maddpg.errors import InvalidArgumentError, InvalidEnvironmentError
from sb3_maddpg.utils import arguments_of, shown, suggest

# Arguments that the algorithm itself passes to the policy
NOT_POLICY_KWARGS = {"observation_space", "action_space", "lr_schedule"}
# Arguments that the algorithm itself passes to the replay buffer
NOT_BUFFER_KWARGS = {
    "buffer_size",
    "observation_space",
    "action_space",
    "device",
    "n_envs",
    "optimize_memory_usage",
    "args",
}
# Arguments that the algorithm and the replay buffer share
OWN_BUFFER_KWARGS = ("n_steps", "gamma")
# Limit for the alternative actions that ``expected`` evaluates in one update; the critics' layers need at least as much
MOST_BYTES_OF_ALTERNATIVES = 4 * 2**30


def check_policy(policy_class: type, kwargs: dict[str, Any]) -> None:
    """
    :param policy_class: class of the policy
    :param kwargs: its arguments
    :raises InvalidArgumentError: if it is not a policy for a team, or has no such argument
    """
    if not issubclass(policy_class, MADDPGPolicy):
        name = policy_class.__name__
        raise InvalidArgumentError(f"{name} is not a policy for a team: use MlpPolicy, CnnPolicy or PairPolicy.")
    for name in kwargs:
        if name in NOT_POLICY_KWARGS:
            raise InvalidArgumentError(
                f"policy_kwargs[{name!r}] is set by the algorithm: leave it out"
                f"{' and pass learning_rate to the algorithm' if name == 'lr_schedule' else ''}."
            )
        if name not in (known := arguments_of(policy_class) - NOT_POLICY_KWARGS - {"args"}):
            raise InvalidArgumentError(suggest("argument in policy_kwargs", name, known))


def check_same_policy(given: Any, stored: Any, policy_class: Any) -> None:
    """
    Check arguments of the policy that were passed to ``load``, like SB3, but without those that the environment adds.

    :param given: the arguments
    :param stored: the arguments in the file
    :param policy_class: class of the policy
    :raises ValueError: if they differ
    """
    if not isinstance(given, dict) or not isinstance(stored, dict):
        raise InvalidArgumentError(f"policy_kwargs={shown(given)} must be a dict of arguments by name.")
    from_env = getattr(policy_class, "env_attributes", ())
    full = {name: value for name, value in stored.items() if name in from_env} | given
    if differing := sorted(name for name in {*full, *stored} if full.get(name) != stored.get(name)):
        raise InvalidArgumentError(
            f"policy_kwargs: {', '.join(differing)} differ from those of the model, {shown(stored)}. Leave them out: "
            "the networks of a model do not change."
        )


def check_train_freq(train_freq: TrainFreq | tuple[int, Any] | int, n_envs: int) -> None:
    """
    :param train_freq: the argument of the algorithm
    :param n_envs: number of parallel environments
    :raises InvalidEnvironmentError: if episodes are counted in several environments
    """
    frequency, unit = train_freq if isinstance(train_freq, tuple) else (train_freq, "step")
    if n_envs > 1 and unit in ("episode", TrainFrequencyUnit.EPISODE):
        raise InvalidEnvironmentError(
            f'train_freq=({frequency}, "episode") needs a single environment, but there are {n_envs}: pass a '
            "number of steps."
        )


def check_buffer_size(
    buffer_size: int, batch_size: int, n_steps: int, n_envs: int, optimize_memory_usage: bool
) -> None:
    """
    :param buffer_size: see the algorithm
    :param batch_size: see the algorithm
    :param n_steps: see the algorithm
    :param n_envs: number of parallel environments
    :param optimize_memory_usage: see the algorithm
    :raises InvalidArgumentError: if the replay buffer would be too small
    """
    if batch_size > buffer_size:
        raise InvalidArgumentError(
            f"batch_size={batch_size} is larger than buffer_size={buffer_size}, from which batches are "
            "sampled. Lower batch_size or raise buffer_size."
        )
    if optimize_memory_usage and buffer_size // n_envs < 2:
        raise InvalidArgumentError(
            f"buffer_size={buffer_size} must hold two transitions of each of the {n_envs} environment(s) "
            "with optimize_memory_usage=True, which never samples one of them. Raise buffer_size."
        )
    if n_steps > buffer_size // n_envs:
        raise InvalidArgumentError(
            f"n_steps={n_steps} is more than buffer_size={buffer_size} stores of each of the "
            f"{n_envs} environment(s): lower n_steps or raise buffer_size."
        )


def check_buffer(buffer: Any, kwargs: dict[str, Any]) -> None:
    """
    :param buffer: ``replay_buffer_class`` of the algorithm
    :param kwargs: its arguments
    :raises InvalidArgumentError: if it is not a replay buffer for teams, or does not have the arguments
    """
    if isinstance(buffer, str):
        raise InvalidArgumentError(
            f"replay_buffer_class={shown(buffer)} is a name, which only recipes accept: pass the class."
        )
    if buffer is not None and not isinstance(buffer, type):
        raise InvalidArgumentError(
            f"replay_buffer_class={shown(buffer)} is not a class: pass TeamReplayBuffer or a subclass of it."
        )
    if buffer is not None and not issubclass(buffer, TeamReplayBuffer):
        raise InvalidArgumentError(
            f"replay_buffer_class={buffer.__name__} does not store the rewards of agents: derive it from "
            "sb3_maddpg.TeamReplayBuffer. Hindsight replay (HerReplayBuffer) needs goals in dictionary "
            "observations, which a team does not have."
        )
    for name in kwargs:
        if name not in (known := arguments_of(buffer or TeamReplayBuffer) - NOT_BUFFER_KWARGS):
            raise InvalidArgumentError(suggest("argument in replay_buffer_kwargs", name, known))
    if missing := sorted(
        (NOT_BUFFER_KWARGS - {"args"} | {*OWN_BUFFER_KWARGS}) - arguments_of(buffer or TeamReplayBuffer)
    ):
        raise InvalidArgumentError(
            f"replay_buffer_class={cast(type, buffer).__name__} does not accept {', '.join(missing)}, which the "
            "algorithm passes: add them to its __init__, or pass **kwargs on to TeamReplayBuffer's."
        )


def check_memory_of_expectation(policy: MADDPGPolicy, batch_size: int) -> None:
    """
    :param policy: the policy
    :param batch_size: see the algorithm
    :raises InvalidEnvironmentError: if the estimator ``expected`` would evaluate more actions than fit into memory
    """
    factors, team = policy.critic.factors, policy.team
    for kind in factors.kinds:
        if isinstance(kind, Continuous):
            continue
        # One alternative per column, each an encoded action in single precision
        of_sample = 4 * len(kind.agents) * kind.width**2
        if batch_size * of_sample > MOST_BYTES_OF_ALTERNATIVES:
            widest = max(range(len(kind.agents)), key=lambda row: sum(kind.sizes[row]))
            agent = kind.agents[widest] * team.n_agents // factors.n_agents
            fits = MOST_BYTES_OF_ALTERNATIVES // of_sample
            raise InvalidEnvironmentError(
                f"estimator='expected' evaluates each of the {kind.width} categories or binary actions of agent "
                f"{team.names[agent]} ({team.action_spaces[agent]}): with batch_size={batch_size} this takes "
                f"{batch_size * of_sample / 2**30:.0f} GiB or more. Choose an estimator that samples, such as "
                "'gapped_straight_through'" + (f", or a batch_size of at most {fits}." if fits else ".")
            )
