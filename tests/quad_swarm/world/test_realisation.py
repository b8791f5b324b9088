"""What chance makes of the disturbances: statistics, seeds, and that nobody sees what a robot could not know."""

import numpy as np
import pytest

from quad_swarm.world.beliefs import BeliefSource, other_indices
from quad_swarm.world.presets import SwarmConfig, make_config
from quad_swarm.world.realisation import OUTAGE_WITHIN, Realisation
from quad_swarm.world.scenarios import ScenarioSampler
from quad_swarm.world.swarm import Swarm

EVERYTHING = {
    "substeps": 5,
    "noise": {"pos": 0.002, "vel": 0.02, "attitude": 0.005, "wind": 1.0, "gust": 0.5},
    "sensing": {
        "pos": 0.01,
        "vel": 0.05,
        "attitude": 0.01,
        "others_pos": 0.01,
        "others_vel": 0.05,
        "others_delay": 2,
        "gaps": 0.1,
        "gap_length": 5,
    },
    "radio": {
        "loss": 0.2,
        "delay": 1,
        "jitter": 2,
        "bursts": 0.1,
        "outage": 0.3,
        "range": 3.0,
        "half_distance": 2.0,
    },
    "mismatch": 0.1,
    "clock_skew": 0.8,
}


def drawn(n_swarms: int = 200, **world) -> tuple[SwarmConfig, Realisation]:
    config = make_config(world=world)
    chance = Realisation(config, n_swarms)
    for k in range(n_swarms):
        chance.reset(k, k, np.zeros((config.n_robots, 9)))
    return config, chance


def make_swarm(n_swarms: int, **world) -> Swarm:
    swarm = Swarm(make_config(world=world), n_swarms, "rti")
    for k in range(n_swarms):
        rng = np.random.default_rng(k)
        swarm.reset(k, *ScenarioSampler("symmetric_swap", 4, swarm.config.space).sample(rng)[1:], noise_seed=k)
    return swarm


def fly(swarm: Swarm, steps: int, seed: int = 0) -> np.ndarray:
    requests = np.random.default_rng(seed).random((steps, 1, *swarm.neighbours.others.shape)) < 0.5
    path = []
    for k in range(steps):
        swarm.step(np.broadcast_to(requests[k], (swarm.n_swarms, *requests.shape[2:])))
        path.append(swarm.state.copy())
    return np.array(path)


def test_the_same_seeds_give_the_same_flight_and_others_another():
    first, second = (fly(make_swarm(3, **EVERYTHING), 25) for _ in range(2))
    assert np.array_equal(first, second)
    assert np.abs(first[:, 0] - first[:, 1]).max() > 0.01


def test_a_swarm_does_not_depend_on_its_company_nor_a_fork_on_its_origin():
    together, alone = make_swarm(3, **EVERYTHING), make_swarm(3, **EVERYTHING)
    alone.keep(np.arange(3) == 1)
    assert np.array_equal(fly(alone, 25)[:, 0], fly(together, 25)[:, 1])
    fork = together.fork()
    assert np.array_equal(fly(fork, 10, seed=1), fly(together, 10, seed=1))


@pytest.mark.parametrize("correlation_time", [0.0, 0.2, 1.0])
def test_errors_are_stationary_and_forgotten_in_the_time_given(correlation_time):
    sensing = {"pos": 0.02, "vel": 0.05, "attitude": 0.01, "others_pos": 0.03, "correlation_time": correlation_time}
    config, chance = drawn(400, sensing=sensing)
    state, pos = np.zeros((400, 4, 9)), np.zeros((400, 4, 3, 3))
    own, seen = [chance.estimate(state)], [chance.observe(pos, pos)[0]]
    for _ in range(5):
        assert chance.advance(state) is state, "there is no process noise"
        own.append(chance.estimate(state))
        seen.append(chance.observe(pos, pos)[0])
    for step in (0, 5):
        spread = own[step].std(axis=(0, 1))
        np.testing.assert_allclose(spread[:8], np.repeat([0.02, 0.05, 0.01], 3)[:8], rtol=0.08)
        assert spread[8] == 0, "the yaw is held"
        assert seen[step].std() == pytest.approx(0.03, rel=0.05)
    correlation = np.corrcoef(own[0][..., 0].ravel(), own[5][..., 0].ravel())[0, 1]
    expected = np.exp(-5 * config.planner.dt / correlation_time) if correlation_time else 0.0
    assert correlation == pytest.approx(expected, abs=0.08)


def test_gusts_come_on_top_of_the_wind():
    _, chance = drawn(400, noise={"wind": 2.0, "gust": 0.5})
    assert np.linalg.norm(chance.air.mean(axis=1), axis=-1).mean() == pytest.approx(2.0, abs=0.1)
    gusts = chance.air - chance.air.mean(axis=1, keepdims=True)
    assert gusts.std() == pytest.approx(0.5 * np.sqrt(3 / 4), rel=0.05)


def test_vehicles_differ_by_the_share_given():
    _, chance = drawn(200, mismatch=0.1)
    assert chance.factors is not None
    assert 0.9 <= chance.factors.min() < 0.91
    assert 1.09 < chance.factors.max() <= 1.1
    assert drawn(2)[1].factors is None


def test_a_vehicle_unlike_its_model_flies_otherwise():
    # Everything else is alike, so that what differs is the vehicle.
    assert np.abs(fly(make_swarm(1, mismatch=0.2), 20) - fly(make_swarm(1), 20)).max() > 0.02


def test_links_are_interrupted_for_the_share_and_the_time_given():
    config, chance = drawn(50, radio={"bursts": 0.2, "burst_length": 8})
    requests, others = np.ones((50, 4, 3), bool), other_indices(config.n_robots)
    arrived = np.stack([chance.arrivals(requests, others)[0] for _ in range(400)])
    assert (~arrived).mean() == pytest.approx(0.2, abs=0.02)
    ends = (~arrived[:-1] & arrived[1:]).sum() / (~arrived[:-1]).sum()
    assert 1 / ends == pytest.approx(8, rel=0.1)


RADIUS = np.array([0.0, 0.5, 1.5, 3.0])  # where four robots stand in a row
DISTANCE = np.abs(RADIUS[other_indices(4)] - RADIUS[:, None])


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_the_share_that_arrives_falls_with_distance(loss):
    radio = {"loss": loss, "range": 2.7, "half_distance": 1.5, "path_loss_exponent": 2.0}
    _, chance = drawn(100, radio=radio)
    requests, others = np.ones((100, 4, 3), bool), other_indices(4)
    pos = np.tile(RADIUS[:, None] * [0.6, 0.0, 0.8], (100, 1, 1))
    carried = [chance.carried(requests, pos, others) for _ in range(200)]
    arrived = [chance.arrivals(one, others)[0] for one in carried]
    expected = np.where(DISTANCE <= 2.7, 0.5 ** ((DISTANCE / 1.5) ** 2), 0.0)
    for found, share in ((carried, expected), (arrived, (1 - loss) * expected)):
        error = np.sqrt(share * (1 - share) / 20_000)
        assert (np.abs(np.mean(found, axis=(0, 1)) - share) <= 4 * error).all()
    assert not carried[0][:, 0, 2].any(), "3 m is beyond the range"


def test_without_a_limit_of_distance_the_radio_draws_what_it_drew():
    _, chance = drawn(1, radio={"loss": 0.3, "jitter": 2})
    requests, others, rng = np.ones((1, 4, 3), bool), other_indices(4), np.random.default_rng(0)
    rng.uniform()  # the direction of the wind
    for pos in np.random.default_rng(1).normal(size=(20, 1, 4, 3)):
        assert chance.carried(requests, pos, others) is requests
        arrived, lateness = chance.arrivals(requests, others)
        assert np.array_equal(arrived[0], rng.random((4, 3)) >= 0.3)
        assert np.array_equal(lateness[0], rng.integers(0, 3, (4, 3)))


def test_silent_robots_answer_nobody_and_stay_silent():
    config, chance = drawn(100, radio={"outage": 0.3})
    requests, others = np.ones((100, 4, 3), bool), other_indices(config.n_robots)
    answers = []
    for _ in range(round(OUTAGE_WITHIN / config.planner.dt) + 1):
        answers.append(chance.arrivals(requests, others)[0])
        chance.advance(np.zeros((100, 4, 9)))
    silent = np.zeros((len(answers), 100, 4), bool)
    for robot in range(4):
        silent[..., robot] = ~np.stack([a[:, others == robot] for a in answers]).any(axis=-1)
        assert np.array_equal(silent[..., robot], ~np.stack([a[:, others == robot] for a in answers]).all(axis=-1))
    assert (silent[1:] >= silent[:-1]).all()
    assert silent[0].mean() < 0.05
    assert silent[-1].mean() == pytest.approx(0.3, abs=0.07)


def test_answers_are_late_by_up_to_the_jitter():
    config, chance = drawn(50, radio={"jitter": 2})
    requests, others = np.ones((50, 4, 3), bool), other_indices(config.n_robots)
    lateness = np.stack([chance.arrivals(requests, others)[1] for _ in range(50)])
    assert np.bincount(lateness.ravel()) / lateness.size == pytest.approx([1 / 3] * 3, abs=0.02)
    swarm = make_swarm(3, radio={"delay": 1, "jitter": 2}, memory=0.3)
    for _ in range(5):
        swarm.step(np.ones((3, 4, 3), bool))
    assert set(np.unique(swarm.beliefs.predict(*swarm.observe()).age)) <= {3, 4, 5}


def test_a_late_answer_holds_the_plan_of_its_time():
    swarm = make_swarm(1, radio={"jitter": 1}, memory=0.0)
    fly(swarm, 6)
    newest, older = swarm.plans[0, :, 2:, :3].copy(), None
    swarm.step(np.zeros((1, 4, 3), bool))
    older, newest = newest, swarm.plans[0, :, 2:, :3].copy()
    believed, source = swarm._believe(np.ones((1, 4, 3), bool))
    assert (source == BeliefSource.REQUESTED).all()
    late = 0
    for i, m in np.ndindex(4, 3):
        j = swarm.neighbours.others[i, m]
        is_new = np.allclose(believed[0, i, m, :-1], newest[j])
        assert is_new or np.allclose(believed[0, i, m, :-2], older[j][1:])
        late += not is_new
    assert 0 < late < 12


def test_robots_act_on_a_plan_when_their_clock_says_so():
    swarm = make_swarm(8, substeps=4, clock_skew=0.8, noise={"wind": 1e-12})
    start = swarm.disturbances.start
    assert start is not None
    assert set(np.unique(start)) == {0, 1, 2, 3}
    # A robot that knows when its input will act plans from where it will be then: the plan holds without a model error.
    for _ in range(10):
        swarm.step(np.ones((8, 4, 3), bool))
    planned = swarm.planned_positions()[:, :, 1]
    np.testing.assert_allclose(swarm.pos, planned, atol=5e-3)
    aligned = start == 0
    np.testing.assert_allclose(swarm.pos[aligned], swarm.plans[..., 1, :3][aligned], atol=1e-3)


def test_substeps_find_what_passes_between_steps():
    coarse, fine = make_swarm(4), make_swarm(4, substeps=20)
    requests = np.zeros((4, 4, 3), bool)
    closest = []
    for swarm in (coarse, fine):
        reports = [swarm.step(requests) for _ in range(40)]
        closest.append(np.min([report.min_separation_continuous for report in reports], axis=0))
        assert all((r.min_separation_continuous <= r.min_separation + 1e-12).all() for r in reports)
    np.testing.assert_allclose(*closest, atol=0.05)


def test_robots_see_estimates_and_not_the_truth():
    swarm = make_swarm(2, sensing={"pos": 0.05, "others_pos": 0.05})
    fly(swarm, 3)
    others = swarm.neighbours.others
    estimate, (seen, _) = swarm.estimate(), swarm.observe()
    assert np.abs(estimate[..., :3] - swarm.pos).max() > 0.02
    assert np.abs(seen - swarm.pos[:, others]).max() > 0.02
    assert np.abs(seen - estimate[:, others, :3]).max() > 0.02, "observers err each in its own way"
    asked = []
    plan = swarm.planner.plan
    swarm.planner.plan = lambda problems, last: asked.append(problems) or plan(problems, last)
    swarm.step(np.zeros((2, 4, 3), bool))
    assert np.array_equal(asked[0].x.reshape(2, 4, 9), estimate)


def test_others_are_observed_where_they_would_be_since_a_delay():
    swarm = make_swarm(3, sensing={"others_delay": 2, "pos": 0.01, "vel": 0.05})
    dt, own = swarm.config.planner.dt, [swarm.estimate()]
    for k in range(12):
        pos, vel = swarm.observe()
        if k >= 2:
            then = own[-3][:, swarm.neighbours.others]
            np.testing.assert_allclose(vel, then[..., 3:6])
            np.testing.assert_allclose(pos, then[..., :3] + 2 * dt * then[..., 3:6])
            assert np.abs(pos - swarm.pos[:, swarm.neighbours.others]).max() > 1e-3
        fly(swarm, 1)
        own.append(swarm.estimate())
    # What they know of themselves is not late
    assert np.array_equal(swarm._seen_by_all()[0], own[-1][:, swarm.neighbours.others][..., :3])


def test_a_robot_that_was_observed_before_the_start_had_flown_steadily():
    config, chance = drawn(1, sensing={"others_delay": 3})
    states = np.random.default_rng(0).normal(size=(config.n_robots, 9))
    chance.reset(0, 0, states)
    np.testing.assert_allclose(chance.shown(states[None])[0], states[:, :6])


def test_a_lost_robot_flies_on_in_the_eyes_of_all_others():
    swarm = make_swarm(1, sensing={"gaps": 0.3, "gap_length": 4})
    dt, gaps = swarm.config.planner.dt, 0
    pos, vel = swarm.observe()
    for _ in range(40):
        fly(swarm, 1)
        steady, kept, (pos, vel) = pos + dt * vel, vel, swarm.observe()
        lost = swarm.disturbances._lost[:, swarm.neighbours.others]
        true = swarm.pos[:, swarm.neighbours.others]
        np.testing.assert_allclose(pos, np.where(lost[..., None], steady, true))
        np.testing.assert_array_equal(vel[lost], kept[lost])
        gaps += lost.sum()
    assert gaps


def test_robots_are_lost_for_the_share_and_the_length_given():
    config, chance = drawn(300, sensing={"gaps": 0.2, "gap_length": 5})
    states, lost = np.zeros((300, config.n_robots, 9)), []
    for _ in range(200):
        lost.append(chance._lost)
        states = chance.advance(states)
    lost = np.array(lost)
    assert not lost[0].any(), "robots know where everybody starts"
    assert lost[50:].mean() == pytest.approx(0.2, abs=0.01)
    ends = (lost[50:-1] & ~lost[51:]).sum()
    assert lost[50:].sum() / ends == pytest.approx(5, rel=0.05)


def test_what_limited_neighbourhoods_perceive_is_not_late():
    world = {"neighbourhood": {"max_others": 2}}
    for sensing in ({"others_delay": 1}, {"gaps": 0.1}):
        with pytest.raises(ValueError, match=r"for robots that perceive all others; set them to 0"):
            make_config(world={**world, "sensing": sensing})


def test_a_state_from_before_robots_could_be_lost_is_restored():
    world = {"noise": {"wind": 1.0}}
    _, chance = drawn(2, **world)
    state = {name: value for name, value in chance.state_dict().items() if name not in ("lost", "past")}
    other = Realisation(chance.config, 2)
    other.load_state_dict(state)
    assert np.array_equal(other.air, chance.air)


@pytest.mark.parametrize(
    ("world", "message"),
    [
        ({"sensing": {"gaps": 0.9, "gap_length": 4}}, r"sensing\.gaps=0\.9: .*at most 0\.8 .*gap_length to at least 9"),
        ({"radio": {"bursts": 0.6, "burst_length": 1}}, r"radio\.bursts=0\.6: .*burst_length to at least 1\.5"),
    ],
)
def test_interruptions_that_are_too_short_for_their_share_are_refused(world, message):
    with pytest.raises(ValueError, match=message):
        make_config(world=world)
    make_config(world={"sensing": {"gaps": 0.5, "gap_length": 1}, "radio": {"bursts": 0.5, "burst_length": 1}})
