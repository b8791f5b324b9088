"""Vehicles from outside: every level of the planner, and what flies, moves as their formulas say."""

import copy
import pickle

import casadi as ca
import foreign
import gymnasium as gym
import numpy as np
import pytest
from planning import QUADROTOR

import quad_swarm
from quad_swarm.planner import (
    PROBLEMS,
    SOLVERS,
    FatropSolver,
    PlannerConfig,
    Plans,
    PlanStatus,
    ProblemModel,
    Problems,
    RtiSolver,
    make_planner,
    make_problem,
    model_of,
)
from quad_swarm.planner.model import same_dynamics
from quad_swarm.planner.problem import OptimalControlProblem
from quad_swarm.quadrotor import QuadrotorModel


@pytest.fixture(autouse=True)
def fleet(monkeypatch):
    for name in ("Boat", "Drifter", "Stepper", "Thrifty"):
        monkeypatch.setitem(PROBLEMS, name.lower(), getattr(foreign, name))


def config(problem: str = "boat", **more) -> PlannerConfig:
    return PlannerConfig(problem=problem, **more)


def problem(name: str = "boat", n_others: int = 1) -> OptimalControlProblem:
    return make_problem(config(name), QUADROTOR, n_others)


def states(count: int, nx: int = 6) -> np.ndarray:
    rng = np.random.default_rng(0)
    x = np.zeros((count, 9))
    x[:, :nx] = rng.normal(size=(count, nx))
    return x


def test_quadrotors_keep_their_model():
    assert type(model_of(problem("quadrotor"))) is QuadrotorModel
    assert type(model_of(problem("thrifty"))) is QuadrotorModel, "another cost is no other vehicle"
    assert isinstance(model_of(problem()), ProblemModel)


@pytest.mark.parametrize("count", [1, 3, 40])
def test_a_step_is_exact_in_wind_and_after_any_time(count):
    model, x, u, wind = ProblemModel(problem()), states(count), np.ones((count, 4)), np.full((count, 2), 0.7)
    after = {False: model.step(x, u, wind), True: model.ahead(x, u, np.full(count, 0.03))}
    for still, found in after.items():
        time, air = (0.03, 0.0) if still else (0.1, 0.7)
        end = np.array([1.0, 1.0]) / 0.4 + air  # speed at which drag balances the push
        decay = np.exp(-0.4 * time)
        np.testing.assert_allclose(found[:, 3:5], end + decay * (x[:, 3:5] - end), atol=1e-6)
        np.testing.assert_allclose(
            found[:, :2], x[:, :2] + end * time + (x[:, 3:5] - end) * (1 - decay) / 0.4, atol=1e-6
        )
        np.testing.assert_array_equal(found[:, 5:], np.column_stack([x[:, 5], np.zeros((count, 3))]))


def test_steps_of_a_discrete_vehicle_are_its_own_and_interpolated_between():
    model, x, u = ProblemModel(problem("stepper")), states(2), np.tile([0.5, -1, 0.25, 9], (2, 1))
    np.testing.assert_allclose(model.step(x, u)[:, :3], x[:, :3] + 0.1 * u[:, :3])
    np.testing.assert_allclose(model.ahead(x, u, np.full(2, 0.05))[:, 3:6], (x[:, 3:6] + u[:, :3]) / 2)


def test_models_survive_pickling():
    model = ProblemModel(problem(), 0.02)
    x, u = states(40), np.ones((40, 4))
    again = pickle.loads(pickle.dumps(model))
    assert (again.dt, type(again.problem)) == (0.02, foreign.Boat)
    assert np.array_equal(again.step(x, u), model.step(x, u))


@pytest.mark.slow
def test_both_solvers_plan_with_the_vehicle():
    one = problem()
    x = states(6)
    x[:, 2] = 1.0
    goal = np.random.default_rng(1).uniform(-3, 3, (6, 3))
    others = np.full((6, 1, 10, 3), 9.0)
    others[:3, 0] = (x[:3, None, :3] + goal[:3, None]) / 2 + [0.3, 0.2, 0]
    call = Problems(x, goal, others), *Plans.steady(x, 10, 0.1)[:2]
    rti, fatrop = RtiSolver(one, sqp_iterations=10).solve(*call), FatropSolver(one).solve(*call)
    assert rti.success.all()
    assert fatrop.success.all()
    np.testing.assert_allclose(rti.x[3:], fatrop.x[3:], atol=0.01)
    np.testing.assert_allclose(rti.x[:3], fatrop.x[:3], atol=0.05)
    np.testing.assert_allclose(rti.x, ProblemModel(one).rollout(x, rti.u), atol=1e-9)


def test_plans_without_a_solver_move_as_the_vehicle_too(monkeypatch):
    monkeypatch.setitem(SOLVERS, "failing", foreign.Failing)
    planner = make_planner(config(), QUADROTOR, 2, "failing")
    x = states(4)
    problems = Problems(x, np.zeros((4, 3)), np.full((4, 1, 10, 3), 9.0))
    plans = Plans.steady(x, 10, 0.1)
    for _ in range(10):
        with pytest.warns(RuntimeWarning, match="no plan"):
            plans = planner.plan(problems, plans)
        assert np.array_equal(plans.x, planner.model.rollout(x, plans.u))
    assert (plans.status == PlanStatus.BRAKING).all()
    speed = np.abs(plans.x[:, :, 3:5])
    assert (speed[:, -1] < 0.4 * speed[:, 0]).all(), "which is what the boat calls braking"
    assert (np.abs(plans.u) <= [1.5, 1.0, 0, 0]).all()


def test_a_solver_of_another_vehicle_than_flies_is_refused(monkeypatch):
    monkeypatch.setitem(SOLVERS, "lighter", foreign.lighter)
    with pytest.raises(ValueError, match=r"plans with the dynamics of Lighter, .* planner.problem='quadrotor'"):
        make_planner(PlannerConfig(), QUADROTOR, 2, "lighter")
    assert not same_dynamics(problem(), problem("stepper"))
    assert same_dynamics(problem("quadrotor"), problem("thrifty"))


class Odd(foreign.Boat):
    pass


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"derivative": lambda self, x, u, wind: x[:3]}, r"Odd.derivative\(x, u, wind\) has 3 entries; it must have 6"),
        ({"derivative": lambda self, x, u, wind: x[17]}, r"Odd.derivative\(x, u, wind\) is no formula"),
        ({"derivative": lambda self, x, u: x}, r"Odd.derivative\(x, u, wind\) is no formula of its arguments"),
        ({"input_cost": lambda self, u: u}, r"Odd.input_cost\(u\) has 2 entries; it must have 1"),
        ({"goal_cost": lambda self, x, x0, goal: ca.SX.sym("z")}, r"Odd.goal_cost\(x, x0, goal\) is no formula"),
        ({"distances": lambda self, x, others: []}, r"Odd.distances\(x, others\) has 0 entries; it must have 1"),
        ({"braking": lambda self, x: None}, r"Odd.braking\(x\) is no formula"),
        ({"nx": 12}, "Odd: nx=12 and nu=2; a problem has 3 to 9 states"),
        ({"nu": 5}, "Odd: nx=6 and nu=5; a problem has"),
        ({"max_input": ca.DM([1, 0])}, r"Odd: max_input=\[1.0, 0.0\]; it must hold 2 positive finite limits"),
        ({"max_input": ca.DM([1, 1, 1])}, "Odd: max_input=.*; it must hold 2 positive"),
    ],
)
def test_formulas_that_do_not_fit_are_refused_in_one_sentence(change, message, monkeypatch):
    def init(self, *arguments):
        foreign.Boat.__init__(self, *arguments)
        for name, value in change.items():
            if not callable(value):
                setattr(self, name, value)

    methods = {name: value for name, value in change.items() if callable(value)}
    monkeypatch.setitem(PROBLEMS, "odd", type("Odd", (foreign.Boat,), {"__init__": init, **methods}))
    with pytest.raises(ValueError, match=message) as error:
        make_planner(config("odd"), QUADROTOR, 2)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("entry", [None, "Boat", lambda *arguments: None, foreign.Stay])
def test_what_is_no_problem_is_refused(entry, monkeypatch):
    monkeypatch.setitem(PROBLEMS, "odd", entry)
    with pytest.raises(ValueError, match=r"PROBLEMS\['odd'\]=.*: it must be a subclass of"):
        make_planner(config("odd"), QUADROTOR, 2)


@pytest.mark.parametrize("name", ["quadrotr", "", "boats"])
def test_unknown_problems_are_refused(name):
    with pytest.raises(
        ValueError, match=r"Unknown problem .*; known: boat, drifter, orca, quadrotor, stepper, thrifty, voronoi"
    ):
        make_planner(config(name), QUADROTOR, 2)


@pytest.mark.slow
def test_every_interface_flies_the_vehicle_and_copies_fly_alike():
    kwargs = {"planner": {"problem": "drifter"}, "scenario": "random", "preset": "flight", "n_robots": 3}
    team = gym.make("QuadSwarm-v0", **kwargs).unwrapped
    batch = gym.make_vec("QuadSwarm-v0", num_envs=15, vectorization_mode="vector_entry_point", **kwargs).unwrapped
    parallel = quad_swarm.parallel_env(**kwargs)
    for env in (team, batch, parallel):
        env.reset(seed=0)
        swarm = env.task.swarm
        height = swarm.pos[..., 2].copy()
        assert (swarm.vel[..., 0] == 0.5).all()
        assert (np.diff(swarm.plans[..., 0], axis=2) > 0).all(), "before the first solve, it drifts on"
        for _ in range(10):
            before = swarm.state.copy()
            env.task.act(np.zeros((*height.shape, 2, 1), bool))
            assert np.abs(swarm.state[..., :2] - before[..., :2]).max() > 1e-3
        np.testing.assert_allclose(swarm.pos[..., 2], height, atol=0.1)  # noise of the world only
        again = pickle.loads(pickle.dumps(copy.deepcopy(env)))
        for one in (env, again):
            one.task.act(np.zeros((*height.shape, 2, 1), bool))
        assert np.array_equal(again.task.swarm.state, env.task.swarm.state)
    assert np.array_equal(batch.task.swarm.plans[0], team.task.swarm.plans[0]), "alone as in a batch"


def test_robots_arrive_where_the_cost_of_the_problem_says():
    env = gym.make("QuadSwarm-v0", planner={"problem": "boat"}, n_robots=2, max_steps=100).unwrapped
    starts, goals = np.array([[-2, 0, 1.5], [2, 0.2, 1.5]]), np.array([[2, 0, 1.5], [-2, 0.2, 1.5]])
    env.reset(seed=0, options={"starts": starts, "goals": goals})
    statuses = set()
    for _ in range(100):
        *_, info = env.step(np.ones(2, np.int8))
        statuses |= {*info["planner"]["status"].tolist()}
        assert not info["collision"]
    assert info["at_goal"].all()
    assert statuses == {0}
    plans = env.task.swarm.plans[0]
    assert np.abs(env.task.swarm.state[0] - plans[:, 1]).max() < 1e-9, "the model is what flies"


def test_what_only_quadrotors_can_is_refused(monkeypatch):
    monkeypatch.setitem(PROBLEMS, "boat", foreign.Boat)
    with pytest.raises(ValueError, match=r"planner.disturbance_time=1: .* planner.problem='boat': leave it out"):
        make_planner(PlannerConfig(problem="boat", disturbance_time=1.0), QUADROTOR, 2)
    env = quad_swarm.QuadSwarmEnv(planner={"problem": "boat"}, n_robots=2)
    starts = [[-1.5, 0, 1], [1.5, 0, 1]]
    for name, value in (("initial_velocities", [[0, 0, 0]] * 2), ("initial_headings", [0, 0])):
        options = {"starts": starts, "goals": starts[::-1], name: value}
        with pytest.raises(ValueError, match=f"{name}: planner.problem='boat' says how its vehicles start"):
            env.reset(seed=0, options=options)
