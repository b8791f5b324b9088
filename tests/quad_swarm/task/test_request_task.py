"""The arguments of a task. What it does is tested through the environments, tests/quad_swarm/interfaces/."""

import pytest

from quad_swarm.task.request_task import RewardConfig, make_task


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"max_steps": float("nan")}, "max_steps=nan: it must be a finite number"),
        ({"max_steps": 0}, "max_steps=0: it must be greater than 0"),
        ({"n_swarms": 0}, "n_swarms=0"),
        ({"n_robots": 1}, "n_robots=1: it must be greater than or equal to 2"),
        ({"scale_observation": 5}, "scale_observation=5: it must be a valid boolean"),
        ({"end_at_arrival": "perhaps"}, "end_at_arrival='perhaps': it must be a valid boolean"),
        ({"scenario": 5}, "scenario=5: it must be a valid string or it must be a valid mapping"),
        ({"scenario": {"random": "often"}}, "scenario=.*'often'"),
        ({"observation": 5}, "observation=5: it must be a valid string"),
        ({"observation": "state", "scale_observation": True}, "observation='state' is scaled already"),
        ({"preset": []}, r"preset=\[\]: it must be a valid string"),
        ({"solver": 5}, "solver=5: it must be a valid string"),
        ({"memory": -1.0}, r"memory=-1\.0: it must be greater than or equal to 0"),
        ({"noise": -1}, "noise=-1: it must be a valid mapping"),
        ({"world": 5}, "world=5: it must be a valid mapping"),
        ({"world": {"n_robots": 3}, "n_robots": 4}, "n_robots is given twice"),
        ({"sceanrio": "random"}, "Unknown argument 'sceanrio'.*Did you mean 'scenario'"),
        ({"reward": 5}, "reward=5: it must be a valid mapping"),
        ({"reward": {"gaol": 1}}, "Unknown reward parameter 'gaol'.*Did you mean 'goal'"),
        ({"reward": {"collision": -150}}, r"reward\.collision=-150: it must be greater than or equal to 0"),
        ({"reward": {"near_miss_width": 0}}, r"reward\.near_miss_width=0: it must be greater than 0"),
        ({"reward": {"near_miss_ahead": -1}}, r"reward\.near_miss_ahead=-1"),
        ({"reward": {"near_miss_ahead": 10}}, r"reward\.near_miss_ahead=10: plans reach .* 9 steps"),
    ],
)
def test_nonsense_is_refused_in_one_line(arguments, message):
    with pytest.raises(ValueError, match=message) as caught:
        make_task(**arguments)
    assert "\n" not in str(caught.value)


def test_texts_are_read_as_what_they_stand_for():
    task = make_task(max_steps="10", continuous_collisions="false", end_at_arrival="true", n_robots="3")
    assert (task.max_steps, task.continuous_collisions, task.end_at_arrival) == (10, False, True)
    assert task.swarm.config.n_robots == 3


def test_near_misses_may_look_ahead_to_the_end_of_the_plans():
    task = make_task(reward={"near_miss": 1.0, "near_miss_ahead": 9})
    assert task.swarm.planned_separation(task.reward.near_miss_ahead).shape == (1, 4, 3, 9)


def test_a_world_reaches_every_field():
    task = make_task(world={"radius": 0.12, "goal_radius": 0.2, "quadrotor": {"drag_x": 0.1}})
    config = task.swarm.config
    assert (config.radius, config.goal_radius, config.quadrotor.drag_x) == (0.12, 0.2, 0.1)
    assert config.planner.separation == 0.24


def test_rewards_are_checked_wherever_they_are_made():
    with pytest.raises(ValueError, match=r"^near_miss_width=0: it must be greater than 0"):
        RewardConfig(near_miss_width=0)
