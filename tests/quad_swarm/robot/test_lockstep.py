"""n robots that exchange messages fly the episode of a swarm, to the last bit."""

import functools

import foreign
import numpy as np
import pytest
import torch as th

from quad_swarm.evaluation.export import export
from quad_swarm.evaluation.flight import Condition, begin, first_episode
from quad_swarm.evaluation.policies import fitted, load_model
from quad_swarm.planner import PROBLEMS
from quad_swarm.robot import Plan, Robot, RulePolicy
from quad_swarm.robot.lockstep import LockstepWorld
from quad_swarm.task.request_task import requests_of
from quad_swarm.world.kinds import make_planners
from quad_swarm.world.presets import for_scenario, make_config
from quad_swarm.world.scenarios import SCENARIOS, ScenarioSampler
from quad_swarm.world.swarm import Swarm
from sb3_maddpg.hub.pretrained import pretrained_folder

MODEL, AMONG_OBSTACLES = (
    str(pretrained_folder(name) / "model.zip") for name in ("quad-swarm-flight", "quad-swarm-flight-v2")
)
EDGE = 1e-5  # of a probability to the threshold, within which a robot alone and a team may round differently
RULES = ["none", "full", "cpa:1.2s:3&stale:4", "event:0.05|push:0.1"]


planners_of = functools.cache(make_planners)


def differences(config, policies, rule, scenario, model=None, steps=60, episode=0, make_robot=Robot, at_edge=None):
    """Fly the same episode as a swarm and as robots, and yield what differs. Ends where ``at_edge(observed, differing
    bits)`` says that bits may differ.
    """
    seed, config = first_episode(0) + episode, for_scenario(config, scenario)
    policy, task, rngs = begin(Condition(rule, scenario, config), [seed], model)
    swarm, rng = task.swarm, np.random.default_rng(seed)
    _, (starts, goals, obstacles, *changing) = ScenarioSampler(scenario, config.n_robots, config.space, config).draw(
        rng
    )
    noise_seed = int(rng.integers(2**63)) if config.is_random else 0
    planners = planners_of(config)
    robots = [make_robot(config, k, one, planners[k]) for k, one in enumerate(policies)]
    world = LockstepWorld(config, robots)
    world.reset(starts, goals, noise_seed, obstacles, *changing)
    columns = [k for k, column in enumerate(task.observation.columns) if ".critic." not in column.name]
    for step in range(steps):
        observed = task.observe()[0][:, columns] if model else None
        bits = policy(task, rngs)
        flown = world.step()
        task.act(bits)
        theirs = swarm.beliefs_seen_by_others
        pairs = {
            "requests": (requests_of(flown[None])[0], requests_of(bits)[0]),
            "states": (world.state, swarm.state),
            "plans": (np.concatenate([robot.plans.x for robot in robots]), swarm._plans.x),
            "inputs": (np.concatenate([robot.plans.u for robot in robots]), swarm._plans.u),
            "status": (np.concatenate([robot.plans.status for robot in robots]), swarm._plans.status),
            "ages": (np.concatenate([robot.beliefs.age for robot in robots], axis=1), swarm.beliefs.age),
            "beliefs": (np.concatenate([r.beliefs._remembered for r in robots], axis=1), swarm.beliefs._remembered),
            "presumed": (
                np.concatenate([robot.presumed._remembered for robot in robots], axis=1),
                swarm.neighbours.of_the_other(theirs._remembered),
            ),
        }
        if model:
            pairs["observations"] = (np.stack([robot.policy.observed[0] for robot in robots]), observed)
        differing = flown != bits[0]
        if at_edge is not None and differing.any() and at_edge(observed, differing):
            return
        for name, (mine, swarms) in pairs.items():
            if np.ascontiguousarray(mine).tobytes() != np.ascontiguousarray(swarms).tobytes():
                yield step, name


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize(
    ("preset", "n", "scenario"),
    [
        ("paper", 4, "random"),
        ("flight-hard", 3, "symmetric_swap"),
        ("flight", 3, "crossing_traffic"),
        ("flight-v2", 3, "symmetric_swap"),
        ("flight-v2", 3, "forest"),
        ("flight-v3", 3, "symmetric_swap"),
        ("flight-v3", 4, "crossing_traffic"),
        ("flight-hard", 4, "tour"),
        ("flight", 3, "moving_goals"),
    ],
)
def test_robots_with_rules_fly_as_the_swarm(preset, n, scenario, rule):
    config = make_config(preset, n_robots=n)
    assert not list(differences(config, [RulePolicy(rule) for _ in range(n)], rule, scenario))


@pytest.mark.parametrize("rule", ["full", "event:0.05|push:0.1"])
@pytest.mark.parametrize("radio", [{}, {"delay": 0, "round_trip": 1}])
def test_robots_fly_as_the_swarm_with_a_radio_that_distance_limits(radio, rule):
    config = make_config("flight", {"radio": {"range": 3.0, "half_distance": 2.0, **radio}}, n_robots=3)
    assert not list(differences(config, [RulePolicy(rule) for _ in range(3)], rule, "symmetric_swap"))


@pytest.mark.parametrize("rule", ["full", "cpa:1.2s:3&stale:4", "stage:0.8:0.5|push:0.1"])
@pytest.mark.parametrize("preset", ["flight-v2", "flight-v3"])
def test_robots_fly_as_the_swarm_if_others_are_observed_late_and_lost(preset, rule):
    config = make_config(preset, {"sensing": {"others_delay": 2, "gaps": 0.2}}, n_robots=4)
    assert not list(differences(config, [RulePolicy(rule) for _ in range(4)], rule, "symmetric_swap"))


UNLIKE = [{"radius": 0.2, "max_speed": 1.0, "max_yaw_rate": 1.0}, {"quadrotor": "x500"}, {"radius": 0.5}]


@pytest.mark.parametrize("rule", ["full", "cpa:1.2s:3&stale:4", "blocked:0.3|push:0.1"])
@pytest.mark.parametrize(("preset", "scenario"), [("flight", "crossing_traffic"), ("flight-hard", "symmetric_swap")])
def test_unlike_robots_fly_as_the_swarm(preset, scenario, rule):
    config = make_config(preset, {"vehicles": UNLIKE}, n_robots=4)
    assert not list(differences(config, [RulePolicy(rule) for _ in range(4)], rule, scenario))


@pytest.mark.parametrize("vehicles", [[], UNLIKE])
def test_robots_that_brake_early_fly_as_the_swarm(vehicles):
    config = make_config("flight-v2", {"vehicles": vehicles, "planner": {"braking_reserve": 0.5}}, n_robots=4)
    assert not list(differences(config, [RulePolicy("full") for _ in range(4)], "full", "crossing_traffic"))


@pytest.mark.parametrize("rule", ["full", "stage:1.0:0.2"])
def test_unlike_robots_that_estimate_and_keep_to_what_they_told_fly_as_the_swarm(rule):
    planner = {"commitment": 3.0, "disturbance_time": 1.0, "max_descent_rate": 0.5}
    config = make_config("flight", {"vehicles": UNLIKE, "planner": planner}, n_robots=4)
    assert not list(differences(config, [RulePolicy(rule) for _ in range(4)], rule, "symmetric_swap"))


@pytest.mark.parametrize("rule", ["full", "stage:1.0:0.2", "cpa:1.2s:3&stale:4|stage:1.0:0.2"])
@pytest.mark.parametrize("radio", [{}, {"delay": 0, "round_trip": 1}])
def test_robots_keep_to_what_they_told_as_the_swarm_does(radio, rule):
    planner = {"commitment": 3.0, "disturbance_time": 1.0}
    config = make_config("flight", {"planner": planner, "radio": radio}, n_robots=3)
    assert not list(differences(config, [RulePolicy(rule) for _ in range(3)], rule, "symmetric_swap"))


@pytest.mark.parametrize(
    "world",
    [
        {},
        {"radio": {"delay": 3, "jitter": 2}},
        {"radio": {"delay": 0, "round_trip": 1}},
        {"clock_skew": 0.0},
        {"vehicles": [{}, {"max_speed": 2}]},
    ],
)
def test_robots_that_start_in_flight_and_turn_fly_as_the_swarm(world):
    config = make_config("flight", world, n_robots=2, planner={"max_yaw_rate": 1.0})
    swarm = Swarm(config)
    planners = getattr(swarm.planner, "planners", [swarm.planner] * 2)
    robots = [Robot(config, k, RulePolicy("full"), planners[k]) for k in range(2)]
    flown, starts = LockstepWorld(config, robots), np.array([[0.0, -2, 1.5], [0, 2, 1.5]])
    motion = {"initial_velocities": [[1, 0.3, 0.2], [-1, 0, -0.3]], "initial_headings": [0.5, -3]}
    goals = starts + np.array([2, 0, 0])
    swarm.reset(0, starts, goals, noise_seed=7, headings=[2, 0], **motion)
    flown.reset(starts, goals, 7, headings=[2, 0], **motion)
    for _ in range(40):
        flown.step()
        swarm.step(np.ones((1, 2, 1), bool))
        assert np.array_equal(flown.state, swarm.state)
        believed = np.concatenate([robot.beliefs._remembered for robot in robots], axis=1)
        assert np.array_equal(believed, swarm.beliefs._remembered)
    assert (np.abs(swarm.state[0, :, 8]) > [1.2, 0]).all()
    assert abs(swarm.state[0, 1, 8]) < 1.8


@pytest.mark.slow
@pytest.mark.parametrize("scenario", SCENARIOS)
@pytest.mark.parametrize("n", [2, 4, 8])
@pytest.mark.parametrize("preset", ["paper", "flight", "flight-v2", "flight-v3", "flight-hard"])
def test_robots_with_rules_fly_as_the_swarm_anywhere(preset, n, scenario):
    config = make_config(preset, n_robots=n)
    for rule in RULES:
        assert not list(differences(config, [RulePolicy(rule) for _ in range(n)], rule, scenario, steps=100))


CHANGED = {
    "late answers": {"radio": {"delay": 3, "jitter": 2}},
    "no losses": {"radio": {"loss": 0.0, "jitter": 0}},
    "answers within the step": {"radio": {"delay": 0, "jitter": 0, "round_trip": 0}},
    "answers a step later": {"radio": {"delay": 0, "jitter": 0, "round_trip": 1}},
    "answers one to four steps later": {"radio": {"delay": 0, "jitter": 3, "round_trip": 1}},
    "a short range": {"radio": {"range": 1.5}},
    "a short range in a network": {"radio": {"delay": 0, "round_trip": 1, "range": 1.5}},
    "loss by distance": {"radio": {"half_distance": 2.0, "path_loss_exponent": 2.0, "bursts": 0.1}},
    "loss by distance in a network": {"radio": {"delay": 0, "jitter": 2, "round_trip": 0, "half_distance": 2.0}},
    "half lost": {"radio": {"loss": 0.5, "bursts": 0.2}},
    "punctual": {"clock_skew": 0.0},
    "no right of way": {"planner": {"right_of_way": 0.0}},
    "no memory": {"memory": 0.0},
    "few neighbours planned with": {"planner": {"max_neighbours": 2}},
    "yaw": {"planner": {"max_yaw_rate": 1.0}},
    "a disturbance estimated": {"planner": {"disturbance_time": 1.0, "max_yaw_rate": 1.0}},
    "commitment": {"planner": {"commitment": 3.0}},
    "commitment in a network": {"planner": {"commitment": 3.0}, "radio": {"delay": 0, "round_trip": 1}},
    "ORCA": {"planner": {"problem": "orca"}},
    "Voronoi cells": {"planner": {"problem": "voronoi", "horizon": 14}},
    "no sensing errors": {"sensing": {"pos": 0.0, "vel": 0.0, "attitude": 0.0, "others_pos": 0.0, "others_vel": 0.0}},
}


@pytest.mark.slow
@pytest.mark.parametrize("world", CHANGED.values(), ids=CHANGED)
def test_robots_fly_as_the_swarm_in_changed_worlds(world):
    config = make_config("flight", world, n_robots=4)
    rule = "event:0.05|push:0.1"
    assert not list(differences(config, [RulePolicy(rule) for _ in range(4)], rule, "symmetric_swap"))


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["paper", "flight", "flight-v2", "flight-v3", "flight-hard"])
@pytest.mark.parametrize("n", [2, 4, 8])
def test_robots_with_a_learned_policy_fly_as_the_swarm(preset, n, tmp_path):
    pytest.importorskip("onnxruntime")
    config = make_config(preset, n_robots=n)
    path = AMONG_OBSTACLES if preset in ("flight-v2", "flight-v3") else MODEL
    written, model = export(path, config, tmp_path), load_model(path, "sb3_maddpg:MADDPG")
    edges = []

    def at_edge(observed, differing):
        probabilities = probabilities_of(model, config, observed)
        edges.append(np.abs(probabilities[differing] - model.policy.threshold).max())
        return edges[-1] < EDGE

    for scenario in SCENARIOS:
        policies = [written.actor() for _ in range(n)]
        arguments = (config, policies, "model.zip", scenario, model)
        assert not list(differences(*arguments, at_edge=at_edge))
    assert len(edges) <= 1, edges  # expected about once in a million bits


def probabilities_of(model, config, observed):
    """Return the probability of each bit, (n, n - 1, bits), for observations without the critic's columns."""
    predictor, observation, n_bits = fitted(model, MODEL, config)
    known = [k for k, column in enumerate(observation.columns) if ".critic." not in column.name]
    alone = predictor.agent_policy(0).of_columns(known)
    with th.no_grad():
        logits = alone.network(th.from_numpy(np.pad(observed, ((0, 0), (0, alone.n_hidden)))[:, alone.places]))
    return logits.sigmoid().numpy().reshape(config.n_robots, -1, n_bits)


class Forgetful(Robot):
    """A robot that does not note what it sent."""

    def sent(self, other, stamp=None):
        pass


class Rounding(Robot):
    """A robot that takes plans in centimetres."""

    def receive(self, sender, plan):
        super().receive(sender, Plan(plan.stamp, plan.positions.round(2)))


class Punctual(Robot):
    """A robot that believes that its commands act at once."""

    def reset(self, start, goal, late=0.0, **others):
        super().reset(start, goal, 0.0, **others)


class Ahead(Robot):
    """A robot that takes plans for a period younger than they are."""

    def receive(self, sender, plan):
        super().receive(sender, plan._replace(stamp=plan.stamp + self.period))


@pytest.mark.parametrize(
    ("mistake", "name"), [(Forgetful, "presumed"), (Rounding, "beliefs"), (Punctual, "plans"), (Ahead, "beliefs")]
)
def test_mistakes_are_noticed(mistake, name):
    config, rule = make_config("flight", n_robots=3), "full"
    found = differences(config, [RulePolicy(rule) for _ in range(3)], rule, "symmetric_swap", make_robot=mistake)
    first = next(found)[0]
    assert name in {what for step, what in [(first, name), *found] if step == first}


class Blind(Robot):
    """A robot that takes all others for as large as itself."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.bodies = self.bodies._replace(larger=None)


class Confused(Robot):
    """A robot that takes itself for the one before it in the team."""

    def __init__(self, config, index, policy, planner):
        super().__init__(config, index, policy)
        before = index - 1 if index else config.n_robots - 1
        self.planner = make_planners(config)[before]


@pytest.mark.parametrize("mistake", [Blind, Confused])
def test_mistakes_about_unlike_robots_are_noticed(mistake):
    config, rule = make_config("flight", {"vehicles": UNLIKE}, n_robots=3), "full"
    found = differences(config, [RulePolicy(rule) for _ in range(3)], rule, "symmetric_swap", make_robot=mistake)
    assert next(found)[1] in ("plans", "states")


def test_a_robot_refuses_the_planner_of_another_kind():
    config = make_config("flight", {"vehicles": UNLIKE}, n_robots=3)
    with pytest.raises(ValueError, match="it is not that of robot 1"):
        Robot(config, 1, RulePolicy("full"), planners_of(config)[0])


@pytest.mark.parametrize("preset", ["paper", "flight"])
@pytest.mark.parametrize("kind", [foreign.Boat, foreign.Drifter])
def test_vehicles_from_outside_fly_alike(kind, preset, monkeypatch):
    monkeypatch.setitem(PROBLEMS, "boat", kind)
    config = make_config(preset, n_robots=3, planner={"problem": "boat"})
    policies = [RulePolicy("full")] * 3
    assert not list(differences(config, policies, "full", "random", steps=20))
    planners_of.cache_clear()
