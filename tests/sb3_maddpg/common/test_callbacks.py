"""The curriculum and the metrics, with MADDPG and with another algorithm."""

import re

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger, configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_maddpg import MADDPG, CurriculumCallback, MetricsCallback
from sb3_maddpg.common.callbacks import check_success, record_metrics
from sb3_maddpg.team.toys import OwnBit
from sb3_maddpg.utils import shown

SMALL = {"learning_starts": 50, "batch_size": 16, "train_freq": 10, "buffer_size": 500, "seed": 0}


class Levelled(OwnBit):
    """Succeeds on every level but the last; five steps an episode."""

    n_curriculum_levels = 3

    def __init__(self):
        super().__init__(episode_length=5)
        self.level = 0
        self.levels_set: list[int] = []

    def set_curriculum_level(self, level: int) -> None:
        self.level = level
        self.levels_set.append(level)

    def step(self, action):
        *rest, truncated, info = super().step(action)
        if truncated:
            info["is_success"] = self.level < 2
        info["metrics"]["task/level"] = self.level
        return *rest, truncated, info


def test_levels_rise_with_success_and_stop_at_the_last():
    env = Levelled()
    model = MADDPG("MlpPolicy", env, **SMALL)
    model.learn(3 * 5 * 10, callback=CurriculumCallback(window=10))
    assert env.levels_set == [0, 1, 2]
    assert model.curriculum_level == 2
    assert model.logger.name_to_value.get("curriculum/level", 2) == 2


@pytest.mark.parametrize(("successes", "raised"), [(9, True), (8, False)])
def test_the_threshold_is_a_share_of_the_window(successes, raised):
    class Given(Levelled):
        outcomes = iter([True] * successes + [False] * (10 - successes))

        def step(self, action):
            *rest, truncated, info = super().step(action)
            if truncated:
                info["is_success"] = next(self.outcomes)
            return *rest, truncated, info

    model = MADDPG("MlpPolicy", Given(), **SMALL)
    model.learn(50, callback=CurriculumCallback(0.9, window=10))
    assert model.curriculum_level == raised


def test_the_level_survives_the_model_file(tmp_path):
    model = MADDPG("MlpPolicy", Levelled(), **SMALL).learn(60, callback=CurriculumCallback(window=10))
    assert model.curriculum_level == 1
    model.save(tmp_path / "model")
    env = Levelled()
    resumed = MADDPG.load(tmp_path / "model", env=env)
    resumed.learn(20, callback=CurriculumCallback(window=10), reset_num_timesteps=False)
    assert env.levels_set == [1]


@pytest.mark.slow
@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_every_training_environment_is_raised_for_any_algorithm(vec_env_cls):
    env = make_vec_env(Levelled, 2, vec_env_cls=vec_env_cls)
    PPO("MlpPolicy", env, n_steps=40, batch_size=40, n_epochs=1).learn(80, callback=CurriculumCallback(window=10))
    assert env.get_attr("level") == [1, 1]
    env.close()


def test_evaluation_neither_counts_nor_changes():
    evaluation = Levelled()
    callbacks = [CurriculumCallback(window=1000), EvalCallback(Monitor(evaluation), n_eval_episodes=20, eval_freq=10)]
    model = MADDPG("MlpPolicy", Levelled(), **SMALL).learn(60, callback=callbacks)
    assert model.curriculum_level == 0
    assert evaluation.levels_set == []


def test_an_environment_without_curriculum_is_refused():
    with pytest.raises(ValueError, match="`n_curriculum_levels`, which this one lacks"):
        MADDPG("MlpPolicy", OwnBit(), **SMALL).learn(20, callback=CurriculumCallback())


def test_an_environment_that_never_says_whether_it_succeeded_is_refused():
    class Silent(OwnBit):
        n_curriculum_levels = 2

        def set_curriculum_level(self, level: int) -> None:
            assert level == 0

    with pytest.raises(ValueError, match="is_success"):
        MADDPG("MlpPolicy", Silent(), **SMALL).learn(20, callback=CurriculumCallback())


@pytest.mark.parametrize(
    "kwargs", [{"success_threshold": 0.0}, {"success_threshold": 1.1}, {"window": 0}, {"window": 2.5}]
)
def test_bad_arguments_are_refused(kwargs):
    with pytest.raises(ValueError, match=r"must be a (fraction|whole number) of episodes"):
        CurriculumCallback(**kwargs)


def test_metrics_of_another_algorithm(tmp_path):
    env = make_vec_env(Levelled, 2)
    model = PPO("MlpPolicy", env, n_steps=20, batch_size=40, n_epochs=1)
    logged = []

    class Spy(MetricsCallback):
        def _on_rollout_end(self) -> None:
            logged.append(dict(self.logger.name_to_value))

    model.learn(80, callback=Spy())
    assert [values["task/level"] for values in logged] == [0, 0]
    assert all(0.3 < values["task/mean_action"] < 0.7 for values in logged)
    assert np.diff([values["task/mean_action"] for values in logged]) != 0


def test_long_names_fit_into_tables(capsys, tmp_path):
    """Stable-Baselines3 refuses keys that are alike when they are cut off."""
    names = [f"a_robot_with_a_name_of_many_letters_{number}" for number in range(3)]

    class Named(Levelled):
        agent_names = names

        def step(self, action):
            *rest, info = super().step(action)
            return *rest, {**info, "metrics": {f"rollout/{key}_of_{name}": 1.0 for name in names for key in "ab"}}

    for logger in (None, configure(str(tmp_path), ["stdout", "log", "csv"])):
        model = MADDPG("MlpPolicy", Named(), verbose=1, **SMALL)
        if logger:
            model.set_logger(logger)
        model.learn(100, callback=EvalCallback(Monitor(Named()), eval_freq=70))
        printed = capsys.readouterr().out
        assert all(f"   q_value/{name} " in printed and f"   a_of_{name} " in printed for name in names)
    PPO("MlpPolicy", make_vec_env(Named, 1), n_steps=20, batch_size=20, verbose=1).learn(40, callback=MetricsCallback())


@pytest.mark.parametrize("wrong", [None, "x", np.nan, -np.inf, [1.0, 2.0], 10**400])
def test_a_metric_that_is_no_finite_number_is_refused(wrong):
    message = rf"info\['metrics'\]\['task/x'\] is {re.escape(shown(wrong))}: a metric must be a finite number"
    with pytest.raises(ValueError, match=message):
        record_metrics(Logger(None, []), [{"metrics": {"task/x": wrong}}])


@pytest.mark.parametrize("wrong", [None, [1.0], 5])
def test_metrics_have_names(wrong):
    with pytest.raises(ValueError, match=r"info\['metrics'\] is .*: it must be a dict of numbers by name"):
        record_metrics(Logger(None, []), [{}, {"metrics": wrong}])


@pytest.mark.parametrize("wrong", ["x", np.nan, 0.5, np.array([True, False])])
@pytest.mark.parametrize("algorithm", [MADDPG, PPO])
def test_success_is_true_or_false(wrong, algorithm):
    class Unsure(Levelled):
        def step(self, action):
            *rest, info = super().step(action)
            return *rest, {**info, "is_success": wrong}

    small = SMALL if algorithm is MADDPG else {"n_steps": 10, "batch_size": 10}
    callback = None if algorithm is MADDPG else CurriculumCallback()
    with pytest.raises(ValueError, match=r"info\['is_success'\] is .*: it must be True or False"):
        algorithm("MlpPolicy", Unsure(), **small).learn(20, callback)
    check_success([{}, *({"is_success": right} for right in (None, True, np.False_, 1, 0.0, np.array(1.0)))])
