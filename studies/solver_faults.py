"""Make the planner's solver fail and evaluate the swarm.

``python -m studies.solver_faults [--episodes 1000] [--json F]``. With full communication in `flight`, a fraction of the
solves fails: the solver reports failure, returns NaN with or without success, raises for the whole batch, or takes too
long, so that neither the solve nor the second attempt ends within the step. Steps must continue, and their results must
be finite. JSON: one row for each share and kind, with the keys of `summarise`.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from quad_swarm.evaluation.command import workers
from quad_swarm.evaluation.evaluation import Rows, summarise
from quad_swarm.evaluation.flight import begin, first_episode, fly_steps
from quad_swarm.planner import Planner, Problems, Solution, Solver
from quad_swarm.world.presets import make_config
from studies.swarm.experiment import Experiment, Row, absolute_path, command_line, condition
from studies.swarm.protocol import VALIDATION

KINDS = ("reports failure", "NaN and failure", "NaN and success", "raises", "takes too long")
SHARES = (0.1, 0.5)
SCENARIOS = ("symmetric_swap", "asymmetric_swap")
_BATCH = 100


class FailingSolver:
    """Solver that fails at random.

    :param solver: the wrapped solver
    :param share: fraction of problems that fail, or of batches if the solver raises
    :param kind: kind of failure, one of `KINDS`
    :param rng: random number generator
    """

    def __init__(self, solver: Solver, share: float, kind: str, rng: np.random.Generator):
        self.name = solver.name
        self._solver, self._share, self._kind, self._rng = solver, share, kind, rng
        self._retries = False  # whether the next call is the second attempt of a step

    def solve(self, problems: Problems, x_guess: np.ndarray, u_guess: np.ndarray) -> Solution:
        """See `Solver`."""
        if self._kind == "raises" and self._rng.random() < self._share:
            raise FloatingPointError("injected")
        solution = self._solver.solve(problems, x_guess, u_guess)
        if self._kind == "raises":
            return solution
        x, u, success = solution.x.copy(), solution.u.copy(), solution.success.copy()
        fails = self._rng.random(len(success)) < self._share
        if self._kind == "takes too long":
            fails |= self._retries
            self._retries = not self._retries and bool(fails.any() or not success.all())
        success[fails] = self._kind == "NaN and success"
        if self._kind.startswith("NaN"):
            x[fails, 1:], u[fails, -1] = np.nan, np.inf
        return solution._replace(x=x, u=u, success=success)


def fly(scenario: str, share: float, kind: str, episodes: Sequence[int]) -> Rows:
    """Fly episodes and return their statistics, see `run_episodes`.

    :raises FloatingPointError: if a state or a plan is not finite
    """
    one, rows = condition("full", scenario, make_config("flight")), []
    for start in range(0, len(episodes), _BATCH):
        policy, task, rngs = begin(one, episodes[start : start + _BATCH])
        planner = task.swarm.planner
        assert isinstance(planner, Planner)  # all robots are alike
        if share:
            planner.solver = FailingSolver(planner.solver, share, kind, np.random.default_rng(start))
        found: dict[int, dict[str, Any]] = {}
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "the solver .* raised", RuntimeWarning)
            for step in fly_steps(policy, task, rngs, one.linger):
                if not (np.isfinite(task.swarm.state).all() and np.isfinite(task.swarm.plans).all()):
                    raise FloatingPointError(f"{kind}, {share:.0%}: a state or a plan is not finite.")
                found |= {int(step.episodes[k]): task.statistics.row(int(k)) for k in np.flatnonzero(step.over)}
        rows += [found[k] for k in range(len(found))]
    return rows


def rows_of(scenario: str, share: float, kind: str, episodes: int) -> list[Row]:
    """Fly a condition and return its row."""
    first = first_episode(VALIDATION)
    row = summarise(fly(scenario, share, kind, range(first, first + episodes)), make_config("flight"))
    failed, collisions = row["planner_failures"], f"{row['collisions']:4}/{row['episodes']}"
    print(
        f"{scenario:16} {share:4.0%} {kind:16} collisions {collisions}, plans without a solution {failed}", flush=True
    )
    return [{"scenario": scenario, "share": share, "kind": kind, **row}]


def main() -> None:
    """Run the command line."""
    parser = command_line(__doc__)
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--json", type=absolute_path, metavar="FILE")
    args = parser.parse_args()
    work = [(name, 0.0, "none", args.episodes) for name in SCENARIOS]
    work += [(name, *fault, args.episodes) for *fault, name in itertools.product(SHARES, KINDS, SCENARIOS)]
    with workers(args) as pool:
        Experiment(args.json, "scenario", "share", "kind").run(pool, "faults", rows_of, work)


if __name__ == "__main__":
    main()
