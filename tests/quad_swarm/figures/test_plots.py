"""Figures of an evaluation: that they show the numbers of its rows and the path of its flight."""

import dataclasses
import subprocess
import sys

import matplotlib.colors
import numpy as np
import pytest
from matplotlib.container import BarContainer
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from PIL import Image

from quad_swarm.evaluation.flight import Condition, Flight, fly
from quad_swarm.figures import plots
from quad_swarm.figures.colours import colour_of
from quad_swarm.world.obstacles import Obstacle
from quad_swarm.world.presets import make_config


def row(scenario: str, policy: str, collisions: int, share: float) -> dict:
    """A row of 20 episodes."""
    bounds = {"collision_low": collisions / 40, "collision_high": collisions / 20 + 0.1}
    keys = {"scenario": scenario, "policy": policy, "collisions": collisions, "episodes": 20, "request_share": share}
    return keys | bounds


ROWS = [
    row("random", "none", 10, 0.0),
    row("random", "full", 0, 1.0),
    row("random", "cpa:1:1", 2, 0.2),
    row("random", "random:0.5", 4, 0.5),  # worse in both
    row("random_swap", "none", 20, 0.0),
    row("random_swap", "full", 1, 1.0),
    row("random_swap", "cpa:1:1", 3, 0.4),
    row("random_swap", "random:0.5", 5, 0.3),
]


@pytest.fixture(scope="module")
def flown() -> tuple[Condition, Flight]:
    condition = Condition("distance:2.5", "random_swap", make_config("paper"), max_steps=100)
    return condition, fly(condition, 0)


@pytest.mark.parametrize(
    ("draw", "height"),
    [
        (plots.draw_collisions, lambda one: one["collisions"] / one["episodes"]),
        (plots.draw_requests, lambda one: one["request_share"]),
    ],
    ids=["collisions", "requests"],
)
def test_bars_are_as_high_as_the_rows_say(draw, height):
    (axes,) = draw(ROWS).axes
    bars = {container.get_label(): container for container in axes.containers if len(container.get_label()) > 0}
    policies = list(dict.fromkeys(one["policy"] for one in ROWS))
    for policy in policies:
        expected = [height(one) for one in ROWS if one["policy"] == policy]
        assert [bar.get_height() for bar in bars[policy]] == expected
    assert [label.get_text() for label in axes.get_xticklabels()] == ["random", "random swap"]


def test_the_front_joins_policies_that_none_is_better_than_in_both():
    figure = plots.draw_front(ROWS)
    assert [axes.get_title("left") for axes in figure.axes] == ["random", "random swap"]
    fronts = [axes.lines[0].get_xydata().tolist() for axes in figure.axes]
    assert fronts == [[[0, 0.5], [0.2, 0.1], [1, 0]], [[0, 1.0], [0.3, 0.25], [0.4, 0.15], [1, 0.05]]]
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["none", "full", "cpa:1:1", "random:0.5"]


def test_a_flight_has_dots_where_a_robot_asks(flown):
    _, flight = flown
    axes = Figure().subplots()
    plots.draw_flight(axes, flight)
    asks = flight.requests.any(axis=2)
    assert 0 < asks.mean() < 1
    assert len(axes.collections) == len(flight.goal)
    for robot, points in enumerate(axes.collections):
        np.testing.assert_array_equal(points.get_offsets(), flight.state[:-1][asks[:, robot], robot, :2])
        if asks[:, robot].any():
            assert matplotlib.colors.to_hex(points.get_facecolor()[0]) == colour_of(robot).lower()
    path, start, goal = axes.lines[:3]
    np.testing.assert_array_equal(path.get_xydata(), flight.state[:, 0, :2])
    assert start.get_xydata()[0].tolist() == flight.state[0, 0, :2].tolist()
    assert goal.get_xydata()[0].tolist() == flight.goal[0, :2].tolist()


def test_a_panel_for_each_flight(flown):
    condition, flight = flown
    figure = plots.draw_flights([condition] * 3, [flight] * 3)
    assert [axes.get_visible() for axes in figure.axes] == [True, True, True, False]
    assert [axes.get_title("left") for axes in figure.axes[:3]] == ["random swap"] * 3
    (legend,) = figure.legends
    assert legend.get_title().get_text() == "distance:2.5"
    assert [text.get_text() for text in legend.get_texts()] == ["start", "goal", "asks somebody"]
    (legend,) = plots.draw_flights([condition], [flight], name="").legends
    assert legend.get_title().get_text() == ""


def test_announced_plans_are_no_requests_in_the_picture(flown):
    condition, flight = flown
    told = np.zeros_like(flight.requests)
    told[3, 1, 0] = told[5, 2, 1] = True  # robot 0 tells 1, and robot 1 tells 2
    figure = plots.draw_flights([condition], [dataclasses.replace(flight, requests=told, announced=told)])
    dots, squares = figure.axes[0].collections[::2], figure.axes[0].collections[1::2]
    assert not any(len(points.get_offsets()) for points in dots), "nobody asks"
    places = [points.get_offsets().tolist() for points in squares]
    assert places[0] == [flight.state[3, 0, :2].tolist()]
    assert places[1] == [flight.state[5, 1, :2].tolist()]
    assert not any(places[2:])
    assert [text.get_text() for text in figure.legends[0].get_texts()][-1] == "announces its plan"


def test_the_animation_ends_shortly_after_all_have_arrived(flown, tmp_path):
    condition, flight = flown
    assert flight.arrival is not None
    end = slice(flight.arrival - 2, None)  # to draw few frames
    flight = dataclasses.replace(
        flight, state=flight.state[end], plans=flight.plans[end], requests=flight.requests[end]
    )
    plots.animate(condition, flight, tmp_path / "swarm.gif")
    with Image.open(tmp_path / "swarm.gif") as film:
        duration = 0
        for frame in range(film.n_frames):
            film.seek(frame)
            duration += film.info["duration"]
    # Frames that look the same are stored as one that lasts longer
    assert duration == 100 * (flight.arrival + 9) < 100 * len(flight.requests)


@pytest.mark.parametrize("dt", [0.1, 0.05, 0.025, 0.03, 0.004])
def test_animations_play_in_real_time(dt, tmp_path):
    config = make_config(planner={"dt": dt, "horizon": max(10, round(0.75 / dt))}, max_steps=30)
    flight = fly(Condition("none", "symmetric_swap", config), seed=0)
    steps = len(flight.requests)
    plots.animate(Condition("none", "symmetric_swap", config), flight, tmp_path / "swarm.gif")
    durations = []
    with Image.open(tmp_path / "swarm.gif") as film:
        for frame in range(film.n_frames):
            film.seek(frame)
            durations.append(film.info["duration"])
    assert sum(durations) == pytest.approx(1000 * dt * steps, abs=5)  # to a hundredth of a second
    assert min(durations) >= 20


def test_drawing_leaves_the_backend_of_matplotlib_alone():
    code = (
        "import matplotlib; matplotlib.use('svg'); import quad_swarm.figures.plots, quad_swarm.figures.dashboard; "
        "assert matplotlib.get_backend() == 'svg'"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_obstacles_are_drawn_from_above_and_explained(flown):
    condition, flight = flown
    still, moving = Obstacle((0.5, 1.0, 0.0), 0.4), Obstacle((-1.0, 0.0, 1.0), 0.2, "sphere", (0.5, 0.0, 0.0))
    steps = np.arange(len(flight.state))[:, None, None]
    centres = np.array([one.position for one in (still, moving)]) + 0.1 * steps * [[0, 0, 0], [0.5, 0, 0]]
    flight = dataclasses.replace(
        flight, obstacles=(still, moving), obstacle_pos=centres, min_obstacle_distance=np.ones(len(steps))
    )
    figure = plots.draw_flights([condition], [flight])
    circles = [one for one in figure.axes[0].get_children() if isinstance(one, Circle)]
    assert flight.arrival is not None
    places = {(one.radius, *np.round(one.center, 6)) for one in circles}
    assert places == {(0.4, 0.5, 1.0), (0.2, round(-1 + 0.05 * flight.arrival, 6), 0.0)}, "at the end of the way"
    assert figure.legends[0].get_texts()[-1].get_text() == "obstacle, at the end of its way"
    alone = dataclasses.replace(flight, obstacles=(still,), obstacle_pos=centres[:, :1])
    assert plots.draw_flights([condition], [alone]).legends[0].get_texts()[-1].get_text() == "obstacle"


def test_collisions_with_obstacles_are_a_part_of_the_bars():
    rows = [
        one | ({"obstacle_collisions": one["collisions"] // 2} if one["scenario"] == "random" else {}) for one in ROWS
    ]
    (axes,) = plots.draw_collisions(rows).axes
    hatched = [bars for bars in axes.containers if isinstance(bars, BarContainer) and bars[0].get_hatch()]
    assert [[bar.get_height() for bar in bars] for bars in hatched] == [[0.25, 0], [0, 0], [0.05, 0], [0.1, 0]]
    assert axes.get_legend().get_texts()[-1].get_text() == "with an obstacle"
    assert len(plots.draw_collisions(ROWS).axes[0].get_legend().get_texts()) == 4
