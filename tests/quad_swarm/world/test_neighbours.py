"""Limited neighbourhoods: the slots, knowledge that is forgotten, and that everything else is unchanged."""

import numpy as np
import pytest

from quad_swarm.native import pairs
from quad_swarm.task.request_task import make_task
from quad_swarm.task.rules import parse_rule
from quad_swarm.task.view import View
from quad_swarm.world.beliefs import BeliefSource, other_indices, reverse_indices
from quad_swarm.world.neighbours import Neighbourhood, Neighbours, slots_to_robots
from quad_swarm.world.presets import make_config
from quad_swarm.world.scenarios import ScenarioSampler
from quad_swarm.world.swarm import Swarm

EVERYBODY = {"range": 1e4}
FEW = {"max_others": 3, "range": 2.5}
PAIRS = "state+approach+side+memory+plan+told+mask+critic"


def make_swarm(
    neighbourhood: dict, preset: str = "flight-hard", n_swarms: int = 2, scenario: str = "random_swap"
) -> Swarm:
    config = make_config(preset, n_robots=8, world={"neighbourhood": neighbourhood})
    swarm, sampler = Swarm(config, n_swarms), ScenarioSampler(scenario, 8, config.space)
    for k in range(n_swarms):
        swarm.reset(k, *sampler.sample(np.random.default_rng(k))[1:], noise_seed=k)
    return swarm


def asked(swarm: Swarm, rng: np.random.Generator, share: float = 0.3) -> np.ndarray:
    requests = rng.random((swarm.n_swarms, swarm.config.n_robots, swarm.config.n_others)) < share
    return swarm.neighbours.perceived(requests)


def placed(*points: tuple[float, float], neighbourhood: dict, preset: str = "paper", **world) -> Swarm:
    """Return a swarm at rest at some points, at a height of 1.5 m."""
    config = make_config(preset, n_robots=len(points), world={"neighbourhood": neighbourhood, **world})
    swarm = Swarm(config, 1)
    starts = np.column_stack([points, np.full(len(points), 1.5)])
    swarm.reset(0, starts, starts)
    return swarm


@pytest.mark.parametrize("preset", ["dense", "flight", "flight-hard"])
def test_who_perceives_everybody_flies_as_without_a_limit(preset):
    plain, limited = make_swarm({}, preset), make_swarm(EVERYBODY, preset)
    assert limited.neighbours.limited
    assert not plain.neighbours.limited
    rng = np.random.default_rng(0)
    for _ in range(60):
        requests = asked(limited, rng)
        first, second = plain.step(requests), limited.step(requests)
        assert np.array_equal(plain.state, limited.state)
        assert np.array_equal(first.belief_source, second.belief_source)
        assert np.array_equal(first.plan_age, second.plan_age)
        for name in ("min_separation", "min_separation_continuous", "separation"):
            np.testing.assert_allclose(getattr(second, name), getattr(first, name), rtol=1e-12)
        assert not second.changed.any()


def test_a_limit_that_nobody_meets_is_none():
    assert not make_config("flight", world={"neighbourhood": {"max_others": 7}}).is_limited
    assert not make_config("flight", world={"neighbourhood": {"max_others": 50}}).is_limited
    assert make_config("flight", world={"neighbourhood": {"max_others": 6}}).n_others == 6


@pytest.mark.parametrize(
    ("neighbourhood", "message"),
    [
        ({"max_others": 0}, "neighbourhood.max_others=0"),
        ({"range": -1.0}, "neighbourhood.range=-1"),
        ({"range": 0.7}, r"neighbourhood.range=0.7: .*planner.separation=0.8"),
        ({"max_other": 3}, "Did you mean 'max_others'"),
    ],
)
def test_refuses_senseless_neighbourhoods(neighbourhood, message):
    with pytest.raises(ValueError, match=message):
        make_config("flight", world={"neighbourhood": neighbourhood})


def test_places_belong_to_the_nearest_and_are_kept():
    rng = np.random.default_rng(1)
    n, m, reach = 9, 4, 1.5
    neighbours = Neighbours(3, n, Neighbourhood(m, reach))
    pos = rng.normal(size=(3, n, 3))
    for k in range(3):
        neighbours.reset(k, pos[k])
    came = left = 0
    for _ in range(200):
        before = neighbours.numbers()
        pos = pos + 0.1 * rng.normal(size=pos.shape)
        changed = neighbours.update(pos, rng.normal(size=pos.shape))
        now = neighbours.numbers()
        distance = np.linalg.norm(pos[:, :, None] - pos[:, None], axis=-1) + np.diag(np.full(n, np.inf))
        for swarm, robot in np.ndindex(3, n):
            order = np.argsort(distance[swarm, robot])[:m]
            near = {j for j in order if distance[swarm, robot, j] <= reach}
            row, old = now[swarm, robot], before[swarm, robot]
            assert set(row) - {-1} == near
            kept = [j for j in old if j in near]
            assert all(row[old.tolist().index(j)] == j for j in kept)
            assert np.array_equal(changed[swarm, robot], row != old)
            for place, j in enumerate(row):
                theirs = now[swarm, j].tolist()
                back = theirs.index(robot) if j >= 0 and robot in theirs else -1
                assert neighbours.reverse[swarm, robot, place] == back
            came += len(near - set(old))
            left += len(set(old) - {-1} - near)
    assert min(came, left) > 100


def test_who_would_soon_be_nearest_may_come_before_who_is_now():
    pos = np.array([[[0.0, 0, 1], [1.5, 0, 1], [4.0, 0, 1], [0, 5, 1]]])
    vel = np.array([[[0.0, 0, 0], [0, 1, 0], [-3, 0, 0], [0, -1, 0]]])
    nearest = {}
    for look_ahead in (0.0, 1.0, 9.0):
        neighbours = Neighbours(1, 4, Neighbourhood(1, 4.5, look_ahead))
        neighbours.reset(0, pos[0])
        assert neighbours.numbers()[0, 0].tolist() == [1], "all are at rest"
        neighbours.update(pos, vel)
        nearest[look_ahead] = neighbours.numbers()[0, 0, 0]
    assert nearest == {0.0: 1, 1.0: 2, 9.0: 2}, "robot 3 is out of range"


def test_places_are_filled_in_ascending_order_at_first():
    neighbours = Neighbours(1, 6, Neighbourhood(range=100.0))
    neighbours.reset(0, np.random.default_rng(0).normal(size=(6, 3)))
    assert np.array_equal(neighbours.others[0], other_indices(6))
    assert np.array_equal(neighbours.reverse[0], reverse_indices(6))


def test_who_leaves_is_forgotten_and_who_stays_is_not():
    swarm = placed((0, 0), (1.5, 0), (0, 1.5), neighbourhood={"range": 2.0})
    swarm.step(swarm.neighbours.perceived(np.ones((1, 3, 2), dtype=bool)))
    pos, vel = swarm.observe()
    assert swarm.beliefs.predict(pos, vel).remembers[0, 0].all()
    swarm.state[0, 1, 0] = 3.0  # out of range of all others
    swarm.step(np.zeros((1, 3, 2), dtype=bool))
    assert swarm.neighbours.numbers()[0].tolist() == [[-1, 2], [-1, -1], [0, -1]]
    remembers = swarm.beliefs.predict(*swarm.observe()).remembers
    assert remembers[0].tolist() == [[False, True], [False, False], [True, False]]
    swarm.state[0, 1, 0] = 1.5  # back at its start
    swarm.step(np.zeros((1, 3, 2), dtype=bool))
    assert swarm.neighbours.numbers()[0, 0].tolist() == [1, 2]
    assert swarm.beliefs.predict(*swarm.observe()).age[0, 0].tolist()[0] >= swarm.config.planner.horizon


def test_errors_of_an_observer_stay_with_the_one_that_is_observed():
    """New neighbours get new draws from the same distribution."""
    swarm = make_swarm(FEW, n_swarms=40)
    rng, drawn, kept, anew = np.random.default_rng(0), [], [], []
    for _ in range(40):
        before, numbers = swarm.disturbances._observer.copy(), swarm.neighbours.numbers()
        changed = swarm.step(asked(swarm, rng)).changed
        came = changed & swarm.neighbours.present
        drawn.append(swarm.disturbances._observer[came, 0])
        jump = np.abs(swarm.disturbances._observer - before)[..., 0]
        kept.append(jump[~changed & (numbers >= 0)])
        anew.append(jump[came])
    kept, anew, drawn = map(np.concatenate, (kept, anew, drawn))
    assert len(drawn) > 500
    assert kept.mean() < 0.75 * anew.mean()
    assert np.std(drawn) == pytest.approx(swarm.config.sensing.others_pos, rel=0.15)


@pytest.mark.parametrize("solver", ["rti", "fatrop"])
def test_nobody_plans_around_an_empty_place(solver):
    config = make_config("flight", n_robots=2, world={"neighbourhood": {"range": 3.0}, "noise": {"wind": 0, "gust": 0}})
    swarm = Swarm(config, 2, solver)
    for k, away in enumerate((4.5, -4.5)):
        starts = np.array([[0.0, 0.0, 1.5], [away, 0.0, 1.5]])
        swarm.reset(k, starts, starts + np.array([0.0, 1.0, 0.0]), noise_seed=0)
    for _ in range(5):
        swarm.step(np.zeros((2, 2, 1), dtype=bool))
    assert not swarm.neighbours.present.any()
    assert np.array_equal(swarm.plans[0, 0], swarm.plans[1, 0]), "the side of the other makes no difference"


def test_nobody_can_be_asked_who_is_not_perceived():
    task = make_task(3, "flight", "random_swap", world={"neighbourhood": FEW}, announcements=True)
    for k in range(3):
        task.reset(k, np.random.default_rng(k))
    everything = np.ones((3, 8, 3, 2), dtype=bool)
    unheard = 0
    for _ in range(30):
        neighbours = task.swarm.neighbours
        numbers, n_present = neighbours.numbers(), neighbours.present.sum(axis=(1, 2))
        hears = (neighbours.reverse >= 0).sum(axis=(1, 2))
        outcome = task.act(everything)
        assert np.array_equal(outcome.report.others, numbers)
        assert (outcome.report.belief_source[numbers < 0] == BeliefSource.CONSTANT_VELOCITY).all()
        assert np.array_equal(outcome.n_requests, n_present + (n_present - hears)), "some announcements are lost"
        assert np.array_equal(outcome.reward_terms["requests"], -task.reward.request * 2 * n_present)
        assert np.array_equal(outcome.pair_rewards != 0, numbers >= 0)
        unheard += int((n_present - hears).sum())
    assert unheard > 0


@pytest.mark.parametrize(
    "rule", ["full", "distance:50", "cpa:9:9", "soon:99", "event:0", "push:0", "stale:0", "plan:99"]
)
def test_rules_ask_whom_they_perceive(rule):
    swarm = make_swarm(FEW, "flight")
    policy = parse_rule(rule)
    for _ in range(3):
        bits = policy(View(swarm))
        assert bits.shape == (2, 8, 3)
        swarm.step(swarm.neighbours.perceived(bits))
    present, mutual = swarm.neighbours.present, swarm.neighbours.reverse >= 0
    assert not present.all()
    wanted = mutual if rule.startswith("push") else present
    assert (swarm.neighbours.perceived(policy(View(swarm))) <= wanted).all()
    if not rule.startswith("push"):
        assert np.array_equal(swarm.neighbours.perceived(policy(View(swarm))), present)


def test_who_does_not_perceive_a_robot_is_taken_to_expect_a_constant_velocity():
    swarm = placed((0, 0), (1.2, 0), (1.9, 0), neighbourhood={"max_others": 1}, planner={"separation": 0.6})
    assert swarm.neighbours.numbers()[0].tolist() == [[1], [2], [1]]  # no robot perceives robot 0
    swarm.state[0, 0, 3:6] = [0.1, 0.2, 0.3]
    seen = View(swarm).seen_by_others([0, 4])
    step = swarm.config.planner.dt * np.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(seen.believed[0, 0, 0], swarm.pos[0, 0] + [step, 5 * step])
    assert not seen.remembers[0, 0, 0]
    assert seen.age[0, 0, 0] >= swarm.config.planner.horizon


def test_robots_that_do_not_perceive_each_other_collide_all_the_same():
    """Two pairs of nearest neighbours meet during a step."""
    points = [(0.0, 0.0), (0.0, 0.8), (3.0, 0.0), (3.0, 0.8)]
    swarm = placed(*points, neighbourhood={"max_others": 1})
    before = swarm.pos.copy()
    assert swarm.neighbours.numbers()[0].tolist() == [[1], [0], [3], [2]]
    swarm.state[0, 2:, 0] = 0.5
    report = swarm._report(np.array([before, swarm.pos]), np.zeros((1, 4, 1)), 0.0)
    assert report.min_separation[0] == pytest.approx(0.5)
    assert report.collision[0]
    assert report.collision_continuous[0]
    assert not report.colliding.any()
    np.testing.assert_allclose(report.separation, 0.8)


@pytest.mark.parametrize("neighbourhood", [EVERYBODY, FEW])
def test_observations_of_empty_places_are_zero_and_others_as_without_a_limit(neighbourhood):
    tasks = [
        make_task(2, "flight", "random_swap", world={"neighbourhood": limit}, observation=PAIRS, announcements=True)
        for limit in ({}, neighbourhood)
    ]
    plain, limited = tasks
    for task in tasks:
        for k in range(2):
            task.reset(k, np.random.default_rng(k))
    layout = limited.observation_layout
    names = limited.observe()[..., layout["who_columns"]]
    assert np.array_equal(names, limited.swarm.neighbours.numbers() + 1)
    assert "complete" not in layout
    sets = (plain.observe(), plain), (limited.observe(), limited)
    (of_all, _), (of_near, _) = sets
    assert np.array_equal(of_all[..., :6], of_near[..., :6])
    columns = [np.array(task.observation_layout["neighbours"]) for _, task in sets]
    views = [obs[..., each] for (obs, _), each in zip(sets, columns, strict=True)]
    for swarm, robot, place in np.ndindex(names.shape):
        other = int(names[swarm, robot, place]) - 1
        if other < 0:
            assert not views[1][swarm, robot, place].any()
        elif neighbourhood is EVERYBODY:
            theirs = other - (other > robot)
            assert np.array_equal(views[1][swarm, robot, place], views[0][swarm, robot, theirs])
    paper = make_task(1, "flight", "random_swap", world={"neighbourhood": FEW})
    paper.reset(0, np.random.default_rng(0))
    seen = paper.observe()[0][:, np.array(paper.observation_layout["neighbours"])]
    assert np.array_equal(seen.any(axis=-1), paper.swarm.neighbours.present[0])


def test_a_flight_goes_on_from_its_state_and_a_fork_on_its_own():
    swarm = make_swarm(FEW)
    rng = np.random.default_rng(0)
    for _ in range(15):
        swarm.step(asked(swarm, rng))
    other, fork = make_swarm(FEW), swarm.fork()
    other.load_state_dict(swarm.state_dict())
    flights = []
    for one in (swarm, other, fork):
        rng = np.random.default_rng(1)
        flights.append([(one.step(asked(one, rng)), one.state.copy())[1] for _ in range(15)])
    assert np.array_equal(flights[0], flights[1])
    assert np.array_equal(flights[0], flights[2])
    with pytest.raises(ValueError, match="neighbours"):
        other.load_state_dict({**swarm.state_dict(), "neighbours": Neighbours(2, 8, Neighbourhood(4)).state_dict()})


def test_a_swarm_does_not_depend_on_its_company():
    together, alone = make_swarm(FEW, n_swarms=3), make_swarm(FEW, n_swarms=3)
    alone.keep(np.arange(3) == 1)
    for _ in range(30):
        requests = np.ones((3, 8, 3), dtype=bool)
        together.step(together.neighbours.perceived(requests))
        alone.step(alone.neighbours.perceived(requests[:1]))
    assert np.array_equal(together.state[1], alone.state[0])


def test_spread_names_robots_by_their_numbers():
    numbers = np.array([[[2, -1], [-1, 0], [1, 0]]])
    slots = np.array([[[True, True], [False, True], [False, True]]])
    assert slots_to_robots(slots, numbers)[0].tolist() == [[False, True], [True, False], [True, False]]
    plain = np.random.default_rng(0).random((2, 4, 3)) < 0.5
    assert slots_to_robots(plain, other_indices(4)) is plain


def nearest_as_observed(swarm: Swarm, m: int) -> list[set[int]]:
    """The others that each robot of the first swarm takes for the nearest, from what it is given about everybody."""
    estimate, numbers = swarm.estimate()[0], swarm.neighbours.numbers_in(0)
    observed = swarm.observe()[0][0]
    chosen = []
    for robot, own in enumerate(estimate[:, :3]):
        seen = estimate[:, :3].copy()  # what the others broadcast
        for slot, other in enumerate(numbers[robot]):
            seen[other] = observed[robot, slot]
        distances = np.linalg.norm(seen - own, axis=-1)
        distances[robot] = np.inf
        chosen.append(set(np.argsort(distances)[:m].tolist()))
    return chosen


@pytest.mark.parametrize("sensing", [{"pos": 1.0}, {"others_pos": 1.0}, {"pos": 0.5, "others_pos": 0.5}])
@pytest.mark.parametrize("way", ["compiled", "numpy"])
def test_neighbours_are_chosen_by_what_robots_observe(sensing, way, monkeypatch):
    if way == "numpy":
        monkeypatch.setattr(pairs, "compiled", lambda: None)
    config = make_config("paper", n_robots=8, world={"neighbourhood": {"max_others": 3}, "sensing": sensing})
    swarm = Swarm(config, 1)
    starts = np.random.default_rng(1).uniform([-4, -4, 0.7], [4, 4, 2.1], (8, 3))
    swarm.reset(0, starts, starts, noise_seed=3)
    if "pos" in sensing:
        estimate = swarm.estimate()[0, :, :3]
        distances = np.linalg.norm(estimate[:, None] - estimate, axis=-1) + np.diag(np.full(8, np.inf))
        expected = [set(row[:3].tolist()) for row in np.argsort(distances)]
        assert [set(row) for row in swarm.neighbours.numbers_in(0).tolist()] == expected
    by_truth = 0
    for _ in range(20):
        swarm.disturbances.advance(swarm.state)  # errors change, robots stay
        expected = nearest_as_observed(swarm, 3)
        swarm._look_around()
        assert [set(row) for row in swarm.neighbours.numbers_in(0).tolist()] == expected
        distances = np.linalg.norm(swarm.pos[0][:, None] - swarm.pos[0], axis=-1) + np.diag(np.full(8, np.inf))
        by_truth += [set(row[:3].tolist()) for row in np.argsort(distances)] == expected
    assert by_truth < 20
