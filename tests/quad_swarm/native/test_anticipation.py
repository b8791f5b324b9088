"""The network that predicts robots: compiled and by NumPy to the same bits, whatever else is in the batch."""

import numpy as np
import pytest

from quad_swarm.native import anticipation
from quad_swarm.native.anticipation import Sight
from quad_swarm.world.beliefs import other_indices

DT, N = 0.05, 6


def sight(n_swarms: int = 3, n: int = 5, n_obstacles: int = 2, seed: int = 0) -> Sight:
    rng = np.random.default_rng(seed)
    of_all, of_obstacles = (n_swarms, n, n), (n_swarms, n_obstacles)
    vel = rng.normal(size=(*of_all, 3))
    vel[0, 0, 1, :2] = 0.0  # without a direction
    pos = 2 * rng.normal(size=(*of_all, 3))
    pos[0, 1, 3] += 30.0  # out of sight
    return Sight(
        pos,
        vel,
        other_indices(n),
        0.1 * rng.normal(size=(n_swarms, n, n - 1, 2, 3)),
        rng.random((n_swarms, n, n - 1)) < 0.2,
        2 * rng.normal(size=(*of_obstacles, 3)),
        rng.normal(size=(*of_obstacles, 3)),
        rng.choice([0.0, 1.0], (*of_obstacles, 3)),
        np.abs(rng.normal(size=of_obstacles)) * (rng.random(of_obstacles) < 0.7),
    )


def weights(hidden: int, width: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (0.3 * rng.normal(size=anticipation.count_weights(hidden, width, N))).astype(np.float32)


def predicted(seen: Sight, hidden: int = 8, width: int = 20, seed: int = 0) -> np.ndarray:
    return anticipation.anticipate(seen, weights(hidden, width, seed), hidden, width, N, DT)


@pytest.mark.parametrize(("hidden", "width"), [(8, 20), (16, 32), (3, 5)])
@pytest.mark.parametrize("n_obstacles", [0, 2])
def test_compiled_and_numpy_give_the_same_bits(monkeypatch, hidden, width, n_obstacles):
    seen = sight(n_obstacles=n_obstacles)
    compiled = predicted(seen, hidden, width)
    monkeypatch.setattr(anticipation, "compiled", lambda: None)
    assert np.array_equal(compiled, predicted(seen, hidden, width))
    assert np.isfinite(compiled).all()


def test_a_prediction_does_not_depend_on_its_batch():
    seen = sight()
    alone = Sight(*(array if name == "place" else array[1:2] for name, array in seen._asdict().items()))
    assert np.array_equal(predicted(seen)[1:2], predicted(alone))
    one = seen._replace(place=seen.place[:, 2:3], changes=seen.changes[:, :, 2:3], skipped=seen.skipped[:, :, 2:3])
    assert np.array_equal(predicted(seen)[:, :, 2:3], predicted(one))


def test_predictions_turn_with_what_is_seen():
    seen = sight(n_obstacles=2)._replace(skipped=np.zeros((3, 5, 4), bool))
    # Spheres: the axes of cylinders stay upright, other factors do not turn
    seen = seen._replace(factors=np.ones((3, 2, 3)))
    seen.vel[0, 0, 1] = [0.3, 0.2, 0.1]  # with a direction
    c, s = np.cos(0.7), np.sin(0.7)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    moved = {name: getattr(seen, name) @ turn.T for name in ("pos", "vel", "changes", "centres", "velocities")}
    assert np.allclose(predicted(seen._replace(**moved)), predicted(seen) @ turn.T, atol=1e-5)
    # and it is no function of the robot's own motion alone
    pos = seen.pos.copy()
    pos[:, 0, 4] += [0.5, 0.0, 0.0]
    assert not np.allclose(predicted(seen._replace(pos=pos))[:, 0, 0], predicted(seen)[:, 0, 0])


def test_whom_it_skips_and_a_network_of_zeros_predict_constant_velocities():
    seen = sight()
    rows = np.arange(5)[:, None]
    times = DT * np.arange(N + 1)[:, None]
    where, way = seen.pos[:, rows, seen.place], seen.vel[:, rows, seen.place]
    steady = where[..., None, :] + times * way[..., None, :]
    found = predicted(seen)
    assert np.allclose(found[seen.skipped], steady[seen.skipped])
    assert not np.allclose(found[~seen.skipped], steady[~seen.skipped])
    assert np.array_equal(found[..., 0, :], where)
    nothing = np.zeros(anticipation.count_weights(8, 20, N), np.float32)
    assert np.allclose(anticipation.anticipate(seen, nothing, 8, 20, N, DT), steady)


def test_what_is_out_of_sight_or_not_there_does_not_count():
    seen = sight()
    far = seen.pos.copy()
    far[0, 1, 3] += 100.0
    assert np.array_equal(predicted(seen)[0, 1, :2], predicted(seen._replace(pos=far))[0, 1, :2])
    absent = seen._replace(radius=np.zeros((3, 2)))
    moved = absent._replace(centres=absent.centres + 0.3)
    assert np.array_equal(predicted(absent), predicted(moved))
    assert not np.array_equal(predicted(seen._replace(radius=np.ones((3, 2)))), predicted(absent))


def test_wanted_outputs_lead_to_the_plans():
    seen = sight()
    rng = np.random.default_rng(1)
    plans = seen.pos[:, np.arange(5)[:, None], seen.place][..., None, :] + rng.normal(size=(3, 5, 4, N, 3))
    own, bodies, near = anticipation.features(seen)
    assert own.shape == (3, 5, 4, anticipation.OWN)
    assert bodies.shape == (3, 5, 4, 7, anticipation.OF_BODY)
    assert (near[..., :5].sum(axis=-1) <= 4).all()
    wanted = anticipation.outputs(seen, plans, DT)
    # A network whose last layer has only biases gives the same outputs to everybody
    biases = np.zeros(anticipation.count_weights(1, 1, N), np.float32)
    last = biases[-6 * N :].reshape(2, -1)
    for place in ((0, 0, 1), (2, 4, 3)):
        last[0] = wanted[place].ravel()
        one = anticipation.anticipate(seen._replace(skipped=np.zeros((3, 5, 4), bool)), biases, 1, 1, N, DT)
        assert np.allclose(one[place][1:], plans[place], atol=1e-5)
