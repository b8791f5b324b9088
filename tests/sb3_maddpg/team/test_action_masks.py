"""Action masks: what a mask forbids is never chosen, by nobody and nowhere, and nothing is learned of it."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from pettingzoo import ParallelEnv
from pettingzoo.classic import tictactoe_v3
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_maddpg import MADDPG
from sb3_maddpg.common.actions import TeamActions
from sb3_maddpg.common.env_checker import check_team_env
from sb3_maddpg.common.estimators import ESTIMATORS
from sb3_maddpg.matd3.matd3 import MATD3
from sb3_maddpg.team.pettingzoo import TeamEnv, TurnBased

ACTIONS = {
    "one": spaces.Discrete(4),
    "some": spaces.MultiDiscrete([2, 3]),
    "bits": spaces.MultiBinary(3),
    "free": spaces.Discrete(3),
    "smooth": spaces.Box(-1, 1, (2,)),
}
LENGTHS = {"one": 4, "some": 5, "bits": 3}
SMALL = {"learning_starts": 60, "batch_size": 16, "train_freq": 4, "buffer_size": 400, "seed": 0}


class Masked(ParallelEnv):
    """Forbids some actions in each step, and takes offence at who chooses one."""

    def __init__(self, agents: tuple[str, ...] = tuple(ACTIONS), in_infos: bool = False):
        self.possible_agents = list(agents)
        self.in_infos = in_infos
        self.rng = np.random.default_rng(0)
        self.counts = dict.fromkeys(agents, 0)

    def observation_space(self, agent: str) -> spaces.Space:
        seen = spaces.Box(-1, 1, (2,))
        if agent not in LENGTHS or self.in_infos:
            return seen
        return spaces.Dict({"observation": seen, "action_mask": spaces.Box(0, 1, (LENGTHS[agent],), np.int8)})

    def action_space(self, agent: str) -> spaces.Space:
        return ACTIONS[agent]

    def draw(self, agent: str) -> np.ndarray:
        mask = self.rng.integers(0, 2, LENGTHS[agent]).astype(np.int8)
        for begin, end in {"one": [(0, 4)], "some": [(0, 2), (2, 5)], "bits": []}[agent]:
            mask[self.rng.integers(begin, end)] = 1
        return mask

    def observe(self):
        self.masks = {agent: self.draw(agent) for agent in self.agents if agent in LENGTHS}
        seen = {agent: self.rng.uniform(-1, 1, 2).astype(np.float32) for agent in self.agents}
        if self.in_infos:
            return seen, {agent: {"action_mask": mask} for agent, mask in self.masks.items()}
        return {
            agent: {"observation": one, "action_mask": self.masks[agent]} if agent in self.masks else one
            for agent, one in seen.items()
        }, {}

    def reset(self, seed=None, options=None):
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        self.agents, self.steps = list(self.possible_agents), 0
        return self.observe()

    def allowed(self, agent: str, action) -> bool:
        mask = self.masks.get(agent)
        if mask is None:
            return True
        if agent == "one":
            return bool(mask[action])
        if agent == "some":
            return bool(mask[action[0]] and mask[2 + action[1]])
        return not (np.asarray(action) & ~mask.astype(bool)).any()

    def step(self, actions):
        for agent, action in actions.items():
            assert self.allowed(agent, action), f"{agent} chose {action} where {self.masks[agent]} is allowed"
            self.counts[agent] += 1
        self.steps += 1
        over = self.steps == 12
        rewards = {agent: float(np.sum(action)) for agent, action in actions.items()}
        observations, infos = self.observe()
        ends, cuts = dict.fromkeys(self.agents, False), dict.fromkeys(self.agents, over)
        if self.steps == 5:
            ends[self.agents[0]] = True  # from now on its row, and with it its mask, is zero
        self.agents = [agent for agent in self.agents if not (ends[agent] or cuts[agent])]
        return observations, rewards, ends, cuts, infos


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("share", [("one", "some", "bits", "free", "smooth"), ("one",), ("bits",)])
def test_nobody_chooses_what_is_forbidden(estimator, share):
    env = Masked(share)
    model = MADDPG("MlpPolicy", env, estimator=estimator, **SMALL)
    model.learn(160)
    assert env.counts[share[-1]] >= 150
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())


@pytest.mark.parametrize("in_infos", [False, True])
def test_all_of_the_library_keeps_to_masks(in_infos):
    model = MATD3("MlpPolicy", TeamEnv(Masked(in_infos=in_infos), info_mask=in_infos), **SMALL)
    model.learn(120)
    team = TeamEnv(Masked(in_infos=in_infos), info_mask=in_infos)
    assert team.observation_space.masks[-1] == ()
    obs, _ = team.reset(seed=3)
    for deterministic in (True, False) * 6:
        action, _ = model.predict(obs, deterministic=deterministic)
        obs, *_, over, _ = team.step(action)
        if over:
            obs, _ = team.reset()
    data = model.replay_buffer.sample(64)
    allowed = model.policy.actions.allowed(data.next_observations)
    present = data.next_active.unsqueeze(2) > 0
    for _ in range(5):
        assert not ((model._target_actions(data.next_observations) != 0) & ~allowed & present).any()


def test_an_environment_with_masks_passes_the_checker():
    state = th.random.get_rng_state()
    assert check_team_env(Masked(("one", "bits"))).masks == ((0, 1, 2, 3), (0, 1, 2))
    assert len(check_team_env(TeamEnv(Masked(in_infos=True), info_mask=True)).masks) == 5
    assert th.equal(th.random.get_rng_state(), state)


def test_masks_in_infos_are_ignored_with_one_warning():
    env = TeamEnv(Masked(in_infos=True))
    with pytest.warns(UserWarning, match=r"infos\['one'\]\['action_mask'\] of .* is ignored: .*info_mask=True"):
        env.reset()
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        env.reset()
        TeamEnv(Masked(in_infos=True), info_mask=True).reset()
        TeamEnv(Masked()).reset()


def of_space(*action_spaces, masks=()) -> TeamActions:
    return TeamActions(action_spaces, masks=masks)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_masked_action_is_one_that_does_not_exist(name):
    """The same objective and gradient as where the action space has the allowed categories only."""
    th.manual_seed(0)
    values = th.randn(5)
    batch = 4000
    logits = th.randn(1, 1, 5).expand(batch, -1, -1).clone()
    allowed = th.tensor([True, False, True, True, False])
    gradients, objectives = [], []
    for masked in (True, False):
        part = (logits if masked else logits[..., allowed]).clone().requires_grad_()
        actions = of_space(spaces.Discrete(part.shape[-1]), masks=[range(5)] if masked else ())
        worth = values if masked else values[allowed]
        seen = allowed.float().expand(batch, 1, -1)
        outputs = actions.mask(part, seen) if masked else part
        objective = actions.objective(ESTIMATORS[name], outputs, lambda own, _, w=worth: (own * w).sum(dim=-1), 1.0)
        objectives.append(objective.mean().item())
        objective.sum().backward()
        gradients.append(part.grad.mean(dim=0)[0])
    assert not gradients[0][~allowed].any(), "nothing is learned of what is forbidden"
    exact = name in ("expected", "score")
    assert objectives[0] == pytest.approx(objectives[1], abs=1e-6 if exact else 0.06)
    assert th.allclose(gradients[0][allowed], gradients[1], atol=1e-6 if exact else 0.03)


def test_who_may_choose_nothing_takes_no_part():
    actions = of_space(spaces.Discrete(3), spaces.MultiBinary(3), masks=[(0, 1, 2), (0, 1, 2)])
    logits = th.randn(2, 2, 3)
    masked = actions.mask(logits, th.zeros(2, 2, 3))
    assert th.equal(masked[:, 0], logits[:, 0])
    assert not actions.squash(masked)[:, 1].any(), "no bit can be set"
    assert actions.regularization(masked).isfinite().all()


def test_random_actions_become_legal_and_stay_otherwise_as_they_are():
    team = (spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(5), spaces.Discrete(5))
    actions = of_space(*team, masks=[range(5), range(5), ()])
    rng = np.random.default_rng(0)
    flat = th.tensor(
        np.stack([np.concatenate([np.ravel(space.sample()) for space in team]) for _ in range(500)])
    ).float()
    obs = th.tensor(rng.integers(0, 2, (500, 3, 5))).float()
    obs[:, 0, 0], obs[:, 0, 4] = 1, 1
    legal = actions.legal(flat, obs)
    encoded = actions.encode(legal)
    assert not ((encoded != 0) & ~actions.allowed(obs)).any()
    was_legal = ~((actions.encode(flat) != 0) & ~actions.allowed(obs)).any(dim=2)
    assert th.equal(legal[was_legal[:, 0]][:, :2], flat[was_legal[:, 0]][:, :2])
    assert th.equal(legal[:, 2:7], flat[:, 2:7] * obs[:, 1])
    assert th.equal(legal[:, 7], flat[:, 7])
    assert 0 < was_legal[:, 0].float().mean() < 1


@pytest.mark.slow
def test_masks_travel_with_models_and_single_agents(tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    model = MADDPG("MlpPolicy", Masked(("one", "some", "bits")), **SMALL)
    model.learn(80)
    model.save(tmp_path / "model.zip")
    loaded = MADDPG.load(tmp_path / "model.zip")
    assert loaded.policy.team.masks == model.policy.team.masks == ((0, 1, 2, 3), (0, 1, 2, 3, 4), (0, 1, 2))
    obs = np.stack([model.replay_buffer.sample(50).observations.numpy()])[0]
    joint, _ = model.predict(obs, deterministic=True)
    assert np.array_equal(loaded.predict(obs, deterministic=True)[0], joint)
    for number, part in enumerate((joint[:, :1], joint[:, 1:3], joint[:, 3:])):
        agent = loaded.agent_policy(number)
        own = obs[:, number, : agent.obs_dim]
        assert np.array_equal(agent.predict(own)[0], part)
        for suffix in ("pt", "onnx"):
            agent.export(tmp_path / f"agent.{suffix}")
        assert np.array_equal(th.jit.load(tmp_path / "agent.pt")(th.as_tensor(own)).numpy(), part)
        session = onnxruntime.InferenceSession(str(tmp_path / "agent.onnx"), providers=["CPUExecutionProvider"])
        assert np.array_equal(session.run(None, {"observation": own})[0], part)


def test_what_does_not_fit_is_refused():
    class Short(Masked):
        def observation_space(self, agent):
            mask = spaces.Box(0, 1, (3,), np.int8)
            return spaces.Dict({"observation": spaces.Box(-1, 1, (2,)), "action_mask": mask})

    with pytest.raises(ValueError, match=r"'one' has an action mask of 3 numbers, but its space Discrete\(4\) needs 4"):
        MADDPG("MlpPolicy", Short(("one",)))
    with pytest.raises(ValueError, match="is continuous and takes no mask"):
        MADDPG("MlpPolicy", Short(("smooth",)))
    with pytest.raises(ValueError, match=r"info_mask=True, but .* \(smooth\) are continuous.*leave info_mask out"):
        TeamEnv(Masked(("smooth",)), info_mask=True)
    env = DummyVecEnv([lambda: TeamEnv(Masked(("one",)))])
    with pytest.raises(ValueError, match=r"shifts the action masks.*norm_obs=False"):
        MADDPG("MlpPolicy", VecNormalize(env))
    MADDPG("MlpPolicy", VecNormalize(DummyVecEnv([lambda: TeamEnv(Masked(("one",)))]), norm_obs=False))


def test_who_has_other_masks_shares_no_network():
    with pytest.raises(ValueError, match="different spaces"):
        MADDPG("MlpPolicy", Masked(("one", "free")), policy_kwargs={"share_actor": True})


# PettingZoo's noughts and crosses: who chooses a taken field loses at once, and a warning is printed
@pytest.mark.slow
def test_a_game_with_turns_is_played_by_its_rules(capfd):
    env = TeamEnv(tictactoe_v3.env())
    model = MADDPG("MlpPolicy", env, learning_starts=200, batch_size=32, train_freq=4, buffer_size=2000, seed=0)
    model.learn(900)
    assert "Illegal" not in "".join(capfd.readouterr())
    obs, _ = env.reset(seed=0)
    rewards = []
    for step in range(9):
        movers = [row for row in range(2) if not np.array_equal(obs[row, :9], np.eye(9)[0])]
        assert movers == [step % 2] or step == 8, "who is not to move may choose the first action alone"
        action, _ = model.predict(obs, deterministic=False)
        obs, _, terminated, truncated, info = env.step(action)
        rewards.append(info["agent_rewards"])
        if terminated or truncated:
            break
    assert terminated
    assert not truncated
    assert not np.any(rewards[:-1])
    assert tuple(rewards[-1]) in {(1.0, -1.0), (-1.0, 1.0), (0.0, 0.0)}


def test_turns_are_for_discrete_actions_and_real_turns():
    from mpe2 import simple_spread_v3

    with pytest.raises(ValueError, match=r"is parallelizable, .*: use its parallel_env"):
        TurnBased(simple_spread_v3.env())
    env = tictactoe_v3.env()
    env.action_space = lambda agent: spaces.MultiBinary(9)
    with pytest.raises(ValueError, match="it must be Discrete"):
        TurnBased(env)
