"""Buffered Voronoi cells: plans that need no messages.

Every robot's plan stays in its own cell: the points that are nearer to it than to any other robot, less a buffer. The
cells of two robots that have the same positions in mind do not overlap, so nobody needs to know where others fly.
Source: Zhou, Wang, Bandyopadhyay and Schwager, "Fast, on-line collision avoidance for dynamic vehicles using buffered
Voronoi cells", IEEE Robotics and Automation Letters, 2017; among obstacles as in Zhu, Brito and Alonso-Mora,
"Decentralized probabilistic multi-robot collision avoidance using buffered uncertainty-aware Voronoi cells", Autonomous
Robots, 2022.
"""

from __future__ import annotations

from typing import ClassVar

import casadi as ca
import numpy as np

from quad_swarm.geometry import dot, length
from quad_swarm.planner.problem import OptimalControlProblem, PlannerConfig, Problems
from quad_swarm.planner.projection import project
from quad_swarm.quadrotor import POSITION, QuadrotorParams

_SMALL = 1e-9  # length of vectors without a direction (m)


class VoronoiCells(OptimalControlProblem):
    """The problem with cells instead of distances, ``planner.problem="voronoi"``: each body is a half-space that all
    stages stay out of. There is no repulsion.

    A half-space between two robots is at half of their present distance, where stage 0 is, less half of the separation.
    One beside an obstacle touches it, and moves along with it, since robots know its motion. All are soft, with the
    weight of other violations.

    Robots that are where their cell ends in the direction of their goal would wait there for each other forever. They
    make a detour to the right, as in the paper: as long as they are there, their goal seems to be to their right.

    :cvar buffer: what is added to half of the separation (m), for vehicles that cannot stop at once
    :cvar rest: weight of the squared velocity at the end of the horizon (s^2/m^2), so that plans end in their cell
        because they stop there
    :cvar detour: how far to the right the goals of robots that are stuck seem to be (m); 0 for no detours
    :cvar stuck: distance to the point of the cell that is nearest to the goal, within which robots are stuck (m)
    """

    buffer: ClassVar[float] = 0.0
    rest: ClassVar[float] = 0.05
    detour: ClassVar[float] = 2.0
    stuck: ClassVar[float] = 0.6

    def __init__(self, config: PlannerConfig, quadrotor: QuadrotorParams, n_others: int, shaped: bool = False):
        super().__init__(config, quadrotor, n_others, True)  # a half-space has a shape: its normal

    def goal_cost(self, x: ca.SX, x0: ca.SX, goal: ca.SX) -> ca.SX:
        """Return the terminal cost of the quadrotor, and that of its velocity."""
        return super().goal_cost(x, x0, goal) + self.rest * ca.sumsqr(x[3:6])

    def distances(self, x: ca.SX, others: ca.SX) -> list[ca.SX]:
        """Return how far positions are from planes (m). `shaped_distances` has multiplied the differences by the
        planes' normals, see `prepare`."""
        return [ca.sum1(x[:3] - others[:, j]) for j in range(self.n_others)]

    def repulsion_residual(self, distance: ca.SX) -> ca.SX:
        """Return 0: cells are enough."""
        return 0 * distance

    def prepare(self, problems: Problems) -> Problems:
        """Return the problems with a plane instead of each body: ``shape`` is its normal, towards the robot, and
        ``others`` a point on it, which the robot keeps away from by what it keeps from other robots."""
        if not self.n_others:
            return problems
        config = self.config
        factors = np.ones((*problems.others.shape[:2], 3)) if problems.shape is None else problems.shape
        size = np.zeros(problems.others.shape[:2]) if problems.size is None else problems.size
        robots = problems.robots(config.downwash)
        position, _ = problems.present(config.dt)
        between = factors * (problems.x[:, None, POSITION] - position)  # in the metric of its shape a body is a sphere
        distance = length(between)
        # Two robots in one place are apart along an axis, whatever others do
        normals = np.where((distance > _SMALL)[..., None], between, [1.0, 0.0, 0.0])
        normals /= np.maximum(length(normals), _SMALL)[..., None]
        # Solvers keep points a separation away from a plane, while cells end half a separation before the middle
        shift = np.where(robots, (distance - config.separation) / 2 + self.buffer, self.buffer)
        normals *= factors
        squared = np.maximum(dot(normals, normals), _SMALL**2)
        moved = (shift / squared)[..., None] * normals
        others = np.where(robots[..., None, None], position[:, :, None], problems.others) + moved[:, :, None]
        cells = problems._replace(others=others, shape=normals, size=np.where(robots, 0.0, size))
        return self._detoured(cells) if self.detour else cells

    def _detoured(self, cells: Problems) -> Problems:
        """Return the problems with the goals of robots that are stuck to their right."""
        config, position, goal = self.config, cells.x[:, POSITION], cells.goal
        assert cells.shape is not None
        assert cells.size is not None
        kept = config.separation + cells.size
        if cells.clearance is not None:
            kept = kept + cells.clearance[..., 0]
        lengths = np.maximum(length(cells.shape), _SMALL)
        offsets = (dot(cells.shape, cells.others[:, :, 0]) + kept) / lengths
        normals = cells.shape / lengths[..., None]
        # A robot outside of its cell takes the half-spaces for those through its place
        offsets = np.minimum(offsets, dot(normals, position[:, None]))
        nearest, _ = project(goal, normals, offsets)
        way = goal - position
        distance = length(way[:, :2] @ np.eye(2, 3))
        stuck = (length(nearest - position) < self.stuck) & (distance > self.stuck)
        if not stuck.any():
            return cells
        right = np.column_stack([way[:, 1], -way[:, 0], np.zeros(len(way))])
        aside = position + self.detour * right / np.maximum(distance, _SMALL)[:, None]
        return cells._replace(goal=np.where(stuck[:, None], aside, goal))
