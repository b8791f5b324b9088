"""Rendering of a swarm with pygame, off-screen or in a window: robots, goals, trails, plans, requests and obstacles.

Robots that almost touch (up to a tenth above contact) wear amber rings, those that collide red ones. With downwash, the
rings are the outlines of the ellipsoids around robots.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Sequence

import gymnasium
import numpy as np
import pygame

from quad_swarm.figures.colours import OBSTACLE, OUTLINE, colour_of
from quad_swarm.geometry import flattened, length
from quad_swarm.quadrotor import POSITION
from quad_swarm.world.beliefs import other_indices
from quad_swarm.world.obstacles import Obstacle, clearances, surroundings
from quad_swarm.world.presets import SwarmConfig

_BACKGROUND, _GRID, _INK, _REQUEST = "#FAFAFA", "#D9D9D9", "#333333", "#555555"
_NEAR, _COLLISION = "#F0A000", "#D50000"
_TRAIL_STEPS = 40
_OPACITY, _FADE = 0.75, 10  # of obstacles; bands in which a pillar fades out
_OPEN = 1.0  # m above starts and goals in which it does


class Renderer:
    """Renderer of a swarm.

    :param config: the world
    :param size: width and height of the image (pixels)
    :param scale: how many times as wide lines, and as high texts, are as in an image of 640 by 480 pixels
    """

    def __init__(self, config: SwarmConfig, size: tuple[int, int] = (640, 480), scale: int = 1):
        pygame.font.init()
        self.config = config
        self.size = size
        self.scale = scale
        self._surface = pygame.Surface(size)
        self._font = pygame.font.Font(None, 22 * scale)
        self._others = other_indices(config.n_robots)
        self._trail: deque[np.ndarray] = deque(maxlen=_TRAIL_STEPS)
        self._camera: _Camera | None = None
        self._window: pygame.Surface | None = None
        self._clock = pygame.time.Clock()

    def reset(self) -> None:
        """Start a new episode: clear the trails and reset the camera."""
        self._trail.clear()
        self._camera = None

    def draw(
        self,
        state: np.ndarray,
        goal: np.ndarray,
        plans: np.ndarray,
        requests: np.ndarray,
        lines: list[str],
        obstacles: Sequence[Obstacle] = (),
    ) -> np.ndarray:
        """Draw one step.

        :param state: states, (n, 9)
        :param goal: goals, (n, 3), world frame (m)
        :param plans: planned states, (n, N + 1, 9)
        :param requests: whose plans each robot requested, (n, n - 1) bool
        :param lines: text to show in the corner
        :param obstacles: the obstacles, where they are now
        :return: the image, (height, width, 3) uint8
        """
        pos = state[:, POSITION]
        if self._camera is None:
            self._camera = _Camera(np.vstack([pos, goal, _around(obstacles, np.vstack([pos, goal]))]), self.size)
            self._top = max(pos[:, 2].max(), goal[:, 2].max()) + _OPEN
        if not self._trail or not np.array_equal(self._trail[-1], pos):  # drawing a step twice adds nothing
            self._trail.append(pos.copy())
        self._surface.fill(_BACKGROUND)
        self._draw_floor()
        strokes = []
        for i in range(len(pos)):
            colour = colour_of(i)
            strokes.append((np.array([step[i] for step in self._trail]), _blend(colour, 0.5), 2))
            strokes.append((plans[i, :, POSITION], pygame.Color(colour), 1))
            strokes.append((_circle(goal[i], self.config.goal_radius), pygame.Color(colour), 2))
        # From the back to the front: what is behind an obstacle is drawn before it
        far = self._camera.away(np.array([one.position for one in obstacles]).reshape(-1, 3))
        order, away, depth = np.argsort(-far), self._camera.away(pos), self._camera.depth(pos)
        for k, (behind, before) in enumerate(itertools.pairwise([np.inf, *far[order], -np.inf])):
            for points, paint, width in strokes:
                self._layer(points, paint, width, behind, before)
            if k == len(obstacles):
                self._draw_requests(pos, requests)
                self._draw_near_misses(pos, obstacles)
            for i in np.argsort(-depth):
                if before < away[i] <= behind:
                    self._draw_robot(state[i], i)
            if k < len(obstacles):
                self._draw_obstacle(obstacles[order[k]])
        for row, line in enumerate(lines):
            place = (10 * self.scale, (8 + 18 * row) * self.scale)
            self._surface.blit(self._font.render(line, True, _INK), place)
        pixels = np.frombuffer(pygame.image.tobytes(self._surface, "RGB"), np.uint8)
        return pixels.reshape(self.size[1], self.size[0], 3).copy()

    def show(self, fps: float) -> None:
        """Show the last image in a window, with at most ``fps`` images per second.

        :raises gymnasium.error.Error: if no window can be opened
        """
        if self._window is None:
            self._window = _open_window(self.size)
        pygame.event.pump()
        self._window.blit(self._surface, (0, 0))
        pygame.display.flip()
        self._clock.tick(fps)

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            pygame.display.quit()
            self._window = None

    def _draw_floor(self) -> None:
        low, high = np.array(self.config.planner.workspace_low), np.array(self.config.planner.workspace_high)
        for axis in (0, 1):
            for value in np.linspace(low[axis], high[axis], 9):
                ends = np.array([low, high])
                ends[:, axis], ends[:, 2] = value, 0.0
                self._polyline(ends, _GRID, 1)

    def _draw_requests(self, pos: np.ndarray, requests: np.ndarray) -> None:
        """Draw arrows from robots to those whose plans they request."""
        for i, k in zip(*np.nonzero(requests), strict=True):
            start, end = self._project(pos[[i, self._others[i, k]]])
            length = np.hypot(*(end - start))
            if length < 1e-6:
                continue
            along = (end - start) / length
            across = np.array([-along[1], along[0]])
            # Beside the line between the two, so that mutual requests do not overlap
            along, across = along * self.scale, across * self.scale
            start, end = start + 12 * along + 3 * across, end - 14 * along + 3 * across
            self._thin_line(_REQUEST, start, end)
            pygame.draw.polygon(
                self._surface, _REQUEST, [end, end - 8 * along + 4 * across, end - 8 * along - 4 * across]
            )

    def _draw_near_misses(self, pos: np.ndarray, obstacles: Sequence[Obstacle]) -> None:
        assert self._camera is not None
        downwash, contact = self.config.planner.downwash, 2 * self.config.radius
        distance = length(flattened(pos[:, None] - pos, downwash)) + np.diag(np.full(len(pos), np.inf))
        if self.config.excess is not None:
            distance = distance - self.config.excess
        gaps = distance.min(axis=1) - contact
        if obstacles:
            gaps = np.minimum(gaps, clearances(pos, surroundings(obstacles)).min(axis=1) - self.config.radii)
        for i, gap in enumerate(gaps):
            colour = _COLLISION if gap < -self.config.collision_tolerance else _NEAR if gap < 0.1 * contact else None
            if downwash != 1:
                axes = self.config.radii[i] * np.array([1.0, 1.0, downwash])
                rim = self._camera.silhouette(pos[i], axes)
                width = (2 if colour else 1) * self.scale
                pygame.draw.lines(self._surface, colour or _blend(colour_of(i), 0.5), True, rim, width)
            elif colour:
                self._ring(pos[i], self.config.radii[i], colour)

    def _draw_robot(self, state: np.ndarray, i: int) -> None:
        colour = colour_of(i)
        p, (phi, theta, psi) = state[POSITION], state[6:9]
        arm = 0.6 * self.config.radii[i]
        rotation = _rotation(phi, theta, psi)
        tips = p + arm * (rotation @ np.array([[1, -1, 1, -1], [1, -1, -1, 1], [0, 0, 0, 0]], float)).T
        screen = self._project(np.vstack([tips, p, p * (1, 1, 0)]))
        self._thin_line(_GRID, screen[4], screen[5])
        pygame.draw.line(self._surface, _INK, screen[0], screen[1], 2 * self.scale)
        pygame.draw.line(self._surface, _INK, screen[2], screen[3], 2 * self.scale)
        for tip in screen[[0, 3]]:  # the two front rotors (+x) are lighter: they show the heading
            pygame.draw.circle(self._surface, _blend(colour, 0.4), tip, 5 * self.scale)
        for tip in screen[[1, 2]]:
            pygame.draw.circle(self._surface, colour, tip, 5 * self.scale)
        label = self._font.render(str(i), True, colour)
        self._surface.blit(label, screen[4] + np.array([8, -20]) * self.scale)

    def _draw_obstacle(self, obstacle: Obstacle) -> None:
        """Draw an obstacle, behind which things show faintly. A pillar is as high as the world: it fades out above the
        robots."""
        assert self._camera is not None
        centre, radius = np.array(obstacle.position), obstacle.radius
        foot = _circle(centre * (1, 1, 0), radius, 49)
        if (self._camera.depth(np.vstack([foot, centre])) < 1.5 * radius).any():
            return  # beside or behind the camera
        layer = pygame.Surface(self.size, pygame.SRCALPHA)
        inside, outline = (pygame.Color(colour) for colour in (OBSTACLE, OUTLINE))
        if obstacle.shape == "sphere":
            pygame.draw.polygon(layer, _clear(inside, 0.3), self._project(foot))  # its shadow
            rim = self._camera.silhouette(centre, np.full(3, radius))
            pygame.draw.polygon(layer, _clear(inside, _OPACITY), rim)
            pygame.draw.aalines(layer, outline, True, rim)
        else:
            screen = self._project(foot[:-1])
            front = screen[self._camera.away(foot[:-1]) <= self._camera.away(foot).mean()]
            front = front[np.argsort(front[:, 0])]
            sides = centre + radius * np.outer([-1, 1], self._camera.right)
            heights = [0.0, *np.linspace(self._top - _OPEN, self._top, _FADE + 1)]
            edges = [self._project(np.column_stack([sides[:, :2], [height] * 2])) for height in heights]
            edges[0] = front
            for k, (low, high) in enumerate(itertools.pairwise(edges)):
                left = 1 - k / (_FADE + 1)
                pygame.draw.polygon(layer, _clear(inside, left * _OPACITY), [*low, *high[::-1]])
                for side in (0, -1):
                    pygame.draw.line(layer, _clear(outline, left), low[side], high[side], self.scale)
            pygame.draw.aalines(layer, outline, False, front)
        self._surface.blit(layer, (0, 0))

    def _layer(self, points: np.ndarray, colour: pygame.Color, width: int, far: float, near: float) -> None:
        """Draw the part of a polyline that is between two distances, see `_Camera.away`."""
        assert self._camera is not None
        away, screen = self._camera.away((points[:-1] + points[1:]) / 2), self._project(points)
        for k in np.flatnonzero((near < away) & (away <= far)):
            pygame.draw.line(self._surface, colour, screen[k], screen[k + 1], width * self.scale)

    def _project(self, points: np.ndarray) -> np.ndarray:
        assert self._camera is not None
        return self._camera.project(points)

    def _polyline(self, points: np.ndarray, colour: str | pygame.Color, width: int) -> None:
        if len(points) > 1:
            pygame.draw.lines(self._surface, colour, False, self._project(points), width * self.scale)

    def _thin_line(self, colour: str, start: np.ndarray, end: np.ndarray) -> None:
        """Draw an antialiased line; those that are wider are smooth once the image is reduced."""
        if self.scale == 1:
            pygame.draw.aaline(self._surface, colour, start, end)
        else:
            pygame.draw.line(self._surface, colour, start, end, self.scale)

    def _ring(self, centre: np.ndarray, radius: float, colour: str) -> None:
        self._polyline(_circle(centre, radius), colour, 2)


def _open_window(size: tuple[int, int]) -> pygame.Surface:
    try:
        pygame.display.init()
        window = pygame.display.set_mode(size)
    except pygame.error as error:
        raise gymnasium.error.Error(
            f"render_mode='human' cannot open a window ({error}). render_mode='rgb_array' needs no display; on the "
            "command line use `enjoy --no-render`, `record` for a video or `replay` for a web page."
        ) from error
    pygame.display.set_caption("QuadSwarm")
    return window


class _Camera:
    """Pinhole camera that looks from above at the centre of some points, from far enough away to see all of them."""

    def __init__(self, points: np.ndarray, size: tuple[int, int], azimuth: float = -1.1, elevation: float = 0.65):
        low, high = points.min(axis=0), points.max(axis=0)
        distance = 1.5 * max(3.0, float(np.linalg.norm(high - low)))
        toward = -np.array(
            [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
        )
        right = np.cross(toward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        self._axes = np.stack([right, np.cross(toward, right), toward])  # right, down, forward
        self._eye = (low + high) / 2 - distance * toward
        self._focal = 1.25 * size[0]
        self._middle = np.array(size) / 2

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Return the distances along the line of sight, (K,) (m)."""
        return (points - self._eye) @ self._axes[2]

    def away(self, points: np.ndarray) -> np.ndarray:
        """Return the level distances in the direction of sight, (K,) (m), which order what stands on the floor."""
        return (points - self._eye)[:, :2] @ (self._axes[2, :2] / np.hypot(*self._axes[2, :2]))

    @property
    def right(self) -> np.ndarray:
        """Direction that is to the right in the picture, (3,), world frame; it is level."""
        return self._axes[0]

    def silhouette(self, centre: np.ndarray, axes: np.ndarray) -> np.ndarray:
        """Return the outline of an ellipsoid in the image, (48, 2) (pixels).

        :param centre: its centre, (3,) (m)
        :param axes: half of its axes along x, y and z, (3,) (m)
        """
        eye = (self._eye - centre) / axes  # where it is the unit sphere
        squared = float(eye @ eye)
        one = np.cross(eye, [0.0, 0.0, 1.0])
        one /= length(one)
        other = np.cross(eye, one) / np.sqrt(squared)
        angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)[:, None]
        rim = eye / squared + np.sqrt(1 - 1 / squared) * (np.cos(angle) * one + np.sin(angle) * other)
        return self.project(centre + axes * rim)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Project points, (K, 3), world frame (m), to the image, (K, 2) (pixels)."""
        camera = (points - self._eye) @ self._axes.T
        return self._middle + self._focal * camera[:, :2] / camera[:, 2:]


def _around(obstacles: Sequence[Obstacle], points: np.ndarray) -> np.ndarray:
    """Return what should be seen of obstacles that stand between some points or near them, (K, 3) (m)."""
    feet = [_circle(np.array(one.position) * (1, 1, 0), one.radius) for one in obstacles if not one.moves]
    room = np.array([1.0, 1.0, 0.0])
    low, high = points.min(axis=0) * (1, 1, 0) - room, points.max(axis=0) + room
    return np.clip(np.reshape(feet, (-1, 3)), low, high)


def _circle(centre: np.ndarray, radius: float, count: int = 25) -> np.ndarray:
    """Return points of a level circle, (count, 3) (m), the last of which is the first."""
    angle = np.linspace(0, 2 * np.pi, count)
    return centre + radius * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)


def _rotation(phi: float, theta: float, psi: float) -> np.ndarray:
    """Return the rotation matrix of roll, pitch and yaw (rad)."""
    (cf, sf), (ct, st), (cp, sp) = ((np.cos(a), np.sin(a)) for a in (phi, theta, psi))
    return np.array(
        [
            [cp * ct, cp * st * sf - sp * cf, cp * st * cf + sp * sf],
            [sp * ct, sp * st * sf + cp * cf, sp * st * cf - cp * sf],
            [-st, ct * sf, ct * cf],
        ]
    )


def _clear(colour: pygame.Color, opacity: float) -> pygame.Color:
    """Return a colour through which what is behind it shows; 1 is opaque."""
    return pygame.Color(colour.r, colour.g, colour.b, round(255 * opacity))


def _blend(colour: str, amount: float) -> pygame.Color:
    """Lighten a colour by ``amount`` in [0, 1]."""
    return pygame.Color(colour).lerp(pygame.Color("white"), amount)
