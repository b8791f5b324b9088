"""Measure the time of the planner's solvers for problems recorded in closed loop, on one core.

python benchmarks/planner.py [--json FILE] [--full]

All solvers get the same problems and the same initial guess, which is the shifted last plan. `ipopt`, `fatrop` and
`hpipm` solve one problem after the other, so their time per solve holds for any number of environments. Times are
processor times of this thread. They do not include other processes, which still affect the caches: rely on the ratios.

- ipopt: the nonlinear program interpreted by CasADi, warm-started, tolerance 1e-6; ipopt_compiled: with C code
- fatrop: the reference solver of `quad_swarm`, tolerance 1e-4
- hpipm: a real-time iteration in C on the HPIPM in CasADi's wheel, the method of acados
- rti: the batched real-time iteration of `quad_swarm`

iterations: quadratic programs per problem for hpipm and rti, mean number of the solver's iterations for the others.

--agreement compares plans instead of times: rti after 1, 2 and 3 quadratic programs with the converged optimum of
fatrop (tolerance 1e-6), in both presets.
"""

from __future__ import annotations

import argparse
import ctypes
import math
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from quad_swarm.evaluation.rows import write_rows
from quad_swarm.planner import FatropSolver, OptimalControlProblem, Problems, RtiSolver, Solution
from quad_swarm.planner.fatrop import transcribe
from quad_swarm.world.presets import SwarmConfig, make_config
from quad_swarm.world.scenarios import ScenarioSampler, without_obstacles
from quad_swarm.world.swarm import Swarm

HORIZONS = (10, 20)
ROBOTS = (4, 8, 16)
ENVIRONMENTS = (1, 4, 16, 64)
STEPS = 40  # steps per recorded flight, until most robots have passed each other
KEYS = (
    "solver", "horizon", "n_robots", "n_envs", "preset", "precision", "iterations", "success_rate", "us_median",
    "us_p99", "times_ipopt", "times_fatrop", "times_hpipm",
)  # fmt: skip


class Call(NamedTuple):
    """Arguments of a solver in one step of some environments."""

    problems: Problems
    x_guess: np.ndarray
    u_guess: np.ndarray

    def part(self, index: Any) -> Call:
        """Return some of the problems."""
        return Call(self.problems.part(index), self.x_guess[index], self.u_guess[index])


Solve = Callable[[Call], Solution]


def world(n_robots: int, horizon: int) -> tuple[str, SwarmConfig]:
    """Return the preset for a number of robots, with a larger room for more than eight robots."""
    preset = "paper" if n_robots <= 4 else "dense"
    config = make_config(preset, n_robots=n_robots)
    space, planner = config.space, replace(config.planner, horizon=horizon)
    if n_robots > 8:
        scale = max(math.sqrt(n_robots / 8), n_robots / 12)  # the second for the circle of the symmetric swap
        space = replace(
            space,
            half_width=scale * space.half_width,
            circle_radius=(scale * space.circle_radius[0], scale * space.circle_radius[1]),
            sector_radius=(scale * space.sector_radius[0], scale * space.sector_radius[1]),
        )
        low, high = planner.workspace_low, planner.workspace_high
        planner = replace(
            planner,
            workspace_low=(scale * low[0], scale * low[1], low[2]),
            workspace_high=(scale * high[0], scale * high[1], high[2]),
        )
    return preset, replace(config, space=space, planner=planner)


def record(config: SwarmConfig, n_envs: int, seed: int = 0) -> list[Call]:
    """Fly environments of all scenarios, half of them with full communication, half without, and record the calls."""
    swarm = Swarm(config, n_envs, "rti")
    names = without_obstacles()
    for k in range(n_envs):
        sampler = ScenarioSampler(names[k % len(names)], config.n_robots, config.space)
        swarm.reset(k, *sampler.sample(np.random.default_rng([seed, k]))[1:])
    calls: list[Call] = []

    class Recorder(RtiSolver):
        def solve(self, problems: Problems, x_guess: np.ndarray, u_guess: np.ndarray) -> Solution:
            calls.append(Call(problems, x_guess, u_guess))
            return super().solve(problems, x_guess, u_guess)

    n = config.n_robots
    swarm.planner.solver = Recorder(swarm.planner.solver.problem)  # type: ignore[attr-defined,misc]
    requests = np.zeros((n_envs, n, n - 1), dtype=bool)
    requests[: n_envs // 2] = True
    for _ in range(STEPS):
        swarm.step(requests)
    return [call for call in calls if len(call.x_guess) == n_envs * n]  # without retries of the fallback chain


def split(calls: Sequence[Call], n_envs: int, n_robots: int, limit: int) -> list[Call]:
    """Return at most ``limit`` calls of ``n_envs`` environments each, spread over the recorded flights."""
    size = n_envs * n_robots
    parts = [
        call.part(slice(start, start + size))
        for call in calls
        for start in range(0, len(call.x_guess) - size + 1, size)
    ]
    return [parts[int(k)] for k in np.linspace(0, len(parts) - 1, min(limit, len(parts)))]


def measure(solve: Solve, calls: Sequence[Call], repeats: int) -> dict[str, Any]:
    """Measure the time of each call (the minimum over repeats) and the success of its solves."""
    solve(calls[0])
    times, success, iterations = [], [], []
    for call in calls:
        elapsed = []
        for _ in range(repeats):
            started = time.thread_time()
            solution = solve(call)
            elapsed.append(time.thread_time() - started)
        times.append(1e6 * min(elapsed) / len(call.x_guess))
        success.append(solution.success)
        iterations.append(solution.iterations)
    return {
        "iterations": float(np.concatenate(iterations).mean()),
        "success_rate": float(np.concatenate(success).mean()),
        "us_median": float(np.median(times)),
        "us_p99": float(np.percentile(times, 99)),
    }


def ipopt(problem: OptimalControlProblem, compiled: bool) -> Solve:
    """Return a solver that uses Ipopt as CasADi's users do."""
    program = transcribe(problem)
    options: dict[str, Any] = {
        "print_time": False,
        "error_on_fail": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.tol": 1e-6,
        "ipopt.warm_start_init_point": "yes",
    }
    if compiled:
        options |= {"jit": True, "compiler": "shell", "jit_options": {"flags": ["-O2", "-march=native"]}}
    solver = ca.nlpsol("ipopt", "ipopt", program.nlp, options)
    nx, nu = problem.nx, problem.nu

    def solve(call: Call) -> Solution:
        count = len(call.x_guess)
        success, iterations = np.zeros(count, dtype=bool), np.zeros(count, dtype=np.int64)
        for b in range(count):
            guess = np.zeros(program.bounds["lbx"].size)
            guess[program.x_index] = call.x_guess[b, 1:, :nx]
            guess[program.u_index] = call.u_guess[b, :, :nu]
            x, goal, others = call.problems.x[b], call.problems.goal[b], call.problems.others[b]
            clearance = np.zeros(others.shape[0] * others.shape[1])
            solver(x0=guess, p=np.concatenate([x[:nx], goal, others.ravel(), clearance]), **program.bounds)
            stats = solver.stats()
            success[b], iterations[b] = stats["success"], stats["iter_count"]
        return Solution(call.x_guess, call.u_guess, success, iterations)

    return solve


def hpipm(problem: OptimalControlProblem, sqp_iterations: int, folder: Path) -> Solve:
    """Return the real-time iteration in `hpipm_rti.c`, compiled for the problem."""
    library = ctypes.CDLL(str(_compile_hpipm(problem, folder)))
    config, nu = problem.config, problem.nu
    u = ca.SX.sym("u", nu)
    hessian = ca.DM(ca.hessian(problem.input_cost(u), u)[0]).full()
    speed = [config.max_speed, config.max_speed, config.max_vertical_speed]
    bounds = np.concatenate(
        [
            problem.max_input.full().ravel(),
            config.workspace_low,
            np.negative(speed),
            config.workspace_high,
            speed,
        ]
    )
    pointer, integer = ctypes.c_void_p, ctypes.c_longlong
    library.hpipm_create.argtypes = [pointer, pointer, ctypes.c_double]
    library.hpipm_create(bounds.ctypes.data, hessian.ctypes.data, config.violation_weight)
    library.hpipm_solve.argtypes = [integer, *[pointer] * 7, integer]

    def solve(call: Call) -> Solution:
        count = len(call.x_guess)
        solution = Solution(
            np.array(call.x_guess), np.array(call.u_guess), np.zeros(count, dtype=bool), np.zeros(count, dtype=np.int64)
        )
        inputs = [np.ascontiguousarray(field) for field in (call.problems.x, call.problems.goal, call.problems.others)]
        library.hpipm_solve(count, *[array.ctypes.data for array in (*inputs, *solution)], sqp_iterations)
        return solution

    return solve


def _compile_hpipm(problem: OptimalControlProblem, folder: Path) -> Path:
    nx, nu, n_others, horizon = problem.nx, problem.nu, problem.n_others, problem.config.horizon
    x, u, x0 = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("x0", nx)
    goal, other, distance = ca.SX.sym("goal", 3), ca.SX.sym("other", 3), ca.SX.sym("distance")
    f = problem.dynamics(x, u)
    a, b = ca.densify(ca.jacobian(f, x)), ca.densify(ca.jacobian(f, u))
    r = ca.gradient(problem.input_cost(u), u)
    d = OptimalControlProblem(problem.config, problem.quadrotor, 1).distances(x, other)[0]
    residual = problem.repulsion_residual(distance)
    slope = ca.gradient(residual, distance)
    repulsion = ca.Function("repulsion", [distance], [2 * residual * slope, 2 * slope**2])
    hessian, gradient = ca.hessian(problem.goal_cost(x, x0, goal), x)
    name = f"hpipm_{horizon}_{n_others}"
    generator = ca.CodeGenerator(f"{name}_functions.c")
    generator.add(ca.Function("stage", [x, u], ca.cse([f, a, b, r])))
    direction = ca.densify(ca.gradient(d, x)[:3])
    generator.add(
        ca.Function("separation", [x, other], ca.cse([problem.config.separation - d, direction, *repulsion(d)]))
    )
    generator.add(ca.Function("goal_cost", [x, x0, goal], [ca.densify(gradient), ca.densify(hessian)]))
    generator.generate(f"{folder}{os.sep}")
    wheel = Path(ca.__file__).parent
    result = folder / f"{name}.so"
    subprocess.run(
        [
            shutil.which("gcc") or "cc", "-O3", "-march=native", "-shared", "-fPIC",
            f"-DOCP_N={horizon}", f"-DOCP_NX={nx}", f"-DOCP_NU={nu}", f"-DOCP_OTHERS={n_others}",
            str(Path(__file__).with_name("hpipm_rti.c")), str(folder / f"{name}_functions.c"),
            f"-I{wheel / 'include'}", f"-L{wheel}", "-l:libhpipm.so", "-l:libblasfeo.so.0",
            "-Wl,--disable-new-dtags", f"-Wl,-rpath,{wheel}", "-lm", "-o", str(result),
        ],
        check=True,
    )  # fmt: skip
    return result


def compare(n_robots: int, horizon: int, n_envs: Sequence[int], full: bool, folder: Path) -> list[dict[str, Any]]:
    """Measure all solvers on the problems of one world."""
    preset, config = world(n_robots, horizon)
    calls = record(config, max(16, *n_envs))
    robots = np.random.default_rng(0).integers(n_robots, size=100)
    alone = [call.part(slice(k, k + 1)) for call, k in zip(split(calls, 1, n_robots, 100), robots, strict=True)]
    problem = OptimalControlProblem(config.planner, config.quadrotor, n_robots - 1)
    common = {"horizon": horizon, "n_robots": n_robots, "preset": preset}
    count = 100 if full else max(20, 400 // (n_robots * horizon // 10))
    slow = [alone[int(k)] for k in np.linspace(0, len(alone) - 1, min(len(alone), count))]

    rows: list[dict[str, Any]] = []

    def add(solver: str, solve: Solve, on: Sequence[Call], repeats: int, **more: Any) -> None:
        row = {"solver": solver, **common, "n_envs": 1, "precision": "float64"}
        rows.append(row | measure(solve, on, repeats) | more)
        print(_line(_with_ratios(rows)[-1]), flush=True)

    add("ipopt", ipopt(problem, compiled=False), slow, 1)
    if full or n_robots == 4:
        add("ipopt_compiled", ipopt(problem, compiled=True), slow, 1)
    fatrop = FatropSolver(problem)
    add("fatrop", lambda call: fatrop.solve(*call), slow, 1)
    for iterations in (1, 2):
        add("hpipm", hpipm(problem, iterations, folder), alone, 3, iterations=iterations)
    choices = [("float32", 2), ("float32", 1), ("float64", 2)] if full or n_robots == 4 else [("float32", 2)]
    for precision, iterations in choices:
        rti = RtiSolver(problem, sqp_iterations=iterations, precision=precision)
        for envs in n_envs:
            batches = split(calls, envs, n_robots, 200)
            more = {"n_envs": envs, "precision": precision, "iterations": iterations}
            add("rti", lambda call, rti=rti: rti.solve(*call), batches, 3, **more)  # type: ignore[misc]
    return _with_ratios(rows)


def plan_cost(problem: OptimalControlProblem, call: Call, u: np.ndarray) -> np.ndarray:
    """Return the cost (eq. 2) of the inputs (B, N, 4) of each problem and the resulting states."""
    c, n_others = problem.config, problem.n_others
    x0, goal, others = ca.SX.sym("x0", problem.nx), ca.SX.sym("goal", 3), ca.SX.sym("others", 3, c.horizon * n_others)
    inputs = ca.SX.sym("u", problem.nu, c.horizon)
    x, cost = x0, ca.SX(0)
    for k in range(c.horizon):
        x = problem.dynamics(x, inputs[:, k])
        distances = ca.vertcat(*problem.distances(x, others[:, k :: c.horizon]))
        violations = ca.fmax(ca.vertcat(c.separation - distances, problem.box_violations(x)), 0)
        cost += problem.input_cost(inputs[:, k]) + ca.sum1(problem.repulsion_cost(distances))
        cost += c.violation_weight * ca.sumsqr(violations)
    cost += problem.goal_cost(x, x0, goal)
    count = len(u)
    total = ca.Function("total", [x0, goal, others, inputs], [cost]).map(count)
    return (
        total(
            call.problems.x[:, : problem.nx].T,
            call.problems.goal.T,
            call.problems.others.reshape(-1, 3).T,
            u[:, :, : problem.nu].reshape(-1, problem.nu).T,
        )
        .full()
        .ravel()
    )


def agreement() -> None:
    """Print the deviations of rti's plans from the converged optimum."""
    print("preset  programs  precision  success   cost gap            first input         position (m)")
    print("                                      (median, p99, max of each)")
    for n_robots in (4, 8):
        preset, config = world(n_robots, 10)
        calls = record(config, 16)
        every = range(0, STEPS, 2 if n_robots == 4 else 4)
        fields = [[*calls[k].problems[:3], calls[k].x_guess, calls[k].u_guess] for k in every]
        x, goal, others, x_guess, u_guess = (np.concatenate(field) for field in zip(*fields, strict=True))
        call = Call(Problems(x, goal, others), x_guess, u_guess)
        problem = OptimalControlProblem(config.planner, config.quadrotor, n_robots - 1)
        best = FatropSolver(problem, tolerance=1e-6).solve(*call)
        best_cost = plan_cost(problem, call, best.u)
        limit = problem.max_input.full().ravel()
        for precision in ("float32", "float64"):
            for iterations in (1, 2, 3):
                mine = RtiSolver(problem, iterations, 0, precision).solve(*call)
                gap = (plan_cost(problem, call, mine.u) - best_cost) / (1 + best_cost)
                first = (np.abs(mine.u - best.u)[:, 0, : problem.nu] / limit).max(axis=1)
                position = np.abs(mine.x - best.x)[..., :3].max(axis=(1, 2))
                text = "  ".join(
                    " ".join(f"{value:8.1e}" for value in np.percentile(figure, [50, 99, 100]))
                    for figure in (gap, first, position)
                )
                print(
                    f"{preset:7} {iterations:8}  {precision}  {mine.success.mean():7.4f}  {text}  ({len(x)} problems)"
                )


def _with_ratios(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Add the speedups over three rivals to the rows; for hpipm, those over a single iteration."""
    rivals: dict[str, float] = {}
    for row in rows:
        rivals.setdefault(row["solver"], row["us_median"])
    ratios = {f"times_{name}": name for name in ("ipopt", "fatrop", "hpipm")}
    return [
        {
            key: row[key] if key in row else (rivals[ratios[key]] / row["us_median"] if ratios[key] in rivals else None)
            for key in KEYS
        }
        for row in rows
    ]


def _line(row: dict[str, Any]) -> str:
    ratios = " ".join(f"{row[key]:9.1f}" if row[key] else " " * 9 for key in KEYS[-3:])
    return (
        f"{row['solver']:15} {row['horizon']:3} {row['n_robots']:3} {row['n_envs']:4} {row['precision']:8}"
        f"{row['iterations']:6.1f} {row['success_rate']:7.3f} {row['us_median']:10.1f} {row['us_p99']:10.1f} {ratios}"
    )


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the rows as a JSON list")
    parser.add_argument("--full", action="store_true", help="more problems and variants (half an hour)")
    parser.add_argument("--agreement", action="store_true", help="compare plans with the converged optimum instead")
    parser.add_argument("--horizon", type=int, nargs="+", default=HORIZONS, help="default 10 20")
    parser.add_argument("--n-robots", type=int, nargs="+", default=ROBOTS, help="default 4 8 16")
    parser.add_argument("--n-envs", type=int, nargs="+", default=ENVIRONMENTS, help="default 1 4 16 64")
    args = parser.parse_args()
    target = args.json.absolute() if args.json else None
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    if args.agreement:
        return agreement()
    print("solver            N   n envs real     iters success     median        p99  x ipopt  x fatrop   x hpipm")
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)  # CasADi compiles in the working directory
        for horizon in args.horizon:
            for n_robots in args.n_robots:
                rows += compare(n_robots, horizon, args.n_envs, args.full, Path(folder))
        os.chdir(Path(__file__).parent)
    if target:
        write_rows(target, rows)


if __name__ == "__main__":
    main()
