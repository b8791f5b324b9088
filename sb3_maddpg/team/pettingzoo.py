"""Wrappers that turn PettingZoo environments into team environments."""

from __future__ import annotations

import importlib
import inspect
import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.spaces.utils import flatdim, flatten_space
from pettingzoo import AECEnv, ParallelEnv
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv

from sb3_maddpg.errors import InvalidEnvironmentError
from sb3_maddpg.team.agents import agent_actions, fits, flat
from sb3_maddpg.team.spaces import TeamObservation, check_action_space, heads_of, joint_action_space
from sb3_maddpg.team.team import Team
from sb3_maddpg.utils import as_flag, as_number, as_seed, not_finite_at, shown, told

ENTRY_POINT = f"{__name__}:make"
MASK = "action_mask"
_ADDRESS = re.compile(" at 0x[0-9a-fA-F]+")
_LARGEST_REWARD = float(np.finfo(np.float32).max)
_BLACK_DEATH = (
    "The wrapper {} keeps dead agents in the episode, which then hardly ever ends (in SuperSuit 3.11 only if all "
    "agents are both terminated and truncated in the same step). Remove this wrapper: TeamEnv handles agents that end "
    "before the others."
)


class TeamEnv(gymnasium.Env):
    """
    Wrapper that turns a PettingZoo environment into a single environment for the whole team, see "The team convention"
    in CONTRIBUTING.md.

    The observation space, ``TeamObservation``, has a row per possible agent with its observation, flattened as by
    Gymnasium's ``flatten``. The action space is that of ``joint_action_space``. The reward is the mean over all
    possible agents, where inactive agents count as 0, so the return is the mean of the agents' returns. When an agent
    is terminated or truncated, its row holds its final observation once. From then on the row is zero, and the agent
    acts no more. The episode ends with the last agent. It is truncated if that agent, or another that ended in the same
    step, was truncated but not terminated.

    If an agent observes a dict with an entry ``action_mask``, as in PettingZoo's environments with illegal moves, it
    chooses only legal actions, both during exploration and in the targets and gradients of training.

    MADDPG wraps PettingZoo environments in a ``TeamEnv`` automatically. Functions of Stable-Baselines3 need the
    wrapper: ``evaluate_policy(model, Monitor(TeamEnv(env)))``, and likewise ``EvalCallback``.

    If all agents observe images of the same size, the attribute ``image_space`` is the space of one image, which
    ``CnnPolicy`` reads. If an agent observes an image, also as a part of a ``Dict``, the attribute ``image_columns``
    lists first and end of the images' columns for each agent and for the state, by which ``MlpPolicy`` divides images
    by 255.

    Other attributes of the environment, such as ``observation_layout`` or a curriculum, are available through
    Gymnasium's ``get_wrapper_attr``, and thus through ``get_attr`` and ``env_method`` of SB3's vectorised environments.

    Everything that the environment returns is checked in each step. Errors name the agent, the step and the value.

    Entries of ``info``, see ``TeamInfo``; the first four are arrays with one entry per agent:

    - ``agent_rewards``: rewards, float32
    - ``agent_terminated``, ``agent_truncated``: whether the agent was terminated or truncated in this step
    - ``agent_active``: whether the agent acted in this step
    - ``agent_infos``: the environment's infos by agent name, left out if they are all empty
    - ``metrics``: the means of the numbers in the agents' ``infos[agent]["metrics"]``, and at the end of an episode
      ``rollout/ep_rew_NAME`` of each agent that took part (``rollout/ep_rew_agent_mean`` of an agent called "mean",
      since ``rollout/ep_rew_mean`` is the team's) and, where agents end before others, ``rollout/ep_len_NAME``
    - ``is_success``: whether all agents succeeded whose infos have said so in this episode, each as it said last

    If a wrapper such as ``TimeLimit`` ended the last episode, its returns and lengths are in the next info of ``reset``
    as ``last_metrics``, from which MADDPG logs them.

    Rewards of agents that have already ended are ignored with a warning, as are action masks in infos without
    ``info_mask``.

    :param env: the environment, parallel or turn-based
    :param state: append ``env.state()`` to the observation, for the critics
    :param info_mask: read action masks from ``infos[agent]["action_mask"]``; agents without one, and those with
        continuous actions, may choose any action
    :raises ValueError: if the environment or one of its spaces is not supported, or the environment is wrapped in
        SuperSuit's ``black_death``, which changes what is learned
    """

    observation_space: TeamObservation

    def __init__(self, env: ParallelEnv | AECEnv, state: bool = False, info_mask: bool = False):
        if isinstance(env, AECEnv):
            env = TurnBased(env)
        agents = _possible_agents(env)
        _refuse_black_death(env)
        self._agents = agents
        self._rows = {agent: row for row, agent in enumerate(agents)}
        action_spaces = [_space_of(env, "action_space", agent) for agent in agents]
        for agent, space in zip(agents, action_spaces, strict=True):
            check_action_space(agent, space)
        self._observation_spaces = [_space_of(env, "observation_space", agent) for agent in agents]
        self._info_mask = info_mask
        if info_mask:
            if all(isinstance(space, spaces.Box) for space in action_spaces):
                raise InvalidEnvironmentError(
                    f"info_mask=True, but the actions of all agents of {env} ({', '.join(map(str, agents))}) are "
                    "continuous and cannot be masked: leave info_mask out."
                )
            self._observation_spaces = [
                seen if isinstance(space, spaces.Box) else _masked_space(seen, space)
                for seen, space in zip(self._observation_spaces, action_spaces, strict=True)
            ]
        if (images := _image_space(self._observation_spaces)) is not None:
            self.image_space = images
        self._box_shapes = [one.shape if isinstance(one, spaces.Box) else None for one in self._observation_spaces]
        self.parallel_env = env
        self.metadata = {"render_modes": [], **_metadata_of(env)}
        self.render_mode = getattr(env, "render_mode", None)
        self.agent_names = _names_of(agents)
        self.observation_space = TeamObservation(
            {
                name: _flat_space(space, f"agent {name!r} observes")
                for name, space in zip(self.agent_names, self._observation_spaces, strict=True)
            },
            _state_space(env) if state else None,
            {name: _mask_columns(s) for name, s in zip(self.agent_names, self._observation_spaces, strict=True)},
            self._observation_spaces,
        )
        self.action_space = joint_action_space(action_spaces)
        self._state_space: Any = env.state_space if state else None
        image_columns = [*map(_image_columns, (*self._observation_spaces, self._state_space))]
        if any(image_columns):
            self.image_columns = image_columns
        self._metric_names = _names_of_returns(self.agent_names)
        self._lay_out(action_spaces)
        self._live: list[int] = []
        self._steps = 0
        self._taking_part: list[int] = []
        self._returns = [0.0] * len(agents)
        # Of agents that have ended in this episode, and whether they succeeded as far as they said
        self._lengths: dict[int, int] = {}
        self._successes: dict[Any, bool] = {}
        self._unequal = False
        self._warned: set[str] = set()

    def set_wrapper_attr(self, name: str, value: Any, *, force: bool = True) -> bool:
        """
        Set an attribute where ``get_wrapper_attr`` finds it.

        :param name: name of the attribute
        :param value: new value
        :param force: whether to set it here if it does not exist
        :return: whether it was set
        """
        layers = layers_of(self.parallel_env) if not hasattr(self, name) else ()
        owner = next((one for one in layers if name in vars(one) or hasattr(type(one), name)), None)
        if owner is None and not (force or hasattr(self, name)):
            return False
        setattr(self if owner is None else owner, name, value)
        return True

    def has_wrapper_attr(self, name: str) -> bool:
        """:return: whether this wrapper or the PettingZoo environment has the attribute"""
        return hasattr(self, name) or hasattr(self.parallel_env, name)

    def get_wrapper_attr(self, name: str) -> Any:
        """:return: the attribute of this wrapper, or else of the PettingZoo environment"""
        return getattr(self if hasattr(self, name) else self.parallel_env, name)

    @property
    def team_spaces(self) -> tuple[TeamObservation, Any]:
        """The spaces of observation and joint action, also behind wrappers and in other processes."""
        return self.observation_space, self.action_space

    def _lay_out(self, action_spaces: Sequence[Any]) -> None:
        self._actions = agent_actions(action_spaces)
        length = self._actions[-1].end
        # Continuous actions are clipped to the first two bounds, all actions must lie within the last two
        self._low = np.full(length, -np.inf, np.float32)
        self._high = np.full(length, np.inf, np.float32)
        self._least = np.full(length, np.finfo(np.float32).min)
        self._most = -self._least
        for begin, end, space, *_ in self._actions:
            if isinstance(space, spaces.Box):
                self._low[begin:end], self._high[begin:end] = space.low.ravel(), space.high.ravel()
            else:
                self._least[begin:end], self._most[begin:end] = 0, np.array(heads_of(space)) - 1
        self._clip = any(isinstance(space, spaces.Box) for space in action_spaces)
        whole = np.concatenate([np.full(len(heads_of(one)), not isinstance(one, spaces.Box)) for one in action_spaces])
        self._whole = whole if whole.any() else None  # bits and categories

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """
        :param seed: seed of the environment, a non-negative integer
        :param options: options of the environment
        :return: observation, (n_agents, columns), and info
        :raises ValueError: if the seed is invalid, or the environment returns something invalid
        """
        seed = as_seed(seed)
        super().reset(seed=seed)
        # A wrapper such as TimeLimit may have ended the episode, unknown to the environment
        last = self._metrics_of_episode() if self._live and self._steps else {}
        self._live, self._steps = [], 0
        with explained_reset(self.parallel_env):
            returned = self.parallel_env.reset(seed=seed, options=options)
        observations, infos = self._parts("reset", returned)
        present = self._present()
        if unknown := present - self._rows.keys():
            raise InvalidEnvironmentError(self._unknown(unknown))
        self._live = [row for row, agent in enumerate(self._agents) if agent in present]
        if not self._live:
            raise InvalidEnvironmentError(
                f"After reset(), `agents` of {self.parallel_env} is empty: it must list the active agents."
            )
        self._taking_part = self._live
        self._returns = [0.0] * len(self._agents)
        self._lengths, self._successes = {}, {}
        info = _agent_infos(infos)
        if last:
            info["last_metrics"] = last
        if len(self._live) < len(self._agents):
            info["agent_active"] = np.isin(np.arange(len(self._agents)), self._live)
        return self._observe(self._with_masks(observations, infos), self._live), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        :param action: flat joint action
        :return: observation, (n_agents, columns), mean reward, terminated, truncated, and info
        :raises ValueError: if the action is outside its space, or the environment returns something invalid
        """
        acted = self._live
        if not acted:
            raise gymnasium.error.ResetNeeded("The episode has ended or has not begun: call reset().")
        actions = self._decode(action)
        self._steps += 1
        observations, agent_rewards, terminations, truncations, infos = self._parts(
            "step", self.parallel_env.step(actions)
        )
        agents, n_agents = self._agents, len(self._agents)
        rewards, active = [0.0] * n_agents, [False] * n_agents
        terminated, truncated = [False] * n_agents, [False] * n_agents
        left = self._present()
        seen, live, finite = [], [], True
        for row in acted:
            agent = agents[row]
            try:
                reward, ends, cut = agent_rewards[agent], terminations[agent], truncations[agent]
            except KeyError:
                raise InvalidEnvironmentError(
                    f"step() of {self.parallel_env} left out reward, termination or truncation of agent {agent!r} "
                    f"{self._when}: it must return them for every agent that acted."
                ) from None
            if type(reward) is not float:
                reward = self._number(agent, reward)
            if type(ends) is not bool or type(cut) is not bool:
                ends, cut = self._flag(agent, "termination", ends), self._flag(agent, "truncation", cut)
            rewards[row] = reward
            finite = finite and -_LARGEST_REWARD <= reward <= _LARGEST_REWARD
            active[row], terminated[row], truncated[row] = True, ends, cut
            self._returns[row] += reward
            if not (ends or cut):
                live.append(row)
            # Some environments leave out the final observation of a terminated agent, which training does not need
            if not ends or cut or agent in observations:
                seen.append(row)
        self._warn_of_lost_rewards(agent_rewards, acted)
        if len(left) != len(live) or not all(agents[row] in left for row in live):
            self._check_left(left, live, acted, terminations, truncations)
        if not finite:
            self._refuse_rewards(rewards)
        self._live = live
        info = _agent_infos(infos)
        self._read_agents_infos(infos, info)
        info["agent_rewards"] = np.array(rewards, np.float32)
        info["agent_terminated"] = np.array(terminated)
        info["agent_truncated"] = np.array(truncated)
        info["agent_active"] = np.array(active)
        over = not live
        cut = over and any(truncated[row] and not terminated[row] for row in acted)
        self._lengths |= dict.fromkeys(set(acted).difference(live), self._steps)
        if self._successes:
            info["is_success"] = all(self._successes.values())
        if over:
            info["metrics"] = {**info.get("metrics", {}), **self._metrics_of_episode()}
        reward = info["team_reward"] = sum(rewards) / n_agents
        info["episode_step"] = self._steps
        return self._observe(self._with_masks(observations, infos), seen), reward, over and not cut, cut, info

    def _read_agents_infos(self, infos: Mapping[Any, Any], info: dict[str, Any]) -> None:
        """Keep whether agents have succeeded so far, and add the means of their metrics to the team's info."""
        if not info:  # no agent has one
            return
        metrics: dict[str, list[float]] = {}
        for agent, one in infos.items():
            if not one or agent not in self._rows:
                continue
            if one.get("is_success") is not None:
                self._successes[agent] = self._flag(agent, "is_success", one["is_success"])
            own = one.get("metrics")
            if own is None:
                continue
            if not isinstance(own, Mapping):
                raise InvalidEnvironmentError(
                    f"infos[{agent!r}]['metrics'] of {self.parallel_env} is {shown(own)} {self._when}: it must be a "
                    "dict of numbers by name."
                )
            for name, value in own.items():
                number = math.nan
                with suppress(TypeError, ValueError, OverflowError):
                    number = float(value)
                if not math.isfinite(number):
                    raise InvalidEnvironmentError(
                        f"infos[{agent!r}]['metrics'][{name!r}] of {self.parallel_env} is {shown(value)} {self._when}: "
                        "a metric must be a finite number."
                    )
                metrics.setdefault(str(name), []).append(number)
        if metrics:
            info["metrics"] = {name: sum(values) / len(values) for name, values in metrics.items()}

    def _metrics_of_episode(self) -> dict[str, float]:
        """:return: returns of the agents that took part and, where agents end before others, how long they lived"""
        metrics = {self._metric_names[row]: self._returns[row] for row in self._taking_part}
        lengths = {row: self._lengths.get(row, self._steps) for row in self._taking_part}
        # Lengths tell something only where agents end before others, and then in every episode
        self._unequal = self._unequal or len(set(lengths.values())) > 1
        if self._unequal:
            names = {row: self._metric_names[row].replace("ep_rew_", "ep_len_", 1) for row in lengths}
            metrics |= {names[row]: float(length) for row, length in lengths.items()}
        return metrics

    def render(self) -> Any:
        """Render the environment."""
        return self.parallel_env.render()

    def close(self) -> None:
        """Close the environment."""
        self.parallel_env.close()

    @property
    def _when(self) -> str:
        return f"in step {self._steps} of the episode" if self._steps else "after reset()"

    def _parts(self, method: str, returned: Any) -> Sequence[Mapping[Any, Any]]:
        """:return: the dicts that the environment returned, after checks; ``infos`` is empty if it was None"""
        names = ["observations", "infos"]
        if method == "step":
            names = ["observations", "rewards", "terminations", "truncations", "infos"]
        if not isinstance(returned, (tuple, list)) or len(returned) != len(names):
            raise InvalidEnvironmentError(
                f"{method}() of {self.parallel_env} returned {shown(returned)}: it must return ({', '.join(names)})."
            )
        for name, part in zip(names, returned, strict=True):
            if type(part) is not dict and not isinstance(part, Mapping) and not (part is None and name == "infos"):
                raise InvalidEnvironmentError(
                    f"{method}() of {self.parallel_env} returned {shown(part)} as {name} {self._when}: it must return "
                    "a dict with an entry for each agent."
                )
        *others, infos = returned
        for agent, info in (infos or {}).items():
            if type(info) is not dict and info is not None and not isinstance(info, Mapping):
                raise InvalidEnvironmentError(
                    f"{method}() of {self.parallel_env} returned {shown(info)} as info of agent {agent!r} "
                    f"{self._when}: it must be a dict."
                )
        return *others, infos or {}

    def _present(self) -> set[Any]:
        agents = getattr(self.parallel_env, "agents", None)
        try:
            return set(agents)  # type: ignore[arg-type]
        except TypeError:
            raise InvalidEnvironmentError(
                f"`agents` of {self.parallel_env} is {shown(agents)} {self._when}: it must be the list of active "
                "agents."
            ) from None

    def _number(self, agent: Any, reward: Any) -> float:
        try:
            return as_number(reward)
        except ValueError:
            raise InvalidEnvironmentError(
                f"{self.parallel_env} returned a reward of {shown(reward)} for agent {agent!r} {self._when}: a reward "
                "must be a number."
            ) from None

    def _flag(self, agent: Any, name: str, value: Any) -> bool:
        try:
            return as_flag(value)
        except ValueError:
            raise InvalidEnvironmentError(
                f"{self.parallel_env} returned {shown(value)} as {name} of agent {agent!r} {self._when}: it must be "
                "True or False."
            ) from None

    def _decode(self, action: Any) -> dict[Any, Any]:
        """:return: the actions of the live agents, each in its own space"""
        values = np.asarray(action)
        if values.shape != self.action_space.shape:
            what = f"is {shown(action)}, not an array of shape"
            if isinstance(action, np.ndarray) and action.dtype != object:
                what = f"has shape {values.shape}, not"
            raise InvalidEnvironmentError(
                f"The joint action {what} {self.action_space.shape}: it must be flat, agent after agent "
                f"({', '.join(self.agent_names)})."
            )
        if values.dtype.kind not in "biuf" or not self._inside(values).all():
            self._refuse_action(values)
        if self._clip:
            values = np.minimum(np.maximum(values, self._low), self._high, dtype=np.float32)
        return {self._agents[row]: self._actions[row].of(values) for row in self._live}

    def _inside(self, values: np.ndarray) -> np.ndarray:
        """:return: which numbers are finite and, unless they will be clipped, in their space, (length,)"""
        inside = (values >= self._least) & (values <= self._most)
        if self._whole is not None and values.dtype.kind == "f":
            inside &= ~self._whole | (values == np.rint(values))
        return inside

    def _refuse_action(self, values: np.ndarray) -> None:
        for agent, (begin, end, space, *_) in zip(self.agent_names, self._actions, strict=True):
            if values.dtype.kind not in "biuf" or not self._inside(values)[begin:end].all():
                raise InvalidEnvironmentError(
                    f"The action of agent {agent!r} is {values[begin:end].tolist()} in step {self._steps + 1} of the "
                    f"episode, but its space is {shown(space)}: pass finite numbers, binary actions as 0 or 1, and "
                    "categories counting from 0."
                )

    def _observe(self, observations: Mapping[Any, Any], rows: list[int]) -> np.ndarray:
        """:return: the team's observation, (n_agents, columns), in which all but the given rows are zero"""
        team = self.observation_space
        matrix = np.zeros(team.shape, np.float32)
        for row in rows:
            agent, space, length = self._agents[row], self._observation_spaces[row], team.obs_dims[row]
            if agent not in observations:
                raise InvalidEnvironmentError(
                    f"{self.parallel_env} returned no observation for agent {agent!r}, which is active or was just "
                    f"truncated, {self._when}: reset() and step() must return one."
                )
            observation = observations[agent]
            is_array = type(observation) is np.ndarray and observation.dtype.kind in "fiub"
            if is_array and observation.shape == self._box_shapes[row]:
                matrix[row, :length] = observation.ravel()
                continue
            try:
                fitting = fits(space, observation)
                if fitting:
                    matrix[row, :length] = flat(space, observation)
            except (TypeError, ValueError, LookupError, OverflowError):
                fitting = False
            if not fitting:
                shape = getattr(observation, "shape", None)
                what = f"is {shown(observation)}" if shape in (None, space.shape) else f"has shape {shape}"
                raise InvalidEnvironmentError(
                    f"The observation of agent {agent!r} {what}, but its space is {shown(space)} ({self._when} of "
                    f"{self.parallel_env})."
                )
        if self._state_space is not None:
            columns = matrix.shape[1] - team.obs_dim
            state = np.zeros(len(matrix) * columns, np.float32)
            state[: team.state_dim] = self._state(team.state_dim)
            matrix[:, team.obs_dim :] = state.reshape(len(matrix), columns)
        if (index := not_finite_at(matrix)) is not None:
            row, column = index
            whose = f"The observation of agent {self._agents[row]!r}" if column < team.obs_dim else "The state"
            raise InvalidEnvironmentError(
                f"{whose} is {matrix[row, column]} in column {column} {self._when} of {self.parallel_env}: it must be "
                "finite. Clip it, or end the episode before a simulation diverges."
            )
        return matrix

    def _with_masks(self, observations: Mapping[Any, Any], infos: Mapping[Any, Any]) -> Mapping[Any, Any]:
        """:return: observations with the action masks in infos, if ``info_mask`` is set"""
        if infos and self._steps < 2:
            self._warn_of_ignored_masks(infos)
        if not self._info_mask:
            return observations
        masked = {}
        for agent, observation in observations.items():
            if agent not in self._rows or not self.observation_space.masks[self._rows[agent]]:
                masked[agent] = observation
                continue
            mask = (infos.get(agent) or {}).get(MASK)
            if mask is None:
                space: Any = self._observation_spaces[self._rows[agent]]
                mask = np.ones(space[MASK].shape, np.int8)
            masked[agent] = {MASK: mask, "observation": observation}
        return masked

    def _warn_of_ignored_masks(self, infos: Mapping[Any, Any]) -> None:
        for agent, info in infos.items():
            if info and MASK in info and agent in self._rows and not self.observation_space.masks[self._rows[agent]]:
                remedy = "pass TeamEnv(env, info_mask=True) to read action masks from infos"
                if isinstance(self._actions[self._rows[agent]].space, spaces.Box):
                    remedy = "its actions are continuous and cannot be masked"
                self._warn_once("masks", f"infos[{agent!r}]['{MASK}'] of {self.parallel_env} is ignored: {remedy}.")

    def _warn_of_lost_rewards(self, rewards: Mapping[Any, Any], acted: list[int]) -> None:
        if len(rewards) <= len(acted) or "rewards" in self._warned:
            return
        if strange := [agent for agent in rewards if agent not in self._rows]:
            self._warn_once(
                "rewards",
                f"{self.parallel_env} returned a reward for {strange[0]!r} {self._when}, which is not in "
                "possible_agents: it is ignored.",
            )
        for row, agent in enumerate(self._agents):
            reward: Any = 0.0
            with suppress(ValueError):
                reward = self._number(agent, rewards.get(agent, 0.0))
            if reward and row not in acted:
                self._warn_once(
                    "rewards",
                    f"{self.parallel_env} returned a reward of {reward} for agent {agent!r} {self._when}, which takes "
                    "part no more: such rewards are ignored. Return them in the step in which the agent ends, or let "
                    "it end later.",
                )

    def _warn_once(self, kind: str, message: str) -> None:
        if kind not in self._warned:
            self._warned.add(kind)
            warnings.warn(message, stacklevel=4)

    def _state(self, size: int) -> np.ndarray:
        try:
            state = flat(self._state_space, self.parallel_env.state())
        except NotImplementedError as error:
            raise InvalidEnvironmentError(
                f"{self.parallel_env} has a state_space but no state(): set state=False."
            ) from error
        except (TypeError, ValueError, LookupError, OverflowError) as error:
            raise InvalidEnvironmentError(
                f"state() of {self.parallel_env} does not fit its state_space: {error}."
            ) from error
        if state.size != size:
            raise InvalidEnvironmentError(
                f"state() of {self.parallel_env} has {state.size} numbers, but its state_space has {size}."
            )
        return state

    def _check_left(
        self,
        left: set[Any],
        live: list[int],
        acted: list[int],
        terminations: Mapping[Any, bool],
        truncations: Mapping[Any, bool],
    ) -> None:
        """Check that ``agents`` of the environment agrees with the terminations and truncations it returned."""
        if unknown := left - self._rows.keys():
            raise InvalidEnvironmentError(self._unknown(unknown))
        for row in live:
            if (agent := self._agents[row]) not in left:
                raise InvalidEnvironmentError(
                    f"Agent {agent!r} left {self.parallel_env} without termination or truncation{self._by_wrappers()}: "
                    "set one of them in the step that removes the agent from `agents`."
                )
        for agent in left - {self._agents[row] for row in acted}:
            # An environment may keep an agent in `agents` as long as it reports it as terminated or truncated
            if not (terminations.get(agent) or truncations.get(agent)):
                how = "returned" if self._rows[agent] in self._taking_part else "joined"
                raise InvalidEnvironmentError(
                    f"Agent {agent!r} {how} in the middle of an episode: only agents that {self.parallel_env} lists "
                    "after reset() may take part, until they are terminated or truncated."
                )

    def _by_wrappers(self) -> str:
        """:return: the wrappers that may be to blame, for error messages"""
        wrappers = [type(layer).__name__ for layer in layers_of(self.parallel_env)][:-1]
        return f", or one of its wrappers ({', '.join(wrappers)}) took them away" if wrappers else ""

    def _unknown(self, agents: Iterable[Any]) -> str:
        names = ", ".join(sorted(map(repr, agents)))
        return (
            f"{names} in `agents` of {self.parallel_env}, but possible_agents has only {', '.join(self.agent_names)}: "
            "it must name every agent that can ever take part."
        )

    def _refuse_rewards(self, rewards: list[float]) -> None:
        wrong = ", ".join(
            f"{reward} for agent {name!r}"
            for name, reward in zip(self.agent_names, rewards, strict=True)
            if not -_LARGEST_REWARD <= reward <= _LARGEST_REWARD
        )
        raise InvalidEnvironmentError(
            f"{self.parallel_env} returned a reward of {wrong} {self._when}: rewards must be finite, also in single "
            "precision."
        )


class TurnBased(ParallelEnv):
    """
    Wrapper that turns a turn-based PettingZoo environment (``AECEnv``) into a parallel one. One agent moves in each
    step. The other agents also observe the board, but their action masks allow only the first action, which is ignored.
    Their actors learn nothing from it, while their critics learn from every step.

    ``TeamEnv`` applies this wrapper to an ``AECEnv`` automatically.

    :param env: an environment with ``Discrete`` actions
    :raises ValueError: if actions are not ``Discrete``, or the environment is parallelizable
    """

    metadata: dict[str, Any]

    def __init__(self, env: AECEnv):
        self.metadata = dict(_metadata_of(env))
        if self.metadata.get("is_parallelizable"):
            raise InvalidEnvironmentError(
                f"{env} is parallelizable, so its agents need not take turns: use its parallel_env, or "
                "pettingzoo.utils.conversions.aec_to_parallel(env)."
            )
        self.env = env
        self.render_mode = getattr(env, "render_mode", None)
        self.possible_agents = list(getattr(env, "possible_agents", None) or ())
        self.agents: list[Any] = []
        self._action_spaces: dict[Any, Any] = {
            agent: _space_of(env, "action_space", agent) for agent in self.possible_agents
        }
        self._observation_spaces = {}
        for agent, space in self._action_spaces.items():
            if not isinstance(space, spaces.Discrete):
                raise InvalidEnvironmentError(
                    f"Agent {agent!r} of {env}, a turn-based environment, has the action space {shown(space)}: it "
                    "must be Discrete, because masks leave one action to agents that wait for their turn."
                )
            seen = _space_of(env, "observation_space", agent)
            masked = isinstance(seen, spaces.Dict) and MASK in seen.spaces
            if not masked and _mask_columns(seen):
                raise InvalidEnvironmentError(
                    f"Agent {agent!r} of {env} observes {seen}: the action mask of a turn-based environment must be an "
                    f"entry {MASK!r} of the outermost Dict."
                )
            self._observation_spaces[agent] = seen if masked else _masked_space(seen, space)
        if getattr(env, "state_space", None) is not None:
            self.state_space = env.state_space

    def observation_space(self, agent: Any) -> spaces.Space:
        """:return: the observation space of an agent, a dict with its action mask"""
        return self._observation_spaces[agent]

    def action_space(self, agent: Any) -> spaces.Space:
        """:return: the action space of an agent"""
        return self._action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        """:return: observations and infos by agent"""
        self.env.reset(seed=seed, options=options)
        self._remove_ended()
        self.agents = list(self.env.agents)
        return self._observe(), {agent: dict(self.env.infos.get(agent) or {}) for agent in self.agents}

    def step(self, actions: dict[Any, Any]) -> tuple[dict, dict, dict, dict, dict]:
        """
        :param actions: actions by agent; all but that of the agent whose turn it is are ignored
        :return: observations, rewards, terminations, truncations and infos by agent
        """
        env, agents = self.env, self.agents
        env.step(actions[env.agent_selection])
        rewards = {agent: env.rewards.get(agent, 0.0) for agent in agents}
        ended = {agent: bool(env.terminations.get(agent, True)) for agent in agents}
        cut = {agent: bool(env.truncations.get(agent, False)) for agent in agents}
        infos = {agent: dict(env.infos.get(agent) or {}) for agent in agents}
        observations = self._observe()
        self._remove_ended()
        self.agents = [agent for agent in agents if not (ended[agent] or cut[agent])]
        return observations, rewards, ended, cut, infos

    def _remove_ended(self) -> None:
        """Remove agents that have ended, up to the next agent that can move."""
        env = self.env
        while env.agents:
            if (mover := env.agent_selection) not in env.agents:
                raise InvalidEnvironmentError(
                    f"agent_selection of {env} is {mover!r}, but its agents are {env.agents}: it must name the agent "
                    "whose turn it is."
                )
            if not (env.terminations[mover] or env.truncations[mover]):
                return
            env.step(None)  # PettingZoo's way to remove an agent that has ended

    def _observe(self) -> dict[Any, Any]:
        observations = {}
        for agent in self.agents:
            seen = self.env.observe(agent)
            if not isinstance(seen, Mapping) or MASK not in seen:
                mask = (self.env.infos.get(agent) or {}).get(MASK)
                seen = {
                    MASK: np.ones(int(self._action_spaces[agent].n), np.int8) if mask is None else mask,
                    "observation": seen,
                }
            if agent != self.env.agent_selection:
                only_first = np.zeros_like(seen[MASK])
                only_first[0] = 1
                seen = {**seen, MASK: only_first}
            observations[agent] = seen
        return observations

    def state(self) -> np.ndarray:
        """The global state."""
        return self.env.state()

    def render(self) -> Any:
        """Render the environment."""
        return self.env.render()

    def close(self) -> None:
        """Close the environment."""
        self.env.close()


def _names_of_returns(names: Sequence[str]) -> list[str]:
    """:return: the names under which agents' returns are logged, other than that of the team's, ep_rew_mean"""
    renamed = "agent_mean"
    while renamed in names:
        renamed = f"agent_{renamed}"
    return [f"rollout/ep_rew_{renamed if name == 'mean' else name}" for name in names]


def _agent_infos(infos: Mapping[Any, Any]) -> dict[str, Any]:
    if not any(infos.values()):
        return {}
    return {"agent_infos": {str(agent): info for agent, info in infos.items() if info}}


def what_to_pass(env: Any, taker: str) -> str:
    """
    :param env: something else than the environment that was expected
    :param taker: the class or function that it was passed to
    :return: what to pass instead, for error messages
    """
    if isinstance(env, gymnasium.Env):
        return f"pass a Gymnasium environment of a team itself, without {taker}"
    if isinstance(env, VecEnv):
        return (
            f"pass one of its environments to {taker}; vectorise after that, as in DummyVecEnv([lambda: TeamEnv(env)])"
        )
    if isinstance(env, gymnasium.vector.VectorEnv):
        try:
            Team.from_spaces(env.single_observation_space, env.single_action_space)
        except (ValueError, AttributeError):
            return "it steps single agents, of which no team is left: pass the PettingZoo environment that was wrapped"
        return "the algorithms take sb3_maddpg.vec_env.GymnasiumVecEnv(env)"
    if isinstance(env, str):
        return "pass the environment itself: what gymnasium.make or a module's parallel_env() returns"
    if isinstance(env, ModuleType):
        return f"pass what its function returns, {env.__name__.rpartition('.')[2]}.parallel_env()"
    if isinstance(env, (list, tuple)):
        return f"pass one environment to {taker}, or DummyVecEnv([make_one, make_another]) of functions to an algorithm"
    if callable(env) and not hasattr(env, "step"):
        return "pass the environment that it creates, by calling it"
    if isinstance(env, type):
        return f"pass an instance, {env.__name__}(...)"
    return (
        "pass an environment of PettingZoo (derived from ParallelEnv or AECEnv), or a Gymnasium environment of a team"
    )


def _possible_agents(env: Any) -> tuple[Any, ...]:
    if not isinstance(env, ParallelEnv):
        raise InvalidEnvironmentError(
            f"{shown(env)} is not an environment of PettingZoo: {what_to_pass(env, 'TeamEnv')}."
        )
    agents = getattr(env, "possible_agents", None) or ()
    agents = tuple(agents) if isinstance(agents, Iterable) else ()
    if not agents:
        raise InvalidEnvironmentError(
            f"{env} has no possible_agents: it must name every agent that can ever take part."
        )
    if len(set(map(str, agents))) < len(agents):
        raise InvalidEnvironmentError(f"possible_agents of {env} contains a name twice: {', '.join(map(str, agents))}.")
    return agents


def _names_of(agents: Sequence[Any]) -> tuple[str, ...]:
    """:return: the agents' names, their numbers if Python would name them by their addresses"""
    names = tuple(
        str(agent) if isinstance(agent, str) or not _ADDRESS.search(str(agent)) else f"agent_{index}"
        for index, agent in enumerate(agents)
    )
    if len(set(names)) < len(names):
        raise InvalidEnvironmentError(
            f"possible_agents, {shown(list(agents))}, have the same name twice: {', '.join(names)}."
        )
    return names


def _metadata_of(env: ParallelEnv | AECEnv) -> Mapping[str, Any]:
    metadata = getattr(env, "metadata", None) or {}
    if not isinstance(metadata, Mapping):
        raise InvalidEnvironmentError(
            f"metadata={shown(metadata)} of {type(env).__name__} must be a dict, or left out."
        )
    return metadata


def layers_of(env: Any) -> Iterator[Any]:
    """
    :param env: an environment of Gymnasium or PettingZoo
    :return: the environment and those that it wraps, outermost first
    """
    seen: list[Any] = []
    while hasattr(env, "reset") and not any(env is one for one in seen):
        yield env
        seen.append(env)
        attributes = getattr(env, "__dict__", {})  # unlike getattr, not those that a wrapper passes on
        env = next((attributes[name] for name in ("parallel_env", "env", "aec_env") if name in attributes), None)


@contextmanager
def explained_reset(env: Any) -> Iterator[None]:
    """
    Explain the error of an environment whose ``reset`` takes too few arguments.

    :param env: an environment of Gymnasium or PettingZoo that is reset
    :raises ValueError: instead of the TypeError
    """
    try:
        yield
    except TypeError as error:
        for inner in layers_of(env) if "unexpected keyword argument" in str(error) else ():
            if missing := [f"`{name}`" for name in ("seed", "options") if not _takes(inner.reset, name)]:
                raise InvalidEnvironmentError(
                    f"reset() of {inner} takes no {' and no '.join(missing)}: declare it as "
                    "`def reset(self, seed=None, options=None)`."
                ) from error
        raise


def _takes(method: Any, name: str) -> bool:
    """:return: whether a method takes a keyword argument, also if its signature is unknown"""
    try:
        parameters = inspect.signature(method).parameters
    except (TypeError, ValueError):
        return True
    kinds = (inspect.Parameter.KEYWORD_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return any(
        one.kind is inspect.Parameter.VAR_KEYWORD or (one.name == name and one.kind in kinds)
        for one in parameters.values()
    )


def _refuse_black_death(env: Any) -> None:
    """:raises ValueError: if SuperSuit's wrapper ``black_death`` is among the environment's wrappers"""
    if any(type(layer).__name__.startswith("black_death") for layer in layers_of(env)):
        raise InvalidEnvironmentError(_BLACK_DEATH.format("black_death"))


def _space_of(env: ParallelEnv, kind: str, agent: Any) -> Any:
    """
    :param env: the environment
    :param kind: "observation_space" or "action_space"
    :param agent: an agent of the environment
    :return: the agent's space
    :raises ValueError: if there is none
    """
    try:
        space = getattr(env, kind)(agent)
    except (LookupError, AttributeError, TypeError, NotImplementedError) as error:
        raise InvalidEnvironmentError(
            f"{kind}({agent!r}) of {env} failed ({type(error).__name__}: {error}): it must return a space for "
            "every agent in possible_agents."
        ) from error
    if not isinstance(space, spaces.Space):
        raise InvalidEnvironmentError(f"{kind}({agent!r}) of {env} is {shown(space)}: it must be a Gymnasium space.")
    return space


def _flat_space(space: spaces.Space, what: str) -> spaces.Box:
    flat: spaces.Space
    try:
        flat = flatten_space(space)
    except (NotImplementedError, ValueError):  # the space is empty or of an unknown type
        flat = space
    if not isinstance(flat, spaces.Box):
        raise InvalidEnvironmentError(
            f"The space that {what}, {shown(space)}, is empty or has no fixed length: it cannot become a row."
        )
    if not np.prod(flat.shape):
        raise InvalidEnvironmentError(
            f"The space that {what}, {shown(space)}, is empty: use Box(0, 1, (1,)) as a placeholder."
        )
    return flat


def _image_space(observations: Sequence[spaces.Space]) -> spaces.Box | None:
    """:return: the space of an agent's image, None if the agents' spaces differ or are not images"""
    first = observations[0]
    if isinstance(first, spaces.Box) and len(first.shape) in (2, 3) and all(space == first for space in observations):
        return first
    return None


def _image_columns(space: spaces.Space | None, first: int = 0) -> list[list[int]]:
    """:return: first and end of the columns of a flat observation that hold each image, as SB3 defines images"""
    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        parts, found = space.values() if isinstance(space, spaces.Dict) else space, []
        for part in parts:
            found += _image_columns(part, first)
            first += flatdim(part)
        return found
    return [[first, first + flatdim(space)]] if space is not None and is_image_space(space) else []


def _masked_space(observation: spaces.Space, action: Any) -> spaces.Dict:
    heads = heads_of(action)
    length = len(heads) if isinstance(action, spaces.MultiBinary) else sum(heads)
    return spaces.Dict({MASK: spaces.Box(0, 1, (length,), np.int8), "observation": observation})


def _mask_columns(space: spaces.Space) -> list[int]:
    """:return: the columns of a flat observation that hold the action mask, PettingZoo's dict entry of that name"""
    found = list(_masks_in(space))
    if len(found) > 1:
        raise InvalidEnvironmentError(
            f"The observation space {shown(space)} holds {len(found)} parts called {MASK!r}: rename all but one, or "
            "leave out info_mask if one of them comes from it."
        )
    return found[0] if found else []


def _masks_in(space: spaces.Space, begin: int = 0) -> Iterator[list[int]]:
    """:return: the columns of each action mask, at any depth"""
    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        for name, part in space.items() if isinstance(space, spaces.Dict) else enumerate(space):
            if name == MASK:
                yield list(range(begin, begin + flatdim(part)))
            else:
                yield from _masks_in(part, begin)
            begin += flatdim(part)


def _state_space(env: Any) -> spaces.Box:
    space = getattr(env, "state_space", None)
    if space is None:
        raise InvalidEnvironmentError(f"{env} has no state_space, which state=True needs: set state=False.")
    return _flat_space(space, f"the state of {env} has")


def make(
    entry: str,
    state: bool = False,
    wrappers: Iterable[str | Mapping[str, Any]] | None = None,
    info_mask: bool = False,
    **kwargs: Any,
) -> TeamEnv:
    """
    Create a team environment from a module with a function ``parallel_env``, such as PettingZoo's modules.

    :param entry: name of the module, e.g. "mpe2.simple_spread_v3"
    :param state: append the global state to the observation, for the critics
    :param wrappers: wrappers of the parallel environment, innermost first. Each is a dotted path, or a dict from the
        path to the wrapper's arguments, e.g.
        ``["supersuit.pad_observations_v0", {"supersuit.frame_stack_v2": {"stack_size": 2}}]``
    :param info_mask: see ``TeamEnv``
    :param kwargs: arguments of ``parallel_env``
    :return: the team environment
    """
    return TeamEnv(make_parallel_env(entry, wrappers, **kwargs), state=state, info_mask=info_mask)


def make_parallel_env(
    entry: str, wrappers: Iterable[str | Mapping[str, Any]] | None = None, **kwargs: Any
) -> ParallelEnv:
    """
    Create the parallel environment of a module and apply wrappers.

    :param entry: see ``make``
    :param wrappers: see ``make``
    :param kwargs: arguments of ``parallel_env``
    :return: the wrapped environment
    :raises ValueError: if there is no such module or wrapper, or the wrapper is ``black_death``, with which episodes
        hardly ever end
    """
    pairs = _wrappers(wrappers)
    for path, _ in pairs:
        if path.rpartition(".")[2].startswith("black_death"):
            raise InvalidEnvironmentError(_BLACK_DEATH.format(path))
    env = find_parallel_env(entry)(**kwargs)
    for path, arguments in pairs:
        env = _load(path)(env, **arguments)
    return env


def _wrappers(wrappers: Iterable[str | Mapping[str, Any]] | None) -> list[tuple[str, dict[str, Any]]]:
    pairs: list[tuple[str, dict[str, Any]]] = []
    for wrapper in [wrappers] if isinstance(wrappers, (str, Mapping)) else wrappers or ():
        if isinstance(wrapper, str):
            pairs.append((wrapper, {}))
        elif isinstance(wrapper, Mapping):
            pairs.extend((path, dict(arguments or {})) for path, arguments in wrapper.items())
        else:
            raise InvalidEnvironmentError(
                f"wrappers: {shown(wrapper)} is neither a dotted path nor a dict from one to its arguments."
            )
    return pairs


def _load(path: str) -> Callable[..., Any]:
    module, _, name = path.rpartition(".")
    try:
        return getattr(importlib.import_module(module), name)
    except (Exception, SystemExit) as error:  # from foreign code
        raise InvalidEnvironmentError(
            f"The wrapper {path} cannot be imported ({told(error)}): name the dotted path of one, and install its "
            "package."
        ) from error


def find_module(name: str) -> ModuleType | None:
    """:return: the module, or None if there is no such module"""
    try:
        return importlib.import_module(name)
    except (Exception, SystemExit) as error:  # from foreign code
        if isinstance(error, ModuleNotFoundError) and f"{name}.".startswith(f"{error.name}."):
            return None
        if not isinstance(error, ImportError):
            raise InvalidEnvironmentError(f"{name} cannot be imported ({told(error)}): repair it.") from error
        text = str(error).rstrip(".")
        remedy = "" if "install" in text.lower() else ". Install what it needs"
        raise InvalidEnvironmentError(f"{name} cannot be imported: {text}{remedy}.") from error


def has_environment(module: ModuleType | None) -> bool:
    """:return: whether a module has what creates a PettingZoo environment"""
    return _creator(module) is not None


def find_parallel_env(entry: str) -> Callable[..., ParallelEnv | AECEnv]:
    make_env = _creator(find_module(entry))
    if make_env is None:
        raise InvalidEnvironmentError(f"There is no function parallel_env in {entry}: name a module that has one.")
    return make_env


def _creator(module: ModuleType | None) -> Callable[..., ParallelEnv | AECEnv] | None:
    found = (getattr(module, name, None) for name in ("parallel_env", "env"))  # the latter is turn-based
    return next((one for one in found if callable(one)), None)
