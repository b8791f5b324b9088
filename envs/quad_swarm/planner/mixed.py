"""The planner of a team of unlike vehicles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quad_swarm.planner.base import Planner, Plans, Solver
from quad_swarm.planner.problem import Problems
from quad_swarm.quadrotor import MixedModel


class MixedPlanner:
    """Planners of several kinds of vehicles as one, which plans for whole teams of n robots. Each robot's plan is bit
    for bit that of its own planner.

    :ivar checks: see `Planner`
    :ivar costs: see `Planner`
    :ivar planners: the planner of each kind
    :ivar kind_of: which of them each robot has, (n,)
    :ivar model: discrete dynamics of the n robots

    :param planners: these planners, all with the same horizon, length of a stage and number of bodies
    :param kind_of: which of them each robot has, (n,)
    """

    def __init__(self, planners: Sequence[Planner], kind_of: Sequence[int]):
        self.planners, self.kind_of = tuple(planners), tuple(kind_of)
        self.model = MixedModel([planner.model for planner in planners], kind_of)
        self.checks = True
        self.costs: np.ndarray | None = None
        for planner in self.planners:
            planner.checks = False  # `plan` checks for all

    @property
    def solver(self) -> Solver:
        """The solver of the first kind; those of all kinds have the same name."""
        return self.planners[0].solver

    def plan(self, problems: Problems, previous: Plans) -> Plans:
        """Solve problems of E teams, a batch of B = E n in the order of teams and robots; solver failures never raise.

        :param problems: the batch. Kinds that hold their yaw take no notice of ``heading``
        :param previous: plans of the same robots in the previous step
        :return: the new plans
        :raises ValueError: if arrays do not fit, see `Planner.plan`, or these are no whole teams; not without `checks`
        """
        if self.checks:
            turning = max(self.planners, key=lambda planner: planner.config.max_yaw_rate)
            problems, previous = turning.checked(problems, previous)
            if len(problems.x) % len(self.kind_of):
                raise ValueError(
                    f"problems: there are {len(problems.x)}, but this planner plans for teams of "
                    f"{len(self.kind_of)} robots."
                )
        kinds = np.tile(self.kind_of, len(problems.x) // len(self.kind_of))
        plans = Plans(*(np.empty_like(array) for array in previous))
        self.costs = None if self.planners[0].rate is None else np.empty(len(kinds))
        for kind, planner in enumerate(self.planners):
            rows = np.flatnonzero(kinds == kind)
            found = planner.plan(problems.part(rows), Plans(*(array[rows] for array in previous)))
            for whole, some in zip(plans, found, strict=True):
                whole[rows] = some
            if self.costs is not None:
                self.costs[rows] = planner.costs
        return plans
