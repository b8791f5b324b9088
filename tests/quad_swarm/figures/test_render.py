"""Pictures of the swarm, off-screen and in a window."""

import time

import gymnasium
import numpy as np
import pygame
import pytest

from quad_swarm.figures.colours import colour_of
from quad_swarm.figures.render import _COLLISION, _NEAR, Renderer, _Camera, _circle, _rotation
from quad_swarm.interfaces.env import QuadSwarmEnv
from quad_swarm.world.obstacles import Obstacle
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


def seen(obstacles: list[Obstacle], config=CONFIG, gap: float = 4.0) -> np.ndarray:
    return Renderer(config).draw(*scene(gap), [], obstacles)


def changed(one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.nonzero((one != other).any(axis=-1))


def test_obstacles_are_drawn_where_they_are():
    """Far from robots, and moving, so that the view is the same without them."""
    plain = seen([])
    camera = _Camera(np.array([[-2, 0, 1], [2, 0, 1], [0, 2, 1], [0, -2, 1.0]]), (640, 480))
    for x in (-1.0, 1.0):
        ball = Obstacle((x, 0.0, 1.2), 0.3, "sphere", (0.1, 0.0, 0.0))
        rows, columns = changed(seen([ball]), plain)
        middle = camera.project(np.array([ball.position]))[0]
        rim = camera.silhouette(np.array(ball.position), np.full(3, 0.3))
        shadow = camera.project(_circle(np.array([x, 0.0, 0.0]), 0.3))
        assert columns.min() == pytest.approx(min(rim[:, 0].min(), shadow[:, 0].min()), abs=2)
        assert columns.max() == pytest.approx(max(rim[:, 0].max(), shadow[:, 0].max()), abs=2)
        assert rows.min() == pytest.approx(rim[:, 1].min(), abs=2)
        assert (np.hypot(rows - middle[1], columns - middle[0]) < 3).any()
    pillar = Obstacle((0.0, 0.0, 7.0), 0.25, velocity=(0.1, 0.0, 0.0))
    rows, columns = changed(seen([pillar]), plain)
    foot, above = camera.project(np.array([[0, 0, 0], [0, 0, 2.0]]))
    assert rows.max() == pytest.approx(foot[1], abs=30)
    assert rows.min() == pytest.approx(above[1], abs=40), "it fades out above the robots"
    assert abs(columns.mean() - foot[0]) < 10


def test_what_is_behind_an_obstacle_is_drawn_behind_it():
    camera = _Camera(np.array([[-2, 0, 1], [2, 0, 1], [0, 2, 1], [0, -2, 1.0]]), (640, 480))
    robot = scene()[0][1, :3]
    x, y = camera.project(robot[None])[0].round().astype(int)
    around = slice(y - 25, y + 26), slice(x - 25, x + 26)
    towards = -np.cross([0.0, 0.0, 1.0], camera.right)
    moves = {"velocity": (0.1, 0.0, 0.0)}
    before, behind = (Obstacle(tuple(robot + side * towards), 0.2, **moves) for side in (0.4, -0.4))
    plain = pixels_of(seen([])[around], colour_of(1))
    assert plain > 50
    assert pixels_of(seen([behind])[around], colour_of(1)) == plain
    assert pixels_of(seen([before])[around], colour_of(1)) < 0.5 * plain


@pytest.mark.parametrize(("gap", "ring"), [(0.2, None), (0.02, _NEAR), (-0.02, _COLLISION)])
def test_contact_with_an_obstacle_wears_the_rings_of_contact(gap, ring):
    config = make_config("flight", n_robots=2)
    beside = Obstacle((2 + config.radius + gap + 0.5, 0.0, 0.0), 0.5)
    picture = seen([beside], config)
    for colour in (_NEAR, _COLLISION):
        assert (pixels_of(picture, colour) > 20) == (colour == ring)


def test_with_downwash_robots_wear_the_ellipsoids_that_collide():
    config = make_config("flight", n_robots=2, planner={"downwash": 2.0})
    state, *rest = scene(0.0)
    for apart, ring in ((2.1, _NEAR), (1.9, _COLLISION)):
        state[1, 2] = state[0, 2] + 2 * apart * config.radius
        picture = Renderer(config).draw(state, *rest, [])
        rows, _ = np.nonzero((picture == np.array(pygame.Color(ring))[:3]).all(axis=-1))
        assert np.ptp(rows) > 100, "outlines that are twice as high as wide"


def test_an_environment_draws_its_obstacles():
    world = {"obstacles": {"listed": [{"position": [0, 0, 0], "radius": 0.5}]}}
    shots = []
    for more in ({}, {"world": world}):
        env = gymnasium.make(
            "QuadSwarm-v0", render_mode="rgb_array", scenario="symmetric_swap", preset="flight", **more
        )
        env.reset(seed=0)
        shots.append(env.render())
        env.close()
    assert (shots[0] != shots[1]).any(axis=-1).mean() > 0.01


def test_unlike_robots_are_drawn_with_their_own_radii():
    state, *rest = scene(0.9)
    seen = {}
    for radii in ((0.3, 0.3), (0.3, 0.6), (0.5, 0.5)):
        config = make_config("paper", {"vehicles": [{"radius": one} for one in radii]}, n_robots=2)
        seen[radii] = Renderer(config).draw(state, *rest, [])
        ring = {0.6: None, 0.9: _NEAR, 1.0: _COLLISION}[round(sum(radii), 1)]
        for colour in (_NEAR, _COLLISION):
            assert (pixels_of(seen[radii], colour) > 0) == (colour == ring)
    assert pixels_of(seen[0.3, 0.6], _NEAR) > 0
    assert np.array_equal(seen[0.3, 0.3], Renderer(CONFIG).draw(state, *rest, []))
