"""What users add from outside, in a module that other processes can import; the tests register it."""

import contextlib
import os
import signal
from pathlib import Path

import casadi as ca
import numpy as np

from quad_swarm.planner import FatropSolver, OptimalControlProblem, RtiSolver, Solution


class Stay:
    """A solver whose plan is to stay in place."""

    name = "stay"

    def __init__(self, problem):
        self.problem = problem

    def solve(self, problems, x_guess, u_guess):
        count, stages = len(x_guess), x_guess.shape[1]
        x = np.repeat(problems.x[:, None], stages, axis=1)
        return Solution(x, np.zeros_like(u_guess), np.ones(count, bool), np.zeros(count, np.int64))


class Lighter(OptimalControlProblem):
    """A quadrotor in a quarter of the gravity."""

    def dynamics(self, x, u):
        return super().dynamics(x, ca.vertcat(u[:2] / 4, u[2:]))


class Thrifty(OptimalControlProblem):
    """Inputs cost a hundred times as much."""

    def input_cost(self, u):
        return 100 * super().input_cost(u)


class Downwash(OptimalControlProblem):
    """Ellipsoids, three times as high as wide."""

    def distances(self, x, others):
        scale = ca.DM([1, 1, 1 / 3])
        return [ca.sqrt(ca.sumsqr(scale * (x[:3] - others[:, j])) + 1e-6) for j in range(self.n_others)]


class Slow(OptimalControlProblem):
    """A lower limit of the velocity along +x, and none along -x."""

    def box_violations(self, x):
        return ca.vertcat(x[3] - 0.2, super().box_violations(x)[:3])


class Gentle(OptimalControlProblem):
    """A tenth of the tilt."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.max_input = self.max_input * ca.DM([0.1, 0.1, 1])


class Pulled(OptimalControlProblem):
    """A goal that is not where the caller says."""

    def goal_cost(self, x, x0, goal):
        return super().goal_cost(x, x0, goal + ca.DM([0, 1, 0]))


PROBLEMS = (Lighter, Thrifty, Downwash, Slow, Gentle, Pulled)


def gentle(problem):
    """A solver of another problem, as a function in `SOLVERS`."""
    return RtiSolver(Gentle(problem.config, problem.quadrotor, problem.n_others))


def converged_gentle(problem):
    return FatropSolver(Gentle(problem.config, problem.quadrotor, problem.n_others))


def ones(pair):
    """An observation that says nothing."""
    return np.ones((*pair.view.pos.shape[:3], 1))


class Scribbling(Stay):
    """Writes into its problems: robots and goals must not move."""

    def solve(self, problems, x_guess, u_guess):
        solution = super().solve(problems, x_guess, u_guess)
        problems.x[...] = problems.goal[...] = 3.0
        return solution


class Drifting:
    """A plant whose robots drift along +x at 1 m/s, whatever they are told."""

    def __init__(self, vehicle, drag, dt, n_swarms, n_robots):
        self.speed, self.dt = {"iris": 1.0, "typhoon": 2.0}[vehicle], dt

    def place(self, swarm, state):
        pass

    def keep(self, swarms):
        pass

    def fork(self):
        return self

    def step(self, state, u, air, factors):
        after = state.copy()
        after[..., 0] += self.speed * self.dt
        return after


class Mortal(Drifting):
    """A plant whose process dies at its first step, if the file that the environment names does not exist yet."""

    def step(self, state, u, air, factors):
        once = Path(os.environ["FOREIGN_DIED"])
        if not once.exists():
            with contextlib.suppress(OSError):
                once.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().step(state, u, air, factors)


class Raising(Drifting):
    def step(self, state, u, air, factors):
        raise KeyError("battery")


class Lost(Drifting):
    def step(self, state, u, air, factors):
        return np.full_like(state, np.nan)


class Truncated(Drifting):
    def step(self, state, u, air, factors):
        return state[..., :6]


class Imaginary(Drifting):
    def step(self, state, u, air, factors):
        return state + 1j


class NoPlant:
    def __init__(self, *arguments):
        pass


class Asker:
    """A policy that asks everyone; it has nothing but `predict`."""

    def predict(self, observation):
        swarms, robots, _ = observation.shape
        return np.ones((swarms, robots * (robots - 1)))


class Loaded(Asker):
    """What `--algo MODULE:CLASS` may be at least."""

    @classmethod
    def load(cls, path):
        if Path(path).read_text() != "weights":
            raise ValueError("other weights")
        return cls()


class Boat(OptimalControlProblem):
    """A boat on a lake at the height of its start: pushed along x and y, against drag; it cannot leave its height."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.nx, self.nu = 6, 2
        self.max_input = ca.DM([1.5, 1.0])

    def derivative(self, x, u, wind):
        push = ca.vertcat(u[0], u[1]) - 0.4 * (x[3:5] - wind)
        return ca.vertcat(x[3:5], 0, push, 0)

    def goal_cost(self, x, x0, goal):
        """Where it is counts in the plane, and it should be slow there."""
        along = goal[:2] - x[:2]
        return self.config.goal_weight * ca.sumsqr(along) + 0.5 * ca.sumsqr(x[3:5])

    def braking(self, x):
        return -5 * x[3:5]

    def box_violations(self, x):
        return ca.vertcat(ca.DM(self.config.workspace_low[:2]) - x[:2], x[:2] - ca.DM(self.config.workspace_high[:2]))


class Drifter(Boat):
    """The same, begun in motion."""

    def start(self, starts, goals):
        states = super().start(starts, goals)
        states[:, 3] = 0.5
        return states


class Stepper(OptimalControlProblem):
    """A vehicle of which only whole steps are known: velocities are commanded."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.nx, self.nu = 6, 3
        self.max_input = ca.DM([1, 1, 0.5])

    def dynamics(self, x, u):
        return ca.vertcat(x[:3] + self.config.dt * u, u)


class Failing:
    """A solver that never finds a plan."""

    name = "failing"

    def __init__(self, problem):
        self.problem = problem

    def solve(self, problems, x_guess, u_guess):
        raise ArithmeticError("no plan")


def lighter(problem):
    """A solver of a vehicle that nobody flies."""
    return RtiSolver(Lighter(problem.config, problem.quadrotor, problem.n_others))
