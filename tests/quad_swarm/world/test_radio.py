"""Plans that travel: which of the last steps an answer contains, and how old it is."""

import numpy as np
import pytest

from quad_swarm.world.beliefs import other_indices
from quad_swarm.world.disturbances import Radio
from quad_swarm.world.radio import RadioChannel, make_channel

N = 4  # stages
OTHERS = other_indices(3)


def plans_of(step: int) -> np.ndarray:
    """What two swarms of three robots plan in a step: robot 10 E + n moves along x by its number, from `step` on."""
    speed = np.array([[0.0, 1, 2], [10, 11, 12]])[..., None, None]
    return (step + np.arange(N + 1))[:, None] * speed * [1.0, 0, 0] + [0, step, 0]


def channel(delay: int, jitter: int = 0) -> RadioChannel:
    radio = RadioChannel(delay, jitter, plans_of(0))
    for step in range(8):
        radio.send(plans_of(step))
    return radio  # at the beginning of step 8


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_answers_take_a_step_and_the_delay(delay):
    arriving = np.zeros((2, 3, 2), dtype=bool)
    arriving[0, 1, 1] = arriving[1, 0, 0] = True  # robot 2 to 1, and in the other swarm robot 1 to 0
    received, age = channel(delay).answers(arriving, OTHERS)
    assert age == 1 + delay
    made = 8 - age
    assert received[:, 0].tolist() == [[8 * 2, made, 0], [8 * 11, made, 0]], "now, as planned then"


def test_some_answers_are_later():
    radio, arriving = channel(1, jitter=2), np.ones((2, 3, 2), dtype=bool)
    lateness = np.random.default_rng(0).integers(0, 3, arriving.shape)
    received, ages = radio.answers(arriving, OTHERS, lateness)
    assert np.array_equal(ages, 2 + lateness.ravel())
    assert np.array_equal(received[:, 0, 1], 8 - ages)
    none, ages = radio.answers(~arriving, OTHERS, lateness)
    assert none.shape == (0, N + 1, 3)
    assert ages.shape == (0,)


def test_one_swarm_starts_again_and_others_leave():
    radio, arriving = channel(2), np.ones((2, 3, 2), dtype=bool)
    radio.reset(1, plans_of(100)[1])
    radio.keep(np.array([False, True]))
    radio.send(plans_of(8)[1:])
    received, _ = radio.answers(arriving[:1], OTHERS)
    assert (received[:, 0, 1] == 100).all()


def test_it_goes_on_from_its_state():
    radio, arriving = channel(1, jitter=1), np.ones((2, 3, 2), dtype=bool)
    other = RadioChannel(1, 1, plans_of(0))
    other.load_state_dict(radio.state_dict())
    for one in (radio, other):
        one.send(plans_of(8))
    lateness = np.ones(arriving.shape, dtype=int)
    assert np.array_equal(radio.answers(arriving, OTHERS, lateness)[0], other.answers(arriving, OTHERS, lateness)[0])
    with pytest.raises(ValueError, match="The state has 2 earlier plans, but this world has 3"):
        RadioChannel(3, 0, plans_of(0)).load_state_dict(radio.state_dict())


def causal(round_trip: int, jitter: int = 0) -> RadioChannel:
    return make_channel(Radio(round_trip=round_trip, jitter=jitter), plans_of(0), n_slots=2)


def test_answers_of_a_network_are_fresh_and_come_later():
    radio, asked = causal(round_trip=2), np.zeros((2, 3, 2), dtype=bool)
    asked[0, 1, 1] = True  # robot 2 to 1
    for step in range(5):
        radio.send(plans_of(step))
        arriving, received, ages = radio.deliver(asked & (step == 1), OTHERS, None)
        assert arriving.any() == (step == 3)
    radio.send(plans_of(5))
    radio.deliver(asked, OTHERS, None)
    for step in (6, 7):
        radio.send(plans_of(step))
        arriving, received, ages = radio.deliver(~asked, OTHERS, None)
    assert np.argwhere(arriving).tolist() == [[0, 1, 1]]
    assert ages.tolist() == [3], "asked in step 6 for the plan of step 5"
    assert received[0, 0].tolist() == [8 * 2, 5, 0]


def test_an_answer_within_the_step_is_the_plan_of_the_last_one():
    radio, asked = causal(round_trip=0), np.ones((2, 3, 2), dtype=bool)
    radio.send(plans_of(4))
    arriving, received, age = radio.deliver(asked, OTHERS, None)
    assert arriving.all()
    assert age == 1
    assert (received[:, 0, 1] == 4).all()


def test_of_two_answers_in_one_step_the_newer_counts():
    radio, asked = causal(round_trip=0, jitter=2), np.zeros((2, 3, 2), dtype=bool)
    asked[1, 0, 0] = True
    for step, late in ((1, 2), (2, 1), (3, 0)):  # all arrive in step 3
        radio.send(plans_of(step))
        arriving, received, ages = radio.deliver(asked, OTHERS, np.full(asked.shape, late))
        assert arriving.any() == (step == 3)
    assert ages.tolist() == [1]
    assert received[0, 0].tolist() == [4 * 11, 3, 0]


def test_what_is_on_its_way_is_part_of_the_state_and_ends_with_the_episode():
    radio, asked = causal(round_trip=2), np.ones((2, 3, 2), dtype=bool)
    radio.send(plans_of(1))
    radio.deliver(asked, OTHERS, None)
    other = causal(round_trip=2)
    other.load_state_dict(radio.state_dict())
    forgetful = causal(round_trip=2)
    forgetful.load_state_dict(radio.state_dict())
    forgetful.reset(0, plans_of(9)[0])
    left = np.zeros(asked.shape, dtype=bool)
    left[1, 2, 0] = True  # its slot holds another robot now
    forgetful.forget(left)
    for step in (2, 3):
        found = []
        for one in (radio, other, forgetful):
            one.send(plans_of(step))
            found.append(one.deliver(~asked, OTHERS, None))
    assert found[0][0].all()
    assert all(np.array_equal(a, b) for a, b in zip(found[0], found[1], strict=True))
    assert np.array_equal(found[2][0], np.array([[[False] * 2] * 3, [[True] * 2, [True] * 2, [False, True]]]))
    with pytest.raises(ValueError, match="The state has 2 earlier plans, but this world has 3"):
        causal(round_trip=3).load_state_dict(radio.state_dict())
    *plans, ages = causal(round_trip=2).state_dict()
    ages[1] = 2  # used in two steps, when it would be four steps old
    with pytest.raises(ValueError, match="on their way for more than the 2 steps"):
        radio.load_state_dict([*plans, ages])
