"""The PettingZoo interface: the same swarm with one agent per robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from quad_swarm.errors import shown
from quad_swarm.interfaces.env import QuadSwarmEnv
from quad_swarm.interfaces.shared import RESET_OPTIONS, TaskAttributes, checked_bits, checked_options, need_reset
from quad_swarm.states import as_other_state


class QuadSwarmParallelEnv(TaskAttributes, ParallelEnv):
    """`QuadSwarmEnv` as a PettingZoo environment. The same seed and the same actions give the same episode.

    The agents are "robot_0", "robot_1", ... Each agent observes its row, acts with `MultiBinary(n - 1)` and gets the
    team reward.

    :param render_mode: None, "rgb_array" or "human"
    :param kwargs: arguments of `QuadSwarmEnv`
    :raises ValueError: if a value is invalid; the message names it and the remedy
    """

    metadata = {"name": "quad_swarm_v0", "render_modes": ["rgb_array", "human"], "render_fps": 10}  # noqa: RUF012

    def __init__(self, render_mode: str | None = None, **kwargs: Any):
        self.team = QuadSwarmEnv(render_mode=render_mode, **kwargs)
        self.render_mode = render_mode
        self.metadata = {**type(self).metadata, "render_fps": self.team.metadata["render_fps"]}
        self.task = self.team.task
        n, size = self.n_agents, self.task.observation_size
        self.possible_agents = list(self.team.agent_names)
        self.agents: list[str] = []
        self.observation_spaces = {a: spaces.Box(-np.inf, np.inf, (size,), np.float32) for a in self.possible_agents}
        n_bits = self.config.n_others * self.task.n_bits
        self.action_spaces = {a: spaces.MultiBinary(n_bits) for a in self.possible_agents}
        self.state_space = spaces.Box(-np.inf, np.inf, (n * size,), np.float32)
        self._is_reset = False

    def observation_space(self, agent: str) -> spaces.Space:
        """Return the observation space of a robot, (6n,) for the paper's observation."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        """Return the action space of a robot: n - 1 bits, twice as many with announcements."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict]]:
        """See `QuadSwarmEnv.reset`. Unknown options are ignored, as PettingZoo's API test requires."""
        known = {name: value for name, value in checked_options(options).items() if name in RESET_OPTIONS}
        observation, info = self.team.reset(seed=seed, options=known)
        self._is_reset = True
        self.agents = list(self.possible_agents)
        return self._rows(observation), {agent: dict(info) for agent in self.agents}

    def set_goals(
        self,
        goals: Any,
        velocities: Any = None,
        waypoints: Any = None,
        robots: Sequence[int] | None = None,
        headings: Any = None,
    ) -> dict[str, np.ndarray]:
        """See `QuadSwarmEnv.set_goals`. Returns the observations of all robots, with the new goals."""
        return self._rows(self.team.set_goals(goals, velocities, waypoints, robots, headings))

    def state_dict(self) -> dict[str, Any]:
        """See `QuadSwarmEnv.state_dict`."""
        return {"team": self.team.state_dict(), "agents": list(self.agents), "is_reset": self._is_reset}

    @as_other_state()
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See `QuadSwarmEnv.load_state_dict`."""
        self.team.load_state_dict(state["team"])
        self.agents, self._is_reset = list(state["agents"]), bool(state["is_reset"])

    def step(self, actions: dict[str, np.ndarray]) -> tuple[dict, dict, dict, dict, dict]:
        """See `QuadSwarmEnv.step`. After the end of the episode, there are no agents and all returned dicts are empty.

        :param actions: bits of each agent, (n - 1,), twice as many with announcements
        :raises ValueError: if an agent's action is missing, or has another shape or other entries than bits
        :raises gymnasium.error.ResetNeeded: if ``reset`` has not been called yet
        """
        if not self._is_reset:
            raise need_reset()
        if not self.agents:
            return {}, {}, {}, {}, {}
        if not isinstance(actions, Mapping):
            raise ValueError(f"actions={shown(actions)}: step() takes a mapping from agent names to actions.")
        if missing := [agent for agent in self.agents if agent not in actions]:
            raise ValueError(f"No action for {', '.join(missing)}; every robot must act in every step.")
        m, n_bits = self.config.n_others, self.task.n_bits
        bits = [
            checked_bits(actions[agent], (m * n_bits,), m, n_bits, f"The action of {agent}") for agent in self.agents
        ]
        observation, reward, terminated, truncated, info = self.team.step(np.concatenate(bits).ravel())
        agents = self.agents
        if terminated or truncated:
            self.agents = []
        return (
            self._rows(observation),
            dict.fromkeys(agents, reward),
            dict.fromkeys(agents, terminated),
            dict.fromkeys(agents, truncated),
            {agent: dict(info) for agent in agents},
        )

    def state(self) -> np.ndarray:
        """Return the observations of all robots, (n * size,), in `state_space`."""
        return self.team.task.observe()[0].ravel()

    def render(self) -> Any:
        """See `QuadSwarmEnv.render`."""
        return self.team.render()

    def close(self) -> None:
        """See `QuadSwarmEnv.close`."""
        self.team.close()

    def _rows(self, observation: np.ndarray) -> dict[str, np.ndarray]:
        return dict(zip(self.possible_agents, observation.copy(), strict=True))
