"""Values of the command line and of recipes, read without running code."""

import argparse

import pytest
import torch
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike

from sb3_maddpg.cli.literals import StoreValues, format_literal, parse_literal, parse_value


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("false", False),
        ("true", True),
        ("False", False),
        ("null", None),
        ("None", None),
        ("1e-3", 0.001),
        ("-2", -2),
        ("[64, 64]", [64, 64]),
        ("(1, 'step')", (1, "step")),
        ("{random: 1, swap: 0.5}", {"random": 1, "swap": 0.5}),
        ("{'random': 1}", {"random": 1}),
        ("dense", "dense"),
        ("'dense'", "dense"),
        ("state+memory", "state+memory"),
        ("lin_0.01", "lin_0.01"),
        ("cpa:0.7:1.5", "cpa:0.7:1.5"),
        ("3:40", "3:40"),
        ("no", "no"),
        ("../path/to.zip", "../path/to.zip"),
    ],
)
def test_a_value_is_what_python_or_yaml_means_by_it_or_a_word(text, meant):
    assert parse_value(text) == meant
    assert type(parse_value(text)) is type(meant)


@pytest.mark.parametrize(
    "text",
    ["nan", "-inf", ".nan", "1e999", "[nan, 1]", "{a: .inf}", "1/0", "2**9999999", "print(1)", "[1, 2", "f(x=1)"],
)
def test_what_is_not_finite_or_would_have_to_be_evaluated_is_refused(text):
    with pytest.raises(ValueError, match=r"finite|not evaluated|not valid Python|neither a list nor a dict"):
        parse_value(text)


def test_arguments_of_a_policy_as_recipes_of_rl_zoo3_have_them():
    text = """dict(log_std_init=-2, ortho_init=False, activation_fn=nn.ReLU, net_arch=dict(pi=[256, 256], vf=[256]),
                   optimizer_class=th.optim.Adam, optimizer_kwargs=dict(eps=1e-5))"""
    meant = {
        "log_std_init": -2,
        "ortho_init": False,
        "activation_fn": torch.nn.ReLU,
        "net_arch": {"pi": [256, 256], "vf": [256]},
        "optimizer_class": torch.optim.Adam,
        "optimizer_kwargs": {"eps": 1e-5},
    }
    assert parse_literal(text) == meant
    assert parse_literal(format_literal(meant)) == meant
    assert parse_literal(format_literal({"optimizer_class": RMSpropTFLike})) == {"optimizer_class": RMSpropTFLike}


@pytest.mark.parametrize(
    "text",
    [
        "dict(a=__import__('os'))",
        "dict(a=os.system)",
        "dict(a=nn.init.zeros_)",
        "dict(a=nn.functional)",
        "dict(**{'a': 1})",
        "{**{}}",
        "[x for x in ()]",
        "lambda: 1",
        "{[1]: 2}",
        "nn.ReLU()",
        "dict(a=",
        "dict(a=float('nan'))",
    ],
)
def test_a_literal_runs_nothing(text):
    with pytest.raises(ValueError, match=r"\w"):
        parse_literal(text)


def test_an_option_is_key_and_value():
    parser = argparse.ArgumentParser()
    parser.add_argument("--env-kwargs", nargs="+", action=StoreValues)
    given = parser.parse_args(["--env-kwargs", "flag:false", "preset:dense"])
    assert given.env_kwargs == {"flag": False, "preset": "dense"}
    for word in ("preset", "preset:", ":1", "n:nan"):
        with pytest.raises(ValueError, match=r"--env-kwargs .*Write key:value"):
            parser.parse_args(["--env-kwargs", word])
