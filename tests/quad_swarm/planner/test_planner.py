"""Making planners: by the name of their solver, and for other processes."""

import copy
import functools
import pickle

import foreign
import gymnasium as gym
import numpy as np
import pytest
from planning import QUADROTOR, crossing, hover

import quad_swarm
from quad_swarm.planner import SOLVERS, FatropSolver, PlannerConfig, Problems, RtiSolver, make_planner
from quad_swarm.planner.problem import OptimalControlProblem


def test_survives_pickling():
    config = PlannerConfig()
    problems = crossing(2, config)
    planner = make_planner(config, QUADROTOR, 3, "fatrop")
    expected = planner.plan(problems, hover(problems, config))
    copy = pickle.loads(pickle.dumps(planner))
    assert np.array_equal(copy.plan(problems, hover(problems, config)).x, expected.x)


def test_suggests_the_solver_that_was_meant():
    with pytest.raises(ValueError, match="Did you mean 'fatrop'"):
        make_planner(PlannerConfig(), QUADROTOR, 2, solver="fatrob")


@pytest.mark.parametrize(
    ("entry", "kind"),
    [
        (foreign.Stay, foreign.Stay),
        (lambda problem: foreign.Stay(problem), foreign.Stay),
        (functools.partial(RtiSolver, sqp_iterations=1), RtiSolver),
        (foreign.gentle, RtiSolver),
    ],
)
def test_the_solver_of_a_name_is_what_the_registry_holds(entry, kind, monkeypatch):
    monkeypatch.setitem(SOLVERS, "mine", entry)
    solver = make_planner(PlannerConfig(), QUADROTOR, 3, "mine").solver
    assert type(solver) is kind
    assert getattr(solver, "sqp_iterations", 1) == (2 if entry is foreign.gentle else 1)
    assert (solver.problem.config, solver.problem.n_others) == (PlannerConfig(), 2)


@pytest.mark.parametrize("name", ["rti", "fatrop"])
def test_built_in_solvers_can_be_replaced(name, monkeypatch):
    monkeypatch.setitem(SOLVERS, name, foreign.Stay)
    assert isinstance(make_planner(PlannerConfig(), QUADROTOR, 2, name).solver, foreign.Stay)
    auto = foreign.Stay if name == "rti" else RtiSolver
    assert isinstance(make_planner(PlannerConfig(), QUADROTOR, 2, "auto").solver, auto)


def test_every_interface_and_copies_of_it_fly_with_the_solver(monkeypatch):
    monkeypatch.setitem(SOLVERS, "stay", foreign.Stay)
    kwargs = {"solver": "stay", "scenario": "random"}
    team = gym.make("QuadSwarm-v0", **kwargs)
    batch = gym.make_vec("QuadSwarm-v0", num_envs=3, vectorization_mode="vector_entry_point", **kwargs)
    parallel = quad_swarm.parallel_env(**kwargs)
    envs = [team.unwrapped, batch.unwrapped, parallel]
    for env in [*envs, copy.deepcopy(envs[0]), pickle.loads(pickle.dumps(envs[0]))]:
        env.reset(seed=0)
        before = env.task.swarm.pos.copy()
        for _ in range(5):
            env.task.act(np.zeros((*before.shape[:2], 3, 1), bool))
        assert np.array_equal(env.task.swarm.pos, before)
        assert isinstance(env.task.swarm.planner.solver, foreign.Stay)


@pytest.mark.parametrize("made", [None, object(), foreign.Stay])
def test_what_creates_no_solver_is_refused(made, monkeypatch):
    monkeypatch.setitem(SOLVERS, "mine", lambda problem: made)
    with pytest.raises(ValueError, match=r"SOLVERS\['mine'\] created .*, which is no solver"):
        make_planner(PlannerConfig(), QUADROTOR, 2, "mine")


@pytest.mark.parametrize("kind", foreign.PROBLEMS)
def test_both_solvers_obey_a_problem_of_another_class(kind):
    config = PlannerConfig()
    state, goal = np.zeros((2, 9)), np.array([[2.0, 0.0, 1.5], [2.0, 0.0, 1.5]])
    state[:, 2] = 1.5
    others = np.tile([[0.5, 0.0, 3.5], [9.0, 9.0, 9.0]], (2, 1, 1)).reshape(2, 2, 1, 3).repeat(10, axis=2)
    others[1, 0] = [0.9, 0.05, 2.8]  # beside a sphere, within an ellipsoid
    found = {}
    for problem in (OptimalControlProblem(config, QUADROTOR, 2), kind(config, QUADROTOR, 2)):
        for solver in (FatropSolver(problem), RtiSolver(problem, sqp_iterations=8)):
            x, u = np.repeat(state[:, None], 11, axis=1), np.zeros((2, 10, 4))
            solution = solver.solve(Problems(state, goal, others), x, u)
            assert solution.success.all()
            found[type(problem), type(solver)] = solution.x[..., :3]
    converged, iterated = found[kind, FatropSolver], found[kind, RtiSolver]
    np.testing.assert_allclose(iterated, converged, atol=0.02)
    plain = found[OptimalControlProblem, FatropSolver]
    assert np.abs(converged - plain).max() > 0.1, "and the class makes a difference"


def test_changes_of_a_problem_that_is_no_subclass_are_obeyed_too():
    config = PlannerConfig()
    problem = OptimalControlProblem(config, QUADROTOR, 1)
    RtiSolver(problem)
    problem.input_cost = lambda u: 100 * OptimalControlProblem.input_cost(problem, u)
    state, others = np.zeros((1, 9)), np.full((1, 1, 10, 3), 9.0)
    call = Problems(state, np.array([[2.0, 0, 0]]), others), np.repeat(state[:, None], 11, axis=1), np.zeros((1, 10, 4))
    thrifty = foreign.Thrifty(config, QUADROTOR, 1)
    assert np.array_equal(RtiSolver(problem).solve(*call).u, RtiSolver(thrifty).solve(*call).u)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"config": "paper"}, "config='paper': pass PlannerConfig"),
        ({"quadrotor": "bebop2"}, "quadrotor='bebop2': pass QuadrotorParams"),
        ({"n_robots": 0}, "n_robots=0: it must be a whole number, at least 1"),
        ({"n_robots": 2.5}, "n_robots=2.5: it must be a whole number"),
        ({"n_obstacles": -1}, "n_obstacles=-1: it must be a whole number, at least 0"),
    ],
)
def test_arguments_of_another_kind_are_refused_in_one_sentence(change, message):
    with pytest.raises(ValueError, match=message):
        make_planner(**{"config": PlannerConfig(), "quadrotor": QUADROTOR, "n_robots": 2} | change)
