"""Arguments that enter: conversion, and one line that says what is allowed."""

import numpy as np
import pytest
import torch as th

from sb3_maddpg import MADDPG
from sb3_maddpg.common.policies import MADDPGPolicy
from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.team.spaces import MixedActions
from sb3_maddpg.team.team import Team
from sb3_maddpg.team.toys import OwnBit
from sb3_maddpg.validation import PairPolicyArguments, PolicyArguments, validated
from toys import toy

GOOD = {
    "net_arch": [8],
    "threshold": 0.5,
    "random_thresholds": 1.0,
    "n_critics": 1,
    "activation_fn": th.nn.ReLU,
    "optimizer_class": th.optim.Adam,
    "optimizer_kwargs": None,
    "agent_names": None,
    "normalize_images": True,
}


def test_values_become_what_is_expected():
    given = {**GOOD, "threshold": "0.25", "n_critics": np.int64(2), "net_arch": (8, 8)}
    expected = {**GOOD, "threshold": 0.25, "n_critics": 2, "net_arch": [8, 8], "image_columns": None}
    assert validated(PolicyArguments, **given) == expected
    assert validated(PairPolicyArguments, pair_credit="false", shared_threshold=True)["pair_credit"] is False


@pytest.mark.parametrize(
    ("name", "value"),
    [("threshold", 1.0), ("threshold", "high"), ("n_critics", 0), ("n_critics", 1.5), ("net_arch", [8, -1])],
)
def test_other_values_are_refused_in_one_line(name, value):
    with pytest.raises(ValueError, match=rf"^{name}=.* must be .*\.$") as refused:
        validated(PolicyArguments, **{**GOOD, name: value})
    assert type(refused.value) is InvalidArgumentError
    assert repr(value) in str(refused.value)


@pytest.mark.parametrize("n_critics", [2.5, "two", 0])
def test_a_number_of_critics_is_an_integer(n_critics):
    with pytest.raises(ValueError, match=rf"^n_critics={n_critics!r} must be an integer of at least 1\.$"):
        validated(PolicyArguments, **{**GOOD, "n_critics": n_critics})


class Centred(th.nn.Module):
    def forward(self, x):
        return x - x.mean()


@pytest.mark.filterwarnings("ignore:Implicit dimension")
@pytest.mark.parametrize(
    "activation_fn",
    [
        *(th.nn.LayerNorm, th.nn.Linear, th.nn.GLU, th.nn.Flatten, th.nn.Threshold, th.nn.PReLU, th.nn.LazyBatchNorm1d),
        *(th.nn.Softmax, th.nn.Softmin, th.nn.LogSoftmax, th.nn.Softmax2d, Centred),
    ],
)
def test_activations_that_mix_numbers_or_have_parameters_are_refused(activation_fn):
    with pytest.raises(ValueError, match=rf"^activation_fn=.*{activation_fn.__name__}'> must be .* by itself, such as"):
        validated(PolicyArguments, **{**GOOD, "activation_fn": activation_fn})


@pytest.mark.parametrize(
    "name",
    [
        *(
            "ReLU",
            "Tanh",
            "ELU",
            "GELU",
            "SiLU",
            "Mish",
            "LeakyReLU",
            "Sigmoid",
            "Softplus",
            "Softsign",
            "SELU",
            "CELU",
        ),
        *("Hardtanh", "Hardswish", "LogSigmoid", "Softshrink", "Tanhshrink", "RReLU", "ReLU6", "Identity"),
    ],
)
def test_elementwise_activations_are_accepted_and_draw_no_random_numbers(name):
    before = th.get_rng_state()
    activation_fn = getattr(th.nn, name)
    assert validated(PolicyArguments, **{**GOOD, "activation_fn": activation_fn})["activation_fn"] is activation_fn
    assert th.equal(th.get_rng_state(), before)


def test_messages_about_long_values_are_short():
    for value in (10**400, 10**5000, [10**400], "x" * 5000):
        with pytest.raises(ValueError, match=r"^n_critics=") as refused:
            validated(PolicyArguments, **{**GOOD, "n_critics": value})
        assert len(str(refused.value)) < 300


def test_an_unknown_argument_is_named():
    with pytest.raises(ValueError, match="Unknown argument 'n_critic': did you mean 'n_critics'"):
        validated(PolicyArguments, **GOOD, n_critic=2)


def test_homogeneous_agents_have_the_same_spaces():
    env = toy("heterogeneous")
    assert isinstance(env.action_space, MixedActions)
    team = Team.from_spaces(env.observation_space, env.action_space)
    assert [[team.homogeneous(i, j) for j in range(4)] for i in range(4)] == np.eye(4, dtype=bool).tolist()
    shared = MADDPGPolicy(env.observation_space, env.action_space, lambda _: 1e-3, share_actor=False).team
    assert shared.homogeneous(2, 2)


@pytest.mark.skipif(th.cuda.is_available(), reason="needs a machine without a GPU")
def test_a_device_that_is_missing_is_told():
    with pytest.warns(UserWarning, match="device='cuda': PyTorch finds no such device, so cpu is used"):
        MADDPG("MlpPolicy", OwnBit(), device="cuda")
