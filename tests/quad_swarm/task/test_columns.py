from pathlib import Path

import numpy as np
import pytest

from quad_swarm.task import columns
from quad_swarm.task.observation import GROUPS, make_observation
from quad_swarm.world.presets import make_config
from quad_swarm.world.swarm import Swarm


@pytest.mark.parametrize("preset", ["paper", "flight"])
@pytest.mark.parametrize("group", GROUPS)
def test_every_group_has_its_columns(preset, group):
    config = make_config(preset, n_robots=3)
    swarm = Swarm(config)
    swarm.reset(0, np.array([[0.0, 0, 1], [2, 0, 1], [0, 2, 1]]), np.array([[2.0, 2, 1], [0, 1, 1], [1, 0, 2]]))
    observation = make_observation(config, group)
    size = GROUPS[group](observation._pair(swarm)).shape[-1]
    assert size == len(columns.COLUMNS[group])
    assert observation(swarm).shape[-1] == observation.size == len(observation.columns) == 6 + 2 * size


def test_names_are_unique_and_meanings_are_sentences_of_people():
    config = make_config("flight", {"neighbourhood": {"max_others": 3}})
    for text in ("paper", "+".join(GROUPS)):
        found = make_observation(config, text).columns
        assert len({column.name for column in found}) == len(found)
        assert {column.frame for column in found} <= {"", "world", "goal", "pair"}
        assert all(column.meaning for column in found)
    assert [column.name for column in found[-3:]] == ["other1.number", "other2.number", "other3.number"]


def test_units_say_what_a_value_of_one_is():
    config = make_config("paper", n_robots=2)
    swarm = Swarm(config)
    swarm.reset(0, np.array([[0.0, 0, 1], [3, 0, 2]]), np.array([[0.0, 2, 1], [3, 3, 2]]))
    named = {column.name: k for k, column in enumerate(make_observation(config, "state").columns)}
    seen = make_observation(config, "state")(swarm)[0, 0]
    assert seen[named["other1.state.distance"]] == pytest.approx(np.sqrt(10) / columns.POSITION_SCALE)
    assert seen[named["other1.state.pos_up"]] == pytest.approx(1.0)
    assert seen[named["own.goal_far"]] == pytest.approx(2.0 / 4.0)
    scaled = make_observation(config, "paper", scale_observation=True)
    assert [column.unit for column in scaled.columns[:4]] == ["4 m/s", "4 m/s", "4 m/s", "4 m"]
    assert scaled(swarm)[0, 0, 4] == pytest.approx(2.0 / 4.0)


def test_the_table_in_the_docs_is_the_present_one():
    assert columns.as_table() in (Path(__file__).parents[3] / "docs" / "observation_columns.md").read_text()
