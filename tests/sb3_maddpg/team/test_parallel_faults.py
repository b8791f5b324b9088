"""Environments that misbehave in ways that a generator draws: each works with finite results or is refused by name."""

import traceback
from pathlib import Path

import numpy as np
import pytest
import torch as th

import sb3_maddpg
from faulty import Faulty, trained
from sb3_maddpg import MADDPG


@pytest.mark.parametrize("seed", range(84))
def test_a_faulty_environment_works_or_is_refused_by_name(seed):
    env = Faulty(seed)
    result = trained(env)
    if isinstance(result, MADDPG):
        assert all(th.isfinite(parameter).all() for parameter in result.policy.parameters())
        kept = result.replay_buffer
        assert all(np.isfinite(array).all() for array in (kept.observations, kept.next_observations, kept.numbers))
    else:
        raised_in = Path(traceback.extract_tb(result.__traceback__)[-1].filename)
        assert raised_in.is_relative_to(Path(sb3_maddpg.__file__).parent), raised_in  # not in NumPy, PyTorch, ...
        about_all = env.fault in ("dict", "return", "agents")
        assert env.agent in str(result) or (about_all and "faulty" in str(result)), result
        assert "\n" not in str(result)
