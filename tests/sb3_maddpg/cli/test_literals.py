"""Values of the command line and of recipes, read without running code."""

import argparse

import pytest
import torch
import yaml
from stable_baselines3.common.sb2_compat.rmsprop_tf_like import RMSpropTFLike

from sb3_maddpg.cli.literals import BoundedLoader, format_literal, parse_literal, parse_value
from sb3_maddpg.cli.options import StoreValues


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
    for word in ("preset", "preset:", ":1"):
        with pytest.raises(ValueError, match=r"--env-kwargs .*Write key:value"):
            parser.parse_args(["--env-kwargs", word])


def test_pairs_of_a_repeated_option_come_together():
    parser = argparse.ArgumentParser()
    default = {"given": False}
    parser.add_argument("--env-kwargs", nargs="+", action=StoreValues, default=default)
    given = parser.parse_args(["--env-kwargs", "flag:false", "--env-kwargs", "preset:dense"])
    assert given.env_kwargs == {"flag": False, "preset": "dense"}
    assert default == {"given": False}
    for words in (["n:1", "n:2"], ["n:1", "--env-kwargs", "n:2"]):
        with pytest.raises(ValueError, match=r"--env-kwargs .*'n' is given twice"):
            parser.parse_args(["--env-kwargs", *words])


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("-" * 3000 + "1", "nested too deeply|not evaluated|not valid Python"),
        ("[" * 3000 + "]" * 3000, "neither a list nor a dict"),
        ("not " * 3000 + "a", "nested too deeply|not evaluated|not valid Python"),
        ("tuple(1)", r"tuple\(1\) needs a list or a tuple"),
        ("list(5)", r"list\(5\) needs a list or a tuple"),
        ("list('ab')", r"list\('ab'\) needs a list or a tuple"),
        ("dict(a={(1, [2]): 3})", r"\(1, \[2\]\) cannot be the key of a dict"),
        ("[!!timestamp 1]", "neither a list nor a dict"),
        ("[!!int '']", "neither a list nor a dict"),
        ("[!!bool 1, a b]", "neither a list nor a dict"),
        ("[2001-99-99, a b]", "neither a list nor a dict"),
        ("[{position: [0, 0], radius:0.2}]", "'radius:0.2' needs a blank after the colon: radius: 0.2"),
        ("{a: {b: 1, c: 2, b: 3}}", "'b' is given twice"),
        ("{a: {b:c}}", "'b:c' needs a blank after the colon: b: c"),
    ],
)
def test_what_cannot_be_read_is_told_in_one_line(text, told):
    with pytest.raises(ValueError, match=told) as refused:
        parse_value(text)
    assert len(str(refused.value)) < 500
    assert len(str(refused.value).splitlines()) == 1


def test_sequences_may_be_written_as_calls():
    assert parse_value("tuple([1, 2])") == (1, 2)
    assert parse_value("list((1, 'a'))") == [1, "a"]


@pytest.mark.parametrize("text", ["!!timestamp 1", "!!int ''", "!!bool 1", "2001-99-99", "!!float x", "!!set [1]"])
def test_yaml_values_that_are_not_what_their_tags_say_are_errors_of_yaml(text):
    with pytest.raises(yaml.YAMLError, match=r"a value is not what|expected a mapping"):
        yaml.load(f"key: {text}", BoundedLoader)
