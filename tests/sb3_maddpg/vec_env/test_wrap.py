"""Copies of environments by their class, function or id."""

import pytest
from mpe2 import simple_spread_v3
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_maddpg import MADDPG, make_vec_env
from sb3_maddpg.team.toys import OwnBit
from toys import SMALL, Toy


@pytest.mark.parametrize(
    ("env", "kwargs"),
    [
        (Toy, {"kind": "binary"}),
        (simple_spread_v3.parallel_env, {"N": 2}),
        ("mpe2/simple_spread_v3", {"N": 2, "state": True}),
        ("OwnBit-v0", {"episode_length": 4}),
        (OwnBit, {}),
    ],
)
def test_what_creates_an_environment_is_enough(env, kwargs, tmp_path):
    made = make_vec_env(env, n_envs=3, seed=1, env_kwargs=kwargs, monitor_dir=tmp_path)
    model = MADDPG("MlpPolicy", made, **SMALL)
    model.learn(60)
    assert made.num_envs == 3
    assert len(list(tmp_path.glob("*.monitor.csv"))) == 3
    made.close()


@pytest.mark.slow
def test_each_copy_may_have_a_process():
    made = make_vec_env("mpe2/simple_spread_v3", n_envs=2, vec_env_cls=SubprocVecEnv)
    MADDPG("MlpPolicy", made, **SMALL).learn(40)
    made.close()


def test_an_environment_itself_is_not_enough():
    with pytest.raises(ValueError, match="pass what creates an environment, not an environment"):
        make_vec_env(Toy("binary"))
    with pytest.raises(ValueError, match="did you mean 'mpe2/simple_spread_v3'"):
        make_vec_env("mpe2/simple_sprad_v3")
