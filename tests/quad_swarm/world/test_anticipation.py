"""Robots that predict others by a network: files, memory of velocities, and what follows from the predictions."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from quad_swarm.native import anticipation
from quad_swarm.world.anticipation import PREDICTORS, Anticipation, Predictor, Scene, load_predictor
from quad_swarm.world.beliefs import Beliefs, BeliefSource, other_indices
from quad_swarm.world.doubts import DoubtfulWorld
from quad_swarm.world.presets import make_config
from quad_swarm.world.swarm import Swarm

N, DT = 20, 0.05


def network(seed: int = 0, horizon: int = N, dt: float = DT, scale: float = 0.2) -> Predictor:
    rng = np.random.default_rng(seed)
    weights = scale * rng.normal(size=anticipation.count_weights(4, 6, horizon))
    return Predictor(weights.astype(np.float32), 4, 6, horizon, dt)


@pytest.fixture
def foreign(tmp_path):
    """The file of a network from elsewhere."""
    path = tmp_path / "mine.npz"
    network().save(path)
    return str(path)


def test_files_hold_what_was_saved(foreign):
    found = load_predictor(foreign)
    assert np.array_equal(found.weights, network().weights)
    assert found[1:] == network()[1:]


def test_a_file_that_changed_is_read_again(foreign, tmp_path):
    before = load_predictor(foreign)
    network(1).save(tmp_path / "new.npz")
    (tmp_path / "new.npz").replace(foreign)
    assert not np.array_equal(load_predictor(foreign).weights, before.weights)


def test_packaged_networks_are_whole():
    assert PREDICTORS
    for name in PREDICTORS:
        assert load_predictor(name).weights.any()


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"weights": np.zeros(5, np.float32)}, "weights do not fit"),
        ({"weights": network().weights.astype(float)}, "weights do not fit"),
        ({"weights": np.full_like(network().weights, np.nan)}, "not finite"),
        ({"hidden": 0}, "out of range"),
        ({"hidden": 10**6}, "out of range"),
        ({"dt": 0.0}, "out of range"),
        ({"dt": np.nan}, "out of range"),
        ({"dt": np.inf}, "out of range"),
        ({"weights": np.full_like(network().weights, 3e38)}, "not finite, or larger than 1000"),
        ({"about": "[" * 100_000}, ""),
        ({"about": "[]"}, "does not say"),
        ({"about": "{"}, ""),
        ({"horizon": "many"}, ""),
        ({"hidden": np.array([4, 4])}, ""),
        ({"weights": np.array([object()])}, ""),
    ],
)
def test_files_that_hold_no_network_are_refused(tmp_path, fields, message):
    path = tmp_path / "bad.npz"
    np.savez(path, **{**network()._asdict(), **fields})
    with pytest.raises(ValueError, match=f"(?s)bad.npz.*{message}.*Write it anew"):
        make_config("flight-v2", predictor=str(path))


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"no archive", None])
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "bad.npz"
    path.mkdir() if content is None else path.write_bytes(content)
    with pytest.raises(ValueError, match=r"(?s)bad.npz.*Write it anew"):
        load_predictor(str(path))


def test_damaged_files_are_refused_or_hold_a_network(foreign):
    """Bits flip, ends are missing: some readers of archives and arrays have errors of their own."""
    whole, rng, refused = Path(foreign).read_bytes(), np.random.default_rng(0), []
    for number in range(400):
        content = bytearray(whole)
        for place in rng.integers(len(whole), size=rng.integers(1, 4)):
            content[place] ^= 1 << rng.integers(8)
        Path(foreign).write_bytes(content[: rng.integers(len(whole)) if rng.random() < 0.2 else None])
        os.utime(foreign, ns=(number, int(rng.integers(2**40))))  # another file
        try:
            assert np.isfinite(load_predictor(foreign).weights).all()
        except ValueError as error:
            refused.append(str(error))
    assert len(refused) > 100
    assert all("Write it anew" in one and "\n" not in one for one in refused)


def test_with_the_largest_weights_predictions_and_flights_are_finite(tmp_path):
    path, rng = tmp_path / "large.npz", np.random.default_rng(0)
    weights = rng.choice([-1e3, 1e3], size=anticipation.count_weights(256, 256, N)).astype(np.float32)
    Predictor(weights, 256, 256, N, DT).save(path)
    swarm = Swarm(make_config("flight-v2", n_robots=4, predictor=str(path)))
    place(swarm)
    assert np.isfinite(believed(swarm, list(range(N)))).all()
    for _ in range(5):
        swarm.step(np.zeros((1, 4, 3), bool))
    assert np.isfinite(swarm.state).all()
    assert np.isfinite(swarm.plans).all()


def test_a_field_that_is_missing_is_named(tmp_path):
    path = tmp_path / "bad.npz"
    np.savez(path, weights=network().weights)
    with pytest.raises(ValueError, match="hidden"):
        load_predictor(str(path))


@pytest.mark.parametrize(
    ("name", "message"),
    [("fligth", "Did you mean 'flight'"), ("none.npz", "there is no such file"), (3, "predictor")],
)
def test_unknown_networks_are_refused_with_the_remedy(name, message):
    with pytest.raises(ValueError, match=message):
        make_config("flight-v2", predictor=name)


@pytest.mark.parametrize("planner", [{"dt": 0.04}, {"horizon": 21}])
def test_a_world_with_other_steps_is_refused(foreign, planner):
    with pytest.raises(ValueError, match=r"predicts 20 steps of 0.05 s, but planner.horizon.*None for constant"):
        make_config("flight-v2", planner=planner, predictor=foreign)


def test_robots_keep_right_of_all_whom_a_network_predicts(foreign):
    nobody = np.zeros((1, 3, 2), bool)
    for predictor, known in ((None, False), (foreign, True)):
        swarm = Swarm(make_config("flight-v2", {"predictor": predictor}, n_robots=3))
        place(swarm)
        problems = swarm._problems(*swarm._believe(nobody))
        assert (problems.announced == known).all()


def test_a_shorter_horizon_takes_the_first_steps(foreign):
    long, short = (
        Swarm(make_config("flight-v2", n_robots=3, predictor=foreign, planner={"horizon": horizon}))
        for horizon in (20, 12)
    )
    for swarm in (long, short):
        place(swarm)
    stages = list(range(12))
    assert np.array_equal(believed(long, stages), believed(short, stages))


def place(swarm: Swarm, seed: int = 0) -> None:
    n = swarm.config.n_robots
    angles = 2 * np.pi * np.arange(n) / n
    starts = np.stack([2 * np.cos(angles), 2 * np.sin(angles), np.full(n, 1.2)], axis=-1)
    for k in range(swarm.n_swarms):
        swarm.reset(k, starts, starts[::-1] if n % 2 else -starts * [1, 1, -1], noise_seed=seed + k)


def believed(swarm: Swarm, stages: list[int]) -> np.ndarray:
    return swarm.beliefs.predict(*swarm.observe(), swarm.scene()).believed(stages)


def test_velocities_of_the_last_steps_are_remembered():
    order = other_indices(3)
    memory = Anticipation(network(), N, 1, order)
    nobody = np.zeros((1, 3, 2, 3))
    vels = [np.full((1, 3, 2, 3), float(k)) for k in range(9)]
    seen = []
    for vel in vels:
        seen.append(memory.look(nobody, vel, Scene(np.zeros((1, 3, 9)), None)).of_others.changes[0, 0, 0, :, 0])
        memory.advance()
    # The change over two steps, and over the three before, as far as they are known
    assert np.array_equal(seen, [[0, 0], [1, 0], [2, 0], [2, 1], [2, 2], [2, 3], [2, 3], [2, 3], [2, 3]])
    memory.forget_others(np.arange(2) == np.zeros((1, 3, 2)))
    memory.look(nobody, vels[0], Scene(np.zeros((1, 3, 9)), None))
    changes = memory.look(nobody, vels[0], Scene(np.zeros((1, 3, 9)), None)).of_others.changes[0, :, :, 0, 0]
    assert np.array_equal(changes, [[0, -7]] * 3)
    memory.forget(np.array([0]))
    assert not memory.look(nobody, vels[0], Scene(np.zeros((1, 3, 9)), None)).of_others.changes.any()


def test_robots_see_themselves_at_their_place():
    memory = Anticipation(network(), N, 1, other_indices(3))
    pos = np.arange(18.0).reshape(1, 3, 2, 3)
    estimate = -np.arange(27.0).reshape(1, 3, 9)
    sight = memory.look(pos, pos + 100, Scene(estimate, None)).of_others
    for robot in range(3):
        others = [other for other in range(3) if other != robot]
        assert np.array_equal(sight.pos[0, robot, others], pos[0, robot])
        assert np.array_equal(sight.pos[0, robot, robot], estimate[0, robot, :3])
        assert np.array_equal(sight.vel[0, robot, robot], estimate[0, robot, 3:6])
        assert np.array_equal(sight.place[robot], others)


def test_plans_that_are_believed_come_first():
    memory = Anticipation(network(), N, 1, other_indices(3))
    beliefs = Beliefs(1, 3, N, DT, 0.03, anticipation=memory)
    plain = Beliefs(1, 3, N, DT, 0.03)
    rng = np.random.default_rng(0)
    pos, vel, scene = rng.normal(size=(1, 3, 2, 3)), rng.normal(size=(1, 3, 2, 3)), Scene(np.zeros((1, 3, 9)), None)
    arriving = np.arange(2) == np.zeros((1, 3, 1))
    plans = pos[arriving][:, None] + 0.1 * np.arange(N + 1)[:, None] * [1.0, 0.0, 0.0]
    found, source = beliefs.update(arriving, pos, vel, plans, 1, scene)
    other, same = plain.update(arriving, pos, vel, plans, 1)
    assert np.array_equal(source, same)
    assert np.array_equal(found[arriving], other[arriving])
    assert not np.allclose(found[~arriving], other[~arriving])
    expected = memory.look(pos, vel, scene).others(np.zeros((1, 3, 2), bool))
    memory.forget(np.array([0]))
    assert np.array_equal(found[~arriving], expected[~arriving][:, 1:])
    # In the next step, the plan is remembered and still comes first
    later = beliefs.predict(pos + np.where(arriving[..., None], [0.1, 0.0, 0.0], 0.0), vel, scene)
    assert np.array_equal(later.remembers, arriving)
    rest = np.concatenate([plans[:, 2:], 2 * plans[:, -1:] - plans[:, -2:-1]], axis=1)
    assert np.allclose(later.believed()[arriving], rest)
    flat = later.flattened(0.5).believed()
    assert np.allclose(flat, later.believed() * [1.0, 1.0, 0.5])


def test_what_others_expect_of_a_robot_is_what_it_expects_of_itself(foreign):
    certain = dict.fromkeys(("pos", "vel", "attitude", "others_pos", "others_vel"), 0)
    swarm = Swarm(make_config("flight-v2", n_robots=4, predictor=foreign, sensing=certain))
    place(swarm)
    nobody = np.zeros((1, 4, 3), bool)
    for _ in range(6):
        swarm.step(nobody)
    mine = swarm.seen_by_others([0, 7, 19]).believed
    theirs = swarm.neighbours.of_the_other(believed(swarm, [0, 7, 19]))
    assert np.allclose(mine, theirs)
    # and without the network it is a constant velocity
    plain = Swarm(make_config(swarm.config, {"predictor": None}))
    assert plain.config.predictor is None
    plain.load_state_dict(swarm.state_dict())
    assert not np.allclose(plain.seen_by_others([19]).believed, mine[..., 2:, :])
    steady = swarm.pos + 20 * DT * swarm.vel
    assert np.allclose(plain.seen_by_others([19]).believed, steady[:, :, None, None])


@pytest.mark.parametrize("neighbourhood", [{}, {"max_others": 2}])
def test_a_swarm_continues_from_its_state_bit_for_bit(foreign, neighbourhood):
    config = make_config("flight-v2", {"neighbourhood": neighbourhood}, n_robots=5, predictor=foreign)
    swarm, other = Swarm(config, 2), Swarm(config, 2)
    place(swarm)
    place(other, 7)
    requests = np.random.default_rng(0).random((12, 2, 5, config.n_others)) < 0.2
    for one in requests[:6]:
        swarm.step(one)
    other.load_state_dict(swarm.state_dict())
    fork = swarm.fork()
    for one in requests[6:]:
        sources = [each.step(one).belief_source for each in (swarm, other, fork)]
        assert np.array_equal(sources[0], sources[1])
    assert (sources[0] == BeliefSource.CONSTANT_VELOCITY).any()
    assert np.array_equal(swarm.state, other.state)
    assert np.array_equal(swarm.state, fork.state)
    assert np.isfinite(swarm.state).all()
    state = swarm.state_dict()
    state["beliefs"]["anticipation"]["past"] = np.zeros(3)
    with pytest.raises(ValueError, match="past velocities"):
        other.load_state_dict(state)


def test_the_network_that_ships_avoids_most_collisions_of_robots_that_do_not_talk():
    collided = {}
    for predictor in (None, "flight"):
        swarm = Swarm(make_config("flight-v2", n_robots=8, predictor=predictor), 8)
        rng = np.random.default_rng(0)
        hit = np.zeros(8, bool)
        for k in range(8):
            angles = 2 * np.pi * np.arange(8) / 8 + rng.uniform(0, 1)
            starts = np.stack([3.2 * np.cos(angles), 3.2 * np.sin(angles), np.full(8, 1.2)], axis=-1)
            swarm.reset(k, starts, starts * [-1, -1, 1], noise_seed=k)
        nobody = np.zeros((8, 8, 7), bool)
        for _ in range(90):
            hit |= swarm.step(nobody).collision_continuous
        collided[predictor] = int(hit.sum())
    assert collided[None] >= 4
    assert collided["flight"] <= 1


def test_what_a_network_was_trained_in_is_said_and_other_worlds_are_doubtful(tmp_path, recwarn):
    about = json.loads(load_predictor("flight").about)
    assert about["n_robots"] == [4, 8, 12, 16]
    make_config("flight-v3")
    make_config("flight-v3", n_robots=16, space={"circle_radius": [3.5, 4.0]})
    assert not recwarn.list
    with pytest.warns(
        DoubtfulWorld, match=r"'flight' learned.*planner.max_speed=4.0 instead of 3.0: .*null.*train one"
    ):
        make_config("flight-v3", planner={"max_speed": 3.0})
    with pytest.warns(DoubtfulWorld, match=r"quadrotor.drag_x=0.25 instead of 0.0142 and 7 other fields"):
        make_config("flight-v3", quadrotor="x500")
    with pytest.warns(DoubtfulWorld, match=r"sensing\.others_delay=0 instead of 4: .*train one for this world"):
        make_config("flight-v3", sensing={"others_delay": 4})
    with pytest.warns(DoubtfulWorld, match=r"sensing\.gaps=0\.0 instead of 0\.1"):
        make_config("flight-v3", sensing={"gaps": 0.1})
    # Of a network that does not say it, nothing is known
    network().save(tmp_path / "mine.npz")
    recwarn.clear()
    make_config("flight-v2", predictor=str(tmp_path / "mine.npz"), sensing={"others_delay": 4})
    make_config("flight-v2", predictor=str(tmp_path / "mine.npz"), planner={"max_speed": 3.0})
    assert not recwarn.list
