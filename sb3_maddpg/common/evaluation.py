"""Returns of teams and their agents: episodes that several policies play alike, intervals, and an ``EvalCallback``."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_maddpg.common.callbacks import widen_tables
from sb3_maddpg.errors import InvalidArgumentError, InvalidEnvironmentError
from sb3_maddpg.team.team import Team
from sb3_maddpg.utils import suggest
from sb3_maddpg.vec_env.wrap import as_vec_env

MEAN_REWARD, SUCCESS_RATE = "mean_reward", "success_rate"  # what ``best_by`` may name beside agents


class Episode(NamedTuple):
    """What an episode came to."""

    seed: int | None
    """Seed of its reset"""
    team_return: float
    """Sum of the team's rewards, which are the mean over the agents in a ``TeamEnv``"""
    length: int
    """Number of steps"""
    returns: dict[str, float]
    """Sum of each agent's rewards, not discounted"""
    lives: dict[str, int]
    """Number of steps in which each agent acted"""
    success: bool | None
    """``info["is_success"]``, None if the environment does not say"""


class Tally:
    """
    The sums of a running episode.

    :param names: names of the agents
    """

    def __init__(self, names: Sequence[str]):
        self.names = names
        self.team_return, self.length = 0.0, 0
        self.returns, self.lives = np.zeros(len(names)), np.zeros(len(names), np.int64)

    def add(self, reward: float, info: Mapping[str, Any]) -> None:
        """
        :param reward: the team's reward in a step, which each agent gets unless there are ``agent_rewards``
        :param info: the step's info, see ``TeamInfo``
        """
        self.team_return += float(reward)
        self.length += 1
        self.returns += np.asarray(info.get("agent_rewards", reward), np.float64)
        self.lives += np.asarray(info.get("agent_active", True), bool)

    def episode(self, seed: int | None, info: Mapping[str, Any]) -> Episode:
        """
        :param seed: seed of the episode
        :param info: info of its last step
        """
        returns, lives = (dict(zip(self.names, values.tolist(), strict=True)) for values in (self.returns, self.lives))
        success = info.get("is_success")
        return Episode(seed, self.team_return, self.length, returns, lives, None if success is None else bool(success))


def agent_names(env: VecEnv) -> tuple[str, ...]:
    """
    :param env: a vectorised team environment
    :return: names of the agents
    :raises ValueError: if it is no team
    """
    names = env.get_attr("agent_names", indices=0)[0] if env.has_attr("agent_names") else None
    return Team.from_spaces(env.observation_space, env.action_space, names).names


def play(policy: Any, env: VecEnv, n_episodes: int, seed: int = 0, deterministic: bool = True) -> Iterator[Episode]:
    """
    Play episodes whose resets have consecutive seeds, so that all policies meet the same ones.

    :param policy: anything with ``predict`` of Stable-Baselines3; None for actions that are drawn from the action space
    :param env: a team environment, vectorised once, without normalisation of rewards
    :param n_episodes: number of episodes
    :param seed: seed of the first
    :param deterministic: whether to act without exploration
    :return: the episodes, as they end
    :raises ValueError: if the environment is vectorised more than once
    """
    if env.num_envs != 1:
        raise InvalidArgumentError(f"The environment is vectorised {env.num_envs} times: play takes a single one.")
    names = agent_names(env)
    for episode_seed in range(seed, seed + n_episodes):
        env.unwrapped.seed(episode_seed)
        env.action_space.seed(episode_seed)
        tally, state, starts = Tally(names), None, np.ones(1, dtype=bool)
        info: dict[str, Any] = {}
        observation = env.reset()
        while tally.length == 0 or not starts[0]:
            if policy is None:
                actions = np.asarray(env.action_space.sample())[None]
            else:
                actions, state = policy.predict(
                    observation, state=state, episode_start=starts, deterministic=deterministic
                )
            observation, rewards, starts, (info,) = env.step(actions)
            tally.add(rewards[0], info)
        yield tally.episode(episode_seed, info)


def mean_interval(values: Sequence[float]) -> tuple[float, float, float]:
    """
    :param values: one value per episode, or per training
    :return: their mean, and its 95 % interval by Student's t distribution, NaN for a single value
    """
    array = np.asarray(values, np.float64)
    mean, n = (float(array.mean()), len(array)) if len(array) else (math.nan, 0)
    if n < 2:
        return mean, math.nan, math.nan
    half = _t_quantile(n - 1) * float(array.std(ddof=1)) / math.sqrt(n)
    return mean, mean - half, mean + half


def _t_quantile(df: int) -> float:
    """:return: the 97.5 % quantile of Student's t distribution, by the expansion of Fisher and Cornish (1960)"""
    if df <= 2:
        return (12.70620473617471, 4.302652729749464)[df - 1]
    z, n = NormalDist().inv_cdf(0.975), float(df)
    terms = (
        (z**3 + z) / 4,
        (5 * z**5 + 16 * z**3 + 3 * z) / 96,
        (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384,
        (79 * z**9 + 776 * z**7 + 1482 * z**5 - 1920 * z**3 - 945 * z) / 92160,
    )
    return z + sum(term / n ** (k + 1) for k, term in enumerate(terms))


def share_interval(count: int, n: int) -> tuple[float, float, float]:
    """
    :param count: number of successes
    :param n: number of trials, at least 1
    :return: their share, and its 95 % interval (Wilson's)
    """
    share, z = count / n, NormalDist().inv_cdf(0.975)
    centre, spread = share + z * z / (2 * n), z * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
    low, high = ((centre + sign * spread) / (1 + z * z / n) for sign in (-1, 1))
    return share, max(0.0, low), min(1.0, high)


def summarise(episodes: Sequence[Episode]) -> dict[str, Any]:
    """
    :param episodes: episodes of a policy
    :return: means and their 95 % intervals: ``return``, ``length``, ``success_rate`` if the environment says who
        succeeded, and ``agents`` with ``return`` and ``length`` of each
    """
    found: dict[str, Any] = {
        "episodes": len(episodes),
        "return": _figure([one.team_return for one in episodes]),
        "length": _figure([one.length for one in episodes]),
    }
    if successes := [float(one.success) for one in episodes if one.success is not None]:
        found["success_rate"] = dict(
            zip(("mean", "low", "high"), share_interval(int(sum(successes)), len(successes)), strict=True)
        )
    found["agents"] = {
        name: {
            "return": _figure([one.returns[name] for one in episodes]),
            "length": _figure([one.lives[name] for one in episodes]),
        }
        for name in (episodes[0].returns if episodes else ())
    }
    return found


def compare(episodes: Sequence[Episode], rival: Sequence[Episode]) -> dict[str, float | None]:
    """
    :param episodes: episodes of a policy
    :param rival: the same episodes of another one
    :return: mean and 95 % interval of the differences of the team's return
    :raises ValueError: if the episodes are others
    """
    if [one.seed for one in episodes] != [one.seed for one in rival]:
        raise InvalidArgumentError("Only the same episodes can be compared, but their seeds differ.")
    pairs = zip(episodes, rival, strict=True)
    return _figure([own.team_return - other.team_return for own, other in pairs])


def _figure(values: Sequence[float]) -> dict[str, float | None]:
    mean, low, high = mean_interval(values)
    known = math.isfinite(low)  # JSON has no NaN
    return {"mean": mean, "low": low if known else None, "high": high if known else None}


class TeamEvalCallback(EvalCallback):
    """
    Stable-Baselines3's ``EvalCallback`` for teams. It also logs ``eval/ep_rew_NAME`` of each agent, and
    ``eval/ep_len_NAME`` where agents end before others, and writes both to ``evaluations.npz``: ``agent_names``, (n,),
    ``agent_results`` and ``agent_lengths``, (evaluations, episodes, n).

    :param eval_env: an environment of its own, of PettingZoo or a team environment of Gymnasium
    :param best_by: what makes a model the best one: ``"mean_reward"`` of the team, ``"success_rate"``, or the name of
        an agent for its return
    :param arguments: those of ``EvalCallback``
    """

    def __init__(self, eval_env: Any, best_by: str = MEAN_REWARD, **arguments: Any):
        super().__init__(as_vec_env(eval_env), **arguments)
        self._names = agent_names(self.eval_env)
        known = (MEAN_REWARD, SUCCESS_RATE, *self._names)
        if best_by not in known:
            raise InvalidArgumentError(suggest("best_by", best_by, known))
        self.best_by = best_by
        self.best_value = -math.inf
        self.agent_results: list[list[list[float]]] = []
        self.agent_lengths: list[list[list[int]]] = []
        self._tallies: dict[int, Tally] = {}
        self._episodes: list[Episode] = []

    def _init_callback(self) -> None:
        super()._init_callback()
        widen_tables(self.logger, [f"eval/ep_rew_{name}" for name in self._names])

    def _log_success_callback(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        super()._log_success_callback(locals_, globals_)
        index, info = locals_["i"], locals_["info"]
        tally = self._tallies.setdefault(index, Tally(self._names))
        tally.add(locals_["reward"], info)
        if locals_["done"]:
            episode = self._tallies.pop(index).episode(None, info)
            self._episodes.append(episode)
            unequal = len(set(episode.lives.values())) > 1
            for name in self._names:
                self.logger.record_mean(f"eval/ep_rew_{name}", episode.returns[name])
                if unequal:
                    self.logger.record_mean(f"eval/ep_len_{name}", episode.lives[name])

    def _on_step(self) -> bool:
        if self.eval_freq <= 0 or self.n_calls % self.eval_freq != 0:
            return True
        self._tallies, self._episodes = {}, []
        if self.best_by == MEAN_REWARD:
            goes_on = super()._on_step()
            self._write_agents()
            return goes_on
        # No mean return is better than infinity, so that EvalCallback saves no model; and what follows an evaluation
        # follows the choice of the best model
        best, self.best_mean_reward = self.best_mean_reward, math.inf
        after, self.callback = self.callback, None
        try:
            super()._on_step()
        finally:
            self.best_mean_reward, self.callback = best, after
        self._write_agents()
        goes_on, value = True, self._value()
        if value > self.best_value:
            self.best_value = self.best_mean_reward = value
            goes_on = self._keep_best()
        return (goes_on and self._on_event()) if self.callback is not None else goes_on

    def _value(self) -> float:
        """:return: what the last evaluation is judged by"""
        if self.best_by != SUCCESS_RATE:
            return float(np.mean([one.returns[self.best_by] for one in self._episodes]))
        if not self._is_success_buffer:
            raise InvalidEnvironmentError(
                'best_by="success_rate" needs info["is_success"] at the end of every episode, which this environment '
                "does not set."
            )
        return float(np.mean(self._is_success_buffer))

    def _keep_best(self) -> bool:
        """Save the model as the best one. Returns whether training goes on."""
        if self.verbose >= 1:
            print(f"New best {self.best_by}: {self.best_value:.2f}")
        if self.best_model_save_path is not None:
            self.model.save(f"{self.best_model_save_path}/best_model")
        return self.callback_on_new_best is None or self.callback_on_new_best.on_step()

    def _write_agents(self) -> None:
        """Add the agents' returns and lengths to ``evaluations.npz``."""
        if self.log_path is None:
            return
        self.agent_results.append([list(one.returns.values()) for one in self._episodes])
        self.agent_lengths.append([list(one.lives.values()) for one in self._episodes])
        successes = {"successes": self.evaluations_successes} if self._is_success_buffer else {}
        np.savez(
            self.log_path,
            timesteps=self.evaluations_timesteps,
            results=self.evaluations_results,
            ep_lengths=self.evaluations_length,
            agent_names=np.array(self._names),
            agent_results=self.agent_results,
            agent_lengths=self.agent_lengths,
            **successes,  # type: ignore[arg-type]
        )
