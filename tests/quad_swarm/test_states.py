"""States of environments: what is loaded flies on bit for bit, in another environment and after other episodes."""

import gymnasium
import numpy as np
import pytest

from quad_swarm import QuadSwarmEnv, QuadSwarmParallelEnv, QuadSwarmVectorEnv
from quad_swarm.states import generator_of, generator_state, like

HARD = {"preset": "flight-hard", "n_robots": 4, "max_steps": 25, "observation": "state+memory+plan+told+critic"}
WORLDS = [{"max_steps": 25}, HARD, {**HARD, "scenario": "curriculum", "memory": 0.0}]


def acted(env, rng, steps: int) -> list:
    """What comes of random requests."""
    bits = env.action_space.shape
    found = []
    for _ in range(steps):
        obs, reward, terminated, truncated, infos = env.step((rng.random(bits) < 0.3).astype(np.int8))
        ended = np.ravel(terminated | truncated)
        if isinstance(env, QuadSwarmEnv) and ended[0]:
            obs, _ = env.reset()
        found.append((obs, reward, terminated, truncated, infos["min_separation"]))
    return found


def assert_same(one: list, two: list) -> None:
    for a, b in zip(one, two, strict=True):
        for x, y in zip(a, b, strict=True):
            assert np.array_equal(x, y)


@pytest.mark.parametrize("kwargs", WORLDS, ids=["paper", "hard", "curriculum"])
@pytest.mark.parametrize("make", [lambda **kwargs: QuadSwarmVectorEnv(3, **kwargs), QuadSwarmEnv])
def test_a_loaded_state_flies_on_bit_for_bit(make, kwargs):
    env = make(**kwargs)
    env.reset(seed=3)
    if env.n_curriculum_levels > 1:
        env.set_curriculum_level(2)
    acted(env, np.random.default_rng(0), 40)
    state = env.state_dict()
    expected = acted(env, np.random.default_rng(1), 40)
    other = make(**kwargs)
    other.reset(seed=8)
    acted(other, np.random.default_rng(2), 13)
    for one in (make(**kwargs), other, env):
        one.load_state_dict(state)
        assert_same(acted(one, np.random.default_rng(1), 40), expected)


def test_the_parallel_environment_tells_its_state_too():
    env, other = QuadSwarmParallelEnv(**HARD), QuadSwarmParallelEnv(**HARD)
    env.reset(seed=0)
    nobody = {agent: np.zeros(3, np.int8) for agent in env.agents}
    env.step(nobody)
    other.load_state_dict(env.state_dict())
    assert other.agents == env.agents
    for one, two in zip(env.step(nobody)[:2], other.step(nobody)[:2], strict=True):
        assert all(np.array_equal(one[agent], two[agent]) for agent in env.agents)


def test_a_state_is_a_copy():
    env = QuadSwarmVectorEnv(2)
    env.reset(seed=0)
    state = env.state_dict()
    before = state["task"]["swarm"]["state"].copy()
    acted(env, np.random.default_rng(0), 5)
    assert np.array_equal(state["task"]["swarm"]["state"], before)
    env.load_state_dict(state)
    acted(env, np.random.default_rng(0), 5)
    assert np.array_equal(state["task"]["swarm"]["state"], before)


def test_a_state_of_something_else_is_refused():
    env = QuadSwarmVectorEnv(2)
    env.reset(seed=0)
    state = env.state_dict()
    for other in (QuadSwarmVectorEnv(2, n_robots=3), QuadSwarmVectorEnv(2, planner={"horizon": 5})):
        with pytest.raises(ValueError, match="A state fits only an environment with the same arguments"):
            other.load_state_dict(state)
    with pytest.raises(ValueError, match="The state has 2 swarms, but this environment has 3"):
        QuadSwarmVectorEnv(3).load_state_dict(state)
    with pytest.raises(ValueError, match=r"present.*|float32"):
        like(np.zeros(3), np.zeros(3, np.float32), "x")


@pytest.mark.parametrize("make", [QuadSwarmEnv, QuadSwarmParallelEnv, lambda: QuadSwarmVectorEnv(2)])
def test_what_is_no_state_is_refused(make):
    env = make()
    env.reset(seed=0)
    state = env.state_dict()
    for wrong in (None, {}, [], 5, dict.fromkeys(state), {**state, next(iter(state)): {}}):
        with pytest.raises(ValueError, match=r"not a state of this environment \(\w+Error: .*`state_dict`"):
            env.load_state_dict(wrong)


def test_a_foreign_simulator_has_no_state_to_tell():
    env = gymnasium.make("QuadSwarm-v0").unwrapped
    object.__setattr__(env.task.swarm.config, "plant", "rotorpy:hummingbird")
    with pytest.raises(ValueError, match="plant='rotorpy:hummingbird' does not provide its state"):
        env.state_dict()


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("state",), np.nan),
        (("goal",), np.inf),
        (("plans", "x"), np.nan),
        (("plans", "status"), 7),
        (("beliefs", "age"), -(2**63)),
        (("beliefs", "age"), 2**63 - 1),
        (("chance", "factors"), 0.0),
        (("chance", "start"), -1),
        (("chance", "start"), 2**40),
        (("neighbours", "others"), 10**6),
        (("neighbours", "reverse"), -(2**40)),
    ],
)
def test_numbers_of_a_state_that_no_world_has_are_refused(path, value):
    kwargs = {**HARD, "world": {"neighbourhood": {"max_others": 2}}} if path[0] == "neighbours" else HARD
    env = QuadSwarmEnv(**kwargs)
    env.reset(seed=0)
    state = env.state_dict()
    owner = state["task"]["swarm"]
    for name in path[:-1]:
        owner = owner[name]
    owner[path[-1]].flat[0] = value
    with pytest.raises(ValueError, match="the state has numbers outside of"):
        QuadSwarmEnv(**kwargs).load_state_dict(state)


BITS = [np.random.PCG64, np.random.PCG64DXSM, np.random.MT19937, np.random.Philox, np.random.SFC64]


def changes_of_generators():
    for bits in BITS:
        for name in ("pos", "buffer_pos", "has_uint32", "uinteger", "state", "inc", "key", "counter", "buffer"):
            state = generator_state(np.random.Generator(bits(5)))
            owner = state["state"] if name in state["state"] else state
            if name not in owner:
                continue
            if isinstance(owner[name], np.ndarray):
                wrong = [owner[name][:-1], owner[name].astype(float), owner[name].tolist(), None]
            else:
                wrong = [-1, -(2**31) + 5, 2**31 - 700, 2**130, 0.5, True, None, "1"]
            if name in ("uinteger", "state", "inc") and not isinstance(owner[name], np.ndarray):
                wrong.remove(2**31 - 700)  # any 32 bits
            yield from (
                pytest.param(bits, name, value, id=f"{bits.__name__} {name} {str(value)[:9]}") for value in wrong
            )


@pytest.mark.parametrize(("bits", "name", "value"), list(changes_of_generators()))
def test_no_state_lets_a_generator_read_outside_of_its_memory(bits, name, value):
    state = generator_state(np.random.Generator(bits(5)))
    (state["state"] if name in state["state"] else state)[name] = value
    with pytest.raises(ValueError, match=f"not a state of NumPy's {bits.__name__}"):
        generator_of(state)
    env = QuadSwarmEnv()
    env.reset(seed=0)
    whole = env.state_dict()
    with pytest.raises(ValueError, match=f"not a state of NumPy's {bits.__name__}"):
        env.load_state_dict({**whole, "generator": state})


@pytest.mark.parametrize("bits", BITS)
def test_a_generator_goes_on_where_it_was(bits):
    rng = np.random.Generator(bits(5))
    rng.random(3)
    state = generator_state(rng)
    expected = rng.normal(size=4)
    assert np.array_equal(generator_of(state).normal(size=4), expected)
    for wrong in ({}, {"bit_generator": "Generator"}, {"bit_generator": "os"}):
        with pytest.raises(ValueError, match="not one of NumPy's"):
            generator_of(wrong)
