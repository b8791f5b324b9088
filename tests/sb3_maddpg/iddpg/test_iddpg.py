"""Independent critics: they see what their agent sees and does, and nothing else."""

import pytest
import torch as th

from sb3_maddpg import IDDPG, MADDPG
from sb3_maddpg.cli.main import main
from sb3_maddpg.iddpg.iddpg import IndependentPolicy
from sb3_maddpg.team.pettingzoo import TeamEnv
from sb3_maddpg.team.toys import OwnBit
from toys import AGENT_SPACES, SMALL, Neighbours, Toy


def made(kind: str, state: bool = False, **policy_kwargs) -> IDDPG:
    arguments = {**SMALL, "policy_kwargs": {"net_arch": [8], **policy_kwargs}}
    return IDDPG("MlpPolicy", TeamEnv(Toy(kind), state=state), **arguments)


def drawn(model: IDDPG, batch: int = 5) -> tuple[th.Tensor, th.Tensor]:
    th.manual_seed(0)
    obs = th.randn(batch, *model.observation_space.shape)
    return obs, model.actor.act(obs, deterministic=False)


@pytest.mark.parametrize("state", [False, True])
@pytest.mark.parametrize("kind", AGENT_SPACES)
def test_a_value_depends_on_the_own_observation_and_action_alone(kind, state):
    model = made(kind, state, n_critics=2)
    obs, actions = drawn(model)
    values = model.critic(obs, actions)
    n = model.policy.team.n_agents
    assert values.shape == (2, 5, n)
    for agent in range(n):
        others = [other for other in range(n) if other != agent]
        changed_obs, changed_actions = obs.clone(), actions.clone()
        changed_obs[:, others] += 1.0
        changed_obs[..., model.policy.team.obs_dim :] += 1.0  # the global state
        changed_actions[:, others] = 1 - changed_actions[:, others]
        changed = model.critic(changed_obs, changed_actions)
        assert th.allclose(changed[..., agent], values[..., agent])
        assert not th.allclose(changed[..., others], values[..., others])
        changed_obs, changed_actions = obs.clone(), actions.clone()
        changed_obs[:, agent, 0] += 1.0
        assert not th.allclose(model.critic(changed_obs, actions)[..., agent], values[..., agent])
        changed_actions[:, agent, 0] += 1.0
        assert not th.allclose(model.critic(obs, changed_actions)[..., agent], values[..., agent])


@pytest.mark.parametrize("factors", [None, [1], [2, 0]])
@pytest.mark.parametrize("n_critics", [1, 2])
@pytest.mark.parametrize("share", [False, True])
def test_alternatives_have_the_values_of_the_action_replaced(factors, n_critics, share):
    policy_kwargs = {"net_arch": [8], "n_critics": n_critics, "share_critic": share}
    model = IDDPG("MlpPolicy", Neighbours(), **{**SMALL, "policy_kwargs": policy_kwargs})
    obs, actions = drawn(model)
    n, width = model.policy.team.n_agents, model.policy.actions.width
    which = list(range(n)) if factors is None else factors
    own = th.randn(5, len(which), 3, width)
    values = model.critic.forward_alternatives(obs, actions, own, None if factors is None else th.tensor(factors))
    assert values.shape == (5, len(which), 3)
    for place, agent in enumerate(which):
        for alternative in range(3):
            replaced = actions.clone()
            replaced[:, agent] = own[:, place, alternative]
            expected = model.critic(obs, replaced)[0, :, agent]
            assert th.allclose(values[:, place, alternative], expected, atol=1e-6)


def test_one_value_for_the_team_is_refused():
    with pytest.raises(ValueError, match="share_critic='team' requires a centralised critic"):
        IDDPG("MlpPolicy", Neighbours(), policy_kwargs={"share_critic": "team"})


@pytest.mark.slow
def test_it_learns_what_needs_no_others():
    model = IDDPG(
        "MlpPolicy", OwnBit(), learning_rate=3e-3, learning_starts=200, batch_size=128, train_freq=2, seed=0
    ).learn(3000)
    env = OwnBit()
    rewards = []
    for seed in range(200):
        obs, _ = env.reset(seed=seed)
        rewards.append(env.step(model.predict(obs, deterministic=True)[0])[1])
    best, random = max(rewards), sum(rewards) / len(rewards)
    assert random > 0.9 * best


def test_files_are_told_apart(tmp_path):
    model = made("mixed").learn(60)
    model.save(tmp_path / "model.zip")
    loaded = IDDPG.load(tmp_path / "model.zip")
    assert isinstance(loaded.policy, IndependentPolicy)
    obs = drawn(model)[0].numpy()
    assert (loaded.predict(obs, deterministic=True)[0] == model.predict(obs, deterministic=True)[0]).all()
    with pytest.raises(ValueError, match=r"holds a model of IDDPG: load it with `IDDPG\.load`"):
        MADDPG.load(tmp_path / "model.zip")
    MADDPG("MlpPolicy", TeamEnv(Toy("mixed")), **SMALL).save(tmp_path / "maddpg.zip")
    with pytest.raises(ValueError, match=r"holds a model of MADDPG: load it with `MADDPG\.load`"):
        IDDPG.load(tmp_path / "maddpg.zip")
    with pytest.raises(ValueError, match="PairPolicy"):
        IDDPG("PairPolicy", OwnBit())


def test_one_command_trains_it(tmp_path, monkeypatch):
    pytest.importorskip("rl_zoo3")
    monkeypatch.chdir(tmp_path)
    argv = ["train", "--algo", "iddpg", "--env", "mpe2/simple_spread_v3", "--n-timesteps", "300", "--eval-freq", "-1"]
    assert main([*argv, "--verbose", "0", "-params", "train_freq:50", "learning_starts:100"]) == 0
    (path,) = tmp_path.glob("logs/iddpg/*_1/*.zip")
    assert IDDPG.load(path).num_timesteps >= 300
