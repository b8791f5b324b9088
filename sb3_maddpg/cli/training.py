"""``sb3-maddpg train``: one training, from its recipe to its saved model, begun or resumed."""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import sys
import time
import uuid
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from pprint import pprint
from typing import Any, cast

from stable_baselines3 import __version__ as sb3_version
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CheckpointCallback,
    EvalCallback,
    LogEveryNTimesteps,
    ProgressBarCallback,
)
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat, configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import configure_logger, safe_mean
from stable_baselines3.common.vec_env import VecEnv

try:
    from torch.utils.tensorboard import SummaryWriter
except ImportError as error:
    raise ImportError(f"{error}. This needs the extra 'zoo': in the clone, pip install -e '.[zoo]'.") from error

from sb3_maddpg.checkpoints import RunCheckpoint, locked, resume
from sb3_maddpg.cli.environments import STATISTICS, is_stochastic
from sb3_maddpg.cli.experiment import Experiment, begin, given_recipe, merged
from sb3_maddpg.cli.options import ENGINES
from sb3_maddpg.cli.recipe import callbacks_of
from sb3_maddpg.cli.resuming import recipe_of, resumed, without_checkpoint
from sb3_maddpg.cli.runs import CHECKPOINTS, claim_folder, latest_number
from sb3_maddpg.cli.safety import write_settings
from sb3_maddpg.cli.seeds import parse_seeds, train_seeds
from sb3_maddpg.common.callbacks import DashboardCallback, check_drawn, check_layout
from sb3_maddpg.common.evaluation import MEAN_REWARD, TeamEvalCallback
from sb3_maddpg.common.team_algorithm import TeamAlgorithm
from sb3_maddpg.errors import InvalidArgumentError, InvalidFileError
from sb3_maddpg.files.model_files import not_ours, refuse_pickled, trusted
from sb3_maddpg.maddpg.maddpg import MADDPG
from sb3_maddpg.offers import broken, load_offer, offer_named, package_of
from sb3_maddpg.team.team import Team
from sb3_maddpg.utils import describe_env, remedy_of, remove_empty_log_folder, shown, suggest, told
from sb3_maddpg.vec_env.states import put_aside

# Default number of log tables when training an off-policy algorithm. SB3's default of one every four episodes floods
# the screen, and short trainings end before the first table.
TABLES = 100
FEWEST_STEPS_PER_TABLE = 1000


def train(args: argparse.Namespace, words: list[str]) -> int:
    """
    Train once, or once per seed in processes of their own.

    :param args: options of ``train``
    :param words: the options as they were given
    :return: exit status
    """
    if args.optimize_hyperparameters:
        from sb3_maddpg.cli.study import tune

        return tune(args, words)
    _check(args)
    if args.seeds is not None:
        jobs = os.cpu_count() or 1 if args.jobs is None else args.jobs
        return train_seeds(args, words, parse_seeds(args.seeds), jobs)
    if args.resume is not None:
        run, args = resumed(args, words)
        begin(args)
        training = Training(args, *recipe_of(run, args), run=run)
    else:
        begin(args)
        training = Training(args, *given_recipe(args))
    training.run()
    return 0


def _check(args: argparse.Namespace) -> None:
    if not args.log_folder:
        raise InvalidArgumentError("--log-folder is empty: name a folder, or leave it out for `logs`.")
    if (every := args.checkpoint_every) is not None and every < 0:
        raise InvalidArgumentError(f"--checkpoint-every {every}: pass a number of steps, or 0 for no checkpoints.")
    if args.seeds is None and (args.jobs is not None or args.engine != "local" or args.address is not None):
        raise InvalidArgumentError(
            "--jobs, --engine and --address are for --seeds: a single training runs in this process."
        )
    if args.engine not in ENGINES:
        raise InvalidArgumentError(suggest("engine", args.engine, ENGINES))
    if args.seeds is not None and args.resume is not None:
        raise InvalidArgumentError("--resume continues one run; --seeds resumes the runs of its command automatically.")
    if args.trained_agent and not (args.trained_agent.endswith(".zip") and Path(args.trained_agent).is_file()):
        raise InvalidArgumentError(f"-i {args.trained_agent}: there is no such model; name a zip file.")


class Training:
    """
    One training.

    :param args: options of ``train``
    :param recipe: the recipe with the changes of the command line, as it is written
    :param source: where it is, for messages
    :param run: folder of the run to resume, None for a new one
    """

    def __init__(self, args: argparse.Namespace, recipe: Mapping[str, Any], source: str, run: Path | None = None):
        self.args, self.resumes, self.track = args, run is not None, _tracked(args)
        self.every = args.checkpoint_every
        if args.trial_id is not None:
            from sb3_maddpg.cli.study import trial_of

            of_trial = trial_of(args)
            print(f"Hyperparameters of trial {args.trial_id} of {args.study_name}: {of_trial}")
            recipe = {**merged(recipe, of_trial), **(args.hyperparams or {})}
        self.experiment = Experiment(args, recipe, source, exact=bool(self.every))
        pprint(dict(sorted(self.experiment.recipe.items())))
        for key in ("env_kwargs", "eval_env_kwargs"):
            if kwargs := getattr(self.experiment, key):
                print(f"{key}={kwargs}")
        self.logs = Path(args.log_folder, args.algo)
        self.folder = run
        self.curves = str(Path(args.tensorboard_log, self.experiment.name)) if args.tensorboard_log else None
        self.checkpoint: RunCheckpoint | None = None
        self.interrupted = False

    @property
    def settings(self) -> Path:
        """Folder of the run's settings."""
        assert self.folder is not None
        return self.folder / self.experiment.name

    def run(self) -> BaseAlgorithm:
        """
        Train and save the model.

        :return: the model
        :raises KeyboardInterrupt: after that, if the training was interrupted
        """
        with contextlib.ExitStack() as lock:
            if self.folder is not None:
                # First of all, because a process that trains in this folder still writes its monitor files
                lock.enter_context(locked(self.folder / CHECKPOINTS))
                put_aside(self.folder)
            else:
                self.folder = self._claim()
            try:
                callbacks = self.callbacks()
                env = self.experiment.environments.make(
                    self.experiment.n_envs,
                    self.experiment.env_kwargs,
                    monitor=self.folder,
                    statistics=self._statistics(),
                )
                model = self._model(env)
            except Exception:
                if not self.resumes:  # nothing has been learned: what is refused leaves no run
                    shutil.rmtree(self.folder, ignore_errors=True)
                raise
            self._write_settings()
            if self.track is not None:
                self.track.config.setdefaults({**vars(self.args), "saved_hyperparams": self.experiment.recipe})
            if self.every != 0 and isinstance(model, TeamAlgorithm):
                checkpoints = self.folder / CHECKPOINTS
                if self.checkpoint is None:
                    self.checkpoint = RunCheckpoint(checkpoints, self.every)
                    lock.enter_context(locked(checkpoints))
                callbacks.append(self.checkpoint)
            self.learn(model, callbacks)
            self.save(model)
        return model

    def _claim(self) -> Path:
        suffix = f"_{uuid.uuid4()}" if self.args.uuid else ""
        name = self.experiment.name
        return claim_folder(f"{self.logs}/{name}", latest_number(self.logs, name) + 1, suffix)

    def _statistics(self) -> Path | None:
        """:return: the statistics of the normalisation of the model to continue, if it has any"""
        path = Path(self.args.trained_agent).parent / self.experiment.name / STATISTICS
        return path if self.args.trained_agent and path.exists() else None

    def _write_settings(self) -> None:
        write_settings(self.settings / "config.yml", self.experiment.recipe)
        write_settings(self.settings / "args.yml", vars(self.args))
        (self.settings / "command.txt").write_text(" ".join(sys.orig_argv))
        print(f"Log path: {self.folder}")

    def callbacks(self) -> list[BaseCallback]:
        """:return: the recipe's callbacks, and those that show, save and evaluate"""
        args, experiment = self.args, self.experiment
        found = callbacks_of(experiment.callback)
        # Stable-Baselines3 counts the steps of all environments at once, and those of agents that share a policy
        per_call, per_episode = experiment.n_envs, 1
        if experiment.shares:
            env = experiment.environments.make(1, experiment.eval_env_kwargs, evaluates=True)
            env.close()
            per_call, per_episode = experiment.n_envs * env.num_envs, env.num_envs
        if args.progress:
            found.append(ProgressBarCallback())
        if args.save_freq > 0:
            every = max(args.save_freq // per_call, 1)
            found.append(CheckpointCallback(every, str(self.folder), "rl_model", verbose=1))
        evaluation = None
        if args.eval_freq > 0:
            env = experiment.environments.make(
                args.n_eval_envs, experiment.eval_env_kwargs, evaluates=True, statistics=self._statistics()
            )
            team = issubclass(experiment.algorithm, TeamAlgorithm)
            if args.best_by != MEAN_REWARD and not team:
                raise InvalidArgumentError(f"--best-by is for teams' algorithms, not for --algo {args.algo}.")
            kind: Any = partial(TeamEvalCallback, best_by=args.best_by) if team else EvalCallback
            evaluation = kind(
                env,
                callback_on_new_best=_SaveStatistics(self.settings / STATISTICS),
                best_model_save_path=str(self.folder),
                n_eval_episodes=args.eval_episodes * per_episode,
                log_path=str(self.folder),
                eval_freq=max(args.eval_freq // per_call, 1),
                deterministic=not is_stochastic(args.env),
            )
            if args.best_by != MEAN_REWARD and args.eval_freq > experiment.n_timesteps:
                raise InvalidArgumentError(
                    f"--best-by {args.best_by} needs evaluations, but this training of {experiment.n_timesteps} steps "
                    f"has none with --eval-freq {args.eval_freq}: pass at most {experiment.n_timesteps}."
                )
            found.append(evaluation)
        if self.curves is not None:
            draw, layout = _dashboard(args.env, experiment.eval_env_kwargs)
            if evaluation is None:  # without evaluations, there are no figures
                found.append(DashboardCallback(layout=layout))
            else:
                evaluation.callback = DashboardCallback(draw, layout)
                evaluation.callback.parent = evaluation
        if args.log_interval == -1 and issubclass(experiment.algorithm, OffPolicyAlgorithm):
            found.append(_RegularTables(max(experiment.n_timesteps // TABLES, FEWEST_STEPS_PER_TABLE)))
        return found

    def _model(self, env: VecEnv) -> BaseAlgorithm:
        if self.resumes:
            return self._resumed(env)
        arguments = {"tensorboard_log": self.curves, "seed": self.args.seed, "verbose": self.args.verbose}
        hyperparams = self.experiment.arguments(env)
        if self.args.trained_agent:
            return self._continued(env, {**hyperparams, **arguments})
        return self.experiment.new_model(env, **arguments, **hyperparams)

    def _resumed(self, env: VecEnv) -> BaseAlgorithm:
        assert self.folder is not None
        algorithm = cast("type[TeamAlgorithm]", self.experiment.algorithm)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".* logs to ")  # the command says where curves go
            found = resume(self.folder / CHECKPOINTS, cast(Any, env), algorithm, self.every, device=self.args.device)
        if found is None:
            raise InvalidFileError(without_checkpoint(self.folder))
        model, self.checkpoint = found
        model.tensorboard_log, model.verbose = self.curves, self.args.verbose
        print(f"Resuming {self.folder} at step {model.num_timesteps}")
        return model

    def _continued(self, env: VecEnv, arguments: dict[str, Any]) -> BaseAlgorithm:
        """:return: the model of ``-i``, with the arguments of the recipe but those of its policy"""
        path, algorithm = self.args.trained_agent, self.experiment.algorithm
        pair = arguments.pop("policy") == "PairPolicy"
        arguments.pop("policy_kwargs", None)
        if pair and issubclass(algorithm, MADDPG):
            trained = algorithm.load(path, device=self.args.device)
            n_agents = Team.from_spaces(env.observation_space, env.action_space).n_agents
            if n_agents != trained.policy.team.n_agents:
                print(f"Continuing with a team of {n_agents} instead of {trained.policy.team.n_agents}, from step 0")
                return trained.resized(env, **arguments)
        trusts = trusted(None)
        if not trusts:
            refuse_pickled(path, {})
        model = algorithm.load(path, env=env, device=self.args.device, **arguments)
        buffer = Path(path).parent / "replay_buffer.pkl"
        if buffer.exists() and isinstance(model, OffPolicyAlgorithm):
            if not trusts and not isinstance(model, TeamAlgorithm):
                raise not_ours(buffer, "is not a replay buffer")
            # The second argument is for HerReplayBuffer only
            model.load_replay_buffer(buffer, truncate_last_traj=self.args.truncate_last_trajectory)
        print(f"Continuing at step {model.num_timesteps}")
        found = getattr(model, "replay_buffer", None)
        if found is not None and found.size() == 0:
            print("There is no replay_buffer.pkl beside the model (see --save-replay-buffer): the buffer starts empty.")
        return model

    def learn(self, model: BaseAlgorithm, callbacks: list[BaseCallback]) -> None:
        """
        :param model: a new or a loaded model
        :param callbacks: see ``callbacks``
        :raises OSError: if the disk is full or fails; the message says how to go on
        """
        try:
            self._learn(model, callbacks)
        except OSError as error:
            if (remedy := remedy_of(error)) is None:
                raise
            text = f"{error.strerror}: {remedy}"
            if self.checkpoint is not None:
                text += f", then continue with `train --resume {self.folder}`"
            raise OSError(error.errno, text, error.filename or str(self.folder)) from error

    def _learn(self, model: BaseAlgorithm, callbacks: list[BaseCallback]) -> None:
        assert model.env is not None
        model.env_spec = describe_env(model.env)  # type: ignore[attr-defined]
        model.set_logger(self._logger(type(model).__name__))
        steps = self.experiment.n_timesteps - (model.num_timesteps if self.resumes else 0)
        kwargs: dict[str, Any] = {}
        if self.args.log_interval != -1:
            kwargs["log_interval"] = max(self.args.log_interval, 0) or None
        elif isinstance(model, OffPolicyAlgorithm):
            kwargs["log_interval"] = None
        continues = self.resumes or bool(self.args.trained_agent)
        try:
            with warnings.catch_warnings():
                # Evaluation runs episode by episode, with any kind of training environment
                warnings.filterwarnings("ignore", "Training and eval env are not of the same type")
                model.learn(steps, callback=callbacks or None, reset_num_timesteps=not continues, **kwargs)
        except KeyboardInterrupt:
            self.interrupted = True
            print("Interrupted: saving what has been learned so far.")
            for callback in callbacks:  # closes the progress bar
                callback.on_training_end()
        finally:
            model.env.close()
            remove_empty_log_folder(model)

    def _logger(self, name: str) -> Logger:
        """:return: a logger of tables, unless there is a progress bar, and of curves for TensorBoard"""
        prints = self.args.verbose > 0 and not self.args.progress
        outputs = [*(["stdout"] if prints else []), "tensorboard"]
        before = "" if self.checkpoint is None else Path(self.checkpoint.logger_folder or "").name
        if self.resumes and before not in ("", "..") and self.curves:
            curves = str(Path(self.curves, before))
            logger = configure(curves, outputs)
            for output in logger.output_formats:
                if isinstance(output, TensorBoardOutputFormat):  # drop events after the checkpoint
                    assert self.checkpoint is not None
                    output.writer.close()
                    output.writer = SummaryWriter(curves, purge_step=self.checkpoint.saved_at + 1)
            return logger
        if not self.curves:
            return configure_logger(int(prints))
        last = latest_number(Path(self.curves), name)
        prefix = str(Path(self.curves, name))
        continues = self.resumes or self.args.trained_agent
        folder = Path(f"{prefix}_{last}") if continues else claim_folder(prefix, last + 1)
        return configure(str(folder), outputs)

    def save(self, model: BaseAlgorithm) -> None:
        """
        Save the model, and remove checkpoints that are no longer needed.

        :param model: the trained model
        :raises KeyboardInterrupt: after that, if the training was interrupted
        """
        assert self.folder is not None
        path = self.folder / f"{self.experiment.name}.zip"
        model.save(path)
        if self.args.save_replay_buffer and isinstance(model, OffPolicyAlgorithm):
            model.save_replay_buffer(self.folder / "replay_buffer.pkl")
        normalization = model.get_vec_normalize_env()
        if normalization is not None:
            normalization.save(str(self.settings / STATISTICS))
        if self.checkpoint is not None and model.num_timesteps >= model._total_timesteps:  # not interrupted
            shutil.rmtree(self.checkpoint.folder, ignore_errors=True)
        if model.ep_info_buffer:
            rewards = [episode["r"] for episode in model.ep_info_buffer]
            print(f"Mean reward: {safe_mean(rewards):.4g} in the last {len(rewards)} episodes of training")
        print(f"Model:       {path}")
        print(f"Logs:        {self.folder}")
        if self.curves:
            print(f"TensorBoard: tensorboard --logdir {self.curves}")
        if self.interrupted:
            raise KeyboardInterrupt


class _RegularTables(LogEveryNTimesteps):
    """Logs a table and a point of each curve every ``n_steps`` timesteps and at the end."""

    def _on_training_start(self) -> None:
        self.last_time_trigger = self.num_timesteps  # a continued training keeps its step count

    def _on_training_end(self) -> None:
        self.num_timesteps = self.model.num_timesteps
        if self.num_timesteps > self.last_time_trigger:
            self._on_event()


class _SaveStatistics(BaseCallback):
    """
    Saves the statistics of the normalisation with the best model.

    :param path: path of the file
    """

    def __init__(self, path: Path):
        super().__init__()
        self.path = path

    def _on_step(self) -> bool:
        normalization = self.model.get_vec_normalize_env()
        if normalization is not None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            normalization.save(str(self.path))
        return True


def _tracked(args: argparse.Namespace) -> Any:
    """:return: a run of Weights & Biases, None without ``--track``"""
    if not args.track:
        return None
    try:
        import wandb
    except ImportError as error:
        raise ImportError("--track needs Weights & Biases: pip install wandb.") from error
    name = f"{args.env}__{args.algo}__{args.seed}__{int(time.time())}"
    run = wandb.init(
        name=name,
        project=args.wandb_project_name,
        entity=args.wandb_entity,
        group=args.wandb_group,
        tags=[*args.wandb_tags, f"v{sb3_version}"],
        config=vars(args),
        sync_tensorboard=True,
        monitor_gym=True,
        save_code=True,
    )
    args.tensorboard_log = f"runs/{name}"
    return run


def _dashboard(env_id: str, env_kwargs: dict[str, Any]) -> tuple[Callable[[BaseAlgorithm], Any] | None, Any]:
    """:return: the function that draws figures of the environment and the layout, None for the default"""
    offer = offer_named("dashboards", env_id)
    if offer is None:
        return None, None
    try:
        found = load_offer(offer)
    except ImportError as error:
        if package_of(offer) != "sb3-maddpg":
            raise
        raise ImportError(
            f"--tensorboard-log draws figures of {env_id}, which needs the extra 'plot': in the clone, "
            f"pip install -e '.[plot]' ({error})."
        ) from error
    if not callable(getattr(found, "draw", None)) or not hasattr(found, "LAYOUT"):
        raise broken(offer, f"is {shown(found)}, which has no LAYOUT or no function draw(model, env_kwargs)")
    try:
        check_layout(found.LAYOUT)
    except ValueError as error:
        raise broken(offer, f"has a wrong LAYOUT ({error})") from error

    def draw(model: BaseAlgorithm) -> Mapping[str, Any]:
        try:
            return check_drawn(found.draw(model, env_kwargs=env_kwargs))
        except Exception as error:  # from foreign code
            raise broken(offer, f"could not draw the model ({told(error)})") from error

    return draw, found.LAYOUT
