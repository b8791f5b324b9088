"""Returns of teams and agents: the right sums, the same episodes for all, and what makes a model the best one."""

import gymnasium
import numpy as np
import pytest
from pettingzoo.utils import BaseParallelWrapper
from stable_baselines3.common.callbacks import BaseCallback, StopTrainingOnNoModelImprovement
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_maddpg import MADDPG, TeamEnv, make_vec_env
from sb3_maddpg.common.evaluation import (
    Episode,
    TeamEvalCallback,
    compare,
    mean_interval,
    play,
    share_interval,
    summarise,
)
from sb3_maddpg.team.toys import OwnBit
from toys import SMALL, Toy


class Leaver(Toy):
    """The first agent leaves after three steps of six, and says that it succeeded if the episode's seed is even."""

    def __init__(self):
        super().__init__("categorical", length=6)

    def reset(self, seed=None, options=None):
        self.even = seed is not None and seed % 2 == 0
        return super().reset(seed, options)

    def step(self, actions):
        first, second = self.possible_agents
        gone = first not in actions
        if gone:
            actions, self.agents = {first: 0, **actions}, [first, second]
        observations, rewards, terminated, truncated, _ = super().step(actions)
        if gone:
            del rewards[first]
        infos = {second: {"is_success": self.even}} if self.time == 6 else {}
        if self.time >= 3:
            self.agents = [agent for agent in self.agents if agent != first]
            terminated[first] = True
        return observations, rewards, terminated, truncated, infos


def test_returns_and_lives_are_those_of_the_agents():
    env = DummyVecEnv([lambda: TeamEnv(Leaver())])
    episodes = [*play(None, env, 4, seed=10)]
    assert [one.seed for one in episodes] == [10, 11, 12, 13]
    assert [one.success for one in episodes] == [True, False, True, False]
    for one in episodes:
        assert (one.length, one.lives) == (6, {"categorical_0": 3, "categorical_1": 6})
        assert one.team_return == pytest.approx(sum(one.returns.values()) / 2, abs=1e-5)
    again = [*play(None, env, 1, seed=12)]
    assert again == episodes[2:3], "an episode depends on its seed alone"
    found = summarise(episodes)
    assert found["success_rate"]["mean"] == 0.5
    assert found["agents"]["categorical_0"]["length"]["mean"] == 3
    assert found["return"]["mean"] == pytest.approx(np.mean([one.team_return for one in episodes]))


def test_the_sums_are_those_of_stable_baselines3():
    model = MADDPG("MlpPolicy", OwnBit(), **SMALL)
    env = DummyVecEnv([lambda: Monitor(OwnBit())])
    ours = [one.team_return for one in play(model, env, 1, seed=3)]
    env.seed(3)
    theirs, _ = evaluate_policy(model, env, 1, deterministic=True, return_episode_rewards=True)
    assert ours == pytest.approx(theirs)
    assert set(next(play(model, env, 1)).returns) == {"agent_0", "agent_1", "agent_2"}


def test_only_one_environment_can_be_played():
    with pytest.raises(ValueError, match="vectorised 2 times"):
        next(play(None, DummyVecEnv([OwnBit, OwnBit]), 1))


@pytest.mark.parametrize("n", [2, 3, 5, 60])
def test_an_interval_holds_the_mean_in_about_95_of_100_samples(n):
    rng, hits = np.random.default_rng(0), 0
    for _ in range(1000):
        mean, low, high = mean_interval(rng.normal(3.0, 2.0, n))
        assert low < mean < high
        hits += low <= 3.0 <= high
    assert 930 <= hits <= 970


def test_intervals_of_known_samples():
    """By SciPy's t and by Wilson (1927)."""
    for n, quantile in ((2, 12.7062), (3, 4.3027), (4, 3.1824), (6, 2.5706), (31, 2.0423)):
        _, low, high = mean_interval(np.resize([0.0, 1.0], n))
        half = quantile * np.resize([0.0, 1.0], n).std(ddof=1) / np.sqrt(n)
        assert (high - low) / 2 == pytest.approx(half, rel=2e-3)
    assert share_interval(0, 100) == pytest.approx((0, 0, 0.0370), abs=1e-4)
    assert share_interval(3, 4) == pytest.approx((0.75, 0.3006, 0.9544), abs=1e-4)
    assert share_interval(5, 5)[1:] == pytest.approx((0.5655, 1.0), abs=1e-4)
    assert mean_interval([2.0])[0] == 2.0
    assert np.isnan(mean_interval([2.0])[1:]).all()
    assert mean_interval([1.0, 1.0, 1.0]) == (1.0, 1.0, 1.0)
    assert mean_interval(range(100)) == mean_interval(range(100))


def test_differences_are_those_of_the_same_episodes():
    def episode(seed: int, value: float) -> Episode:
        return Episode(seed, value, 1, {"a": value}, {"a": 1}, None)

    ours, theirs = ([episode(k, k * 10.0 + more) for k in range(30)] for more in (1.0, 0.0))
    assert compare(ours, theirs) == {"mean": 1.0, "low": 1.0, "high": 1.0}, "whatever the episodes differ by"
    with pytest.raises(ValueError, match="their seeds differ"):
        compare(ours, theirs[1:])


class Opposed(BaseParallelWrapper):
    """The second agent gets the opposite of the first one's reward, and ten times as much, in all steps."""

    def __init__(self):
        super().__init__(Toy("categorical"))

    def step(self, actions):
        observations, rewards, *rest = super().step(actions)
        first, second = self.possible_agents
        return observations, {first: rewards[first], second: -10 * rewards[first]}, *rest


class Kept(BaseCallback):
    """Notes the evaluations that were the best so far."""

    def __init__(self):
        super().__init__()
        self.at: list[int] = []

    def _on_step(self):
        self.at.append(self.parent.num_timesteps)
        return True


@pytest.mark.parametrize("best_by", ["mean_reward", "categorical_0", "categorical_1"])
def test_the_best_model_is_the_best_by_what_was_asked(best_by, tmp_path):
    kept = Kept()
    model = MADDPG("MlpPolicy", TeamEnv(Opposed()), **SMALL)
    callback = TeamEvalCallback(
        make_vec_env(Opposed, seed=1),
        best_by=best_by,
        eval_freq=20,
        n_eval_episodes=3,
        log_path=str(tmp_path),
        best_model_save_path=str(tmp_path),
        callback_on_new_best=kept,
        verbose=0,
    )
    model.learn(200, callback=callback)
    with np.load(tmp_path / "evaluations.npz") as file:
        names, returns, lengths = (file[key] for key in ("agent_names", "agent_results", "agent_lengths"))
        results, steps = file["results"], file["timesteps"]
    assert names.tolist() == ["categorical_0", "categorical_1"]
    assert returns.shape == lengths.shape == (10, 3, 2)
    np.testing.assert_allclose(returns.mean(axis=2), results, atol=1e-5)
    judged = {"mean_reward": results, "categorical_0": returns[..., 0], "categorical_1": returns[..., 1]}[best_by]
    judged = judged.mean(axis=1)
    best = [int(step) for k, step in enumerate(steps) if judged[k] > max(judged[:k], default=-np.inf)]
    assert kept.at == best
    assert (tmp_path / "best_model.zip").is_file()
    assert model.logger.name_to_value.get("eval/ep_rew_categorical_0") is None, "it was written"


def test_the_returns_of_agents_are_logged_with_the_evaluation(tmp_path):
    model = MADDPG("MlpPolicy", TeamEnv(Toy("categorical")), **SMALL)
    callback = TeamEvalCallback(make_vec_env(Leaver), eval_freq=30, n_eval_episodes=2, verbose=0)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(30, callback=callback)
    titles = (tmp_path / "progress.csv").read_text().splitlines()[0].split(",")
    assert {"eval/ep_rew_categorical_0", "eval/ep_rew_categorical_1", "eval/ep_len_categorical_0"} <= set(titles)


def test_an_environment_of_pettingzoo_is_evaluated_as_it_is(tmp_path):
    model = MADDPG("MlpPolicy", Leaver(), **SMALL)
    callback = TeamEvalCallback(Leaver(), eval_freq=30, n_eval_episodes=2, log_path=str(tmp_path), verbose=0)
    model.learn(30, callback=callback)
    assert np.load(tmp_path / "evaluations.npz")["agent_results"].shape == (1, 2, 2)


def test_the_best_by_successes_needs_successes():
    model = MADDPG("MlpPolicy", TeamEnv(Leaver()), **SMALL)
    callback = TeamEvalCallback(make_vec_env(Leaver), best_by="success_rate", eval_freq=30, n_eval_episodes=2)
    model.learn(30, callback=callback)
    assert callback.best_value in (0.0, 0.5, 1.0)
    silent = make_vec_env(Toy, env_kwargs={"kind": "categorical", "length": 6})
    with pytest.raises(ValueError, match=r'best_by="success_rate" needs info\["is_success"\]'):
        model.learn(30, callback=TeamEvalCallback(silent, best_by="success_rate", eval_freq=30))
    with pytest.raises(ValueError, match=r"Unknown best_by 'categorical_2': did you mean 'categorical_[01]'"):
        TeamEvalCallback(make_vec_env(Leaver), best_by="categorical_2")


def test_what_follows_an_evaluation_follows_the_choice_of_the_best():
    model = MADDPG("MlpPolicy", TeamEnv(Opposed()), **SMALL)
    stop = StopTrainingOnNoModelImprovement(max_no_improvement_evals=1, min_evals=0)
    callback = TeamEvalCallback(make_vec_env(Opposed), best_by="categorical_1", eval_freq=10, callback_after_eval=stop)
    model.learn(10_000, callback=callback)
    assert model.num_timesteps < 10_000
    assert stop.last_best_mean_reward == callback.best_value


def test_the_windows_of_team_and_agents_are_alike():
    model = MADDPG("MlpPolicy", TeamEnv(Toy("categorical", length=5)), stats_window_size=4, **SMALL)
    model.learn(200)
    assert {len(window) for window in model.agent_windows.values()} == {4}
    team = np.mean([one["r"] for one in model.ep_info_buffer])
    agents = [np.mean(window) for name, window in model.agent_windows.items() if "ep_rew" in name]
    assert np.mean(agents) == pytest.approx(team, abs=1e-5)


def test_an_environment_of_gymnasium_is_a_team_too():
    env = make_vec_env(lambda: gymnasium.make("OwnBit-v0"))
    assert summarise([*play(None, env, 3)])["agents"].keys() == {"agent_0", "agent_1", "agent_2"}
