"""
Stable-Baselines3's own algorithms on PettingZoo's environments: one policy with shared parameters for all agents, each
of which sees its own observation and learns from its own reward (PS-PPO and the like, Gupta et al. 2017; Terry et al.
2020). SuperSuit lays the agents out as the environments of a vector environment.
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

from sb3_maddpg import MADDPG, parallel


def shares_parameters(algorithm: type[BaseAlgorithm], env_id: str) -> bool:
    """
    :param algorithm: to train with
    :param env_id: Gymnasium id
    :return: whether it trains one policy for all agents: an algorithm for single agents on a PettingZoo environment
    """
    return not issubclass(algorithm, MADDPG) and gymnasium.spec(env_id).entry_point == parallel.ENTRY_POINT


class AgentsVecEnv(VecEnv):
    """
    Every agent of every copy of a PettingZoo ``ParallelEnv`` as one environment of a vector environment, by SuperSuit.
    A step of all copies counts as ``n_agents * n_envs`` timesteps.

    SuperSuit's own wrapper for Stable-Baselines3 does not pass the seed on, marks no truncation, so that the value of
    the last observation would not be bootstrapped, and takes no actions of another dtype than the space's.

    :param env_id: id of a PettingZoo environment, see ``pettingzoo_ids.register``
    :param n_envs: number of copies
    :param env_kwargs: arguments of ``parallel.make_parallel_env``
    :raises ValueError: agents that cannot share a policy
    """

    def __init__(self, env_id: str, n_envs: int, env_kwargs: dict[str, Any]):
        if env_kwargs.get("state"):
            raise ValueError("state:True is for critics of MADDPG and MATD3: a shared policy sees its own agent only.")
        self.spec = copy.deepcopy(gymnasium.spec(env_id))
        self.spec.kwargs.update(env_kwargs)
        env = parallel.make_parallel_env(**{key: one for key, one in self.spec.kwargs.items() if key != "state"})
        self.agents = _homogeneous_agents(env_id, env)
        with warnings.catch_warnings():  # it looks for a Gymnasium environment
            warnings.filterwarnings("ignore", module="supersuit")
            self.envs = concat_vec_envs_v1(pettingzoo_env_to_vec_env_v1(EveryAgent(env)), n_envs)
        env.close()  # the copies go on
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
        :param actions: of all agents, (n_envs * n_agents, ...); algorithms for Box also act in MultiBinary spaces by
            floats, and SuperSuit takes none
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
        :param mode: unused: PettingZoo's environments are told when they are made
        :return: what the first copy renders
        """
        return self.envs.render()

    def close(self) -> None:
        """Close the environments."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        :param attr_name: name
        :param indices: of agents
        :return: the attribute of the environment that each agent is in
        """
        if attr_name == "spec":
            return [self.spec for _ in self._get_indices(indices)]
        return [getattr(self._env_of(k), attr_name) for k in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """
        :param attr_name: name
        :param value: for each of the environments
        :param indices: of agents
        """
        for env in self._distinct(indices):
            setattr(env, attr_name, value)

    def env_method(self, method_name: str, *method_args, indices: VecEnvIndices = None, **method_kwargs) -> list[Any]:
        """
        :param method_name: called once in each environment
        :param method_args: for the method
        :param indices: of agents
        :param method_kwargs: for the method
        :return: what each environment returns
        """
        return [getattr(env, method_name)(*method_args, **method_kwargs) for env in self._distinct(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        """Never: they are no environments of Gymnasium."""
        return [False for _ in self._get_indices(indices)]

    def _env_of(self, agent: int) -> Any:
        return self.envs.vec_envs[agent // len(self.agents)].par_env

    def _distinct(self, indices: VecEnvIndices) -> list[Any]:
        return [self._env_of(k) for k in sorted({k - k % len(self.agents) for k in self._get_indices(indices)})]


def _homogeneous_agents(env_id: str, env: ParallelEnv) -> Sequence[Any]:
    """The agents, which have to have equal spaces."""
    agents = env.possible_agents
    for kind, space_of, wrapper in (
        ("observation", env.observation_space, "pad_observations_v0"),
        ("action", env.action_space, "pad_action_space_v0"),
    ):
        first = space_of(agents[0])
        for agent in agents:
            if space_of(agent) != first:
                raise ValueError(
                    f"{env_id} has heterogeneous agents: the {kind} space of {agents[0]} is {first}, that of {agent} "
                    f"{space_of(agent)}. One policy with shared parameters needs equal ones: add supersuit.{wrapper} "
                    "to `wrappers` of env_kwargs, or train with --algo maddpg or matd3."
                )
    return agents


class EveryAgent(BaseParallelWrapper):
    """
    Shows agents that ended before the others zeros, and rewards them with nothing, until the episode ends. SuperSuit's
    ``black_death_v3`` should do so, but in version 3.11 an episode goes on until all agents terminate and are truncated
    in the same step.

    :param env: the environment
    """

    def __init__(self, env: ParallelEnv):
        super().__init__(env)
        self.agents = self.possible_agents

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        """
        :param seed: for the environment
        :param options: for the environment
        :return: observations and infos of all agents
        """
        observations, infos = self.env.reset(seed=seed, options=options)
        return self._fill(observations), {agent: infos.get(agent, {}) for agent in self.agents}

    def step(self, actions: dict) -> tuple[dict, dict, dict, dict, dict]:
        """
        :param actions: of all agents
        :return: observations, rewards, terminations, truncations and infos of all agents; all end together
        """
        given = {agent: actions[agent] for agent in self.env.agents}
        observations, rewards, terminations, truncations, infos = self.env.step(given)
        over = not self.env.agents
        # Some environments go on telling of agents that have left
        truncated = {agent: over and agent in given and bool(truncations[agent]) for agent in self.agents}
        terminated = {agent: over and (not truncated[agent] or bool(terminations[agent])) for agent in self.agents}
        return (
            self._fill({agent: observations[agent] for agent in given if agent in observations}),
            {agent: rewards[agent] if agent in given else 0.0 for agent in self.agents},
            terminated,
            truncated,
            {agent: infos.get(agent, {}) for agent in self.agents},
        )

    def _fill(self, observations: dict) -> dict:
        for agent in self.agents:
            if agent not in observations:
                space = self.observation_space(agent)
                observations = {**observations, agent: next(iter(iterate(space, create_empty_array(space))))}
        return observations


class SharedPolicy:
    """
    A model of ``AgentsVecEnv`` as the policy of a whole team (``TeamEnv``): of observations (n_envs, n_agents, columns)
    it makes joint actions, (n_envs, n_actions). For rl_zoo3's ``enjoy`` and ``record``, and for ``evaluate_policy``.

    :param model: the trained model
    """

    def __init__(self, model: BaseAlgorithm):
        self.model = model

    @classmethod
    def loader(cls, load: Callable[..., BaseAlgorithm]) -> type:
        """
        :param load: of the algorithm
        :return: a stand-in for the algorithm whose ``load`` returns a ``SharedPolicy``
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
        :param observation: of the team, (n_envs, n_agents, columns)
        :param state: unused
        :param episode_start: unused
        :param deterministic: choose the most probable actions
        :return: joint actions, (n_envs, n_actions), and no state
        """
        space = self.model.observation_space
        n_envs, n_agents = observation.shape[:2]
        if isinstance(space, spaces.Box):  # other spaces were flattened into their rows
            observation = observation[..., : int(np.prod(space.shape))].reshape(-1, *space.shape)
        actions, _ = self.model.predict(observation, deterministic=deterministic)
        return np.asarray(actions).reshape(n_envs, n_agents, -1).reshape(n_envs, -1), None
