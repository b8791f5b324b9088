"""Pictures of the swarm, off-screen and in a window."""

import time

import gymnasium
import numpy as np
import pygame
import pytest

from quad_swarm.figures.render import _COLLISION, _NEAR, Renderer, _Camera, _rotation
from quad_swarm.interfaces.env import QuadSwarmEnv
from quad_swarm.world.presets import make_config

CONFIG = make_config("paper", n_robots=2)


def scene(gap: float = 4.0) -> tuple:
    """State, goals, plans and requests of two robots at rest, ``gap`` apart (m)."""
    state = np.zeros((2, 9))
    state[:, :3] = [[-gap / 2, 0, 1], [gap / 2, 0, 1]]
    plans = np.repeat(state[:, None], CONFIG.planner.horizon + 1, axis=1)
    return state, np.array([[0.0, 2, 1], [0, -2, 1]]), plans, np.zeros((2, 1), bool)


def pixels_of(picture: np.ndarray, colour: str) -> int:
    return int((picture == np.array(pygame.Color(colour))[:3]).all(axis=-1).sum())


def test_a_step_drawn_twice_leaves_the_same_picture():
    renderer = Renderer(CONFIG)
    state, *rest = scene()
    first = renderer.draw(state, *rest, [])
    assert np.array_equal(renderer.draw(state, *rest, []), first)
    moved = state + np.eye(9)[1]
    trail = renderer.draw(moved, *rest, [])
    assert not np.array_equal(trail, first)
    renderer.reset()
    alone = renderer.draw(moved, *rest, [])
    assert not np.array_equal(alone, trail), "the trail and the view are those of the new episode"
    assert np.array_equal(Renderer(CONFIG).draw(moved, *rest, []), alone)


def test_requests_and_text_are_drawn():
    plain = Renderer(CONFIG).draw(*scene(), [])
    state, goal, plans, requests = scene()
    one = Renderer(CONFIG).draw(state, goal, plans, np.array([[True], [False]]), [])
    other = Renderer(CONFIG).draw(state, goal, plans, np.array([[False], [True]]), [])
    assert (one != plain).any()
    assert (other != plain).any()
    assert (one != other).any(), "arrows show who asks"
    text = Renderer(CONFIG).draw(state, goal, plans, requests, ["step 1"])
    rows, columns = np.nonzero((text != plain).any(axis=-1))
    assert rows.max() < 30
    assert columns.max() < 100


@pytest.mark.parametrize(("distance", "ring"), [(1.15, None), (1.05, _NEAR), (0.98, _COLLISION)])
def test_robots_that_nearly_touch_wear_an_amber_ring_and_those_that_collide_a_red_one(distance, ring):
    config = make_config("flight", n_robots=CONFIG.n_robots)  # where the planner keeps far more than contact
    picture = Renderer(config).draw(*scene(2 * distance * config.radius), [])
    for colour in (_NEAR, _COLLISION):
        assert (pixels_of(picture, colour) > 20) == (colour == ring)


def test_the_camera_sees_all_from_above():
    points = np.random.default_rng(0).uniform([-4, -4, 0.5], [4, 4, 2.4], (50, 3))
    camera = _Camera(points, (640, 480))
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    np.testing.assert_allclose(camera.project(middle[None]), [[320, 240]], atol=1e-9)
    screen = camera.project(points)
    assert (screen > 0).all()
    assert (screen < [640, 480]).all()
    higher = camera.project(middle[None] + [0, 0, 0.5])
    assert higher[0, 1] < 240, "up is up"
    assert (camera.depth(points) > 0).all()


def test_roll_pitch_and_yaw_turn_about_their_axes():
    quarter = np.pi / 2
    np.testing.assert_allclose(_rotation(0, 0, quarter) @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(_rotation(quarter, 0, 0) @ [0, 1, 0], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(_rotation(0, quarter, 0) @ [0, 0, 1], [1, 0, 0], atol=1e-12)
    turned = _rotation(0.1, 0.2, 0.3)
    np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turned) == pytest.approx(1)


def test_pictures_show_the_swarm():
    env = gymnasium.make("QuadSwarm-v0", render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render()
    for _ in range(10):
        env.step(np.ones(12, dtype=np.int8))
    after = env.render()
    assert before.shape == after.shape == (480, 640, 3)
    assert before.dtype == np.uint8
    assert len(np.unique(after.reshape(-1, 3), axis=0)) > 50
    assert (before != after).any(axis=-1).mean() > 0.005
    with pytest.raises(ValueError, match="render_mode='rgb_array'"):
        QuadSwarmEnv().render()


def test_a_window_shows_every_step(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "none such")
    with pytest.raises(gymnasium.error.Error, match="rgb_array"):
        gymnasium.make("QuadSwarm-v0", render_mode="human").reset(seed=0)
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gymnasium.make("QuadSwarm-v0", render_mode="human")
    env.reset(seed=0)
    first = pygame.surfarray.array3d(pygame.display.get_surface())
    started = time.perf_counter()
    for _ in range(5):
        env.step(np.ones(12, dtype=np.int8))
    assert time.perf_counter() - started > 0.3, "ten steps a second"
    assert (pygame.surfarray.array3d(pygame.display.get_surface()) != first).any()
    assert env.render() is None
    env.close()
    assert pygame.display.get_surface() is None
