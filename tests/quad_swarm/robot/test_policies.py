import numpy as np
import pytest

from quad_swarm.planner import make_planner
from quad_swarm.robot import Robot, RulePolicy
from quad_swarm.robot.policies import Actor
from quad_swarm.world.presets import make_config

CONFIG = make_config("paper", n_robots=3)
PLANNER = make_planner(CONFIG.planner, CONFIG.quadrotor, 3)


def decided(rule):
    robot = Robot(CONFIG, 0, RulePolicy(rule), PLANNER)
    robot.reset(np.array([0.0, 0, 1]), np.array([3.0, 0, 1]))
    state = np.zeros(9)
    state[:6] = 0, 0, 1, 1, 0, 0
    return robot.decide(0, state, np.array([[1.0, 0, 1], [0, 4, 1]]), np.zeros((2, 3))).tolist()


@pytest.mark.parametrize(
    ("rule", "bits"),
    [
        ("none", [[False], [False]]),
        ("full", [[True], [True]]),
        ("distance:2", [[True], [False]]),
        ("distance:2&none|distance:9&cpa:0.5:3", [[True], [False]]),
        ("random:1", [[True], [True]]),
        ("push:0.3", [[False, True], [False, True]]),  # nobody knows that the robot will stop at its goal
        ("distance:2|push:0.3&push:100", [[True, False], [False, False]]),
    ],
)
def test_rules_ask_and_push_tells(rule, bits):
    assert decided(rule) == bits


def test_rules_that_join_two_robots_knowledge_cannot_be_flown():
    with pytest.raises(ValueError, match=r"'cpa:0.7:1.5&push:0.1' joins what the receiver and the sender know"):
        RulePolicy("full|cpa:0.7:1.5&push:0.1")


def test_unknown_rules_are_refused():
    with pytest.raises(ValueError, match="distnce"):
        RulePolicy("distnce:2")


def test_files_that_are_no_programs_are_refused(tmp_path):
    pytest.importorskip("onnxruntime")
    path = tmp_path / "actor.onnx"
    path.write_bytes(b"no program")
    with pytest.raises(ValueError, match=r"actor\.onnx: no policy that ONNX Runtime can load"):
        Actor(path, CONFIG, "paper")
