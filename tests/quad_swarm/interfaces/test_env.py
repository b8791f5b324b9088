"""The Gymnasium interface: upstream's checkers, exact repetition, observations, info, videos, and bad input."""

import copy
import pickle
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from gymnasium.wrappers import RecordVideo
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecVideoRecorder

import quad_swarm
from quad_swarm.interfaces.env import QuadSwarmEnv
from quad_swarm.world.presets import make_config
from quad_swarm.world.scenarios import SCENARIOS


def run(env: gymnasium.Env, seed: int, steps: int) -> list:
    """Random bits over several episodes; returns everything that came back."""
    rng = np.random.default_rng(seed)
    log = [env.reset(seed=seed)]
    for _ in range(steps):
        log.append(env.step(rng.integers(0, 2, env.action_space.shape, dtype=np.int8)))
        if log[-1][2] or log[-1][3]:
            log.append(env.reset())
    return log


def without_times(log: list) -> list:
    for entry in log:
        entry[-1].get("metrics", {}).pop("planner/solve_us", None)
    return log


def assert_same(a, b):
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, (list, tuple)):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    else:
        assert np.array_equal(a, b)


LIMITED = {
    "preset": "flight-hard",
    "observation": "state+told+mask+critic",
    "announcements": True,
    "world": {"neighbourhood": {"max_others": 2, "range": 3.0}},
}


@pytest.mark.parametrize("kwargs", [{}, {"preset": "dense"}, {"n_robots": 2, "scenario": "random"}, LIMITED])
def test_upstream_checkers(kwargs):
    env = gymnasium.make("QuadSwarm-v0", render_mode="rgb_array", **kwargs)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", category=UserWarning)
        warnings.filterwarnings("ignore", message=".*infinity.*")  # positions have no bound
        warnings.filterwarnings("ignore", message=".*unconventional shape.*")  # the team convention: one row an agent
        gymnasium_check_env(env.unwrapped)
        sb3_check_env(env.unwrapped)


@pytest.mark.parametrize("kwargs", [{}, {"noise": {"vel": 0.05, "wind": 1.0}, "memory": 0.3, "n_robots": 3}, LIMITED])
def test_a_hundred_steps_repeat_exactly(kwargs):
    first = without_times(run(gymnasium.make("QuadSwarm-v0", **kwargs), 7, 100))
    second = without_times(run(gymnasium.make("QuadSwarm-v0", **kwargs), 7, 100))
    assert_same(first, second)
    other = run(gymnasium.make("QuadSwarm-v0", **kwargs), 8, 1)
    assert not np.array_equal(first[0][0], other[0][0])


def test_observation_is_the_paper_s():
    env = QuadSwarmEnv(n_robots=3, scenario="random_swap")
    observation, _ = env.reset(seed=0)
    for _ in range(3):
        observation, *_ = env.step(np.ones(6, dtype=np.int8))
    swarm = env.task.swarm
    pos, vel, goal = swarm.pos[0], swarm.vel[0], swarm.goal[0]
    for i, (j, k) in enumerate([(1, 2), (0, 2), (0, 1)]):
        expected = [vel[i], goal[i] - pos[i], pos[j] - pos[i], pos[k] - pos[i], vel[j] - vel[i], vel[k] - vel[i]]
        np.testing.assert_allclose(observation[i], np.concatenate(expected), rtol=1e-6)


def test_scaling_divides_the_observation():
    plain, scaled = QuadSwarmEnv(), QuadSwarmEnv(scale_observation=True)
    np.testing.assert_allclose(plain.reset(seed=1)[0], 4 * scaled.reset(seed=1)[0], rtol=1e-6)


def test_info_at_the_end_carries_what_the_learner_logs():
    env = QuadSwarmEnv(max_steps=40, scenario="random")
    env.reset(seed=5)
    for _ in range(40):
        *_, info = env.step(np.ones(12, dtype=np.int8))
    assert info["is_success"]
    metrics = info["metrics"]
    assert metrics["comm/request_share"] == 1.0
    assert metrics["swarm/arrival_rate"] == 1.0
    assert metrics["swarm/collision_rate"] == 0.0
    assert metrics["planner/failure_rate"] == 0.0
    assert metrics["planner/solve_us"] > 0
    assert metrics["swarm/min_separation"] == pytest.approx(env.task.statistics.min_separation[0])


def test_a_hopeless_planner_never_raises():
    env = QuadSwarmEnv(scenario="symmetric_swap")
    env.task.swarm.planner.solver.max_iterations = 1
    env.reset(seed=0)
    for _ in range(5):
        *_, info = env.step(np.zeros(12))
        assert (info["planner"]["status"] >= 2).all()


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.ones(11), r"shape \(11,\); the action space has \(12,\): 3 bits per robot"),
        (np.full(12, 0.5), r"contains .*0\.5.*Threshold"),
        (np.full(12, np.nan), "contains .*nan"),
        (np.full(12, 2), "must be 0 or 1"),
    ],
)
def test_refuses_senseless_actions(action, message):
    env = QuadSwarmEnv()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        env.step(action)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"preset": "papr"}, "Did you mean 'paper'"),
        ({"scenario": "swap"}, "Unknown scenario 'swap'"),
        ({"n_robots": 1}, "n_robots=1"),
        ({"n_robots": 200}, "do not fit"),
        ({"solver": "ipop"}, "Unknown solver 'ipop'"),
        ({"reward": {"gaol": 1}}, "Did you mean 'goal'"),
        ({"max_steps": 0}, "max_steps=0"),
        ({"memory": -1.0}, "memory=-1"),
        ({"render_mode": "ansi"}, "render_mode"),
    ],
)
def test_refuses_senseless_arguments(kwargs, message):
    with pytest.raises(ValueError, match=message):
        QuadSwarmEnv(**kwargs)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"start": np.zeros((4, 3))}, "reset option 'start'"),
        ({"starts": np.zeros((4, 3))}, "pass both"),
        ({"waypoints": [[]] * 4, "goals": np.zeros((4, 3))}, "name only 'waypoints', 'goals'; pass both"),
        ({"starts": np.full((4, 3), np.nan), "goals": np.zeros((4, 3))}, "finite points"),
    ],
)
def test_refuses_senseless_reset_options(options, message):
    with pytest.raises(ValueError, match=message):
        QuadSwarmEnv().reset(options=options)


def test_videos_are_recorded(tmp_path):
    env = RecordVideo(gymnasium.make("QuadSwarm-v0", render_mode="rgb_array", max_steps=5), str(tmp_path))
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.zeros(12, dtype=np.int8))
    env.close()
    (video,) = tmp_path.glob("*.mp4")
    assert video.stat().st_size > 1000


@pytest.mark.parametrize("arguments", [{}, {"preset": "flight"}, {"planner": {"dt": 0.02}}, {"planner": {"dt": 0.03}}])
def test_videos_show_real_time(arguments, tmp_path):
    steps, dt = 6, make_config(arguments.get("preset", "paper"), planner=arguments.get("planner")).planner.dt
    recorded = RecordVideo(
        gymnasium.make("QuadSwarm-v0", render_mode="rgb_array", max_steps=steps, **arguments), str(tmp_path)
    )
    assert recorded.frames_per_sec * dt == pytest.approx(1)
    batch = VecVideoRecorder(DummyVecEnv([lambda: recorded]), str(tmp_path), lambda step: False)
    assert batch.frames_per_sec * dt == pytest.approx(1)
    assert quad_swarm.parallel_env(**arguments).metadata["render_fps"] * dt == pytest.approx(1)
    assert QuadSwarmEnv.metadata["render_fps"] == 10, "the class's own is that of the preset 'paper'"


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
@pytest.mark.parametrize("make", [QuadSwarmEnv, quad_swarm.parallel_env])
def test_survives_copying_after_it_was_rendered(make, copied):
    env = make(render_mode="rgb_array")
    env.reset(seed=2)
    picture = env.render()
    twin = copied(env)
    assert np.array_equal(twin.render(), picture)
    twin.close()
    assert np.array_equal(env.render(), picture), "closing a copy leaves the original's renderer"


def test_survives_pickling_in_the_middle_of_an_episode():
    env = QuadSwarmEnv()
    env.reset(seed=2)
    for _ in range(3):
        env.step(np.ones(12, dtype=np.int8))
    copy = pickle.loads(pickle.dumps(env))
    for _ in range(3):
        assert np.array_equal(env.step(np.zeros(12))[0], copy.step(np.zeros(12))[0])


@pytest.mark.parametrize("scenario", [*SCENARIOS, "mixed", "curriculum"])
def test_info_names_the_scenario(scenario):
    env = QuadSwarmEnv(scenario=scenario)
    _, info = env.reset(seed=0)
    assert info["scenario"] in SCENARIOS
    assert env.n_curriculum_levels == (4 if scenario == "curriculum" else 1)


@pytest.mark.parametrize("shape", [(4, 3), (1, 12), (12, 1), ()])
def test_an_action_has_the_shape_of_its_space(shape):
    env = QuadSwarmEnv()
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"has shape \(.*\); the action space has \(12,\)"):
        env.step(np.zeros(shape))


def test_every_field_of_the_world_can_be_set():
    world = {"radius": 0.12, "goal_radius": 0.2, "quadrotor": {"drag_x": 0.1}, "noise": {"wind": 1.0}}
    env = gymnasium.make("QuadSwarm-v0", n_robots=2, world=world)
    env.reset(seed=0)
    config = env.unwrapped.config
    assert (config.radius, config.planner.separation, config.noise.wind) == (0.12, 0.24, 1.0)
    env.step(np.zeros(2, dtype=np.int8))


def test_unknown_arguments_are_named():
    with pytest.raises(ValueError, match=r"Unknown argument 'sceanrio'.*Did you mean 'scenario'"):
        QuadSwarmEnv(sceanrio="random")


@pytest.mark.parametrize("options", [5, "x", int, [1], {1: 2}])
def test_options_that_are_no_mapping_of_names_are_refused(options):
    for env in (
        QuadSwarmEnv(),
        gymnasium.make_vec("QuadSwarm-v0", num_envs=2).unwrapped,
        quad_swarm.parallel_env(),
    ):
        with pytest.raises(ValueError, match="the options of reset"):
            env.reset(options=options)


STARTS, GOALS = np.array([[0.0, -2, 1.5], [0, 2, 1.5]]), np.array([[3.0, -2, 1.5], [3, 2, 1.5]])


def test_reset_takes_waypoints_and_goals_that_move():
    env = gymnasium.make("QuadSwarm-v0", n_robots=2)
    options = {
        "starts": STARTS,
        "goals": GOALS,
        "waypoints": [[[1, -3, 1]], []],
        "velocities": [[0, 0, 0], [0, 0.2, 0]],
    }
    observation, _ = env.reset(seed=0, options=options)
    np.testing.assert_allclose(observation[:, 3:6], [[1, -1, -0.5], [3, 0, 0]])
    for _ in range(10):
        *_, info = env.step(np.zeros(2, np.int8))
    swarm = env.unwrapped.task.swarm
    np.testing.assert_allclose(swarm.final_goal[0], GOALS + np.array([[0, 0, 0], [0, 0.2, 0]]))
    assert not info["at_goal"].any()


def test_reset_and_new_goals_take_headings():
    env = gymnasium.make("QuadSwarm-v0", n_robots=2, planner={"max_yaw_rate": 1.5}).unwrapped
    env.reset(seed=0, options={"starts": STARTS, "goals": GOALS, "headings": [1.0, -1.0]})
    for _ in range(30):
        env.step(np.zeros(2, np.int8))
    np.testing.assert_allclose(env.task.swarm.state[0, :, 8], [1, -1], atol=0.1)
    env.set_goals(STARTS[:1], robots=[0], headings=[3.0])
    assert env.task.swarm.heading.tolist() == [[3, -1]]
    env.reset(seed=0)
    assert env.task.swarm.heading is None
    still = QuadSwarmEnv(n_robots=2)
    with pytest.raises(ValueError, match=r"headings\[0\]=1: with planner\.max_yaw_rate=0"):
        still.reset(options={"starts": STARTS, "goals": GOALS, "headings": [1.0, -1.0]})


def test_reset_takes_velocities_and_headings_of_the_robots():
    env = gymnasium.make("QuadSwarm-v0", n_robots=2).unwrapped
    motion = {"initial_velocities": [[1, 0, 0], [0, 0.5, 0]], "initial_headings": [0.5, -2]}
    observation, _ = env.reset(seed=0, options={"starts": STARTS, "goals": GOALS, **motion})
    np.testing.assert_allclose(observation[:, :3], motion["initial_velocities"])
    np.testing.assert_array_equal(env.task.swarm.state[0, :, 8], motion["initial_headings"])
    observation, _ = env.reset(seed=0, options={"starts": STARTS, "goals": GOALS})
    assert not observation[:, :3].any()


def test_an_episode_whose_goals_change_arrives_again():
    env = gymnasium.make("QuadSwarm-v0", n_robots=2, max_steps=90).unwrapped
    with pytest.raises(gymnasium.error.ResetNeeded, match="set_goals"):
        env.set_goals(GOALS)
    for robots in ([0, 1], [0]):
        env.reset(seed=0, options={"starts": STARTS, "goals": GOALS})
        for _ in range(50):
            *_, info = env.step(np.zeros(2, np.int8))
        assert info["at_goal"].all()
        assert env.task.statistics.arrived[0]
        observation, swarm = env.set_goals(STARTS[robots], robots=robots), env.task.swarm
        np.testing.assert_allclose(observation[:, 3:6], swarm.goal[0] - swarm.pos[0], atol=1e-6)
        assert np.linalg.norm(observation[robots, 3:6], axis=1).min() > 2
        for step in range(40):
            *_, terminated, truncated, info = env.step(np.zeros(2, np.int8))
            assert not env.task.statistics.arrived[0] or step > 5
        assert (terminated, truncated, info["is_success"]) == (False, True, True)


def test_points_beyond_any_number_are_refused_in_one_line():
    for starts in (10**400, np.full((4, 3), np.nan)):
        with pytest.raises(ValueError, match="starts must be 4 finite points") as told:
            QuadSwarmEnv().reset(options={"starts": starts, "goals": np.ones((4, 3))})
        assert "\n" not in str(told.value)


@pytest.mark.parametrize("level", ["x", 0.5, None, -1])
def test_a_level_that_is_none_is_refused(level):
    with pytest.raises(ValueError, match=r"Level .* does not exist"):
        QuadSwarmEnv(scenario="curriculum").set_curriculum_level(level)


def test_plans_are_in_the_info_on_request():
    """And nothing else changes."""
    world = {"preset": "flight", "scenario": "random", "max_steps": 6}
    plain, told = (gymnasium.make("QuadSwarm-v0", plans_in_info=on, **world).unwrapped for on in (False, True))
    kind = {"vectorization_mode": "vector_entry_point", "plans_in_info": True}
    batch = gymnasium.make_vec("QuadSwarm-v0", num_envs=2, **kind, **world).unwrapped
    parallel = quad_swarm.parallel_env(plans_in_info=True, **world)
    for env in (plain, told, batch, parallel):
        env.reset(seed=0)
    rng = np.random.default_rng(0)
    for step in range(6):
        action = rng.integers(0, 2, plain.action_space.shape)
        expected, *_, without = plain.step(action)
        observation, *_, info = told.step(action)
        *_, infos = batch.step(np.stack([action, action]))
        *_, of_agents = parallel.step(dict(zip(parallel.possible_agents, action.reshape(8, 7), strict=True)))
        assert np.array_equal(observation, expected)
        assert info.keys() - without.keys() == {"plan"}
        plan, swarm = info["plan"], told.task.swarm
        shapes = {"states": (8, 21, 9), "inputs": (8, 4), "cost": (8,), "solve_seconds": ()}
        assert {name: np.shape(value) for name, value in plan.items()} == shapes
        assert np.array_equal(plan["states"], swarm.plans[0])
        assert np.array_equal(plan["inputs"], swarm.inputs[0])
        assert (plan["cost"] > 0).all()
        assert plan["solve_seconds"] > 0
        for name in ("states", "inputs", "cost"):  # in the last step, too, after which the batch begins anew
            assert np.array_equal(infos["plan"][name][0], plan[name]), (step, name)
            assert np.array_equal(of_agents["robot_3"]["plan"][name], plan[name])
    assert pickle.loads(pickle.dumps(told)).step(action)[-1]["plan"]["cost"].shape == (8,)


def test_a_pickled_environment_reaches_the_end_of_its_episode():
    env = gymnasium.make("QuadSwarm-v0", scenario="random", max_steps=30).unwrapped
    env.reset(seed=0)
    copied = pickle.loads(pickle.dumps(env))
    for _ in range(30):
        *_, over, truncated, info = copied.step(np.ones(12, np.int8))
    assert over or truncated
    assert "swarm/arrival_rate" in info["metrics"]
