"""The Gymnasium vector interface: many swarms in one environment, with a single planner call for all robots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from pydantic import Field

from quad_swarm.errors import shown
from quad_swarm.interfaces.shared import (
    TaskAttributes,
    checked_bits,
    checked_options,
    checked_seed,
    checked_start,
    need_reset,
)
from quad_swarm.states import as_other_state, generator_of, generator_state
from quad_swarm.task.request_task import make_task
from quad_swarm.validation import checked_arguments


class QuadSwarmVectorEnv(TaskAttributes, VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Vector environment of E copies of `QuadSwarmEnv`: ``gymnasium.make_vec("QuadSwarm-v0", num_envs=256)``.

    Each swarm flies exactly as it would alone. When an episode ends, its environment resets in the same step
    (`AutoresetMode.SAME_STEP`): the final observation is in ``infos["final_obs"]`` and the final info in
    ``infos["final_info"]``, both valid where ``infos["_final_obs"]`` is True.

    :param num_envs: number of swarms E, at most 100 000
    :param render_mode: must be None, since the vector environment cannot render
    :param kwargs: arguments of `QuadSwarmEnv`
    :raises ValueError: if a value is invalid; the message names it and the remedy
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012 - Gymnasium's convention

    @checked_arguments
    def __init__(self, num_envs: Annotated[int, Field(ge=1, le=100_000)] = 1, render_mode: Any = None, **kwargs: Any):
        if render_mode is not None:
            raise _draws_nothing(f"render_mode={shown(render_mode)}")
        self.num_envs = num_envs
        self.task = make_task(num_envs, **kwargs)
        n = self.n_agents
        self.single_observation_space = spaces.Box(-np.inf, np.inf, (n, self.task.observation_size), np.float32)
        self._n_bits = n * self.config.n_others * self.task.n_bits
        self.single_action_space = spaces.MultiBinary(self._n_bits)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._rngs: list[np.random.Generator] = []

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode in every swarm.

        :param seed: seed of swarm 0, from which the seeds of the others count up, or a list with one seed per swarm
        :param options: those of `QuadSwarmEnv`, for the first episodes of all swarms; those of single swarms are in
            "swarms", a mapping from a swarm's index to its options
        :raises ValueError: if a seed or an option is invalid
        """
        starts = self._checked_starts(options)
        if isinstance(seed, (list, tuple)) or (isinstance(seed, np.ndarray) and seed.ndim > 0):
            seeds = [checked_seed(value) for value in seed]
        else:
            first = checked_seed(seed)
            seeds = [None if first is None else first + k for k in range(self.num_envs)]
        if len(seeds) != self.num_envs:
            raise ValueError(f"{len(seeds)} seeds for {self.num_envs} swarms.")
        if not self._rngs:
            self._rngs = [np.random.default_rng() for _ in seeds]
        for k, value in enumerate(seeds):
            if value is not None:
                self._rngs[k] = gym.utils.seeding.np_random(value)[0]
            if starts[k]:
                self.task.place(k, "custom", rng=self._rngs[k], **starts[k])
            else:
                self.task.reset(k, self._rngs[k])
        return self.task.observe(), self._with_masks({"scenario": np.array(self.task.scenario)})

    def _checked_starts(self, options: Any) -> list[dict[str, Any]]:
        """Return the options of each swarm's start."""
        options = checked_options(options)
        own = options.pop("swarms", {})
        if not isinstance(own, Mapping) or not all(map(self._is_swarm, own)):
            raise ValueError(
                f"reset option 'swarms'={shown(own)}: it must be a mapping from numbers of swarms, 0 to "
                f"{self.num_envs - 1}, to their options."
            )
        common = checked_start(options, ("swarms",))
        return [checked_start(own[k]) if k in own else common for k in range(self.num_envs)]

    def _is_swarm(self, index: Any) -> bool:
        whole = isinstance(index, (int, np.integer)) and not isinstance(index, bool)
        return whole and bool(0 <= index < self.num_envs)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take one step in every swarm; see `QuadSwarmEnv.step`.

        :param actions: bits, (E, n(n - 1)), twice as many with announcements
        :raises ValueError: if the actions have another shape or other entries than bits
        :raises gymnasium.error.ResetNeeded: if ``reset`` has not been called yet
        """
        if not self._rngs:
            raise need_reset()
        bits = checked_bits(actions, (self.num_envs, self._n_bits), self.config.n_others, self.task.n_bits)
        outcome = self.task.act(bits)
        info = self.task.info(outcome)
        infos = self._with_masks(info)
        done = outcome.terminated | outcome.truncated
        observations = self.task.observe()
        if done.any():
            final = self.task.final_info()
            final = {**info, **final, "metrics": info["metrics"] | final["metrics"]}
            infos |= _masked({"final_obs": observations, "final_info": final}, done)
            for k in np.flatnonzero(done):
                self.task.reset(int(k), self._rngs[k])
            observations = observations.copy()
            observations[done] = self.task.observe(done)
        return observations, outcome.reward, outcome.terminated, outcome.truncated, infos

    def set_goals(
        self,
        swarm: int,
        goals: Any,
        velocities: Any = None,
        waypoints: Any = None,
        robots: Sequence[int] | None = None,
        headings: Any = None,
    ) -> np.ndarray:
        """Let robots of one swarm fly to other goals from now on, until its episode ends; see `QuadSwarmEnv.set_goals`.

        :param swarm: index of the swarm
        :return: the observation of that swarm, (n, size) float32, with the new goals
        :raises ValueError: if there is no such swarm, or as in `QuadSwarmEnv.set_goals`
        :raises gymnasium.error.ResetNeeded: if ``reset`` has not been called yet
        """
        if not self._rngs:
            raise need_reset("set_goals")
        if not self._is_swarm(swarm):
            raise ValueError(f"swarm={shown(swarm)}: it must be the number of a swarm, from 0 to {self.num_envs - 1}.")
        self.task.set_goals(int(swarm), goals, velocities, waypoints, robots, headings)
        return self.task.observe(np.arange(self.num_envs) == swarm)[0]

    def state_dict(self) -> dict[str, Any]:
        """Return the complete state as plain values and arrays, see `load_state_dict`."""
        return {"task": self.task.state_dict(), "generators": [generator_state(rng) for rng in self._rngs]}

    @as_other_state()
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state from `state_dict` of an environment with the same arguments, bit for bit.

        :raises ValueError: if the state belongs to another environment
        """
        if len(state["generators"]) not in (0, self.num_envs):
            raise ValueError(
                f"The state has {len(state['generators'])} swarms, but this environment has {self.num_envs}."
            )
        self.task.load_state_dict(state["task"])
        self._rngs = [generator_of(one) for one in state["generators"]]

    def render(self) -> Any:
        """Raise an error, since the vector environment cannot render.

        :raises ValueError: always
        """
        raise _draws_nothing("render()")

    def _with_masks(self, info: Mapping[str, Any]) -> dict[str, Any]:
        return _masked(info, np.ones(self.num_envs, dtype=bool))


def _draws_nothing(asked: str) -> ValueError:
    return ValueError(f"{asked}: the vector environment cannot render; use QuadSwarmEnv.")


def _masked(info: Mapping[str, Any], mask: np.ndarray, metrics: bool = False) -> dict[str, Any]:
    """Convert infos to Gymnasium's batched form, where each entry has a mask of the environments it is valid for.

    :param metrics: whether they are metrics, which are not valid where they are infinite
    """
    masked: dict[str, Any] = {}
    for name, value in info.items():
        masked[name] = _masked(value, mask, name == "metrics") if isinstance(value, Mapping) else value
        masked[f"_{name}"] = mask & ~np.isinf(value) if metrics and np.isinf(value).any() else mask
    return masked
