"""Values as JSON that says their types: what was written comes back, and nothing else is made of a file."""

import json
import math
from collections import deque

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import FloatSchedule, LinearSchedule

from sb3_maddpg import PairPolicy
from sb3_maddpg.common.buffers import PrioritizedTeamReplayBuffer
from sb3_maddpg.files.typed_json import decode, encode
from sb3_maddpg.team.spaces import CategoricalActions, MixedActions, TeamObservation
from toys import INT32

BOX = spaces.Box(-np.arange(1, 4, dtype=np.float32), np.float32(np.inf), (3,))
AGENTS = {"a": BOX, "b": spaces.Box(-1, 1, (5,))}
VALUES = [
    None,
    True,
    3,
    -(2**80),
    0.1,
    "text",
    [1, [2.5, None]],
    {"a": {"b": 1}},
    (1, (2, "x")),
    {1: "one", (2, 3): "pair"},
    {"$": "a name that means something"},
    deque([{"r": np.float64(1.5), "l": 3}], maxlen=100),
    np.zeros(0),
    np.arange(6, dtype=np.int16).reshape(2, 3),
    np.full((4, 5), -np.inf, np.float32),
    np.array(True),
    np.float32(0.1),
    np.int64(-5),
    BOX,
    spaces.Box(0, 255, (4, 4, 3), np.uint8),
    spaces.Discrete(5, start=-2),
    spaces.Discrete(3, **INT32),
    spaces.MultiDiscrete([2, 3], start=[1, -1]),
    spaces.MultiDiscrete([2, 3], np.uint8, start=[1, 2]),
    spaces.MultiBinary(7),
    spaces.MultiBinary([2, 3]),
    spaces.Dict({"z": spaces.Discrete(2), "a": BOX}),
    spaces.Tuple([spaces.Discrete(2), BOX]),
    TeamObservation(AGENTS),
    TeamObservation(AGENTS, spaces.Box(-3, 2, (7,))),
    MixedActions([spaces.Discrete(3, start=1), spaces.Box(-2, 1, (2,)), spaces.MultiBinary(2)]),
    CategoricalActions([spaces.Discrete(3, start=1), spaces.Discrete(4)]),
    TrainFreq(4, TrainFrequencyUnit.EPISODE),
    th.float64,
    th.nn.Tanh,
    PairPolicy,
    PrioritizedTeamReplayBuffer,
    th.optim.Adam,
]


def same(a, b) -> bool:
    if isinstance(a, np.ndarray):
        return type(a) is type(b) and a.dtype == b.dtype and a.shape == b.shape and np.array_equal(a, b)
    if isinstance(a, (list, tuple, deque)):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict):
        return list(a) == list(b) and all(map(same, a.values(), b.values()))
    return type(a) is type(b) and a == b


@pytest.mark.parametrize("value", VALUES, ids=lambda value: type(value).__name__)
def test_what_is_written_comes_back(value):
    text = json.dumps(encode(value, "value"), allow_nan=False)
    assert same(decode(json.loads(text), "value"), value)


def test_a_discrete_space_of_an_older_file_has_the_usual_type():
    assert decode({"$": "Discrete", "n": 3, "start": 1}, "value") == spaces.Discrete(3, start=1)


def test_numbers_that_json_does_not_know_come_back():
    text = json.dumps(encode([math.nan, math.inf, -math.inf], "value"), allow_nan=False)
    nan, *infinite = decode(json.loads(text), "value")
    assert math.isnan(nan)
    assert infinite == [math.inf, -math.inf]


@pytest.mark.parametrize(
    "value",
    [
        LinearSchedule(1.0, 0.1, 0.5),
        FloatSchedule(LinearSchedule(1.0, 0.1, 0.5)),
        FloatSchedule(0.3),
    ],
)
def test_schedules_come_back(value):
    loaded = decode(json.loads(json.dumps(encode(value, "value"))), "value")
    assert type(loaded) is type(value)
    assert [loaded(k / 10) for k in range(11)] == [value(k / 10) for k in range(11)]


def test_action_noise_comes_back_in_the_middle_of_its_process():
    base = OrnsteinUhlenbeckActionNoise(np.zeros(3), np.ones(3))
    base()
    for noise in (NormalActionNoise(np.zeros(2), np.ones(2)), base, VectorizedActionNoise(base, 2)):
        loaded = decode(json.loads(json.dumps(encode(noise, "noise"))), "noise")
        np.random.seed(0)  # noqa: NPY002 - what SB3's noise draws from
        expected = noise()
        np.random.seed(0)  # noqa: NPY002
        assert np.array_equal(loaded(), expected)


def test_what_is_no_plain_value_is_not_written():
    class Local:
        pass

    for wrong in (Local, Local(), lambda x: x, object(), np.array(["text"]), np.array([None])):
        with pytest.raises(ValueError, match=r"array of|cannot be saved"):
            encode(wrong, "value")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"$": "class", "name": "os.system"}, r"Unknown class 'os\.system'"),
        ({"$": "class", "name": ["os"]}, "is not a class"),
        ({"$": "object", "class": "subprocess.Popen", "attributes": {}}, "Unknown class"),
        ({"$": "object", "class": "torch.nn.modules.activation.ReLU", "attributes": {}}, "an instance of ReLU"),
        ({"$": "Bx"}, "Unknown type 'Bx': did you mean 'Box'"),
        ({"$": 5}, "Unknown type"),
        ({"$": "array", "dtype": "O", "shape": [1], "base64": ""}, "array of 'O'"),
        ({"$": "array", "dtype": "f4", "shape": [10**6, 10**6], "base64": "AAAAAA==", "repeated": True}, "numbers"),
        ({"$": "array", "dtype": "f4", "shape": [-1], "base64": ""}, "which is invalid or has more than"),
        ({"$": "array", "dtype": "f4", "shape": [2], "base64": "AAAAAA=="}, "reshape"),
        ({"$": "array", "dtype": "f4", "shape": [1], "base64": "!"}, ""),
        ({"$": "array", "dtype": "f4", "shape": [2], "base64": "AAAAAAAAAAA=", "repeated": True}, "too many values"),
        ({"$": "MultiBinary", "n": 10**12}, "bits"),
        ({"$": "Discrete", "n": 0, "start": 0}, ""),
        ({"$": "Discrete", "n": 3, "start": 0, "dtype": "O"}, "integer dtype|unexpected keyword"),
        ({"$": "Discrete", "n": 300, "start": 0, "dtype": "uint8"}, ""),
        ({"$": "Box", "low": 0, "high": 1}, ""),
        ({"$": "dtype", "name": "torch.save"}, "not a PyTorch dtype"),
        ({"$": "tuple"}, "KeyError"),
        ({"$": "tuple", "items": 5}, "TypeError"),
    ],
)
def test_what_nobody_wrote_is_refused(value, message):
    with pytest.raises(
        ValueError, match=f"thing is damaged.*{message}" if message != "damaged" else "thing is damaged"
    ):
        decode(value, "thing")


def test_values_within_values_end_somewhere():
    nested: list = []
    for _ in range(100):
        nested = [nested]
    for function in (encode, decode):
        with pytest.raises(ValueError, match="nested more than 50"):
            function(nested, "value")
