"""The Gymnasium face: one swarm as a team environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from .errors import unknown_name
from .presets import make_config, replace_fields
from .scenarios import ScenarioSampler
from .statistics import EpisodeStatistics
from .swarm import Swarm
from .task import Outcome, RequestTask, RewardConfig


class QuadSwarmEnv(gym.Env[np.ndarray, np.ndarray]):
    """Quadrotors that fly to their goals and may ask each other for their plans.

    ## Description
    At every step each robot chooses whom to ask. It gets the plans it asked for, predicts the other robots with a
    constant velocity, solves a nonlinear model predictive control problem with separation constraints, and flies its
    first input (Serra-Gomez et al., IROS 2020).

    ## Action Space
    `MultiBinary(n * (n - 1))`: robot 0's bits for robots 1..n-1, robot 1's bits for robots 0, 2..n-1, and so on; 1
    asks.

    ## Observation Space
    `Box(n, 6n)`, one row a robot: own velocity (3, m/s), goal relative to the robot (3, m), relative positions of the
    others (3(n-1), m), their relative velocities (3(n-1), m/s); others in ascending order.

    ## Rewards
    The team's: +1.3 in each step in which all robots are at their goals, -150 for a collision, -0.1 for each request.

    ## Starting State
    At rest; starts and goals as the scenario draws them. `reset(options={"starts": ..., "goals": ...})` sets them, both
    (n, 3), m.

    ## Episode End
    Terminated by a collision, truncated after `max_steps`.

    ## Info
    `reward_terms`, `n_requests`, `min_separation`, `min_separation_continuous`, `collision`, `collision_continuous`,
    `at_goal` (n,), `belief_source` (n, n - 1), `planner` (`status` and `iterations`, (n,)), and at the end `is_success`
    and `metrics`.

    ## Arguments
    :param preset: "paper" or "dense" (`presets.PRESETS`)
    :param scenario: a name of `scenarios.SCENARIOS`, "mixed" or "curriculum"
    :param n_robots: number of robots; None: the preset's
    :param max_steps: time limit (steps)
    :param scale_observation: divide distances by 4 m and velocities by 4 m/s
    :param continuous_collisions: end episodes at collisions between steps too
    :param memory: how far off (m) an earlier plan may be and still be believed, see `Beliefs`; 0: off; None: the
        preset's
    :param reward: values of `RewardConfig` to replace
    :param planner: values of `PlannerConfig` to replace
    :param noise: values of `ProcessNoise` to replace
    :param space: values of `ScenarioSpace` to replace
    :param solver: "auto" or a name of `planner.SOLVERS`
    :param render_mode: None or "rgb_array"
    :raises ValueError: a wrong value; the message names it and the remedy

    ## Version History
    * v0: initial release, presets of version 1
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 - Gymnasium's own convention
    reset_options = ("starts", "goals")

    def __init__(
        self,
        preset: str = "paper",
        scenario: str = "mixed",
        n_robots: int | None = None,
        max_steps: int = 100,
        scale_observation: bool = False,
        continuous_collisions: bool = False,
        memory: float | None = None,
        reward: Mapping[str, float] | None = None,
        planner: Mapping[str, Any] | None = None,
        noise: Mapping[str, float] | None = None,
        space: Mapping[str, Any] | None = None,
        solver: str = "auto",
        render_mode: str | None = None,
    ):
        config = make_config(preset, n_robots=n_robots, memory=memory, planner=planner, noise=noise, space=space)
        self.config = config
        self.n_agents = n = config.n_robots
        sampler = ScenarioSampler(scenario, n, config.space)
        weights = replace_fields(RewardConfig(), reward or {}, "reward")
        self.task = RequestTask(
            Swarm(config, solver=solver), sampler, weights, max_steps, scale_observation, continuous_collisions
        )
        self.observation_space = spaces.Box(-np.inf, np.inf, (n, self.task.observation_size), np.float32)
        self.action_space = spaces.MultiBinary(n * (n - 1))
        self.statistics = EpisodeStatistics(1, n)
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise unknown_name("render_mode", render_mode, self.metadata["render_modes"])
        self.render_mode = render_mode
        self._renderer: Any = None
        self._requests = np.zeros((n, n - 1), dtype=bool)

    # The curriculum: a training callback sets the level, the environment itself never does.
    @property
    def n_curriculum_levels(self) -> int:
        """Number of curriculum levels; 1 where the scenario has none."""
        return self.task.sampler.n_levels

    @property
    def curriculum_level(self) -> int:
        """The present level, from 0."""
        return self.task.sampler.level

    def set_curriculum_level(self, level: int) -> None:
        """Draw later episodes from the first ``level + 1`` scenarios.

        :raises ValueError: no such level
        """
        self.task.sampler.set_level(level)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode; see the class for ``options``."""
        super().reset(seed=seed)
        options = options or {}
        if unknown := set(options).difference(self.reset_options):
            raise unknown_name("reset option", unknown.pop(), self.reset_options)
        if len(options) == 1:
            raise ValueError(f"reset options name only {next(iter(options))!r}; give both 'starts' and 'goals'.")
        if options:
            self.task.place(0, "custom", np.asarray(options["starts"], float), np.asarray(options["goals"], float))
        else:
            self.task.reset(0, self.np_random)
        self.statistics.reset(0)
        self._requests = np.zeros_like(self._requests)
        if self._renderer is not None:
            self._renderer.reset()
        return self.task.observe()[0], {"scenario": self.task.scenario[0]}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Let every robot ask, plan and fly for one step.

        :raises ValueError: the action is not n(n - 1) bits; a solver's failure never raises
        """
        self._requests = request_matrix(action, self.n_agents)
        before = self.task.swarm.pos.copy()
        outcome = self.task.step(self._requests[None])
        self.statistics.add(outcome, np.linalg.norm(self.task.swarm.pos - before, axis=-1))
        terminated, truncated = bool(outcome.terminated[0]), bool(outcome.truncated[0])
        info = self._info(outcome)
        if terminated or truncated:
            info["is_success"] = bool(self.statistics.success[0])
            info["metrics"] |= self.statistics.metrics(0)
        return self.task.observe()[0], float(outcome.reward[0]), terminated, truncated, info

    def _info(self, outcome: Outcome) -> dict[str, Any]:
        report = outcome.report
        terms = {name: float(term[0]) for name, term in outcome.reward_terms.items()}
        return {
            "scenario": self.task.scenario[0],
            "reward_terms": terms,
            "n_requests": int(outcome.n_requests[0]),
            "min_separation": float(report.min_separation[0]),
            "min_separation_continuous": float(report.min_separation_continuous[0]),
            "collision": bool(report.collision[0]),
            "collision_continuous": bool(report.collision_continuous[0]),
            "at_goal": report.at_goal[0].copy(),
            "belief_source": report.belief_source[0].copy(),
            "planner": {"status": report.plan_status[0].copy(), "iterations": report.iterations[0].copy()},
            "metrics": {f"reward/{name}": term for name, term in terms.items()},
        }

    def render(self) -> Any:
        """The present step as an image, (480, 640, 3) uint8."""
        if self.render_mode is None:
            raise ValueError("No render_mode: make the environment with render_mode='rgb_array'.")
        if self._renderer is None:
            from .render import Renderer  # pygame is needed only here

            self._renderer = Renderer(self.config)
        swarm = self.task.swarm
        lines = [
            f"step {self.statistics.steps[0]}   {self.task.scenario[0]}",
            f"requests {self._requests.sum()} now, {self.statistics.requests[0]} in all",
            f"smallest separation {self.statistics.min_separation[0]:.2f} m",
        ]
        if self.statistics.collided[0]:
            lines.append("COLLISION")
        return self._renderer.draw(swarm.state[0], swarm.goal[0], swarm.plans[0], self._requests, lines)

    def close(self) -> None:
        """Free the renderer."""
        self._renderer = None


def request_matrix(action: Any, n_robots: int) -> np.ndarray:
    """A joint action as whom each robot asks, (n, n - 1) bool.

    :raises ValueError: wrong size, or anything but zeros and ones
    """
    bits = np.asarray(action)
    size = n_robots * (n_robots - 1)
    if bits.size != size:
        raise ValueError(
            f"The action has {bits.size} entries; {n_robots} robots need {size} bits, {n_robots - 1} each."
        )
    asked = bits == 1
    if not (asked | (bits == 0)).all():
        wrong = bits[~(asked | (bits == 0))].ravel()[0]
        raise ValueError(f"The action contains {wrong!r}; every entry must be 0 or 1. Threshold scores before acting.")
    return asked.reshape(n_robots, n_robots - 1)
