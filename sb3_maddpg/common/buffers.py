"""Replay buffers of a team, uniform and prioritised."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_maddpg.errors import DivergedError, InvalidArgumentError, InvalidEnvironmentError, InvalidFileError
from sb3_maddpg.files.registry import allow_in_files
from sb3_maddpg.team.spaces import heads_of
from sb3_maddpg.team.team import InfoKey, Team
from sb3_maddpg.utils import all_finite, as_numbers, integers_problem, not_finite_at, shown
from sb3_maddpg.validation import PriorityArguments, ReplayBufferArguments, validated


class TeamReplayBufferSamples(NamedTuple):
    """
    SB3's ``ReplayBufferSamples`` with an entry per agent. The window of a sample consists of ``n_steps`` transitions
    starting with the sampled one, or fewer if it has to stop early, see ``TeamReplayBuffer``.

    :param observations: observations, (batch, n_agents, columns)
    :param actions: stored joint actions, (batch, length)
    :param next_observations: observations at the end of the window, (batch, n_agents, columns)
    :param dones: 1 if the target must not bootstrap, (batch, n_agents)
    :param rewards: discounted sums of rewards over the window, (batch, n_agents)
    :param discounts: factors of the next value: the number gamma with single steps, else gamma to the power of the
        number of rewards summed, (batch, n_agents)
    :param active: 1 if the agent acted, (batch, n_agents); ``None`` if every agent always has
    :param next_active: 1 if the agent is still active at the end of the window, (batch, n_agents); ``None`` if every
        agent always has been active
    :param next_truncated: 1 if the agent was truncated at the end of the window although others go on, (batch,
        n_agents); ``None`` if no agent was. Only its own critic counts its next action.
    :param pair_rewards: discounted sums of pair rewards, (batch, n_agents, n_pairs); ``None`` if they are not stored
    :param pair_goes_on: 1 if the next observation is about the same pair, (batch, n_agents, n_pairs); ``None`` if pairs
        never end before their agents
    :param indices: indices of the samples for ``update_priorities``, (batch,); ``None`` without priorities
    :param weights: importance-sampling weights, at most 1, (batch,); ``None`` without priorities
    """

    observations: th.Tensor
    actions: th.Tensor
    next_observations: th.Tensor
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor | float
    active: th.Tensor | None = None
    next_active: th.Tensor | None = None
    next_truncated: th.Tensor | None = None
    pair_rewards: th.Tensor | None = None
    pair_goes_on: th.Tensor | None = None
    indices: np.ndarray | None = None
    weights: th.Tensor | None = None

    def mean(self, values: th.Tensor, active: th.Tensor | None) -> th.Tensor:
        """
        :param values: values to average, (batch, n)
        :param active: 1 for the values that count, else 0, (batch, n), None for all
        :return: the means over the batch, with its importance weights, (n,)
        """
        if self.weights is not None:
            values = values * self.weights.unsqueeze(1)
        return values.mean(dim=0) if active is None else (values * active).sum(dim=0) / active.sum(dim=0).clamp(min=1.0)


_TRUNCATED = 2.0


class _Columns(NamedTuple):
    """Views of the numbers stored besides observations and actions, each (..., its own shape)."""

    agent_rewards: np.ndarray
    agent_terminated: np.ndarray
    agent_active: np.ndarray
    """1 if the agent acted, `_TRUNCATED` if it acted and was truncated although others go on, else 0"""
    rewards: np.ndarray
    dones: np.ndarray
    timeouts: np.ndarray
    cuts: np.ndarray
    """1 if the next transition does not continue this one although the episode did not end, as after a new learn()"""
    pair_rewards: np.ndarray
    pair_terminated: np.ndarray


# Attributes that are not pickled, because they are views of the records or derived from them
_VIEWS = {
    "observations",
    "next_observations",
    "actions",
    "numbers",
    *_Columns._fields,
    "_new",
    "_new_columns",
    "_truncated",
    "_flags",
}
_REMEDY = "Look there for a division by zero or a diverging simulation; end the episode earlier, or clip the value."
_REMEDY_ACTION = "Look for diverged networks (lower learning_rate) or a Box whose bounds are equal or too large."


@allow_in_files(name="sb3_maddpg.buffers.TeamReplayBuffer")
class TeamReplayBuffer(ReplayBuffer):
    """
    SB3's replay buffer with rewards and terminations of each agent. It reads these entries of ``infos``:

    - ``agent_rewards``, (n_agents,): the agents' rewards, by default the team's reward for every agent;
    - ``agent_terminated``, (n_agents,): whether each agent terminated, by default none terminates before the team;
    - ``agent_truncated``, (n_agents,): whether each agent was truncated although others go on, by default those that
      act no more in the next step without having terminated;
    - ``agent_active``, (n_agents,): whether each agent acted, by default all did;
    - ``pair_rewards``, (n_agents, n_pairs), required if ``n_pairs`` is set: the part of an agent's reward that belongs
      to each of its neighbours.

    Time limits are treated as truncation: targets still bootstrap from the next observation. With ``n_steps`` > 1,
    rewards are summed over a window of that many transitions. The window stops early at the end of the episode, at the
    newest transition, and when an agent is truncated (inactive without having terminated). It stops for all agents,
    because they share the next observation. When an agent terminates, only its own sum stops.

    ``VecNormalize`` with ``norm_reward=True`` divides agents' rewards by the running standard deviation of the agents'
    returns, see ``TeamVecNormalize``.

    ``add`` refuses NaN and infinity and leaves the buffer unchanged.

    All arrays are views of ``records``, (buffer_size, n_envs), so that a transition is contiguous in memory.

    :param buffer_size: maximum number of transitions
    :param observation_space: ``Box(n_agents, columns)``
    :param action_space: flat joint action space
    :param device: PyTorch device
    :param n_envs: number of parallel environments
    :param optimize_memory_usage: see SB3's ``ReplayBuffer``; needs ``n_steps=1`` and
        ``handle_timeout_termination=False``
    :param handle_timeout_termination: see SB3's ``ReplayBuffer``
    :param n_steps: number of rewards in the n-step return
    :param gamma: discount factor
    :param n_pairs: number of neighbours in ``pair_rewards``, 0 without pair rewards
    :param pairs_end: whether neighbours change, so that ``info["pair_terminated"]``, (n_agents, n_pairs), is required
    :raises ValueError: if the spaces do not describe a team, or an argument is out of range
    """

    _ARGUMENTS: ClassVar[tuple[str, ...]] = (
        "buffer_size",
        "observation_space",
        "action_space",
        "n_envs",
        "optimize_memory_usage",
        "handle_timeout_termination",
        "n_steps",
        "gamma",
        "n_pairs",
        "pairs_end",
    )
    _COUNTERS: ClassVar[tuple[str, ...]] = ("pos", "full", "all_active", "n_added")

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        n_steps: int = 1,
        gamma: float = 0.99,
        n_pairs: int = 0,
        pairs_end: bool = False,
    ):
        self.team = Team.from_spaces(observation_space, action_space)
        arguments = validated(
            ReplayBufferArguments,
            buffer_size=buffer_size,
            n_envs=n_envs,
            optimize_memory_usage=optimize_memory_usage,
            handle_timeout_termination=handle_timeout_termination,
            n_steps=n_steps,
            gamma=gamma,
            n_pairs=n_pairs,
            pairs_end=pairs_end,
        )
        self.n_agents = self.team.n_agents
        self.n_steps = arguments.pop("n_steps")
        self.gamma = arguments.pop("gamma")
        self.n_pairs = arguments.pop("n_pairs")
        self.pairs_end = arguments.pop("pairs_end")
        if self.n_steps > 1 and arguments["optimize_memory_usage"]:
            raise InvalidArgumentError(
                f"n_steps={n_steps} needs the observation after each step, which optimize_memory_usage=True does not "
                "store at the end of an episode. Set n_steps=1 or optimize_memory_usage=False."
            )
        if arguments["optimize_memory_usage"] and arguments["handle_timeout_termination"]:
            raise InvalidArgumentError(
                "optimize_memory_usage=True drops the last observation of a truncated episode. Set it to False, or "
                "set handle_timeout_termination=False (in replay_buffer_kwargs) to treat truncation as termination."
            )
        super().__init__(
            observation_space=observation_space,
            action_space=action_space,
            device=device,
            **arguments,
        )
        self.all_active = True
        self.n_added = 0
        names = ["observations", "actions"]
        if not self.optimize_memory_usage:
            names.append("next_observations")
        fields: list[Any] = [(name, getattr(self, name).dtype, getattr(self, name).shape[2:]) for name in names]
        # All other numbers are one field, so that one index reads n steps of them
        n_columns = 3 + self.n_pairs * (2 if self.pairs_end else 1)
        fields.append(("numbers", np.float32, (self.n_agents * n_columns + 4,)))
        self._use(np.zeros((self.buffer_size, self.n_envs), np.dtype(fields, align=True)))

    def _use(self, records: np.ndarray) -> None:
        self.records = records
        self.observations = records["observations"]
        self.actions = records["actions"]
        if not self.optimize_memory_usage:
            self.next_observations = records["next_observations"]
        self.numbers = records["numbers"]
        columns = self._columns(self.numbers)
        self.agent_rewards = columns.agent_rewards
        self.agent_terminated = columns.agent_terminated
        self.agent_active = columns.agent_active
        self.rewards = columns.rewards
        self.dones = columns.dones
        self.timeouts = columns.timeouts
        self.cuts = columns.cuts
        self.pair_rewards = columns.pair_rewards
        self.pair_terminated = columns.pair_terminated
        # The numbers of the transition being added, which are stored only if they are finite
        self._new = np.zeros(self.numbers.shape[1:], np.float32)
        self._truncated = np.zeros((self.n_envs, self.n_agents), np.float32)
        self._new_columns = self._columns(self._new)
        # Columns of all numbers that are 1 or 0
        every = self._columns(np.arange(self.numbers.shape[-1]))
        flags = (every.agent_terminated, every.agent_active, every.dones, every.timeouts, every.pair_terminated)
        self._flags = np.concatenate([np.ravel(columns) for columns in flags])

    def _columns(self, numbers: np.ndarray) -> _Columns:
        """
        :param numbers: the numbers stored besides observations and actions, in the last axis
        :return: views of them
        """
        n, end = self.n_agents, 3 * self.n_agents + 4 + self.n_agents * self.n_pairs
        pairs = (*numbers.shape[:-1], n, self.n_pairs)
        return _Columns(
            agent_rewards=numbers[..., :n],
            agent_terminated=numbers[..., n : 2 * n],
            agent_active=numbers[..., 2 * n : 3 * n],
            rewards=numbers[..., 3 * n],
            dones=numbers[..., 3 * n + 1],
            timeouts=numbers[..., 3 * n + 2],
            cuts=numbers[..., 3 * n + 3],
            pair_rewards=numbers[..., 3 * n + 4 : end].reshape(pairs),
            pair_terminated=numbers[..., end:].reshape(pairs if self.pairs_end else (*pairs[:-1], 0)),
        )

    def __getstate__(self) -> dict[str, Any]:
        state = {name: value for name, value in self.__dict__.items() if name not in _VIEWS}
        # Only the rows in use. Without next_observations, the row after them holds the last next observation
        state["records"] = self.records[: self.size() + int(self.optimize_memory_usage)]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        records = self.records
        if len(records) < self.buffer_size:
            records = np.zeros((self.buffer_size, self.n_envs), records.dtype)
            records[: len(self.records)] = self.records
        self._use(records)

    def contents(self) -> tuple[dict[str, Any], dict[str, Any], dict[str, np.ndarray]]:
        """
        Return what recreates the buffer with ``cls(**arguments)`` and ``restore(counters, arrays)``.

        :return: arguments except the device, counters, and the used part of the arrays
        """
        # Without next_observations, the row after the last one holds the last next observation
        used = self.records[: self.size() + int(self.optimize_memory_usage)]
        arguments = {name: getattr(self, name) for name in self._ARGUMENTS}
        arguments["buffer_size"] *= self.n_envs  # SB3 stores the number of rows
        counters = {name: getattr(self, name) for name in self._COUNTERS}
        return arguments, counters, {name: used[name] for name in self.records.dtype.names or ()}

    def restore(self, counters: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        """
        Restore the contents of another buffer with the same arguments.

        :param counters: see ``contents``
        :param arrays: see ``contents``
        :raises ValueError: if they do not fit this buffer's arguments, or hold actions outside of their space or
            numbers that are not finite
        """
        if set(counters) != set(self._COUNTERS):
            raise InvalidFileError(f"A {type(self).__name__} has the counters {self._COUNTERS}, not {tuple(counters)}.")
        for name, value in counters.items():
            default = getattr(self, name)
            if type(value) is not type(default) or not 0 <= value < (2**53 if type(value) is int else math.inf):
                raise InvalidFileError(f"The replay buffer's {name} is {shown(value)}.")
            setattr(self, name, value)
        names = self.records.dtype.names or ()
        rows = self.size() + int(self.optimize_memory_usage)
        if self.pos >= self.buffer_size:
            raise InvalidFileError(f"The replay buffer's pos is {self.pos}, but it has {self.buffer_size} rows.")
        if self.n_added < self.size():
            raise InvalidFileError(f"The replay buffer's n_added is {self.n_added}, but it holds {self.size()} rows.")
        for name in names:
            array, own = arrays.get(name), self.records[name][:rows]
            if array is None or (array.shape, array.dtype) != (own.shape, own.dtype):
                given = "nothing" if array is None else f"{array.dtype} of shape {array.shape}"
                raise InvalidFileError(f"The replay buffer's {name} are {given}, not {own.dtype} of shape {own.shape}.")
            if not all_finite(array):
                raise InvalidFileError(f"The replay buffer's {name} hold NaN or infinity.")
            own[...] = array
        if rows:
            self._check_stored_actions(arrays["actions"])

    def _check_stored_actions(self, actions: np.ndarray) -> None:
        """
        :param actions: stored joint actions, (rows, n_envs, length)
        :raises ValueError: if one lies outside of its space
        """
        sizes = np.concatenate([heads_of(space) for space in self.team.action_spaces])
        continuous = sizes == 0
        low, high = np.where(continuous, -1, 0), np.where(continuous, 1, sizes - 1)
        slack = 1e-3 * continuous  # scaling to [-1, 1] rounds
        least, most = actions.min(axis=(0, 1)), actions.max(axis=(0, 1))
        wrong = (least < low - slack) | (most > high + slack)
        wrong |= ~continuous & (actions != np.rint(actions)).any(axis=(0, 1))
        if wrong.any():
            agent, column = self._place_of_action(place := int(np.argmax(wrong)))
            kind = "numbers" if continuous[place] else "integers"
            raise InvalidFileError(
                f"The replay buffer's actions of agent {agent} ({self.team.names[agent]}) lie between {least[place]} "
                f"and {most[place]} in column {column}: they must be {kind} from {low[place]} to {high[place]}."
            )

    def reset(self) -> None:
        super().reset()
        self.all_active = True
        self.n_added = 0

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Add one transition per environment.

        :param obs: observations, (n_envs, n_agents, columns)
        :param next_obs: next observations, (n_envs, n_agents, columns), the final ones if the episode ended
        :param action: joint actions, (n_envs, length)
        :param reward: team rewards, (n_envs,)
        :param done: whether the episode was terminated or truncated, (n_envs,)
        :param infos: infos of the environments
        :raises ValueError: if a shape does not fit, a required entry of ``infos`` is missing, or a number is NaN or
            infinite
        """
        team = (self.n_envs, *self.obs_shape)
        self._check("observation", obs, team)
        self._check("next observation", next_obs, team)
        self._check("action", action, (self.n_envs, self.action_dim))
        new = self._new_columns
        new.rewards[:] = reward
        new.dones[:] = done
        if self.handle_timeout_termination:
            new.timeouts[:] = [info.get("TimeLimit.truncated", False) for info in infos]
        self._read_infos("agent_rewards", new.agent_rewards, infos, new.rewards[:, None])
        self._read_infos("agent_terminated", new.agent_terminated, infos, 0.0)
        some_say = self._read_infos("agent_active", new.agent_active, infos, 1.0)
        self._read_infos("agent_truncated", self._truncated, infos, 0.0)
        cut_early = np.count_nonzero(self._truncated)
        if self.n_pairs:
            self._read_infos("pair_rewards", new.pair_rewards, infos, None)
        if self.pairs_end:
            self._read_infos("pair_terminated", new.pair_terminated, infos, None)
        if not all_finite(self._new):
            self._refuse_numbers(infos)
        flags = self._new.take(self._flags, axis=1)
        if cut_early or np.count_nonzero(flags * (flags - 1)):
            self._check_flags()
        if cut_early:
            goes_on = (new.agent_active > 0) & (new.agent_terminated == 0) & (self._truncated == 0)
            early = (self._truncated > 0) & (new.agent_active > 0) & goes_on.any(axis=1, keepdims=True)
            new.agent_active[early] = _TRUNCATED
            self.all_active = self.all_active and not early.any()

        pos = self.pos
        if self.optimize_memory_usage:
            # This observation takes the place of the last next observation. Where another episode begins although the
            # last one did not end, the last transition is treated as its end, like a time limit.
            self.dones[pos - 1][(self.observations[pos] != obs).any(axis=(1, 2))] = 1
        some_left = some_say and np.count_nonzero(new.agent_active) < new.agent_active.size
        if some_left:
            self._mark_departures(obs, new.agent_active)
        self.observations[pos] = obs
        if self.optimize_memory_usage:
            self.observations[(pos + 1) % self.buffer_size] = next_obs
        else:
            self.next_observations[pos] = next_obs
        self.actions[pos] = action.reshape(self.n_envs, self.action_dim)
        self.numbers[pos] = self._new
        self.all_active = self.all_active and not some_left
        if self.n_steps > 1:
            self.cuts[pos - 1] = (self.next_observations[pos - 1] != self.observations[pos]).any(axis=(1, 2))
        self.n_added += 1
        self.pos += 1
        if self.pos == self.buffer_size:
            self.full = True
            self.pos = 0

    def _mark_departures(self, obs: np.ndarray, active: np.ndarray) -> None:
        """
        Agents that act no more, although they have not terminated, were truncated in the step before.

        :param obs: the present observations, (n_envs, n_agents, columns)
        :param active: column ``agent_active`` of the present step, (n_envs, n_agents)
        """
        if not self.n_added:
            return
        before = self._columns(self.numbers[self.pos - 1])
        left = (active == 0) & (before.agent_active == 1) & (before.agent_terminated == 0)
        left &= before.dones[:, None] == 0
        if left.any():
            seen = self.observations[self.pos] if self.optimize_memory_usage else self.next_observations[self.pos - 1]
            same_episode = (seen == obs).all(axis=(1, 2))
            before.agent_active[left & same_episode[:, None]] = _TRUNCATED

    def _check(self, what: str, values: np.ndarray, shape: tuple[int, ...]) -> None:
        """
        :param what: name of the values, for error messages
        :param values: observations or joint actions of all environments
        :param shape: the required shape; actions may have another shape of the same size
        :raises ValueError: if the shape differs, or a value is NaN or infinite
        """
        if values.shape == shape and values.dtype == self.observations.dtype == np.float32 and all_finite(values):
            return
        fits = values.shape == shape or (what == "action" and values.size == math.prod(shape))
        if not fits or len(values) != self.n_envs:
            raise InvalidEnvironmentError(
                f"The {what} has shape {values.shape}, but this replay buffer is for {self.n_envs} environment(s) of "
                f"{self.n_agents} agents: it must be {shape}. A buffer fits only the team and the number of "
                "environments that it was created for."
            )
        if values.dtype.kind not in "biuf":
            raise InvalidEnvironmentError(f"The {what} is an array of {values.dtype}: it must hold real numbers.")
        values = values.reshape(shape)
        if (index := not_finite_at(values)) is None:
            if what != "action" and self.observations.dtype.kind in "iu":
                self._check_integers(what, values)
            return
        env, *place = index
        agent, column = place if what != "action" else self._place_of_action(place[0])
        raise DivergedError(
            f"The {what} of agent {agent} ({self.team.names[agent]}) is {values[index]} in column {column}, "
            f"{self._where(env)}: it must be finite. {_REMEDY_ACTION if what == 'action' else _REMEDY}"
        )

    def _check_integers(self, what: str, values: np.ndarray) -> None:
        for env, rows in enumerate(values):
            if (problem := integers_problem(rows, self.observations.dtype)) is not None:
                raise InvalidEnvironmentError(f"The {what} of agent {problem} {self._where(env)}. {_REMEDY}")

    def _place_of_action(self, column: int) -> tuple[int, int]:
        """:return: the agent that a column of the joint action belongs to, and the column in its own action"""
        ends = np.cumsum([len(heads_of(space)) for space in self.team.action_spaces])
        agent = int(np.searchsorted(ends, column, side="right"))
        return agent, column - (int(ends[agent - 1]) if agent else 0)

    def _where(self, env: int) -> str:
        return f"in environment {env} at step {self.n_added + 1} (counted since the replay buffer was created)"

    def _read_infos(
        self, key: InfoKey, array: np.ndarray, infos: Sequence[dict[str, Any]], default: np.ndarray | float | None
    ) -> bool:
        """
        Read one entry of all infos into an array.

        :param key: key of the entry
        :param array: array to write to, (n_envs, ...)
        :param infos: infos of the environments
        :param default: value for environments without the key, None if the key is required
        :return: whether any environment has the key
        """
        value = infos[0].get(key) if len(infos) == 1 else None
        if type(value) is np.ndarray and value.dtype.kind in "bfiu" and value.shape == array.shape[1:]:
            array[0] = value  # fast path for the common case
            return True
        values = [info[key] for info in infos if key in info]
        where: slice | list[int] = slice(None)
        if len(values) < len(infos):
            if default is None:
                raise InvalidEnvironmentError(
                    f"info['{key}'] is missing, but the buffer was created with n_pairs={self.n_pairs}: return it with "
                    f"shape {array.shape[1:]} in every step of the environment, or leave n_pairs at 0."
                )
            array[:] = default
            if not values:
                return False
            where = [env for env, info in enumerate(infos) if key in info]
        try:
            rows = [as_numbers(value) for value in values]
        except ValueError:
            self._check_shapes(key, values, array.shape[1:])
            raise InvalidEnvironmentError(f"info['{key}'] of {shown(values)} does not hold numbers.") from None
        self._check_shapes(key, rows, array.shape[1:])
        array[where] = rows
        return True

    def _check_shapes(self, key: InfoKey, values: Sequence[Any], needed: tuple[int, ...]) -> None:
        for value in values:
            try:
                shape = np.shape(value)
            except (TypeError, ValueError, RuntimeError):  # of nested lists that differ, or foreign arrays
                continue
            if shape != needed:
                of_pairs = key in ("pair_rewards", "pair_terminated")
                pairs = f" and n_pairs={self.n_pairs}" if of_pairs else ""
                remedy = "" if of_pairs else ", or leave the key out"
                raise InvalidEnvironmentError(
                    f"info['{key}'] has shape {shape}, but there are {self.n_agents} agents{pairs}: "
                    f"the environment must return shape {needed}{remedy}."
                )

    def _check_flags(self) -> None:
        """:raises ValueError: if what says whether agents acted or something ended is neither 1 nor 0"""
        new = self._new_columns
        arrays = {
            "info['agent_terminated']": new.agent_terminated,
            "info['agent_active']": new.agent_active,
            "info['agent_truncated']": self._truncated,
            "info['pair_terminated']": new.pair_terminated,
            "The end of the episode": new.dones,
            "info['TimeLimit.truncated']": new.timeouts,
        }
        for name, array in arrays.items():
            if (wrong := np.argwhere(array * (array - 1) != 0)).size:  # NaN counts
                env, *agent = wrong[0].tolist()
                whose = f" of agent {agent[0]} ({self.team.names[agent[0]]})" if agent else ""
                value = array[tuple([env, *agent])]
                raise InvalidEnvironmentError(f"{name}{whose} is {value} {self._where(env)}: it must be True or False.")

    def _refuse_numbers(self, infos: Sequence[dict[str, Any]]) -> None:
        keys = ("agent_rewards", "pair_rewards", "pair_terminated", "agent_terminated", "agent_active", "rewards")
        for key in keys:
            array = getattr(self._new_columns, key)
            for index in np.argwhere(~np.isfinite(array)):
                env, agent = index[0], index[1 if key != "rewards" else 0]
                source, value = "The team's reward", array[tuple(index)]
                if key in infos[env]:
                    source = f"info['{key}'] of agent {agent} ({self.team.names[agent]})"
                    value = np.asarray(infos[env][key])[tuple(index[1:])]
                raise InvalidEnvironmentError(
                    f"{source} is {value} {self._where(env)}: it must be finite in single precision. {_REMEDY}"
                )

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> TeamReplayBufferSamples:  # type: ignore[override]
        """
        Sample transitions uniformly.

        :param batch_size: number of transitions
        :param env: normalises observations and rewards
        :return: the samples
        :raises ValueError: if the buffer is empty
        """
        self._check_not_empty()
        return super().sample(batch_size, env)  # type: ignore[return-value]

    def _check_not_empty(self) -> None:
        if not self.size():
            raise InvalidArgumentError("The replay buffer is empty: add transitions first, see learning_starts.")

    def _get_samples(  # type: ignore[override]
        self, batch_inds: np.ndarray, env: VecNormalize | None = None
    ) -> TeamReplayBufferSamples:
        """
        :param batch_inds: rows of the transitions, (batch,)
        :param env: normalises observations and rewards
        """
        # NumPy's global generator, as in SB3, so that set_random_seed() makes sampling reproducible
        env_inds = np.random.randint(0, high=self.n_envs, size=len(batch_inds))  # noqa: NPY002
        return self.samples_at(batch_inds, env_inds, env)

    def samples_at(
        self, batch_inds: np.ndarray, env_inds: np.ndarray, env: VecNormalize | None = None
    ) -> TeamReplayBufferSamples:
        """
        Return the samples that start at given transitions.

        :param batch_inds: rows of the transitions in the buffer, (batch,)
        :param env_inds: indices of their environments, (batch,)
        :param env: normalises observations and rewards
        :return: the samples
        """
        # take() is several times faster than an index, and so is one read per transition instead of one per array
        batch = self.records.reshape(-1).take(batch_inds * self.n_envs + env_inds)
        if self.n_steps > 1:
            last, data = self._windows(batch_inds, env_inds, env)
            next_obs = self._read("next_observations", last * self.n_envs + env_inds)
        else:
            data = self._single_steps(batch["numbers"], env)
            if self.optimize_memory_usage:
                next_obs = self.observations[(batch_inds + 1) % self.buffer_size, env_inds]
            else:
                next_obs = batch["next_observations"]
        observations = batch["observations"]
        if env is not None and env.norm_obs:
            columns = self._columns(batch["numbers"])
            observations = self._normalized(observations, env, columns.agent_active == 0)
            if self.n_steps > 1:
                columns = self._columns(self._read("numbers", last * self.n_envs + env_inds))
            next_obs = self._normalized(next_obs, env, (columns.agent_active == 0) | (columns.agent_terminated > 0))
        rest: dict[str, Any] = {
            name: self.to_torch(value) if isinstance(value, np.ndarray) else value for name, value in data.items()
        }
        return TeamReplayBufferSamples(
            observations=self.to_torch(observations),
            actions=self.to_torch(batch["actions"]),
            next_observations=self.to_torch(next_obs),
            active=None
            if self.all_active
            else self.to_torch(np.minimum(self._columns(batch["numbers"]).agent_active, 1)),
            **rest,
        )

    def _normalized(self, obs: np.ndarray, env: VecNormalize, gone: np.ndarray) -> np.ndarray:
        """
        :param obs: observations, (batch, n_agents, columns)
        :param env: normalises observations
        :param gone: which agents take no part, (batch, n_agents)
        :return: the normalised observations, in which the zeros of those agents stay zeros
        """
        normalized = np.asarray(self._normalize_obs(obs, env))
        own = self.team.obs_dim
        normalized[..., :own][gone & ~obs[..., :own].any(axis=2)] = 0.0
        return normalized

    def _read(self, name: str, index: np.ndarray) -> np.ndarray:
        """
        Read an array at given transitions. NumPy's ``take`` would copy the whole array first.

        :param name: name of the array
        :param index: indices of the transitions, with rows and environments flattened, (batch,)
        :return: the values, (batch, ...)
        """
        array = getattr(self, name)
        flat = th.from_numpy(array.reshape(-1, *array.shape[2:]))
        return flat.index_select(0, th.from_numpy(index)).numpy()

    def _single_steps(self, numbers: np.ndarray, env: VecNormalize | None) -> dict[str, Any]:
        """
        :param numbers: numbers of the sampled transitions, (batch, columns)
        :param env: normalises rewards
        :return: fields of the samples: dones, rewards, discounts, ...
        """
        columns = self._columns(numbers)
        # timeouts stay zero unless handle_timeout_termination is set
        team_done = columns.dones * (1 - columns.timeouts)
        terminated = columns.agent_terminated
        return {
            "dones": self._dones(terminated, columns.agent_active, team_done),
            "rewards": self._normalize_reward(columns.agent_rewards, env),
            "discounts": self.gamma,
            **self._next_active(columns.agent_active, terminated),
            "pair_rewards": self._normalize_reward(columns.pair_rewards, env) if self.n_pairs else None,
            "pair_goes_on": 1 - columns.pair_terminated if self.pairs_end else None,
        }

    def _dones(self, gone: np.ndarray, active: np.ndarray, team_done: np.ndarray) -> np.ndarray:
        """
        :param gone: which agents terminated within the windows, (batch, n_agents)
        :param active: column ``agent_active`` of the last transitions of the windows, (batch, n_agents)
        :param team_done: whether the team's episodes ended there, other than by time limits, (batch,)
        :return: the field ``dones`` of the samples
        """
        dones = np.maximum(gone, team_done[:, None])
        if not self.handle_timeout_termination:  # which makes time limits of single agents terminations, too
            dones = np.maximum(dones, active == _TRUNCATED)
        return dones

    def _next_active(self, active: np.ndarray, terminated: np.ndarray) -> dict[str, np.ndarray | None]:
        """
        :param active: column ``agent_active`` of the last transitions of the windows, (batch, n_agents)
        :param terminated: which agents terminated there, (batch, n_agents)
        :return: the fields ``next_active`` and ``next_truncated`` of the samples
        """
        if self.all_active:
            return {"next_active": None, "next_truncated": None}
        truncated = active == _TRUNCATED
        goes_on = (active > 0) & (terminated == 0)
        return {
            "next_active": goes_on.astype(np.float32),
            "next_truncated": (truncated & goes_on).astype(np.float32) if truncated.any() else None,
        }

    def _windows(
        self, batch_inds: np.ndarray, env_inds: np.ndarray, env: VecNormalize | None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """
        :param batch_inds: first rows of the windows, (batch,)
        :param env_inds: indices of their environments, (batch,)
        :param env: normalises rewards before they are summed
        :return: last rows of the windows, and fields of the samples as in ``_single_steps``
        """
        rows = (batch_inds + np.arange(self.n_steps)[:, None]) % self.buffer_size
        numbers = self._read("numbers", (rows * self.n_envs + env_inds).ravel())
        # Move the batch to the contiguous axis in memory, which is longer than that of the agents
        columns = self._columns(np.moveaxis(numbers.T.copy().reshape(-1, *rows.shape), 0, -1))
        rewards = self._normalize_reward(columns.agent_rewards, env)
        pairs = self._normalize_reward(columns.pair_rewards, env)
        terminated, active = columns.agent_terminated > 0, columns.agent_active > 0
        ends = (columns.dones > 0) | (columns.cuts > 0)
        newer = (self.pos - 1 - batch_inds) % self.buffer_size

        total, pair_total = rewards[0].copy(order="K"), pairs[0].copy(order="K")
        discounts = np.full_like(total, self.gamma)
        last = np.zeros(len(batch_inds), np.intp)
        # Which agents' sums and which windows continue after the steps so far
        alive, goes_on = active[0] & ~terminated[0], np.ones(len(batch_inds), bool)
        gone = terminated[0].copy(order="K")
        same_pair = columns.pair_terminated[0] == 0
        for step in range(1, self.n_steps):
            goes_on &= (newer >= step) & ~ends[step - 1] & (active[step] | ~alive).all(axis=1)
            counts = alive & goes_on[:, None]
            total += self.gamma**step * rewards[step] * counts
            if self.n_pairs:
                pair_counts = counts[..., None] & same_pair if self.pairs_end else counts[..., None]
                pair_total += self.gamma**step * pairs[step] * pair_counts
            if self.pairs_end:
                same_pair &= ~goes_on[:, None, None] | (columns.pair_terminated[step] == 0)
            np.copyto(discounts, self.gamma ** (step + 1), where=counts)
            last += goes_on
            gone |= counts & terminated[step]
            alive &= ~terminated[step]
        at_end = (last, np.arange(len(last)))
        team_done = columns.dones[at_end] * (1 - columns.timeouts[at_end])
        return (batch_inds + last) % self.buffer_size, {
            "dones": self._dones(gone, columns.agent_active[at_end], team_done),
            "rewards": total,
            "discounts": discounts,
            **self._next_active(columns.agent_active[at_end], terminated[at_end]),
            "pair_rewards": pair_total if self.n_pairs else None,
            "pair_goes_on": same_pair.astype(np.float32) if self.pairs_end else None,
        }


@allow_in_files(name="sb3_maddpg.buffers.PrioritizedTeamReplayBuffer")
class PrioritizedTeamReplayBuffer(TeamReplayBuffer):
    """
    Team replay buffer with proportional prioritised experience replay (Schaul et al. 2016, arXiv:1511.05952,
    Algorithm 1). The priority of a transition is its absolute TD error when it was last sampled, plus ``epsilon``; new
    transitions get the largest priority so far. Transitions are sampled in proportion to their priority to the power of
    ``alpha``. Their losses are weighted by the importance-sampling weights ``(size * probability) ** -beta``, divided
    by the largest weight in the batch. Sampling is stratified: each sample of a batch comes from an equal share of the
    total priority.

    :param alpha: exponent of the priorities, 0 for uniform replay
    :param beta: exponent of the importance-sampling weights, 1 to correct the whole bias of prioritised replay
    :param epsilon: number added to each TD error, so that every transition has a positive probability
    :param args: see ``TeamReplayBuffer``
    :param kwargs: see ``TeamReplayBuffer``
    """

    _ARGUMENTS = (*TeamReplayBuffer._ARGUMENTS, "alpha", "beta", "epsilon")
    _COUNTERS = (*TeamReplayBuffer._COUNTERS, "largest_priority", "new_rows")

    def __init__(self, *args: Any, alpha: float = 0.6, beta: float = 0.5, epsilon: float = 0.01, **kwargs: Any):
        given = validated(PriorityArguments, alpha=alpha, beta=beta, epsilon=epsilon)
        self.alpha, self.beta, self.epsilon = given["alpha"], given["beta"], given["epsilon"]
        super().__init__(*args, **kwargs)
        self.reset()

    def reset(self) -> None:
        super().reset()
        self.priorities = SumTree(self.buffer_size * self.n_envs)
        self.largest_priority = 1.0
        self.new_rows = 0

    def contents(self) -> tuple[dict[str, Any], dict[str, Any], dict[str, np.ndarray]]:
        arguments, counters, arrays = super().contents()
        return arguments, counters, {**arrays, "priorities": self.priorities.values[: self.size() * self.n_envs]}

    def restore(self, counters: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        super().restore(counters, arrays)
        given = arrays.get("priorities")
        if given is None or (given.shape, given.dtype) != ((self.size() * self.n_envs,), np.dtype(float)):
            raise InvalidFileError(
                f"The replay buffer does not hold priorities of its {self.size() * self.n_envs} transitions."
            )
        if not (np.isfinite(given).all() and (given >= 0).all()):
            raise InvalidFileError("The replay buffer has priorities that are negative, NaN or infinite.")
        if self.new_rows > self.size():
            raise InvalidFileError(f"The replay buffer's new_rows is {self.new_rows}, but it holds {self.size()} rows.")
        if not 0 < self.largest_priority * self.buffer_size * self.n_envs < math.inf:
            raise InvalidFileError(
                f"The replay buffer's largest_priority is {self.largest_priority}: the priorities of all its rows must "
                "have a positive and finite sum."
            )
        with np.errstate(over="ignore"):
            total = given.sum() + self.largest_priority * self.new_rows * self.n_envs
        if self.size() and not 0 < total < math.inf:
            raise InvalidFileError(
                f"The replay buffer's priorities add up to {total}: the sum must be positive and finite."
            )
        self.priorities.set(np.arange(len(given)), given)

    def add(self, *args: Any, **kwargs: Any) -> None:
        super().add(*args, **kwargs)
        self.new_rows = min(self.new_rows + 1, self.buffer_size)

    def _prioritize_new(self) -> None:
        """Set the priorities of all transitions added since the last call at once, which is faster than one by one."""
        if not self.new_rows:
            return
        rows = (self.pos - 1 - np.arange(self.new_rows)) % self.buffer_size
        self.priorities.set(self._indices(rows), self.largest_priority)
        self.new_rows = 0
        if self.optimize_memory_usage and self.full:
            # The newest next observation has overwritten this row's observation
            self.priorities.set(self._indices(np.array([self.pos])), 0.0)

    def _indices(self, rows: np.ndarray) -> np.ndarray:
        """:return: the indices of all transitions in these rows"""
        return (rows[:, None] * self.n_envs + np.arange(self.n_envs)).ravel()

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> TeamReplayBufferSamples:  # type: ignore[override]
        """
        Sample transitions by priority.

        :param batch_size: number of transitions
        :param env: normalises observations and rewards
        :return: the samples
        :raises ValueError: if the buffer is empty
        """
        self._check_not_empty()
        self._prioritize_new()
        shares = (np.arange(batch_size) + np.random.random(batch_size)) / batch_size  # noqa: NPY002
        indices, probabilities = self.priorities.find(shares)
        samples = self.samples_at(indices // self.n_envs, indices % self.n_envs, env)
        weights = (probabilities / probabilities.min()) ** -self.beta
        return samples._replace(indices=indices, weights=self.to_torch(weights.astype(np.float32)))

    def update_priorities(self, indices: np.ndarray, errors: np.ndarray) -> None:
        """
        Set priorities from TD errors.

        :param indices: indices of the samples, (batch,)
        :param errors: absolute TD errors, (batch,)
        :raises ValueError: if an error is NaN or infinite
        """
        self._prioritize_new()
        priorities = (errors.astype(np.float64) + self.epsilon) ** self.alpha
        largest = priorities.max()
        if not math.isfinite(largest):
            raise DivergedError(
                f"The critics' error is {errors[~np.isfinite(errors)][0]}: the critics diverged. Lower the "
                "learning_rate or scale the rewards down."
            )
        self.largest_priority = max(self.largest_priority, float(largest))
        self.priorities.set(indices, priorities)


class SumTree:
    """
    Sum tree, which samples indices in proportion to their priorities in O(log n).

    :param size: number n of priorities, initially 0
    """

    def __init__(self, size: int):
        self.depth = max(size - 1, 0).bit_length()
        self.sums = np.zeros(2 << self.depth)  # the total at 1, children of i at 2 i and 2 i + 1, priorities last

    @property
    def values(self) -> np.ndarray:
        """All priorities, padded with zeros."""
        return self.sums[1 << self.depth :]

    def set(self, indices: np.ndarray, values: np.ndarray | float) -> None:
        """
        Set priorities.

        :param indices: indices of the priorities, (n,)
        :param values: the non-negative priorities, (n,), or one for all
        """
        nodes = indices + (1 << self.depth)
        self.sums[nodes] = values
        for _ in range(self.depth):
            nodes = nodes >> 1
            self.sums[nodes] = self.sums[2 * nodes] + self.sums[2 * nodes + 1]

    def find(self, shares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Find the indices whose intervals of the cumulative sum of priorities contain given points.

        :param shares: the points, as fractions of the total in [0, 1), (n,)
        :return: the indices and their probabilities, each (n,)
        """
        nodes = np.ones(len(shares), np.intp)
        rest = shares * self.sums[1]
        for _ in range(self.depth):
            nodes = 2 * nodes
            left, right = self.sums[nodes], self.sums[nodes + 1]
            goes_right = (rest >= left) & (right > 0)  # rounding must not lead to an empty subtree
            rest -= left * goes_right
            nodes += goes_right
        return nodes - (1 << self.depth), self.sums[nodes] / self.sums[1]
