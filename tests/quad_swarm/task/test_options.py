"""The arguments of the environments: the same for each, and each explained."""

import dataclasses
import inspect
import re

import pytest

from quad_swarm.interfaces.env import QuadSwarmEnv
from quad_swarm.task.options import TaskOptions
from quad_swarm.task.request_task import make_task, task_of

FIELDS = {field.name: field.default for field in dataclasses.fields(TaskOptions)}


@pytest.mark.parametrize(
    ("function", "own"), [(QuadSwarmEnv, {"render_mode": None}), (make_task, {"n_swarms": 1})], ids=["env", "task"]
)
def test_they_are_the_arguments_of_environments(function, own):
    found = {name: one.default for name, one in inspect.signature(function).parameters.items()}
    assert found == FIELDS | own


def test_each_is_explained():
    assert re.findall(r":param (\w+):", QuadSwarmEnv.__doc__) == [*FIELDS, "render_mode"]


def test_a_task_has_them():
    task = task_of(TaskOptions(preset="dense", n_robots=3, reward={"request": 0.2}, announcements=True), 2)
    assert (task.swarm.n_swarms, task.swarm.config.n_robots, task.action_cost, task.n_bits) == (2, 3, 0.2, 2)
