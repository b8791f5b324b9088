"""Validation of arguments by pydantic, whose errors become a ValueError with one line."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch as th
from annotated_types import Len
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, InstanceOf, ValidationError, field_validator
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import TrainFreq
from stable_baselines3.common.utils import get_device
from torch import nn

from sb3_maddpg.errors import InvalidArgumentError
from sb3_maddpg.utils import shown, suggest

LARGEST_FLOAT = float(np.finfo(np.float32).max)  # larger numbers are infinite in single precision
AtLeastZero = Annotated[float, Field(ge=0, le=LARGEST_FLOAT)]
Positive = Annotated[float, Field(gt=0, le=LARGEST_FLOAT)]
Limit = Annotated[float, Field(gt=0, allow_inf_nan=True)]
# Outside these bounds, a price becomes 0 or infinite in single precision
Price = Annotated[float, Field(ge=1e-12, le=1e12)]
LEAST_TEMPERATURE = 1e-6
LARGEST = 2**63  # larger integers do not fit into an array
Natural = Annotated[int, Field(ge=1, lt=LARGEST)]
NaturalOrZero = Annotated[int, Field(ge=0, lt=LARGEST)]
Widths = list[Natural]
Schedule = Callable[[float], float]


class Arguments(BaseModel):
    """Base class of arguments. Messages quote the fields' descriptions, which say what is allowed."""

    model_config = ConfigDict(allow_inf_nan=False, arbitrary_types_allowed=True, extra="forbid")

    @field_validator("*", mode="before")
    @classmethod
    def _without_numpy(cls, value: Any) -> Any:
        return value.tolist() if isinstance(value, (np.generic, np.ndarray)) else value


def _device(device: Any) -> Any:
    try:
        found = get_device(device)
        th.empty(0, device=found)
    except (RuntimeError, TypeError, AssertionError, NotImplementedError):
        raise ValueError from None
    if device != "auto" and th.device(device).type != found.type:  # SB3 falls back silently
        warnings.warn(f"device={str(device)!r}: PyTorch finds no such device, so {found} is used.", stacklevel=2)
    return device


class RunArguments(Arguments):
    """Arguments of every algorithm of Stable-Baselines3, whose base class reads them before its subclasses can."""

    replay_buffer_kwargs: dict[str, Any] | None = Field(description="a dict of arguments by name, or None")
    policy_kwargs: dict[str, Any] | None = Field(description="a dict of arguments by name, or None")
    stats_window_size: int = Field(ge=1, le=10**9, description="a whole number of episodes, at least 1")
    tensorboard_log: str | Path | None = Field(description="a folder, or None")
    verbose: NaturalOrZero = Field(description="0, 1 or 2")
    seed: int | None = Field(ge=0, lt=2**32, description="an integer from 0 to 2**32 - 1, or None")
    device: Annotated[Any, AfterValidator(_device)] = Field(
        description='"auto", "cpu", or another device of PyTorch that this machine has'
    )


class LearnArguments(Arguments):
    """Arguments of ``learn``."""

    total_timesteps: float = Field(ge=0, lt=LARGEST, description="a finite number of steps of at least 0")
    callback: InstanceOf[BaseCallback] | list[InstanceOf[BaseCallback]] | Callable[..., Any] | None = Field(
        description="a callback of Stable-Baselines3, a list of them, a function (not a class), or None"
    )
    log_interval: Natural | None = Field(description="a whole number of episodes, at least 1, or None")

    @field_validator("callback")
    @classmethod
    def _made(cls, callback: Any) -> Any:
        if isinstance(callback, type):
            raise ValueError
        return callback


def _frequency(train_freq: TrainFreq) -> TrainFreq:
    if type(train_freq.frequency) is not int or not 1 <= train_freq.frequency < LARGEST:
        raise ValueError
    return train_freq


class TeamArguments(Arguments):
    """Arguments of every algorithm for teams."""

    # 0 is allowed, because rl_zoo3 loads models with it to render them
    learning_rate: AtLeastZero | Schedule = Field(description="a finite number that is not negative, or a schedule")
    buffer_size: Natural = Field(description="a whole number of transitions, at least 1")
    learning_starts: NaturalOrZero = Field(description="a whole number of steps, at least 0")
    batch_size: Natural = Field(description="a whole number of transitions, at least 1")
    tau: float = Field(gt=0, le=1, description="a number above 0 and up to 1")
    gamma: float = Field(ge=0, le=1, description="a number between 0 and 1")
    train_freq: (
        Annotated[InstanceOf[TrainFreq], AfterValidator(_frequency)]
        | Natural
        | tuple[Natural, Literal["step", "episode"]]
    ) = Field(description='an integer of at least 1, or such a number with its unit, (1, "step") or (1, "episode")')
    gradient_steps: Annotated[int, Field(ge=-1, lt=LARGEST)] = Field(
        description="a whole number of steps, or -1 for as many as environment steps"
    )
    action_noise: InstanceOf[ActionNoise] | None = Field(description="an ActionNoise of Stable-Baselines3, or None")
    optimize_memory_usage: bool = Field(description="True or False")
    n_steps: Natural = Field(description="a whole number of steps, at least 1")
    use_action_cost: bool = Field(description="True or False")
    max_grad_norm: Positive | None = Field(description="positive, or None for no limit")


class TrainingArguments(TeamArguments):
    """Arguments of ``MADDPG``."""

    threshold_price: tuple[Price, Price] | None = Field(
        description="a positive price and a higher one, both from 1e-12 to 1e12, or None"
    )
    exploration_noise: AtLeastZero | tuple[AtLeastZero, AtLeastZero] = Field(
        description="a standard deviation of at least 0, or two of them, the first and the last"
    )
    estimator: str = Field(description="a name of sb3_maddpg.common.estimators.ESTIMATORS")
    temperature: Annotated[float, Field(ge=LEAST_TEMPERATURE, le=LARGEST_FLOAT)] | Schedule = Field(
        description=f"positive, at least {LEAST_TEMPERATURE:g}, or a schedule"
    )
    policy_delay: Natural = Field(description="a number of critic updates, an integer of at least 1")
    policy_regularization: AtLeastZero = Field(description="a finite number of at least 0")

    @field_validator("threshold_price")
    @classmethod
    def _ascending(cls, prices: tuple[float, float] | None) -> tuple[float, float] | None:
        if prices is not None and prices[1] < prices[0] * (1 + 1e-6):
            raise ValueError
        return prices


class SmoothedTrainingArguments(TrainingArguments):
    """Arguments of ``MATD3``."""

    target_policy_noise: AtLeastZero = Field(description="a finite standard deviation, which must not be negative")
    target_noise_clip: AtLeastZero = Field(description="a finite number, which must not be negative")


class ThresholdArgument(Arguments):
    """Argument of policies with binary actions."""

    threshold: float = Field(ge=0, lt=1, description="a number with 0 <= threshold < 1, as probabilities are")


@th.no_grad()
def _is_elementwise(activation_fn: type[nn.Module]) -> bool:
    """
    :param activation_fn: class of an activation function
    :return: whether it maps every number by itself. Others would mix agents, and their axes are not those of
        ``torch.nn``, see ``StackedMLP``; parameters would be shared by all networks.
    """
    try:
        activation = activation_fn().eval()
        if next(chain(activation.parameters(), activation.buffers()), None) is not None:
            return False
        numbers = th.linspace(-3.0, 3.0, 2 * 3 * 4).reshape(2, 3, 4)
        alone = [activation(number.reshape(1, 1, 1)) for number in numbers.flatten()]
        together = activation(numbers.clone())
        return together.shape == numbers.shape and th.allclose(together.flatten(), th.cat(alone).flatten(), atol=1e-5)
    except Exception:  # from foreign code
        return False


class PolicyArguments(ThresholdArgument):
    """Arguments of ``MADDPGPolicy``."""

    net_arch: Widths | dict[str, Widths] = Field(
        description="a list of widths, each at least 1, or dict(pi=[...], qf=[...]) of such lists"
    )
    random_thresholds: float = Field(gt=0, le=1, description="a fraction above 0 and up to 1 (0 would not explore)")
    n_critics: Natural = Field(description="an integer of at least 1")
    activation_fn: type[nn.Module] = Field(
        description="a class of torch.nn that needs no arguments, has no parameters and maps every number by itself, "
        "such as torch.nn.ReLU"
    )
    optimizer_class: type[th.optim.Optimizer] = Field(
        description="a class of torch.optim, such as torch.optim.Adam, but neither LBFGS, which needs a closure, nor "
        "SparseAdam, which needs sparse gradients"
    )
    optimizer_kwargs: dict[str, Any] | None = Field(description="a dict of the optimizer's arguments, or None")
    agent_names: list[str] | tuple[str, ...] | None = Field(description="a list of names, one per agent, or None")
    normalize_images: bool = Field(description="True or False")
    image_columns: Sequence[Sequence[Annotated[Sequence[NaturalOrZero], Len(2, 2)]]] | None = Field(
        default=None,
        description="for each agent and for the state, a list of first and end of the columns of an image, or None",
    )

    @field_validator("activation_fn")
    @classmethod
    def _elementwise(cls, activation_fn: type[nn.Module]) -> type[nn.Module]:
        if not _is_elementwise(activation_fn):
            raise ValueError
        return activation_fn

    @field_validator("optimizer_class")
    @classmethod
    def _of_dense_gradients(cls, optimizer_class: type[th.optim.Optimizer]) -> type[th.optim.Optimizer]:
        if issubclass(optimizer_class, (th.optim.LBFGS, th.optim.SparseAdam)):
            raise ValueError
        return optimizer_class

    @field_validator("net_arch")
    @classmethod
    def _of_actor_and_critic(cls, net_arch: Any) -> Any:
        if isinstance(net_arch, dict) and set(net_arch) != {"pi", "qf"}:
            raise ValueError
        return net_arch


class ReplayBufferArguments(Arguments):
    """Arguments of ``TeamReplayBuffer``."""

    buffer_size: Natural = Field(description="an integer of at least 1")
    n_envs: Natural = Field(description="an integer of at least 1")
    optimize_memory_usage: bool = Field(description="True or False")
    handle_timeout_termination: bool = Field(description="True or False")
    n_steps: Natural = Field(description="an integer of at least 1")
    gamma: float = Field(ge=0, le=1, description="a number between 0 and 1")
    n_pairs: NaturalOrZero = Field(description="an integer of at least 0")
    pairs_end: bool = Field(description="True or False")


class PriorityArguments(Arguments):
    """Arguments of ``PrioritizedTeamReplayBuffer`` beyond those of ``TeamReplayBuffer``."""

    alpha: float = Field(ge=0, le=1, description="a number between 0 and 1")
    beta: float = Field(ge=0, le=1, description="a number between 0 and 1")
    epsilon: float = Field(
        gt=0, description="positive and finite: with 0, transitions without TD error would never be sampled"
    )


class NormalizationArguments(Arguments):
    """Arguments of ``SafeVecNormalize`` in its files."""

    training: bool = Field(description="True or False")
    norm_obs: bool = Field(description="True or False")
    norm_reward: bool = Field(description="True or False")
    clip_obs: Limit = Field(description="a positive number, or infinity")
    clip_reward: Limit = Field(description="a positive number, or infinity")
    gamma: float = Field(ge=0, le=1, description="a number between 0 and 1")
    epsilon: float = Field(gt=0, description="positive and finite")
    norm_obs_keys: list[str] | None = Field(description="a list of keys of the observation, or None")


class CurriculumArguments(Arguments):
    """Arguments of ``CurriculumCallback``."""

    success_threshold: float = Field(gt=0, le=1, description="a fraction of episodes above 0 and up to 1")
    window: Natural = Field(description="a whole number of episodes, at least 1")


class PairPolicyArguments(Arguments):
    """Arguments of ``PairPolicy`` beyond those of ``MADDPGPolicy``."""

    pair_credit: bool = Field(description="True or False")
    shared_threshold: bool = Field(description="True or False")


def validated(arguments: type[Arguments], **values: Any) -> dict[str, Any]:
    """
    Validate arguments.

    :param arguments: class of the arguments
    :param values: values of all arguments
    :return: the values, converted to the expected types
    :raises ValueError: if a value is not allowed, with one line that names the argument, its value and what is allowed
    """
    return validated_as(arguments, values, "{}".format)


def validated_as(
    arguments: type[Arguments], values: Mapping[str, Any], as_written: Callable[[str], str]
) -> dict[str, Any]:
    """
    Validate values that the user did not write as Python arguments.

    :param arguments: class of the arguments
    :param values: values by name
    :param as_written: maps a name to the form in which the user wrote the argument
    :return: the values, converted to the expected types
    :raises ValueError: see ``validated``
    """
    try:
        return dict(arguments.model_validate(dict(values)))
    except ValidationError as error:
        findings = error.errors(include_url=False)
    name = str(findings[0]["loc"][0])
    if findings[0]["type"] == "missing":
        raise InvalidArgumentError(f"{as_written(name)} is missing.")
    if findings[0]["type"] == "extra_forbidden":
        raise InvalidArgumentError(suggest("argument", as_written(name), map(as_written, arguments.model_fields)))
    given = f"{as_written(name)}={shown(values.get(name))}"
    findings = [one for one in findings if one["loc"][0] == name]
    if any(one.get("ctx", {}).get("lt") == LARGEST for one in findings):
        raise InvalidArgumentError(f"{given} is too large: it must be less than 2**63.")
    if allowed := arguments.model_fields[name].description:
        raise InvalidArgumentError(f"{given} must be {allowed}.")
    messages = [one["msg"].removeprefix("Value error, ") for one in findings]
    said = dict.fromkeys(message[:1].lower() + message[1:] for message in messages)
    raise InvalidArgumentError(f"{given}: {', or '.join(said)}.")
