"""Rendering of a swarm with pygame, off-screen or in a window: robots, goals, trails, plans and requests, with rings
around robots that almost touch (amber; up to a tenth above contact) or collide (red)."""

from __future__ import annotations

from collections import deque

import gymnasium
import numpy as np
import pygame

from quad_swarm.figures.colours import colour_of
from quad_swarm.quadrotor import POSITION
from quad_swarm.world.beliefs import other_indices
from quad_swarm.world.presets import SwarmConfig

_BACKGROUND, _GRID, _INK, _REQUEST = "#FAFAFA", "#D9D9D9", "#333333", "#555555"
_NEAR, _COLLISION = "#F0A000", "#D50000"
_TRAIL_STEPS = 40


class Renderer:
    """Renderer of a swarm.

    :param config: the world
    :param size: width and height of the image (pixels)
    """

    def __init__(self, config: SwarmConfig, size: tuple[int, int] = (640, 480)):
        pygame.font.init()
        self.config = config
        self.size = size
        self._surface = pygame.Surface(size)
        self._font = pygame.font.Font(None, 22)
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
        self, state: np.ndarray, goal: np.ndarray, plans: np.ndarray, requests: np.ndarray, lines: list[str]
    ) -> np.ndarray:
        """Draw one step.

        :param state: states, (n, 9)
        :param goal: goals, (n, 3), world frame (m)
        :param plans: planned states, (n, N + 1, 9)
        :param requests: whose plans each robot requested, (n, n - 1) bool
        :param lines: text to show in the corner
        :return: the image, (height, width, 3) uint8
        """
        pos = state[:, POSITION]
        if self._camera is None:
            self._camera = _Camera(np.vstack([pos, goal]), self.size)
        if not self._trail or not np.array_equal(self._trail[-1], pos):  # drawing a step twice adds nothing
            self._trail.append(pos.copy())
        self._surface.fill(_BACKGROUND)
        self._draw_floor()
        for i in range(len(pos)):
            colour = colour_of(i)
            self._polyline(np.array([step[i] for step in self._trail]), _blend(colour, 0.5), 2)
            self._polyline(plans[i, :, POSITION], colour, 1)
            self._ring(goal[i], self.config.goal_radius, colour)
        self._draw_requests(pos, requests)
        self._draw_near_misses(pos)
        self._draw_robots(state)
        for row, line in enumerate(lines):
            self._surface.blit(self._font.render(line, True, _INK), (10, 8 + 18 * row))
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
            start, end = start + 12 * along + 3 * across, end - 14 * along + 3 * across
            pygame.draw.aaline(self._surface, _REQUEST, start, end)
            pygame.draw.polygon(
                self._surface, _REQUEST, [end, end - 8 * along + 4 * across, end - 8 * along - 4 * across]
            )

    def _draw_near_misses(self, pos: np.ndarray) -> None:
        distance = np.linalg.norm(pos[:, None] - pos[None], axis=-1) + np.diag(np.full(len(pos), np.inf))
        contact = 2 * self.config.radius
        for i, nearest in enumerate(distance.min(axis=1)):
            if nearest < 1.1 * contact:
                collides = nearest < contact - self.config.collision_tolerance
                self._ring(pos[i], self.config.radius, _COLLISION if collides else _NEAR)

    def _draw_robots(self, state: np.ndarray) -> None:
        assert self._camera is not None
        depth = self._camera.depth(state[:, POSITION])
        for i in np.argsort(-depth):
            colour = colour_of(i)
            p, (phi, theta, psi) = state[i, POSITION], state[i, 6:9]
            arm = 0.6 * self.config.radius
            rotation = _rotation(phi, theta, psi)
            tips = p + arm * (rotation @ np.array([[1, -1, 1, -1], [1, -1, -1, 1], [0, 0, 0, 0]], float)).T
            screen = self._project(np.vstack([tips, p, p * (1, 1, 0)]))
            pygame.draw.aaline(self._surface, _GRID, screen[4], screen[5])
            pygame.draw.line(self._surface, _INK, screen[0], screen[1], 2)
            pygame.draw.line(self._surface, _INK, screen[2], screen[3], 2)
            for tip in screen[[0, 3]]:  # the two front rotors (+x) are lighter: they show the heading
                pygame.draw.circle(self._surface, _blend(colour, 0.4), tip, 5)
            for tip in screen[[1, 2]]:
                pygame.draw.circle(self._surface, colour, tip, 5)
            label = self._font.render(str(i), True, colour)
            self._surface.blit(label, screen[4] + (8, -20))

    def _project(self, points: np.ndarray) -> np.ndarray:
        assert self._camera is not None
        return self._camera.project(points)

    def _polyline(self, points: np.ndarray, colour: str | pygame.Color, width: int) -> None:
        if len(points) > 1:
            pygame.draw.lines(self._surface, colour, False, self._project(points), width)

    def _ring(self, centre: np.ndarray, radius: float, colour: str) -> None:
        angle = np.linspace(0, 2 * np.pi, 25)
        circle = centre + radius * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
        self._polyline(circle, colour, 2)


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

    def project(self, points: np.ndarray) -> np.ndarray:
        """Project points, (K, 3), world frame (m), to the image, (K, 2) (pixels)."""
        camera = (points - self._eye) @ self._axes.T
        return self._middle + self._focal * camera[:, :2] / camera[:, 2:]


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


def _blend(colour: str, amount: float) -> pygame.Color:
    """Lighten a colour by ``amount`` in [0, 1]."""
    return pygame.Color(colour).lerp(pygame.Color("white"), amount)
