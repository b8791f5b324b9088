"""Whom a robot asks: rules, and learned policies in ONNX Runtime."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from quad_swarm.errors import shown
from quad_swarm.robot.robot import Policy, Robot
from quad_swarm.task.observation import make_observation
from quad_swarm.task.rules import parse_decisions
from quad_swarm.task.view import View
from quad_swarm.world.presets import SwarmConfig

__all__ = ["Actor", "Policy", "RulePolicy"]


class RulePolicy:
    """A rule such as ``"cpa:1.0s:3&stale:4"`` or ``"event:0.1|push:0.2"``.

    :param rule: the rule, see `quad_swarm.task.rules`; `push` and `stage` become announcements
    :param seed: seed of rules that draw random numbers
    :raises ValueError: if the rule is unknown, or joins what two different robots know
    """

    def __init__(self, rule: str, seed: int | Sequence[int] = 0):
        self._asks, self._tells = parse_decisions(rule)
        self._rngs = [np.random.default_rng(seed)]

    def __call__(self, robot: Robot) -> np.ndarray:
        view = View(robot, self._rngs)
        parts = [self._asks(view)] if self._tells is None else [self._asks(view), self._tells(view)]
        return np.stack([part[0, 0] for part in parts], axis=-1)


class Actor:
    """A learned policy, as ``sb3-maddpg export`` writes it.

    :param path: path of the program, ``actor.onnx``
    :param config: the world
    :param observation: what the policy reads, see `quad_swarm.task.observation.make_observation`; without the columns
        that only critics see
    :param n_bits: number of bits for each of the others: 1 to ask, 2 to ask and to tell
    :param scaled: whether the paper's observation is scaled
    :raises ValueError: if the file is no such program, or reads observations of another length
    """

    def __init__(
        self, path: str | os.PathLike[str], config: SwarmConfig, observation: str, n_bits: int = 1, scaled: bool = False
    ):
        seen = "+".join(group for group in observation.split("+") if group != "critic")
        self.observation, self.n_bits = make_observation(config, seen, scaled), n_bits
        self._run = _program(os.fspath(path))
        self.observed = np.zeros((1, self.observation.size), np.float32)
        expected = config.n_others * n_bits
        try:
            width: Any = self._run(self.observed).size
        except Exception:  # ONNX Runtime has its own classes of errors
            raise ValueError(
                f"{path}: the policy does not read the {self.observation.size} columns of {seen!r} of "
                f"{config.n_robots} robots: export it for this world."
            ) from None
        if width != expected:
            raise ValueError(f"{path}: the policy answers with {width} bits, not {expected}.")

    def __call__(self, robot: Robot) -> np.ndarray:
        self.observed = self.observation(robot)[0]
        return self._run(self.observed).reshape(-1, self.n_bits) > 0


def _program(path: str) -> Any:
    """Return the function of an ONNX program, which runs on one thread."""
    try:
        import onnxruntime
    except ImportError:
        raise ValueError(
            f"{path}: learned policies need ONNX Runtime: in the clone, pip install -e '.[onnx]', or on a robot, "
            "pip install onnxruntime."
        ) from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    try:
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        (given,), (returned,) = session.get_inputs(), session.get_outputs()
    except Exception as error:  # ONNX Runtime has its own classes of errors
        raise ValueError(f"{path}: no policy that ONNX Runtime can load ({shown(error)}).") from None

    def run(observed: np.ndarray) -> np.ndarray:
        return session.run([returned.name], {given.name: observed})[0]

    return run
