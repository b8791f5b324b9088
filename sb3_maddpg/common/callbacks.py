"""Callbacks for MADDPG and for any other Stable-Baselines3 algorithm."""

import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Figure, HParam, HumanOutputFormat, Logger, TensorBoardOutputFormat

from sb3_maddpg.errors import InvalidArgumentError, InvalidEnvironmentError
from sb3_maddpg.utils import arguments_of, as_number, shown
from sb3_maddpg.validation import CurriculumArguments, validated

# Outputs that cannot show figures and hyperparameters
TENSORBOARD_ONLY = ("stdout", "log", "json", "csv")


def widen_tables(logger: Logger, keys: Iterable[str]) -> None:
    """
    Widen the logger's tables so that long keys fit, which Stable-Baselines3 would cut off, or refuse if they are then
    alike.

    :param logger: the algorithm's logger
    :param keys: keys that will be logged
    """
    width = max((3 + len(key.partition("/")[2] or key) for key in keys), default=0)  # indented, without their tag
    for output in logger.output_formats:
        if isinstance(output, HumanOutputFormat):
            output.max_length = max(output.max_length, width)


# Metrics that SB3 logs of the team as means of its last episodes
_OF_EPISODES = ("rollout/ep_rew_", "rollout/ep_len_")


def record_metrics(
    logger: Logger, infos: list[dict[str, Any]], last: Callable[[str, float], None] | None = None
) -> None:
    """
    Log the numbers in ``info["metrics"]``, as means over the steps until the next dump of the log.

    :param logger: the algorithm's logger
    :param infos: infos of one step, one per environment, see ``TeamInfo``
    :param last: takes name and value of the agents' returns and lengths instead, None to log them as the others
    :raises ValueError: if a metric is not a finite number
    """
    for info in infos:
        if "metrics" not in info:
            continue
        metrics = info["metrics"]
        if not isinstance(metrics, Mapping):
            raise InvalidEnvironmentError(f"info['metrics'] is {shown(metrics)}: it must be a dict of numbers by name.")
        widen_tables(logger, map(str, metrics))
        for name, value in metrics.items():
            try:
                number = float(value)
            except (TypeError, ValueError, OverflowError):
                number = math.nan
            if not math.isfinite(number):
                raise InvalidEnvironmentError(
                    f"info['metrics'][{name!r}] is {shown(value)}: a metric must be a finite number."
                )
            if last is not None and str(name).startswith(_OF_EPISODES):
                last(name, number)
            else:
                logger.record_mean(name, number)


def check_success(infos: list[dict[str, Any]]) -> None:
    """
    Check the entries ``info["is_success"]``, if there are any.

    :param infos: infos of one step, one per environment, see ``TeamInfo``
    :raises ValueError: if an entry is neither True nor False
    """
    for info in infos:
        success = info.get("is_success")
        try:
            known = success in (None, True, False)
        except ValueError:  # from an array
            known = False
        if not known:
            raise InvalidEnvironmentError(f"info['is_success'] is {shown(success)}: it must be True or False.")


class MetricsCallback(BaseCallback):
    """Logs ``info["metrics"]`` for algorithms that, unlike MADDPG, do not do so themselves."""

    def _on_step(self) -> bool:
        record_metrics(self.logger, self.locals["infos"])
        return True


class CurriculumCallback(BaseCallback):
    """
    Callback that makes the training environment harder once the team succeeds. The environment must have an attribute
    ``n_curriculum_levels`` and a method ``set_curriculum_level(level)`` with levels from 0, and must set
    ``info["is_success"]`` at the end of each episode. The level is stored in ``model.curriculum_level``, and thus in
    the saved model, and logged as ``curriculum/level``. Evaluation environments neither count nor change.

    :param success_threshold: success rate that raises the level
    :param window: number of most recent episodes at the current level that determine the success rate
    :param verbose: 1 to print when the level is raised
    """

    def __init__(self, success_threshold: float = 0.9, window: int = 100, verbose: int = 0):
        super().__init__(verbose)
        arguments = validated(CurriculumArguments, success_threshold=success_threshold, window=window)
        self.success_threshold = arguments["success_threshold"]
        self.successes: deque[bool] = deque(maxlen=arguments["window"])
        self.n_levels = 0

    @property
    def level(self) -> int:
        """The model's current level."""
        return getattr(self.model, "curriculum_level", 0)

    def _set_level(self, level: int) -> None:
        self.model.curriculum_level = level  # type: ignore[attr-defined]
        self.training_env.env_method("set_curriculum_level", level)
        self.successes.clear()

    def _on_training_start(self) -> None:
        for name in ("n_curriculum_levels", "set_curriculum_level"):
            if not self.training_env.has_attr(name):
                raise InvalidEnvironmentError(
                    f"CurriculumCallback needs an environment with `{name}`, which this one lacks. Choose an "
                    "environment or scenario with a curriculum, or remove the callback."
                )
        self.n_levels = int(self.training_env.get_attr("n_curriculum_levels", indices=0)[0])
        self._set_level(min(self.level, self.n_levels - 1))

    def _on_step(self) -> bool:
        for info, done in zip(self.locals["infos"], self.locals["dones"], strict=True):
            if done:
                if "is_success" not in info:
                    raise InvalidEnvironmentError(
                        'CurriculumCallback needs info["is_success"] at the end of every episode.'
                    )
                check_success([info])
                self.successes.append(bool(info["is_success"]))
        full = len(self.successes) == self.successes.maxlen
        if (
            full
            and self.level < self.n_levels - 1
            and sum(self.successes) >= self.success_threshold * len(self.successes)
        ):
            self._set_level(self.level + 1)
            if self.verbose > 0:
                print(f"Curriculum: level {self.level} of {self.n_levels - 1} at step {self.num_timesteps}")
        self.logger.record("curriculum/level", self.level)
        return True


class DashboardCallback(BaseCallback):
    """
    Callback that adds to TensorBoard's curves. At the start of training, it logs the hyperparameters with the metrics
    that judge them, and a layout for the tab "Custom scalars". At each call, it logs figures and numbers of the current
    model. Pass it to SB3's ``EvalCallback`` as ``callback_after_eval`` to call it after each evaluation. Without
    TensorBoard it does nothing.

    :param draw: function that returns Matplotlib figures and numbers of a model by tag, None for no figures
    :param layout: title -> chart -> kind and tags, see ``SummaryWriter.add_custom_scalars``
    """

    def __init__(
        self,
        draw: Callable[[BaseAlgorithm], Mapping[str, Any]] | None = None,
        layout: Mapping[str, Mapping[str, list[Any]]] | None = None,
    ):
        super().__init__()
        if draw is not None and not callable(draw):
            raise InvalidArgumentError(f"draw={shown(draw)} must be a function of the model, or None.")
        self.draw = draw
        self.layout = LAYOUT if layout is None else check_layout(layout)

    def _on_training_start(self) -> None:
        for writer in self._writers():
            writer.writer.add_custom_scalars(self.layout)
        tags = {tag for charts in self.layout.values() for _, some in charts.values() for tag in some}
        judged = sorted(tag for tag in tags if not tag.startswith(("train/", "time/")))
        params = HParam(hyperparameters(self.model), dict.fromkeys(judged, 0.0))
        self.logger.record("hparams", params, exclude=TENSORBOARD_ONLY)

    def _on_step(self) -> bool:
        if self.draw is not None and self._writers():
            for tag, value in check_drawn(self.draw(self.model)).items():
                picture = hasattr(value, "savefig")
                self.logger.record(
                    tag, Figure(value, close=True) if picture else value, exclude=TENSORBOARD_ONLY if picture else None
                )
            self.logger.dump(self.num_timesteps)
        return True

    def _writers(self) -> list[TensorBoardOutputFormat]:
        return [one for one in self.logger.output_formats if isinstance(one, TensorBoardOutputFormat)]


def check_layout(layout: Any) -> Any:
    """
    :param layout: see ``DashboardCallback``
    :return: the same
    :raises ValueError: if TensorBoard cannot show it
    """
    try:
        for charts in layout.values():
            for kind, tags in charts.values():
                if (
                    kind not in ("Multiline", "Margin")
                    or isinstance(tags, str)
                    or not all(isinstance(one, str) for one in tags)
                ):
                    raise ValueError
    except (AttributeError, TypeError, ValueError):
        raise InvalidArgumentError(
            f"layout={shown(layout)} must map titles to charts, and each chart to its kind and tags, such as "
            '{"Learning": {"return": ["Multiline", ["rollout/ep_rew_mean"]]}}.'
        ) from None
    return layout


def check_drawn(drawn: Any) -> Mapping[str, Any]:
    """
    :param drawn: what ``draw`` returned, see ``DashboardCallback``
    :return: figures and Python's numbers by tag
    :raises ValueError: if it is anything else
    """
    if not isinstance(drawn, Mapping):
        raise InvalidArgumentError(
            f"draw returned {shown(drawn)}: it must return a dict of figures and numbers by tag."
        )
    found = {}
    for tag, value in drawn.items():
        try:
            if not isinstance(tag, str):
                raise ValueError
            found[tag] = value if hasattr(value, "savefig") else as_number(value)
        except ValueError:
            raise InvalidArgumentError(
                f"draw returned {shown(value)} for {shown(tag)}: it must be a Matplotlib figure or a number, and its "
                "tag a text."
            ) from None
    return found


# Default layout. Each chart has one tag, because TensorBoard draws all tags of a run in the same colour
LAYOUT: dict[str, dict[str, list[Any]]] = {
    "Learning": {
        "training: return": ["Multiline", ["rollout/ep_rew_mean"]],
        "evaluation: return": ["Multiline", ["eval/mean_reward"]],
        "critics' loss": ["Multiline", ["train/critic_loss"]],
        "actors' loss": ["Multiline", ["train/actor_loss"]],
        "mean probability of an action": ["Multiline", ["train/probability_mean"]],
        "its standard deviation": ["Multiline", ["train/probability_std"]],
        "steps per second": ["Multiline", ["time/fps"]],
    },
}


def hyperparameters(model: BaseAlgorithm) -> dict[str, bool | str | float]:
    """
    :param model: a model of any algorithm
    :return: the numbers and strings among the arguments it was created with, and collections as strings
    """
    known: dict[str, bool | str | float] = {"algo": type(model).__name__, "policy": type(model.policy).__name__}
    for name in sorted(arguments_of(type(model)) - {"env", "policy", "verbose", "tensorboard_log"}):
        value = getattr(model, name, None)
        if value is not None and not callable(value):
            known[name] = value if isinstance(value, (bool, int, float, str)) else str(value)
    return known
