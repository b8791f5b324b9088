"""The Gymnasium interface: one swarm as a team environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from quad_swarm.errors import unknown_name
from quad_swarm.interfaces.shared import TaskAttributes, checked_bits, checked_seed, checked_start, need_reset
from quad_swarm.states import as_other_state, generator_of, generator_state, like
from quad_swarm.task.options import TaskOptions
from quad_swarm.task.request_task import requests_of, task_of
from quad_swarm.validation import with_fields
from quad_swarm.world.neighbours import slots_to_robots


class QuadSwarmEnv(TaskAttributes, gym.Env[np.ndarray, np.ndarray]):
    """Quadrotors that fly to their goals and may request each other's plans.

    ## Description
    At each step, every robot chooses which robots to ask for their plans. It receives the requested plans, predicts the
    other robots with earlier plans or constant velocities, solves a nonlinear model predictive control problem with
    separation constraints, and applies the first input of the solution (Serra-Gomez et al., IROS 2020).

    ## Action Space
    `MultiBinary(n * (n - 1))`: robot 0's bits for robots 1..n-1, robot 1's bits for robots 0, 2..n-1, and so on. 1
    requests the robot's plan. With `announcements`, there are two consecutive bits for each of the others: to request
    its plan, and to send it the robot's own plan. With `world={"neighbourhood": {"max_others": m}}`, there are bits for
    only m of the others, which change during an episode, see `world.neighbours`.

    ## Observation Space
    `Box(n, 6n)`, one row per robot: own velocity (3, m/s), goal relative to the robot (3, m), relative positions of the
    others (3(n-1), m), relative velocities of the others (3(n-1), m/s), with the others in ascending order.
    ``observation`` selects another observation, see `observation.GROUPS`.

    ## Rewards
    The team reward is +1.3 for each step in which all robots are at their goals, -150 for a collision, and -0.1 for
    each request.

    ## Starting State
    Robots start at rest. The scenario draws starts and goals; `reset(options={"starts": ..., "goals": ...})` sets them,
    both (n, 3), m. They must lie in the workspace; robots must not start in contact, and goals must not be too close
    for two robots to be at both. With them, "velocities" (n, 3), m/s, lets goals move, and "waypoints", n sequences
    (any number, 3), m, are what each robot passes on the way to its goal. "headings" (n,), rad from the x axis
    counter-clockwise, are what robots turn to, the short way, for which they need a `planner.max_yaw_rate`.
    "initial_velocities" (n, 3), m/s, and "initial_headings" (n,), rad, are those of the robots at the start.

    ## Goals in Flight
    Gymnasium's `step` takes an action only, so goals are changed between steps: `env.unwrapped.set_goals(...)`.

    ## Episode End
    A collision terminates the episode, and with `end_at_arrival` so does the arrival of all robots. The episode is
    truncated after `max_steps`.

    ## Info
    `team_reward`, `reward_terms`, `pair_rewards` (n, n - 1; the part of a robot's reward that belongs to one of the
    others), `n_requests`, `min_separation`, `min_separation_continuous`, `collision`, `collision_continuous`,
    `at_goal` (n,), `belief_source` (n, n - 1), `planner` (`status` and `iterations`, (n,)), and `metrics`. In the last
    step of an episode also `is_success` and further `metrics`. With a limited neighbourhood also `neighbours` (n, m),
    the index of the robot in each slot of the action and of the entries about others, -1 for an empty slot, and
    `pair_terminated` (n, m), whether another robot, or none, is in the slot after the step. With obstacles also
    `min_obstacle_distance` and `min_obstacle_distance_continuous` (m, between surfaces, infinity without any). With
    `plans_in_info` also `plan`: `states` (n, N + 1, 9), the planned states at stages 0..N, the first of which are those
    from which the inputs act; `inputs` (n, 4), chosen in the step; `cost` (n,), the problem's objective with the
    violations of soft constraints; and `solve_seconds`, the wall-clock time of the planner's call for all robots.

    ## Arguments
    :param preset: a name of `presets.PRESETS`, such as "paper" or "dense"
    :param scenario: a name of `scenarios.SCENARIOS`, "mixed" or "curriculum", or a mapping of names to weights
    :param n_robots: number of robots, by default the preset's
    :param max_steps: time limit (steps), by default the preset's
    :param observation: "paper", or names of `observation.GROUPS` joined by "+", for example "state+memory+plan"
    :param scale_observation: for the paper's observation: divide distances by 4 m and velocities by 4 m/s
    :param continuous_collisions: whether contact at any time of a step is a collision, or only contact at the steps; by
        default as in the preset
    :param end_at_arrival: end episodes as soon as all robots are at their goals
    :param memory: maximum error (m) up to which an earlier plan is still believed, see `Beliefs`; 0 for no memory; by
        default the preset's
    :param reward: values of `RewardConfig` to replace
    :param planner: values of `PlannerConfig` to replace
    :param noise: values of `ProcessNoise` to replace
    :param radio: values of `Radio` to replace
    :param space: values of `ScenarioSpace` to replace
    :param world: fields of `SwarmConfig` to replace, nested ones as mappings, for example ``{"radius": 0.12,
        "quadrotor": {"drag_x": 0.3}}``; fields that are also arguments may be passed either way, but not both
    :param solver: "auto" or a name of `planner.SOLVERS`
    :param announcements: whether robots may also send their plans without a request, see the action space
    :param plans_in_info: whether `info` holds plans, inputs, costs and solve times
    :param render_mode: None, "rgb_array", or "human" for a window that shows every step in real time
    :raises ValueError: if a value is invalid; the message names it and the remedy

    ## Version History
    * v0: initial release, presets of version 1
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 10}  # noqa: RUF012 - Gymnasium's own convention

    @with_fields(TaskOptions)
    def __init__(self, options: TaskOptions, render_mode: str | None = None):
        self.task = task_of(options)
        n = self.n_agents
        self.observation_space = spaces.Box(-np.inf, np.inf, (n, self.task.observation_size), np.float32)
        self._n_bits = n * self.config.n_others * self.task.n_bits
        self.action_space = spaces.MultiBinary(self._n_bits)
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise unknown_name("render_mode", render_mode, self.metadata["render_modes"])
        self.render_mode = render_mode
        # An image per step: videos and windows show real time at whatever rate the robots plan
        self.metadata = {**type(self).metadata, "render_fps": 1 / self.config.planner.dt}
        self._renderer: Any = None
        self._requests = np.zeros((n, n - 1), dtype=bool)
        self._is_reset = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; see the class for ``options``.

        :raises ValueError: if the seed or an option is invalid
        """
        super().reset(seed=checked_seed(seed))
        if start := checked_start(options):
            self.task.place(0, "custom", rng=self.np_random, **start)
        else:
            self.task.reset(0, self.np_random)
        self._requests = np.zeros_like(self._requests)
        self._is_reset = True
        if self._renderer is not None:
            self._renderer.reset()
        if self.render_mode == "human":
            self.render()
        return self.task.observe()[0], {"scenario": self.task.scenario[0]}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Let all robots make requests, plan and fly for one step.

        :param action: bits, (n(n - 1),), twice as many with announcements
        :raises ValueError: if the action has another shape or other entries than bits; solver failures never raise
        :raises gymnasium.error.ResetNeeded: if ``reset`` has not been called yet
        """
        if not self._is_reset:
            raise need_reset()
        bits = checked_bits(action, (self._n_bits,), self.config.n_others, self.task.n_bits)[None]
        if self.render_mode is not None:
            neighbours = self.task.swarm.neighbours
            self._requests = slots_to_robots(requests_of(self.task.sent(bits), neighbours)[0], neighbours.numbers_in(0))
        outcome = self.task.act(bits)
        terminated, truncated = bool(outcome.terminated[0]), bool(outcome.truncated[0])
        info = info_of(self.task.info(outcome), 0)
        if terminated or truncated:
            final = info_of(self.task.final_info(), 0)
            info["is_success"] = final["is_success"]
            info["metrics"] |= {name: value for name, value in final["metrics"].items() if not np.isinf(value)}
        if self.render_mode == "human":
            self.render()
        return self.task.observe()[0], float(outcome.reward[0]), terminated, truncated, info

    def set_goals(
        self,
        goals: Any,
        velocities: Any = None,
        waypoints: Any = None,
        robots: Sequence[int] | None = None,
        headings: Any = None,
    ) -> np.ndarray:
        """Let k robots fly to other goals from now on. Their former goals and waypoints are forgotten, and the episode
        counts as arrived only when all robots are at the goals that they have now.

        :param goals: goals, (k, 3), world frame (m)
        :param velocities: velocities of the goals, (k, 3), world frame (m/s), by default 0
        :param waypoints: what each of the robots passes before, k sequences (any number, 3), world frame (m), by
            default nothing
        :param robots: indices of the robots, (k,), by default all
        :param headings: headings that the robots turn to, (k,) (rad), by default as before
        :return: the observation of all robots, (n, size) float32, with the new goals
        :raises ValueError: if there are no such robots, or goals or headings do not fit, see `SwarmConfig.check_goals`
            and `SwarmConfig.check_headings`
        :raises gymnasium.error.ResetNeeded: if ``reset`` has not been called yet
        """
        if not self._is_reset:
            raise need_reset("set_goals")
        self.task.set_goals(0, goals, velocities, waypoints, robots, headings)
        return self.task.observe()[0]

    def state_dict(self) -> dict[str, Any]:
        """Return the complete state as plain values and arrays, see `load_state_dict`."""
        return {
            "task": self.task.state_dict(),
            "requests": self._requests.copy(),
            "is_reset": self._is_reset,
            "generator": generator_state(self.np_random),
        }

    @as_other_state()
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state from `state_dict` of an environment with the same arguments, bit for bit.

        :raises ValueError: if the state belongs to another environment
        """
        self.task.load_state_dict(state["task"])
        self._requests = like(self._requests, state["requests"], "requests")
        self._is_reset = bool(state["is_reset"])
        self.np_random = generator_of(state["generator"])

    def render(self) -> Any:
        """Render the current step as an image, (480, 640, 3) uint8, or in a window with render mode "human".

        :raises ValueError: if the environment has no render mode
        :raises gymnasium.error.Error: if no window can be opened
        """
        if self.render_mode is None:
            raise ValueError("No render_mode: create the environment with render_mode='rgb_array'.")
        if self._renderer is None:
            from quad_swarm.figures.render import Renderer  # pygame is only needed here

            self._renderer = Renderer(self.config)
        swarm, statistics = self.task.swarm, self.task.statistics
        obstacles = () if swarm.obstacles is None else swarm.obstacles.of_swarm(0)
        lines = [
            f"step {statistics.steps[0]}   {self.task.scenario[0]}",
            f"{'plans sent' if self.task.n_bits == 2 else 'requests'} {self._requests.sum()} now, "
            f"{statistics.requests[0]} in all",
            f"smallest separation {statistics.min_separation[0]:.2f} m",
        ]
        if obstacles and np.isfinite(statistics.min_obstacle_distance[0]):
            lines.append(f"closest to an obstacle {statistics.min_obstacle_distance[0]:.2f} m")
        if statistics.collided[0]:
            lines.append("COLLISION")
        picture = self._renderer.draw(swarm.state[0], swarm.goal[0], swarm.plans[0], self._requests, lines, obstacles)
        if self.render_mode == "human":
            self._renderer.show(self.metadata["render_fps"])
            return None
        return picture

    def __getstate__(self) -> dict[str, Any]:
        """Return what copies and pickles hold: everything but the renderer, which a copy creates when it renders."""
        return {**self.__dict__, "_renderer": None}

    def close(self) -> None:
        """Close the window and free the renderer."""
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = None


def info_of(batch: dict[str, Any], swarm: int) -> dict[str, Any]:
    """Return one swarm's part of a batched `info`, as plain Python numbers and copies of arrays."""
    return {
        name: info_of(value, swarm)
        if isinstance(value, dict)
        else (value[swarm].copy() if value.ndim > 1 else value.item(swarm))
        for name, value in batch.items()
    }
