"""
Stable-Baselines3's own algorithms in PettingZoo environments, with parameter sharing: all agents share one policy,
which acts on each agent's own observation and learns from its own reward (PS-PPO etc., Gupta et al. 2017; Terry et al.
2020). SuperSuit turns the agents into the environments of a vectorised environment.
"""

import copy
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import create_empty_array, iterate
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices
from supersuit import concat_vec_envs_v1, pettingzoo_env_to_vec_env_v1

from sb3_maddpg.common.team_algorithm import TeamAlgorithm
from sb3_maddpg.team import pettingzoo as parallel


def shares_parameters(algorithm: type[BaseAlgorithm], env_id: str) -> bool:
    """
    :param algorithm: an algorithm
    :param env_id: Gymnasium id
    :return: whether training shares one policy among all agents: a single-agent algorithm in a PettingZoo environment
    """
    return not issubclass(algorithm, TeamAlgorithm) and gymnasium.spec(env_id).entry_point == parallel.ENTRY_POINT


class AgentsVecEnv(VecEnv):
    """
    Vectorised environment whose environments are the agents of all copies of a PettingZoo ``ParallelEnv``, based on
    SuperSuit. A step of all copies counts as ``n_agents * n_envs`` timesteps.

    It replaces SuperSuit's wrapper for Stable-Baselines3, which ignores the seed, does not report truncation, so that
    values are not bootstrapped, and rejects actions of another dtype than the space's.

    :param env_id: id of a PettingZoo environment, see ``pettingzoo_ids.register``
    :param n_envs: number of copies
    :param env_kwargs: arguments of ``parallel.make_parallel_env``
    :raises ValueError: if the agents cannot share a policy
    """

    def __init__(self, env_id: str, n_envs: int, env_kwargs: dict[str, Any]):
        if env_kwargs.get("state"):
            raise ValueError(
                "state:True is for centralised critics, of MADDPG, MATD3 and MASAC: a shared policy only sees its own "
                "agent's observation."
            )
        if env_kwargs.get("info_mask"):
            raise ValueError(
                "info_mask:True is for MADDPG, MATD3, MASAC and IDDPG: a shared policy reads no action masks."
            )
        self.spec = copy.deepcopy(gymnasium.spec(env_id))
        self.spec.kwargs.update(env_kwargs)
        env = parallel.make_parallel_env(
            **{key: one for key, one in self.spec.kwargs.items() if key not in ("state", "info_mask")}
        )
        self.agents = _homogeneous_agents(env_id, env)
        with warnings.catch_warnings():  # SuperSuit expects a Gymnasium environment
            warnings.filterwarnings("ignore", module="supersuit")
            self.envs = concat_vec_envs_v1(pettingzoo_env_to_vec_env_v1(EveryAgent(env)), n_envs)
        env.close()  # only the copies are used
        self.actions: np.ndarray | None = None
        super().__init__(self.envs.num_envs, self.envs.observation_space, self.envs.action_space)
        self.metadata = self.envs.metadata

    def reset(self) -> np.ndarray:
        """
        :return: observations, (n_envs * n_agents, ...)
        """
        observations, self.reset_infos = self.envs.reset(seed=self._seeds[0])
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """
        :param actions: actions of all agents, (n_envs * n_agents, ...); converted to the dtype of the action space,
            because some algorithms return floats for MultiBinary spaces
        """
        self.actions = np.asarray(actions).astype(self.action_space.dtype, copy=False)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """
        :return: observations, rewards, dones and infos of all agents
        """
        observations, rewards, terminations, truncations, infos = self.envs.step(self.actions)
        terminated, truncated = terminations.astype(bool), truncations.astype(bool)
        for k, info in enumerate(infos):
            if truncated[k]:
                info["TimeLimit.truncated"] = not terminated[k]
        return observations, rewards, terminated | truncated, infos

    def render(self, mode: str | None = None) -> Any:
        """
        :param mode: unused, since PettingZoo's environments get their render mode on creation
        :return: rendering of the first copy
        """
        return self.envs.render()

    def close(self) -> None:
        """Close the environments."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        :param attr_name: name of the attribute
        :param indices: indices of agents
        :return: the attribute of each agent's environment
        """
        if attr_name == "spec":
            return [self.spec for _ in self._get_indices(indices)]
        return [getattr(self._env_of(k), attr_name) for k in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """
        :param attr_name: name of the attribute
        :param value: value for each of the environments
        :param indices: indices of agents
        """
        for env in self._distinct(indices):
            setattr(env, attr_name, value)

    def env_method(self, method_name: str, *method_args, indices: VecEnvIndices = None, **method_kwargs) -> list[Any]:
        """
        :param method_name: name of the method, which is called once in each environment
        :param method_args: positional arguments of the method
        :param indices: indices of agents
        :param method_kwargs: keyword arguments of the method
        :return: the result of each environment
        """
        return [getattr(env, method_name)(*method_args, **method_kwargs) for env in self._distinct(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        """:return: False, since these are not Gymnasium environments"""
        return [False for _ in self._get_indices(indices)]

    def _env_of(self, agent: int) -> Any:
        return self.envs.vec_envs[agent // len(self.agents)].par_env

    def _distinct(self, indices: VecEnvIndices) -> list[Any]:
        return [self._env_of(k) for k in sorted({k - k % len(self.agents) for k in self._get_indices(indices)})]


def _homogeneous_agents(env_id: str, env: ParallelEnv) -> Sequence[Any]:
    """:return: the agents, after checking that their spaces are equal"""
    agents = env.possible_agents
    kinds = (
        ("observation", env.observation_space, "pad_observations_v0", (spaces.Box,)),
        ("action", env.action_space, "pad_action_space_v0", (spaces.Box, spaces.Discrete)),
    )
    # Only if both can be padded is there anything to gain
    pads = all(_can_be_padded([space_of(agent) for agent in agents], types) for _, space_of, _, types in kinds)
    for kind, space_of, wrapper, _ in kinds:
        first = space_of(agents[0])
        for agent in agents:
            if space_of(agent) != first:
                remedy = "train with --algo maddpg, matd3, masac or iddpg"
                if pads:
                    remedy = f"add supersuit.{wrapper} to `wrappers` of env_kwargs, or {remedy}"
                else:
                    remedy = f"no wrapper makes these spaces alike, so {remedy}"
                raise ValueError(
                    f"{env_id} has heterogeneous agents: the {kind} space of {agents[0]} is {first}, that of {agent} "
                    f"is {space_of(agent)}. A shared policy needs equal spaces: {remedy}."
                )
    return agents


def _can_be_padded(agents_spaces: Sequence[spaces.Space], types: tuple[type[spaces.Space], ...]) -> bool:
    """:return: whether SuperSuit can make the spaces of these types alike, or they are"""
    first = agents_spaces[0]
    same = all(type(one) is type(first) and len(one.shape or ()) == len(first.shape or ()) for one in agents_spaces)
    return all(one == first for one in agents_spaces) or (same and isinstance(first, types))


class EveryAgent(BaseParallelWrapper):
    """
    Wrapper that keeps agents that ended before the others, with zero observations and rewards, until the episode ends.
    In the last step, each agent's info holds the ``is_success`` that it said last.
    SuperSuit's ``black_death_v3`` should do this, but in version 3.11 it only ends an episode if all agents are both
    terminated and truncated in the same step.

    :param env: the environment
    """

    def __init__(self, env: ParallelEnv):
        super().__init__(env)
        self.agents = self.possible_agents
        self._successes: dict[Any, Any] = {}

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        """
        :param seed: seed of the environment
        :param options: options of the environment
        :return: observations and infos of all agents
        """
        observations, infos = self.env.reset(seed=seed, options=options)
        self._successes = {}
        return self._fill(observations), {agent: infos.get(agent, {}) for agent in self.agents}

    def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
        """
        :param actions: actions of all agents
        :return: observations, rewards, terminations, truncations and infos of all agents, which end together
        """
        given = {agent: actions[agent] for agent in self.env.agents}
        observations, rewards, terminations, truncations, infos = self.env.step(given)
        over = not self.env.agents
        said = {agent: (infos.get(agent) or {}).get("is_success") for agent in given}
        self._successes |= {agent: success for agent, success in said.items() if success is not None}
        infos = {agent: dict(infos.get(agent) or {}) for agent in self.agents}
        if over:  # SB3 reads it in the last step only, to which not every agent came
            for agent, success in self._successes.items():
                infos[agent]["is_success"] = success
        # Some environments keep reporting agents that have left
        truncated = {agent: over and agent in given and bool(truncations[agent]) for agent in self.agents}
        terminated = {agent: over and (not truncated[agent] or bool(terminations[agent])) for agent in self.agents}
        return (
            self._fill({agent: observations[agent] for agent in given if agent in observations}),
            {agent: rewards[agent] if agent in given else 0.0 for agent in self.agents},
            terminated,
            truncated,
            infos,
        )

    def _fill(self, observations: dict) -> dict:
        for agent in self.agents:
            if agent not in observations:
                space = self.observation_space(agent)
                observations = {**observations, agent: next(iter(iterate(space, create_empty_array(space))))}
        return observations


class SharedPolicy:
    """
    Adapter that lets a model trained in ``AgentsVecEnv`` act for a whole team (``TeamEnv``): it maps observations,
    (n_envs, n_agents, columns), to joint actions, (n_envs, n_actions). Used by rl_zoo3's ``enjoy`` and ``record``, and
    for ``evaluate_policy``.

    :param model: the trained model
    """

    def __init__(self, model: BaseAlgorithm):
        self.model = model

    @classmethod
    def loader(cls, load: Callable[..., BaseAlgorithm]) -> type:
        """
        :param load: the algorithm's ``load``
        :return: a replacement for the algorithm, whose ``load`` returns a ``SharedPolicy``
        """

        class Algorithm:
            @staticmethod
            def load(path: Any, env: Any = None, **kwargs: Any) -> SharedPolicy:
                return cls(load(path, **kwargs))

        return Algorithm

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[np.ndarray, None]:
        """
        :param observation: observations of the team, (n_envs, n_agents, columns)
        :param state: unused
        :param episode_start: unused
        :param deterministic: whether to choose the most probable actions
        :return: joint actions, (n_envs, n_actions), and None for the state
        """
        space = self.model.observation_space
        n_envs, n_agents = observation.shape[:2]
        if isinstance(space, spaces.Box):  # other spaces were flattened into their rows
            observation = observation[..., : int(np.prod(space.shape))].reshape(-1, *space.shape)
        actions, _ = self.model.predict(observation, deterministic=deterministic)
        return np.asarray(actions).reshape(n_envs, n_agents, -1).reshape(n_envs, -1), None
