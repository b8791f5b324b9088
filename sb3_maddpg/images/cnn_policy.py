"""Policy for teams whose agents observe images."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, NatureCNN
from torch import nn

from sb3_maddpg.common.policies import (
    Actor,
    Critic,
    FeaturesActor,
    FeaturesCritic,
    ImageScale,
    MADDPGPolicy,
    MLPActor,
    StackedCritic,
)
from sb3_maddpg.errors import InvalidArgumentError, InvalidEnvironmentError
from sb3_maddpg.files.registry import allow_in_files
from sb3_maddpg.utils import shown


@allow_in_files(name="sb3_maddpg.cnn_policy.ImageFeatures")
class ImageFeatures(nn.Module):
    """
    Features extractor of a team, which replaces each agent's image by its features. All agents share it.

    :param space: space of an agent's image, channels first or last, or without an axis of channels
    :param extractor_class: features extractor of Stable-Baselines3, which reads images with channels first
    :param extractor_kwargs: keyword arguments to pass to the features extractor
    :param normalize: whether to divide images by 255
    :param state_factors: factors of the columns after the agents' images, (n_agents, columns), None for 1
    """

    state_factors: th.Tensor | None

    def __init__(
        self,
        space: spaces.Box,
        extractor_class: type[BaseFeaturesExtractor],
        extractor_kwargs: dict[str, Any],
        normalize: bool,
        state_factors: th.Tensor | None = None,
    ):
        super().__init__()
        self.register_buffer("state_factors", state_factors, persistent=False)
        space = _with_channels(space)
        self.shape = space.shape
        self.obs_dim = int(th.Size(space.shape).numel())
        self.channels_last = len(space.shape) == 3 and not is_image_space_channels_first(space)
        self.scale = 1 / 255 if normalize else 1.0
        if self.channels_last:
            low, high = (bound.transpose(2, 0, 1) for bound in (space.low, space.high))
            space = spaces.Box(low, high, dtype=space.dtype.type)
        self.extractor = extractor_class(space, **extractor_kwargs)
        self.features_dim = self.extractor.features_dim

    def forward(self, obs: th.Tensor) -> th.Tensor:
        """
        :param obs: observations, (..., obs_dim or more); numbers after an agent's image are kept
        :return: features, (..., features_dim or more)
        """
        images = obs[..., : self.obs_dim].reshape(-1, *self.shape) * self.scale
        if self.channels_last:
            images = images.permute(0, 3, 1, 2)
        features = self.extractor(images).reshape(*obs.shape[:-1], -1)
        rest = obs[..., self.obs_dim :]
        if self.state_factors is not None and rest.shape[-1]:
            rest = rest * self.state_factors
        return th.cat([features, rest], dim=-1)

    def single(self, agent: int) -> ImageFeatures:
        """:return: this module, which all agents share"""
        return self


def _with_channels(space: spaces.Box) -> spaces.Box:
    """:return: the space of images with an axis of channels, which comes first if there was none"""
    if len(space.shape) != 2:
        return space
    return spaces.Box(space.low[np.newaxis], space.high[np.newaxis], dtype=space.dtype.type)


@allow_in_files(name="sb3_maddpg.cnn_policy.CnnPolicy")
class CnnPolicy(MADDPGPolicy):
    """
    Policy for teams of homogeneous agents that observe images. All agents share one convolutional features extractor
    for the actors and another for the critics; the networks of ``MADDPGPolicy`` read the features.

    :param args: see ``MADDPGPolicy``
    :param image_space: ``Box`` of an agent's image, (height, width, channels), (channels, height, width) or (height,
        width); by default MADDPG reads it from the environment
    :param features_extractor_class: features extractor, see Stable-Baselines3
    :param features_extractor_kwargs: keyword arguments to pass to the features extractor, such as ``features_dim``
    :param kwargs: see ``MADDPGPolicy``; ``normalize_images`` says whether to divide images by 255, also the state's
    :raises ValueError: if the agents do not each observe one image of the same size
    """

    env_attributes: ClassVar[tuple[str, ...]] = ("agent_names", "image_space", "image_columns")

    def __init__(
        self,
        *args: Any,
        image_space: spaces.Box | None = None,
        features_extractor_class: type[BaseFeaturesExtractor] = NatureCNN,
        features_extractor_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ):
        if image_space is None:
            raise InvalidEnvironmentError(
                "CnnPolicy needs agents that observe images of the same size, each a Box of two or three axes, or an "
                "`image_space` in policy_kwargs. Use MlpPolicy for other observations."
            )
        if not isinstance(features_extractor_class, type) or not issubclass(
            features_extractor_class, BaseFeaturesExtractor
        ):
            raise InvalidArgumentError(
                f"features_extractor_class={shown(features_extractor_class)}: pass a subclass of Stable-Baselines3's "
                "BaseFeaturesExtractor, such as NatureCNN."
            )
        self.image_space = image_space
        self._extractor_class = features_extractor_class
        self._extractor_kwargs = dict(features_extractor_kwargs or {})
        super().__init__(*args, **kwargs)

    def _make_networks(self, actor_arch: list[int], critic_arch: list[int]) -> tuple[Actor, Critic]:
        size = int(th.Size(self.image_space.shape).numel())
        if set(self.team.obs_dims) != {size} or self.team.masks:
            raise InvalidArgumentError(
                f"image_space={shown(self.image_space)} has {size} numbers, but the agents observe {self.team.obs_dims}"
                f"{' with action masks' if self.team.masks else ''}: CnnPolicy is for agents that observe one image "
                "each."
            )
        # The networks after the extractors see a team that observes features
        of_actor, of_critic = self._make_features(), self._make_features()
        team, width = self.team, of_actor.features_dim
        self.team = replace(team, obs_dims=(width,) * team.n_agents, obs_dim=width)
        actor, critic = super()._make_networks(actor_arch, critic_arch)
        self.team = team
        assert isinstance(actor, MLPActor)
        assert isinstance(critic, StackedCritic)
        return FeaturesActor(of_actor, actor), FeaturesCritic(of_critic, critic)

    def _divide_images(self) -> None:
        """Leave it to the features extractors."""

    def _make_features(self) -> ImageFeatures:
        if self._extractor_class is NatureCNN:
            if not is_image_space(_with_channels(self.image_space), normalized_image=not self.normalize_images):
                raise InvalidArgumentError(
                    f"image_space={shown(self.image_space)} is not an image for NatureCNN, which needs two or three "
                    "axes and uint8 from 0 to 255. For images of floats, set normalize_images=False or write your own "
                    "features_extractor_class."
                )
            self._extractor_kwargs.setdefault("normalized_image", not self.normalize_images)
        factors = None
        if self.image_columns is not None and self.normalize_images:
            factors = ImageScale.of(self.image_columns, self.team).factors[:, self.team.obs_dim :]
        try:
            return ImageFeatures(
                self.image_space, self._extractor_class, self._extractor_kwargs, self.normalize_images, factors
            )
        except (AssertionError, TypeError, ValueError, RuntimeError) as error:
            raise InvalidArgumentError(
                f"features_extractor_class={self._extractor_class.__name__} cannot be created for "
                f"{shown(self.image_space)} with features_extractor_kwargs={self._extractor_kwargs}: {error}"
            ) from error

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            **super()._get_constructor_parameters(),
            "image_space": self.image_space,
            "features_extractor_class": self._extractor_class,
            "features_extractor_kwargs": self._extractor_kwargs,
            "normalize_images": self.normalize_images,
        }
