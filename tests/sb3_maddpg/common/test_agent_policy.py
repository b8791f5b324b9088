"""One agent by itself: the same actions as in the team, as an object, in a file, and without this package."""

import pickle
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
import torch as th
from gymnasium import spaces

import quad_swarm  # noqa: F401 - registers QuadSwarm-v0
from sb3_maddpg import MADDPG
from sb3_maddpg.common.agent_policy import AgentPolicy
from sb3_maddpg.matd3.matd3 import MATD3
from sb3_maddpg.team.pettingzoo import TeamEnv
from sb3_maddpg.team.spaces import heads_of
from toys import AGENT_SPACES, INT32, SMALL, Neighbours, Toy

pytestmark = pytest.mark.filterwarnings("error::DeprecationWarning", "error::torch.jit.TracerWarning")


class Alone(Neighbours):
    """Neighbours who act by themselves, on numbers."""

    def __init__(self):
        super().__init__()
        self.action_space = spaces.Box(-2, 1, (8,))
        self.observation_layout["acts_on_neighbours"] = False

    def pair_rewards(self, obs, actions):
        return np.repeat(actions.reshape(-1, 4, 2)[..., :1], 3, axis=2) * obs[..., 1::2]


MODELS = {kind: lambda kind=kind: MADDPG("MlpPolicy", TeamEnv(Toy(kind)), **SMALL) for kind in AGENT_SPACES}
MODELS |= {
    "threshold and sharing": lambda: MADDPG(
        "MlpPolicy",
        TeamEnv(Toy("binary"), state=True),
        **{**SMALL, "policy_kwargs": {"net_arch": [8], "threshold": 0.8, "share_actor": [["binary_2"]]}},
    ),
    "twins": lambda: MATD3("MlpPolicy", TeamEnv(Toy("mixed")), **SMALL),
    "pairs": lambda: MADDPG("PairPolicy", Neighbours(), **SMALL),
    "categories of pairs": lambda: MADDPG("PairPolicy", Neighbours(n_choices=3), **SMALL),
    "pairs that act by themselves": lambda: MATD3("PairPolicy", Alone(), **SMALL),
}
each_model = pytest.mark.parametrize("make", MODELS.values(), ids=MODELS)


def varied(make) -> MADDPG:
    """With actors whose actions are not all alike."""
    model = make()
    th.manual_seed(2)
    with th.no_grad():
        for parameter in model.actor.parameters():
            parameter.normal_(std=2.0 if parameter.shape[-1] > 1 else 0.5)
    return model


def team_actions(model: MADDPG, n: int = 40) -> list[tuple[AgentPolicy, np.ndarray, np.ndarray]]:
    """:return: of each agent its policy, its observations and its part of the team's actions"""
    model.observation_space.seed(0)
    obs = np.array([model.observation_space.sample() for _ in range(n)])  # padding is zero
    joint, _ = model.predict(obs, deterministic=True)
    team = model.policy.team
    ends = np.cumsum([len(heads_of(space)) for space in team.action_spaces])[:-1]
    rows = zip(team.names, np.split(joint, ends, axis=1), strict=True)
    # The joint action counts categories from 0, an agent's own as its space does
    spaces_of = zip(rows, team.action_spaces, strict=True)
    policies = [(model.agent_policy(name), part + getattr(space, "start", 0)) for (name, part), space in spaces_of]
    return [(policy, obs[:, agent, : policy.obs_dim], part) for agent, (policy, part) in enumerate(policies)]


@each_model
def test_an_agent_acts_as_in_the_team(make):
    varies = []
    for policy, obs, expected in team_actions(varied(make)):
        actions, _ = policy.predict(obs)
        varies.append(len(np.unique(expected, axis=0)) > 1)
        assert np.allclose(actions, expected, atol=1e-6)
        for row, joint in zip(obs[:3], expected, strict=False):
            single, _ = policy.predict(row)
            assert policy.action_space.contains(single)
            assert np.allclose(np.ravel(single), joint, atol=1e-6)
    assert np.mean(varies) > 0.5


@each_model
def test_an_agent_survives_pickling_and_carries_nothing_of_the_team(make):
    model = varied(make)
    for policy, obs, expected in team_actions(model):
        data = pickle.dumps(policy)
        assert np.allclose(pickle.loads(data).predict(obs)[0], expected, atol=1e-6)
        for foreign in (b"optim", b"Critic", b"ReplayBuffer"):
            assert foreign not in data
    before, _ = policy.predict(obs)
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.zero_()
    assert np.array_equal(policy.predict(obs)[0], before)
    assert not any(parameter.requires_grad for parameter in policy.parameters())


@each_model
def test_columns_that_an_agent_is_not_given_count_as_zero(make):
    for policy, obs, _ in team_actions(varied(make)):
        known = [k for k in reversed(range(policy.obs_dim)) if k % 3]
        if not known:
            continue
        blind = np.zeros_like(obs)
        blind[:, known] = obs[:, known]
        narrow = policy.of_columns(known)
        assert narrow.obs_dim == len(known)
        assert np.array_equal(narrow.predict(obs[:, known])[0], policy.predict(blind)[0])
        assert policy.obs_dim == obs.shape[1], "the policy itself stays"
        with pytest.raises(ValueError, match="already"):
            narrow.of_columns([0])
    for wrong in ([0, 0], [policy.obs_dim], [-1]):
        with pytest.raises(ValueError, match=rf"must name different columns from 0 to {policy.obs_dim - 1}"):
            policy.of_columns(wrong)


RUN = """
import sys
import numpy as np
import torch
folder, count = sys.argv[1:]
for agent in range(int(count)):
    program = torch.jit.load(f"{folder}/{agent}.pt")
    obs = torch.from_numpy(np.load(f"{folder}/obs_{agent}.npy"))
    actions = program(obs)
    assert torch.equal(actions[:1], program(obs[:1])) or torch.allclose(actions[:1], program(obs[:1]))
    np.save(f"{folder}/actions_{agent}.npy", actions.numpy())
assert "sb3_maddpg" not in sys.modules and "stable_baselines3" not in sys.modules
"""


@pytest.mark.slow
def test_exported_agents_run_without_this_package(tmp_path):
    cases = team_actions(varied(MODELS["mixed"]))
    cases += [case for make in MODELS.values() for case in team_actions(varied(make))[:2]]
    state = th.random.get_rng_state()
    for number, (policy, obs, _) in enumerate(cases):
        policy.export(tmp_path / str(number))
        np.save(tmp_path / f"obs_{number}.npy", obs)
    assert th.equal(th.random.get_rng_state(), state)
    subprocess.run([sys.executable, "-c", RUN, tmp_path, str(len(cases))], check=True, cwd=tmp_path, timeout=500)
    for number, (policy, obs, expected) in enumerate(cases):
        actions = np.load(tmp_path / f"actions_{number}.npy")
        assert actions.dtype == policy.predict(obs)[0].dtype
        assert np.allclose(actions, expected, atol=1e-6)


@pytest.mark.slow
@each_model
def test_agents_exported_to_onnx_act_as_in_the_team(make, tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    cases = team_actions(varied(make))[:3]
    state = th.random.get_rng_state()
    for number, (policy, obs, expected) in enumerate(cases):
        path = tmp_path / f"{number}.onnx"
        policy.export(path)
        session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        (seen,), (given,) = session.get_inputs(), session.get_outputs()
        assert (seen.name, seen.shape[1:], given.name) == ("observation", [policy.obs_dim], "action")
        obs = obs.astype(np.float32)
        (actions,) = session.run(None, {"observation": obs})
        assert actions.dtype == policy.predict(obs)[0].dtype
        assert np.allclose(actions, expected, atol=1e-5)
        for count in (1, 3):
            assert np.allclose(session.run(None, {"observation": obs[:count]})[0], expected[:count], atol=1e-5)
    assert th.equal(th.random.get_rng_state(), state)


class Bounded(Toy):
    """Continuous actions whose bounds rounding exceeds, and that hold integers."""

    def __init__(self):
        super().__init__("continuous")
        self.spaces = (
            spaces.Box(-3.0, 0.9, (2,)),
            spaces.Box(-3.0, 0.9, (2,), np.float64),
            spaces.Box(0, 200, (2, 1), np.uint8),
            spaces.Box(-(2**31), 2**31 - 1, (1,), np.int32),
        )
        self.possible_agents = [f"agent_{i}" for i in range(len(self.spaces))]


@pytest.mark.slow
def test_actions_lie_within_their_space_and_those_of_integers_are_whole(tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    saturated = 0
    for policy, obs, expected in team_actions(varied(lambda: MADDPG("MlpPolicy", Bounded(), **SMALL))):
        space, obs = policy.action_space, obs.astype(np.float32)
        for row, joint in zip(obs, expected, strict=True):
            action, _ = policy.predict(row)
            assert space.contains(action)
            assert action.dtype == space.dtype
            assert np.allclose(action.ravel(), np.rint(joint) if policy.whole else joint, atol=1e-6)
            saturated += np.isin(action, [space.low, space.high]).sum()
        actions, _ = policy.predict(obs)
        assert actions.dtype == space.dtype
        policy.export(tmp_path / "a.pt")
        policy.export(tmp_path / "a.ONNX")
        session = onnxruntime.InferenceSession(str(tmp_path / "a.ONNX"), providers=["CPUExecutionProvider"])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            program = th.jit.load(tmp_path / "a.pt")
        low, high = space.low, space.high
        for exported in (program(th.from_numpy(obs)).numpy(), session.run(None, {"observation": obs})[0]):
            assert ((exported >= low) & (exported <= high)).all()
            assert (np.abs(exported - actions.astype(float)) <= 1e-5 * (high - low.astype(float))).all()
    assert saturated > 20


class Alike(Toy):
    """Two agents with the same action space."""

    def __init__(self, space):
        super().__init__("continuous")
        self.spaces = (space, space)
        self.possible_agents = ["agent_0", "agent_1"]

    def step(self, actions):
        for space, action in zip(self.spaces, actions.values(), strict=True):
            assert space.contains(action), (space, action)
        return super().step(actions)


@pytest.mark.slow
@pytest.mark.parametrize(
    "space",
    [
        *(spaces.Box(0, 9, (2,), dtype) for dtype in (np.uint8, np.int16, np.int32, np.int64, np.float16, np.float64)),
        spaces.Box(-1.5, 0.3, (2, 3), np.float64),
        spaces.Box(-1, 1, ()),
        spaces.Box(0, 5, (2, 2), np.int8),
        spaces.MultiBinary(3),
        spaces.MultiBinary([2, 3]),
        spaces.MultiDiscrete([[2, 3], [4, 5]]),
        spaces.MultiDiscrete([2, 3], start=[1, -4], dtype=np.int32),
        spaces.Discrete(4, start=-2),
        spaces.Discrete(4, **INT32),
    ],
    ids=str,
)
def test_an_agent_of_a_homogeneous_team_acts_in_its_own_space(space, tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    model = varied(lambda: MADDPG("MlpPolicy", Alike(space), **SMALL)).learn(30)
    obs = np.random.default_rng(0).uniform(-1, 1, (6, 3)).astype(np.float32)
    policy = model.agent_policy("agent_1")
    assert policy.action_space == space
    assert all(space.contains(policy.predict(row)[0]) for row in obs)
    batch, _ = policy.predict(obs)
    policy.export(tmp_path / "a.pt")
    policy.export(tmp_path / "a.onnx")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        program = th.jit.load(tmp_path / "a.pt")(th.from_numpy(obs)).numpy()
    session = onnxruntime.InferenceSession(str(tmp_path / "a.onnx"), providers=["CPUExecutionProvider"])
    for actions in (program, session.run(None, {"observation": obs})[0]):
        assert actions.dtype == space.dtype
        assert np.allclose(actions.astype(float), batch.astype(float), atol=1e-2 if space.dtype == np.float16 else 1e-5)
        for action in actions:
            assert space.contains(action[0] if isinstance(space, spaces.Discrete) else action)


@pytest.mark.parametrize("dtype", [np.uint8, np.int64, np.float16])
def test_an_agent_of_a_gymnasium_team_acts_in_the_data_type_of_the_team(dtype):
    class Joint(Neighbours):
        def __init__(self):
            super().__init__()
            self.action_space = spaces.Box(0, 7, (8,), dtype)

    policy = varied(lambda: MADDPG("MlpPolicy", Joint(), **SMALL)).agent_policy(1)
    action, _ = policy.predict(np.zeros(policy.obs_dim))
    assert action.dtype == dtype
    assert spaces.Box(0, 7, (2,), dtype).contains(action)


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.uint8])
def test_joint_actions_lie_within_their_space(dtype):
    class Joint(Neighbours):
        def __init__(self):
            super().__init__()
            self.action_space = (
                spaces.Box(0, 7, (8,), dtype) if dtype == np.uint8 else spaces.Box(-3.0, 0.9, (8,), dtype)
            )

        def step(self, action):
            assert self.action_space.contains(action)
            return self.observation_space.sample(), 0.0, False, False, {}

    model = varied(lambda: MADDPG("MlpPolicy", Joint(), **SMALL))
    for _ in range(50):
        assert model.action_space.contains(model.predict(model.observation_space.sample(), deterministic=True)[0])
    model.learn(60)


def test_an_export_has_the_format_of_its_suffix(tmp_path):
    policy = MODELS["binary"]().agent_policy(0)
    for name in ("a.onxx", "a.zip", "robot.1"):
        with pytest.raises(
            ValueError, match=rf"{name}' has the suffix .*end the path with .onnx for ONNX, or with .pt"
        ):
            policy.export(tmp_path / name)
    assert not list(tmp_path.iterdir())
    for name in ("a.PT", "a.pth", "b"):
        policy.export(tmp_path / name)
    assert {file.name for file in tmp_path.iterdir()} == {"a.PT", "a.pth", "b.pt"}


def test_without_onnx_the_remedy_is_named(tmp_path, monkeypatch):
    policy = MODELS["binary"]().agent_policy(0)

    def export(*args, **kwargs):
        raise ModuleNotFoundError("No module named 'onnxscript'", name="onnxscript")

    monkeypatch.setattr(th.onnx, "export", export)
    with pytest.raises(ValueError, match=r'ONNX is not installed .*pip install -e "\.\[onnx\]"'):
        policy.export(tmp_path / "a.onnx")
    assert not list(tmp_path.iterdir())


def test_agents_have_the_names_of_the_environment():
    model = MADDPG("MlpPolicy", gymnasium.make("QuadSwarm-v0", n_robots=3), **SMALL)
    obs = np.random.default_rng(0).normal(size=(20, 18)).astype(np.float32)
    named, numbered = model.agent_policy("robot_2"), model.agent_policy(2)
    assert named.name == numbered.name == "robot_2"
    assert np.array_equal(named.predict(obs)[0], numbered.predict(obs)[0])
    assert named.action_space == spaces.MultiBinary(2)
    chosen = MADDPG("MlpPolicy", Neighbours(), **{**SMALL, "policy_kwargs": {"agent_names": list("abcd")}})
    assert chosen.agent_policy("c").name == "c"
    for unknown in ("robot_3", 3, -1):
        with pytest.raises(ValueError, match=rf"There is no agent {unknown!r}: the agents are robot_0, .*, or 0 to 2"):
            model.agent_policy(unknown)


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        (np.zeros(3), r"An observation of binary_2 has shape \(4,\), not \(3,\)"),
        (np.zeros((2, 5)), r"not \(2, 5\)"),
        (np.zeros((1, 2, 4)), r"not \(1, 2, 4\).*gymnasium.spaces.flatten\(env.observation_space\('binary_2'\), obs"),
        ({"x": np.zeros(4)}, r"and holds numbers; it is not {'x': "),
        (np.array(0.0), r"not \(\)"),
        (np.array([0, 0, np.nan, 0]), "observation of binary_2 holds NaN or infinity"),
        (np.array([[0, 0, np.inf, 0]]), "observation of binary_2 holds NaN or infinity"),
        (10**400, "observation of binary_2 .* and holds numbers; it is not 10"),
        (np.array(["1", "0", "1", "0"]), "observation of binary_2 .* and holds numbers"),
    ],
)
def test_an_observation_that_does_not_fit_is_refused(observation, message):
    policy = MODELS["binary"]().agent_policy("binary_2")
    with pytest.raises(ValueError, match=message):
        policy.predict(observation)


def test_a_policy_that_is_not_finite_is_not_exported(tmp_path):
    model = MODELS["binary"]()
    agent = model.agent_policy("binary_1")
    exports = {agent.network: lambda: agent.export(tmp_path / "a.onnx"), model.actor: lambda: model.agent_policy(0)}
    for policy, export in exports.items():
        with th.no_grad():
            next(policy.parameters()).fill_(float("nan"))
        with pytest.raises(ValueError, match=r"holds NaN or infinity"):
            export()
    assert not list(tmp_path.iterdir())
