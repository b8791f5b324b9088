"""The hand-made rules."""

from fractions import Fraction

import numpy as np
import pytest

from quad_swarm.quadrotor import POSITION, VELOCITY
from quad_swarm.task.rules import RULES, parse_rule
from quad_swarm.task.view import View
from quad_swarm.world.presets import make_config
from quad_swarm.world.swarm import Swarm


def view(pos, vel, n_swarms: int = 1) -> View:
    swarm = Swarm(make_config("paper", n_robots=len(pos)), n_swarms)
    swarm.state[..., POSITION], swarm.state[..., VELOCITY] = pos, vel
    return View(swarm, [np.random.default_rng(k) for k in range(n_swarms)])


# Robot 1 comes towards robot 0 and passes it at 0.5 m after 2 s; robot 2 stands 3 m away.
SCENE = view([[0, 0, 0], [4, 0.5, 0], [0, -3, 0]], [[0, 0, 0], [-2, 0, 0], [0, 0, 0]])


@pytest.mark.parametrize(
    ("text", "asked"),
    [
        ("none", [[0, 0], [0, 0], [0, 0]]),
        ("full", [[1, 1], [1, 1], [1, 1]]),
        ("distance:3.5", [[0, 1], [0, 0], [1, 0]]),
        ("distance:4.5", [[1, 1], [1, 0], [1, 0]]),
        ("cpa:0.6:3", [[1, 0], [1, 0], [0, 0]]),
        ("cpa:0.6:1", [[0, 0], [0, 0], [0, 0]]),  # it is still 2 m away after 1 s
        ("cpa:0.4:3", [[0, 0], [0, 0], [0, 0]]),
        ("cpa:3.1:0", [[0, 1], [0, 0], [1, 0]]),
        ("random:0", [[0, 0], [0, 0], [0, 0]]),
        ("random:1", [[1, 1], [1, 1], [1, 1]]),
        ("soon:2.1", [[1, 1], [1, 1], [1, 1]]),
        ("soon:1.9", [[0, 1], [0, 0], [1, 0]]),  # robots at rest are at their closest already
        ("distance:3.5&cpa:0.6:3", [[0, 0], [0, 0], [0, 0]]),
        ("distance:3.5|cpa:0.6:3", [[1, 1], [1, 0], [1, 0]]),
        ("none&full|cpa:0.6:3", [[1, 0], [1, 0], [0, 0]]),
        ("event:0.1", [[1, 1], [1, 1], [1, 1]]),  # nobody has been asked yet
        ("stale:3", [[1, 1], [1, 1], [1, 1]]),
        ("blocked:9", [[0, 0], [0, 0], [0, 0]]),  # without obstacles
    ],
)
def test_whom_a_rule_asks(text, asked):
    requests = parse_rule(text)(SCENE)
    assert requests.dtype == bool
    assert requests[0].astype(int).tolist() == asked


def test_random_asks_with_its_probability_and_each_swarm_draws_for_itself():
    many = view([[0, 0, 0]] * 5, [[0, 0, 0]] * 5, n_swarms=500)
    requests = parse_rule("random:0.3")(many)
    assert abs(requests.mean() - 0.3) < 0.02
    alone = parse_rule("random:0.3")(view([[0, 0, 0]] * 5, [[0, 0, 0]] * 5, n_swarms=1))
    assert np.array_equal(alone[0], requests[0])


def test_robots_at_the_same_place_do_not_divide_by_zero():
    with np.errstate(all="raise"):
        assert parse_rule("cpa:0.5:1")(view([[0, 0, 0], [0, 0, 0]], [[1, 0, 0], [1, 0, 0]])).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("distnace:4", "Did you mean 'distance'"),
        ("distance", "write distance:EPS"),
        ("distance:far", "must be numbers; write distance:EPS"),
        ("cpa:0.7", "write cpa:DIST:LOOKAHEAD"),
        ("distance:-1", "non-negative"),
        ("distance:nan", "finite"),
        ("none:1", "takes 0"),
        ("none&distnace:4", "Did you mean 'distance'"),
        ("cpa:0.6:3|", "Unknown rule ''"),
        ("random:2", r"\[0, 1\]"),
    ],
)
def test_says_how_to_write_a_rule(text, message):
    with pytest.raises(ValueError, match=message):
        parse_rule(text)


def test_rules_that_remember_ask_again_when_a_plan_is_old_or_wrong():
    swarm = Swarm(make_config("paper", n_robots=2), 1)
    swarm.reset(0, np.array([[-3.0, 0, 1], [3, 0, 1]]), np.array([[-3.0, 0, 1], [3, 0, 1]]))
    ask, rest = np.ones((1, 2, 1), bool), np.zeros((1, 2, 1), bool)
    swarm.step(ask)
    ages = []
    for _ in range(4):
        view = View(swarm)
        ages.append(int(view.age[0, 0, 0]))
        assert not parse_rule("event:0.1")(view).any()
        assert parse_rule("stale:4")(view).all() == (ages[-1] >= 4)
        swarm.step(rest)
    assert ages == [2, 3, 4, 5]
    swarm.state[..., POSITION] += [0.0, 0.5, 0.0]
    assert parse_rule("event:0.1")(View(swarm)).all()
    assert parse_rule("stale:9")(View(swarm)).all(), "no longer believed"


def test_plan_looks_at_the_own_plan():
    swarm = Swarm(make_config("paper", n_robots=2), 1)
    # Robot 0 flies to where robot 1 rests
    swarm.reset(0, np.array([[-1.5, 0, 1], [1.5, 0, 1]]), np.array([[1.5, 0.2, 1], [1.5, 0, 1]]), checked=True)
    for _ in range(6):
        swarm.step(np.zeros((1, 2, 1), bool))
    near = View(swarm).plan_approach.least
    assert near[0, 0, 0] < 1.5
    assert np.array_equal(parse_rule("plan:1.5")(View(swarm)), near < 1.5)
    assert not parse_rule("plan:0.1")(View(swarm)).any()


def test_push_sends_what_has_left_what_the_others_were_told():
    swarm = Swarm(make_config("paper", n_robots=3), 1)
    starts = np.array([[-2.0, 0, 1], [2.0, 2, 1], [2.0, -2, 1]])
    swarm.reset(0, starts, np.array([[2.0, 0, 1], [2.0, 2, 1], [2.0, -2, 1]]))
    asked = np.zeros((1, 3, 2), bool)
    for _ in range(3):
        swarm.step(asked)
    # Robot 0 sets off, which a constant velocity does not tell; the others rest.
    pushed = parse_rule("push:0.1")(View(swarm))
    assert pushed[0].tolist() == [[False, False], [True, False], [True, False]]
    asked[0, 1, 0] = True
    swarm.step(asked)
    assert parse_rule("push:0.1")(View(swarm))[0].tolist() == [[False, False], [False, False], [True, False]]
    assert not parse_rule("push:9")(View(swarm)).any()


def test_stage_sends_what_has_left_what_was_told_to_those_nearby():
    swarm = Swarm(make_config("paper", n_robots=3), 1)
    starts = np.array([[-2.0, 0, 1], [0.6, 1.2, 1], [4.0, -4, 1]])
    swarm.reset(0, starts, np.array([[2.0, 0, 1], [0.6, 1.2, 1], [4.0, -4, 1]]))
    asked, rule = np.zeros((1, 3, 2), bool), parse_rule("stage:1.5:0.1")
    for _ in range(8):
        swarm.step(asked)
    # Robot 0 passes robot 1, whose prediction of it is off; robot 2 is far away
    assert rule(View(swarm))[0].tolist() == [[False, False], [True, False], [False, False]]
    assert not parse_rule("stage:1.5:9")(View(swarm)).any()
    asked[0, 1, 0] = True
    swarm.step(asked)
    assert not rule(View(swarm)).any(), "it knows the plan now"


def test_lengths_may_be_given_in_separations():
    swarm = Swarm(make_config("paper", n_robots=2, radius=0.1), 1)
    assert View(swarm).separation == pytest.approx(0.2)
    for distance, asks in ((0.29, True), (0.31, False)):
        swarm.reset(0, np.array([[0, 0, 1], [distance, 0, 1]]), np.array([[0, 0, 1], [distance, 0, 1]]))
        assert parse_rule("distance:1.5s")(View(swarm)).all() == asks
        assert parse_rule("distance:1.5s&cpa:9:2|distance:0.01")(View(swarm)).all() == asks
    with pytest.raises(ValueError, match="only lengths"):
        parse_rule("stale:3s")


@pytest.mark.parametrize(
    "form", [np.array, np.ndarray.tolist, lambda bits: bits.astype(float), lambda bits: bits + Fraction(0)]
)
@pytest.mark.parametrize("text", ["own", "own&full", "none|own"])
def test_a_rule_may_answer_with_numbers(form, text, monkeypatch):
    asked = np.array([[[1, 0], [0, 1], [1, 1]]], bool)
    monkeypatch.setitem(RULES, "own", (lambda: lambda view: form(asked), ()))
    answer = parse_rule(text)(SCENE)
    assert answer.dtype == bool
    assert np.array_equal(answer, asked)


@pytest.mark.parametrize("text", ["own", "own&full", "none|own"])
@pytest.mark.parametrize(
    "answer",
    [
        None, True, "all", [[1], [1, 0]], np.full((1, 3, 2), 0.7), np.full((1, 3, 2), np.nan), np.full((1, 3, 2), -1),
        np.ones((1, 2, 3), bool), np.ones((3, 2), bool), np.ones((1, 3, 1), bool), np.full((1, 3, 2), "x"),
        np.full((1, 3, 2), 1j),
        np.ma.array(np.ones((1, 3, 2)), mask=True),
    ],
)  # fmt: skip
def test_a_rule_that_answers_with_something_else_is_refused(answer, text, monkeypatch):
    monkeypatch.setitem(RULES, "own", (lambda: lambda view: answer, ()))
    with pytest.raises(ValueError, match=r"Rule 'own' returned .*True or False .* shape \(1, 3, 2\)"):
        parse_rule(text)(SCENE)


def test_a_rule_cannot_move_robots():
    swarm = Swarm(make_config("paper", n_robots=3), 1)
    View(swarm).own_pos[...] = 1.0
    assert not swarm.state.any()


def test_a_rule_keeps_its_state_with_lengths_in_separations_too(monkeypatch):
    def make(distance):
        calls = []

        def rule(view):
            calls.append(distance)
            return np.full(view.pos.shape[:-1], len(calls) > 1)

        return rule

    monkeypatch.setitem(RULES, "own", (make, ("DIST",)))
    for text in ("own:1", "own:1s"):
        rule = parse_rule(text)
        assert [rule(SCENE).all() for _ in range(3)] == [False, True, True]


def test_blocked_asks_whose_predicted_motion_leads_to_an_obstacle():
    """Robot 1 flies towards a pillar, others stand beside it."""
    config = make_config("paper", n_robots=3, obstacles={"listed": [{"position": (2.0, 0, 0), "radius": 0.5}]})
    swarm = Swarm(config)
    places = np.array([[0.0, 0, 1], [4, 0, 1], [2, 2, 1]])
    swarm.reset(0, places, places, checked=True)
    swarm.state[0, 1, VELOCITY] = [-2.0, 0, 0]
    assert parse_rule("blocked:0.1")(View(swarm))[0].tolist() == [[True, False], [False, False], [False, True]]
    assert parse_rule("blocked:1.3")(View(swarm))[0].tolist() == [[True, True], [True, True], [True, True]]
