"""rl_zoo3's experiment manager with fixes for environment arguments, resuming and tuning."""

import contextlib
import itertools
import shutil
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, cast

import gymnasium
import optuna
import yaml
from optuna.trial import TrialState
from rl_zoo3.callbacks import TrialEvalCallback
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import ALGOS, SimpleLinearSchedule, get_callback_list
from sqlalchemy.exc import DBAPIError
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import EvalCallback, LogEveryNTimesteps
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat, configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import LinearSchedule, configure_logger, safe_mean
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from torch.utils.tensorboard import SummaryWriter

from sb3_maddpg.checkpoints.callback import RunCheckpoint
from sb3_maddpg.checkpoints.commit import locked
from sb3_maddpg.checkpoints.resume import resume
from sb3_maddpg.cli.command_files import latest_run_number, write_command
from sb3_maddpg.cli.interrupts import noticed_interrupts
from sb3_maddpg.cli.literals import format_literal, parse_literal
from sb3_maddpg.cli.options import check_writable
from sb3_maddpg.cli.parameter_sharing import AgentsVecEnv, shares_parameters
from sb3_maddpg.cli.recipes import check_env_kwargs, check_options, check_recipe, policy_class, read_recipe
from sb3_maddpg.cli.safety import check_names, check_paths
from sb3_maddpg.cli.search import (
    STUDY,
    as_absolute,
    best_recipe,
    bring_back,
    check_trials,
    enlist,
    kept_search,
    open_storage,
    sign,
    tell_best,
)
from sb3_maddpg.common.callbacks import DashboardCallback, check_drawn, check_layout
from sb3_maddpg.common.team_algorithm import TeamAlgorithm
from sb3_maddpg.files.model_files import trusted
from sb3_maddpg.maddpg.maddpg import MADDPG
from sb3_maddpg.offers import broken, load_offer, offer_named, package_of
from sb3_maddpg.team.team import Team
from sb3_maddpg.utils import (
    arguments_of,
    atomic_write,
    describe_env,
    remedy_of,
    remove_empty_log_folder,
    shown,
    suggest,
    told,
)
from sb3_maddpg.vec_env.gymnasium import GymnasiumVecEnv
from sb3_maddpg.vec_env.states import Replayable, put_aside, tells_state

# Default number of log tables when training an off-policy algorithm. SB3's default of one every four episodes floods
# the screen, and short trainings end before the first table.
TABLES = 100
FEWEST_STEPS_PER_TABLE = 1000


CHECKPOINTS = "checkpoints"


class Checkpoints(NamedTuple):
    """The command line's settings of checkpoints."""

    every: int | None
    """Number of steps between checkpoints, None for checkpoints by time"""
    argv: list[str]
    """Arguments of the command that starts the run"""
    run: Path | None = None
    """Folder of the run to resume"""
    foreign: bool = False
    """Whether the run to resume may be someone else's, so that it must not run code"""


class TeamExperimentManager(ExperimentManager):
    """
    Experiment manager of rl_zoo3 with these changes:

    - ``--env-kwargs`` are merged over the recipe's ``env_kwargs``, and both also apply to the evaluation environment,
      where ``eval_env_kwargs`` and ``--eval-env-kwargs`` are merged over them;
    - options and recipes are checked before anything runs, see ``recipes``; no text of a recipe is evaluated;
    - each run claims its folder, so that trainings that start at the same time use different ones;
    - a single-agent algorithm on a PettingZoo environment trains one policy for all agents, see ``AgentsVecEnv``;
    - ``vec_env: gymnasium`` uses the environment's own Gymnasium vector environment, see ``GymnasiumVecEnv``;
    - ``replay_buffer_class`` can be a dotted path, like ``policy``;
    - models can be loaded without rl_zoo3, because linear schedules are Stable-Baselines3's;
    - every model, not only MADDPG's, stores the environment it was trained in as ``env_spec``;
    - resuming (``-i``) continues counters and schedules and skips the random warm-up; with a team of another size, a
      ``PairPolicy`` keeps its networks only;
    - ``--trial-id`` accepts every trial of a study, including the first, whose number is 0;
    - tuning (``-optimize``) keeps the recipe's other ``policy_kwargs``, leaves no run folder behind and draws different
      hyperparameters in each worker of a study. A trial is pruned if its networks diverge; any other error ends the
      search instead of counting as a bad trial. The best trial is written as a recipe.
    """

    study: optuna.Study | None = None  # the study of the search
    interrupted = False  # whether the user ended the training
    learns = False  # whether a trial is training
    continues = False  # whether the study has trials of other workers or of an earlier command

    def __init__(
        self,
        args: Any,
        *rest: Any,
        uuid_str: str = "",
        checkpoints: Checkpoints | None = None,
        given_seed: int | None = None,
        **kwargs: Any,
    ):
        check_options(args)
        self.given_seed = given_seed  # None if rl_zoo3 chose one
        self.checkpoints = checkpoints
        self.checkpoint: RunCheckpoint | None = None
        self.lock = contextlib.ExitStack()  # of the run's folder of checkpoints, until learn() ends
        super().__init__(args, *rest, **{**kwargs, "uuid_str": uuid_str})
        self.uuid_str = uuid_str
        self.pressed = threading.Event()  # whether the user ended the search
        self.shares_parameters = shares_parameters(ALGOS[self.algo], self.env_name.gym_id)

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        # rl_zoo3 would replace the recipe's arguments with these, and would ignore trial 0
        given, self.env_kwargs = self.env_kwargs, {}
        trial_id, self.trial_id = self.trial_id, None
        foreign = self.checkpoints.run if self.checkpoints is not None and self.checkpoints.foreign else None
        # Recipes can be programs, and samplers come from the internet
        if foreign and (self.optimize_hyperparameters or not self.config.endswith((".yml", ".yaml"))):
            raise ValueError(f"{foreign} with {self.config} may run any code. If you trust its author, pass --trust.")
        read_recipe(self.config, self.algo, self.env_name.gym_id)
        hyperparams, _ = super().read_hyperparameters()
        if trial_id is not None:
            of_trial = self._read_trial(trial_id)
            print(f"Hyperparameters of trial {trial_id} of {self.study_name}: {of_trial}")
            hyperparams = {**update(hyperparams, of_trial), **(self.custom_hyperparams or {})}
        if self.n_timesteps > 0:
            hyperparams.setdefault("n_timesteps", self.n_timesteps)
        if "noise_type" in hyperparams and hyperparams["noise_type"] is None:  # which switches the recipe's noise off
            del hyperparams["noise_type"]
            hyperparams.pop("noise_std", None)
        if foreign:
            kwargs = {"env_kwargs": given, "eval_env_kwargs": self._eval_env_kwargs_args}
            for named in (hyperparams, kwargs):
                check_names(named, self.env_name.gym_id, f"{foreign} with {self.config}")
                check_paths(named, foreign, f"{foreign} with {self.config}")
        as_written = dict(hyperparams)
        hyperparams = check_recipe(self.algo, hyperparams, f"recipe for {self.algo} in {self.config}")
        self.own_vec_env = self._read_vec_env(hyperparams)
        env_kwargs = {**(hyperparams.get("env_kwargs") or {}), **given}
        eval_env_kwargs = {**(hyperparams.pop("eval_env_kwargs", None) or {}), **(self._eval_env_kwargs_args or {})}
        self.eval_env_kwargs = {**env_kwargs, **eval_env_kwargs}
        hyperparams["env_kwargs"] = env_kwargs
        # Keep the original text, because YAML has no plain form for classes
        self.recipe = {**as_written, "env_kwargs": env_kwargs, "eval_env_kwargs": eval_env_kwargs}
        check_env_kwargs(self.env_name.gym_id, self.eval_env_kwargs)
        return hyperparams, dict(sorted(self.recipe.items()))

    def _read_vec_env(self, hyperparams: dict[str, Any]) -> bool:
        """:return: whether to train in the environment's own vector environment"""
        vec_env = hyperparams.pop("vec_env", None)
        if vec_env not in (None, "gymnasium"):
            raise ValueError(
                f"vec_env: {vec_env} in the recipe: only 'gymnasium' is known; --vec-env chooses dummy or subproc."
            )
        if vec_env and gymnasium.spec(self.env_name.gym_id).vector_entry_point is None:
            raise ValueError(
                f"vec_env: gymnasium in the recipe, but {self.env_name.gym_id} has no vector environment of its own."
            )
        if vec_env and (wrappers := {"env_wrapper", "frame_stack", "monitor_kwargs"} & set(hyperparams)):
            raise ValueError(
                f"vec_env: gymnasium in the recipe cannot be combined with {', '.join(sorted(wrappers))}: remove one "
                "of them."
            )
        others = ("env_wrapper", "frame_stack", "monitor_kwargs", "normalize", "vec_env_wrapper")
        if self.shares_parameters and (refused := [key for key in others if hyperparams.get(key)]):
            raise ValueError(
                f"{', '.join(refused)} in the recipe: {self.algo} shares its policy among the agents of "
                f"{self.env_name.gym_id}, which needs wrappers of PettingZoo. Name them in `wrappers` of env_kwargs, "
                "such as supersuit.frame_stack_v2."
            )
        return vec_env is not None

    def _read_trial(self, trial_id: int) -> dict[str, Any]:
        """:return: the algorithm's arguments in a trial of the study given by ``--storage`` and ``--study-name``"""
        if not self.storage or not self.study_name:
            raise ValueError(f"--trial-id {trial_id} needs a study: pass --storage and --study-name.")
        if self.storage.endswith(".log") and not Path(self.storage).is_file():  # Optuna would create an empty file
            raise FileNotFoundError(f"There is no file {self.storage}.")
        storage = open_storage(self.storage)
        try:
            study = optuna.load_study(storage=storage, study_name=self.study_name)
        except KeyError:
            names = optuna.get_all_study_names(storage)
            raise ValueError(suggest(f"study in {self.storage}", self.study_name, names)) from None
        except DBAPIError as error:
            raise _no_database(self.storage, error) from error
        check_trials(study, self.storage)
        for trial in study.get_trials(deepcopy=False):
            if trial.number == trial_id:
                return self._arguments_of(trial)
        raise ValueError(f"Study {self.study_name} has no trial {trial_id}, only {len(study.trials)}, counted from 0.")

    def _arguments_of(self, trial: optuna.trial.FrozenTrial) -> dict[str, Any]:
        """:return: the algorithm's arguments in a trial, which someone else may have written"""
        source = f"trial {trial.number} of {self.storage}"
        try:
            found: dict[str, Any] = HYPERPARAMS_CONVERTER[self.algo](trial.params)
        except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError) as error:
            raise ValueError(
                f"{source} has {shown(trial.params)}, which are no parameters of {self.algo} ({told(error)})."
            ) from error
        if not trusted(None):
            check_names(found, self.env_name.gym_id, source)
        return found

    def create_log_folder(self) -> None:
        """Create the run's folder. A search has none: the log of each trial goes to ``--optimization-log-path``."""
        if self.optimize_hyperparameters:
            return
        if self.checkpoints is not None and self.checkpoints.run is not None:
            self.save_path, self.params_path = str(self.checkpoints.run), f"{self.checkpoints.run}/{self.env_name}"
            # First of all, because a process that trains in this folder still writes its monitor files
            self.lock.enter_context(locked(self.checkpoints.run / CHECKPOINTS))
            put_aside(self.checkpoints.run)
            return
        first = latest_run_number(self.log_path, self.env_name) + 1
        self.save_path = str(claim_folder(f"{self.log_path}{self.env_name}", first, self.uuid_str))
        self.params_path = f"{self.save_path}/{self.env_name}"
        super().create_log_folder()
        if self.checkpoints is not None:
            write_command(Path(self.save_path), self.checkpoints.argv, self.checkpoints.every)

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        """
        Create folder, environments, callbacks and model.

        :return: the model and its hyperparameters, None for a search
        """
        try:
            return super().setup_experiment()
        except BaseException:
            self.lock.close()
            raise

    @staticmethod
    def _preprocess_schedules(hyperparams: dict[str, Any]) -> dict[str, Any]:
        found = ExperimentManager._preprocess_schedules(
            {key: one for key, one in hyperparams.items() if one is not None}
        )
        for key, one in found.items():
            if isinstance(one, SimpleLinearSchedule):  # loading a model with it would need rl_zoo3
                found[key] = LinearSchedule(one.initial_value, 0.0, 1.0)
        return found

    def create_callbacks(self) -> None:
        """Create rl_zoo3's callbacks and the TensorBoard dashboard."""
        if self.shares_parameters:  # rl_zoo3 counts steps of all copies, and episodes
            env = self.create_envs(1, eval_env=True)
            env.close()
            self.eval_freq = max(self.eval_freq // env.num_envs, 1) if self.eval_freq > 0 else -1
            self.save_freq = max(self.save_freq // env.num_envs, 1) if self.save_freq > 0 else -1
            self.n_eval_episodes *= env.num_envs
        super().create_callbacks()
        if not self.tensorboard_log or self.optimize_hyperparameters:
            return
        draw, layout = self._dashboard()
        evaluation = next((one for one in self.callbacks if isinstance(one, EvalCallback)), None)
        if evaluation is None:  # without evaluations, there are no figures
            self.callbacks.append(DashboardCallback(layout=layout))
            return
        evaluation.callback = DashboardCallback(draw, layout)
        evaluation.callback.parent = evaluation

    def _dashboard(self) -> tuple[Callable[[BaseAlgorithm], Any] | None, Any]:
        """:return: the function that draws figures of the environment and the layout, None for the default"""
        name = self.env_name.gym_id
        offer = offer_named("dashboards", name)
        if offer is None:
            return None, None
        try:
            found = load_offer(offer)
        except ImportError as error:
            if package_of(offer) != "sb3-maddpg":
                raise
            raise ImportError(
                f"--tensorboard-log draws figures of {name}, which needs the extra 'plot': in the clone, "
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
                return check_drawn(found.draw(model, env_kwargs=self.eval_env_kwargs))
            except Exception as error:  # from foreign code
                raise broken(offer, f"could not draw the model ({told(error)})") from error

        return draw, found.LAYOUT

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """
        Create the vectorised environment.

        :param n_envs: number of environments
        :param eval_env: whether the environments are for evaluation
        :param no_log: whether to write no monitor file
        :return: the environment
        """
        no_log = no_log or eval_env or self.optimize_hyperparameters
        if self.shares_parameters:
            kwargs = self.eval_env_kwargs if eval_env else self.env_kwargs
            agents: VecEnv = AgentsVecEnv(self.env_name.gym_id, n_envs, kwargs)
        elif self.own_vec_env and not eval_env:
            agents = GymnasiumVecEnv(gymnasium.make_vec(self.env_name.gym_id, num_envs=n_envs, **self.env_kwargs))
        else:
            self._make_replayable()
            return super().create_envs(n_envs, eval_env, no_log)
        env = VecMonitor(agents, None if no_log else f"{self.save_path}/0")
        env.seed(self.seed)
        return self._maybe_normalize(env, eval_env)

    def _resume(self, run: Path, env: Any) -> TeamAlgorithm:
        assert self.checkpoints is not None
        algorithm = cast("type[TeamAlgorithm]", ALGOS[self.algo])
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".* logs to ")  # the command says where curves go
            found = resume(run / CHECKPOINTS, env, algorithm, self.checkpoints.every, device=self.device)
        if found is None:
            raise ValueError(f"{run} has no complete checkpoint.")
        model, self.checkpoint = found
        model.tensorboard_log, model.verbose = self.tensorboard_log, self.verbose
        self.n_timesteps -= model.num_timesteps
        print(f"Resuming {run} at step {model.num_timesteps}")
        return model

    def _make_replayable(self) -> None:
        """Wrap environments that do not provide their state in ``Replayable`` if exact checkpoints are requested."""
        if self.checkpoints is None or self.checkpoints.every is None or isinstance(self.env_wrapper, _Replaying):
            return
        env = gymnasium.spec(self.env_name.gym_id).make(**self.env_kwargs)
        if not tells_state(env):
            self.env_wrapper = _Replaying(self.env_wrapper)
        env.close()

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: Any) -> BaseAlgorithm:
        algorithm = ALGOS[self.algo]
        if self.checkpoints is not None and self.checkpoints.run is not None:
            return self._resume(self.checkpoints.run, env)
        if hyperparams.get("policy") == "PairPolicy" and issubclass(algorithm, MADDPG):
            trained = algorithm.load(self.trained_agent, device=self.device)
            n_agents = Team.from_spaces(env.observation_space, env.action_space).n_agents
            if n_agents != trained.policy.team.n_agents:
                print(f"Continuing with a team of {n_agents} instead of {trained.policy.team.n_agents}, from step 0")
                # The policy's arguments stay as trained, as in rl_zoo3
                arguments = {key: one for key, one in hyperparams.items() if key not in ("policy", "policy_kwargs")}
                return trained.resized(
                    env, tensorboard_log=self.tensorboard_log, seed=self.seed, verbose=self.verbose, **arguments
                )
        model = super()._load_pretrained_agent(hyperparams, env)
        print(f"Continuing at step {model.num_timesteps}")
        buffer = getattr(model, "replay_buffer", None)
        if buffer is not None and buffer.size() == 0:
            print("There is no replay_buffer.pkl beside the model (see --save-replay-buffer): the buffer starts empty.")
        return model

    def learn(self, model: BaseAlgorithm) -> None:
        """
        Train a model.

        :param model: a new or a loaded model
        """
        with self.lock:
            try:
                self._learn(model)
            except OSError as error:
                remedy = remedy_of(error)
                if remedy is None:
                    raise
                said = f"{error.strerror}: {remedy}"
                if self.checkpoint is not None:
                    said += f", then continue with `train --resume {self.save_path}`"
                raise OSError(error.errno, said, error.filename or self.save_path) from error

    def _learn(self, model: BaseAlgorithm) -> None:
        assert model.env is not None
        model.env_spec = describe_env(model.env)  # type: ignore[attr-defined]
        model.set_logger(self._logger(type(model).__name__))
        kwargs: dict[str, Any] = {}
        if self.log_interval != -1:
            kwargs["log_interval"] = max(self.log_interval, 0) or None
        elif isinstance(model, OffPolicyAlgorithm):
            kwargs["log_interval"] = None
            total = self.n_timesteps + (model.num_timesteps if self.checkpoint is not None else 0)
            self.callbacks.append(RegularTables(max(total // TABLES, FEWEST_STEPS_PER_TABLE)))
        if self.checkpoints is not None and isinstance(model, TeamAlgorithm):
            folder = Path(self.save_path, CHECKPOINTS)
            if self.checkpoint is None:
                self.checkpoint = RunCheckpoint(folder, self.checkpoints.every)
                self.lock.enter_context(locked(folder))
            self.callbacks.append(self.checkpoint)
        try:
            with warnings.catch_warnings():
                # Evaluation runs episode by episode, with any kind of training environment
                warnings.filterwarnings("ignore", "Training and eval env are not of the same type")
                model.learn(
                    self.n_timesteps,
                    callback=self.callbacks or None,
                    reset_num_timesteps=not self.continue_training,
                    **kwargs,
                )
        except KeyboardInterrupt:
            self.interrupted = True
            print("Interrupted: saving what has been learned so far.")
            for callback in self.callbacks:  # closes the progress bar
                callback.on_training_end()
        finally:
            assert model.env is not None
            model.env.close()
            remove_empty_log_folder(model)

    def _logger(self, name: str) -> Logger:
        """:return: a logger of tables on the screen, unless there is a progress bar, and of curves for TensorBoard"""
        prints = self.verbose > 0 and not self.show_progress
        before = "" if self.checkpoint is None else Path(self.checkpoint.logger_folder or "").name
        if self.checkpoint is not None and before not in ("", "..") and self.tensorboard_log:
            curves = str(Path(self.tensorboard_log, before))
            logger = configure(curves, [*(["stdout"] if prints else []), "tensorboard"])
            for output in logger.output_formats:
                if isinstance(output, TensorBoardOutputFormat):  # drop events after the checkpoint
                    output.writer.close()
                    output.writer = SummaryWriter(curves, purge_step=self.checkpoint.saved_at + 1)
            return logger
        if not self.tensorboard_log:
            return configure_logger(int(prints))
        last = latest_run_number(self.tensorboard_log, name)
        prefix = str(Path(self.tensorboard_log, name))
        folder = Path(f"{prefix}_{last}") if self.continue_training else claim_folder(prefix, last + 1)
        return configure(str(folder), [*(["stdout"] if prints else []), "tensorboard"])

    def _create_sampler(self, sampler_method: str) -> optuna.samplers.BaseSampler:
        sampler: optuna.samplers.BaseSampler
        if sampler_method == "tpe":
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
                # In groups, because some hyperparameters exist only with certain values of others
                sampler = optuna.samplers.TPESampler(
                    n_startup_trials=self.n_startup_trials, seed=self.seed, multivariate=True, group=True
                )
        else:
            sampler = super()._create_sampler(sampler_method)
        if self.continues:
            sampler.reseed_rng()  # otherwise workers with the same --seed and continued searches would repeat trials
        return sampler

    def hyperparameters_optimization(self) -> None:
        """
        Search hyperparameters, alone or with other workers, and write the best trial as a recipe.

        :raises KeyboardInterrupt: after that, if the search was interrupted
        """
        best = best_recipe(Path(self.log_path), self.env_name)
        check_writable(best)
        kept = None
        if self.storage is None:
            kept = kept_search(Path(self.log_path), str(self.env_name), (self.recipe, *self._search_settings()))
            self.storage, self.study_name = str(kept), STUDY
            self.max_total_trials = self.max_total_trials or self.n_trials
        elif not self.storage.endswith(".log"):
            _make_tables(self.storage)
        self.storage = as_absolute(self.storage)
        self.continues = kept is None or kept.is_file()
        with self._told_disk(kept):
            study = self._bring_back()
        if kept is not None:
            self.study = study  # may be complete except for its report
        verbosity = optuna.logging.get_verbosity()
        # Optuna's writing cannot be interrupted: a trial would remain unfinished
        with noticed_interrupts(lambda: not self.learns) as self.pressed:
            try:
                with self._told_disk(kept):
                    super().hyperparameters_optimization()
            except KeyboardInterrupt:
                self.pressed.set()
            except ValueError:  # without a complete trial, there is no best one
                if not self.pressed.is_set() or self._has_best():
                    raise
            finally:
                optuna.logging.set_verbosity(verbosity)
        interrupted = self.pressed.is_set()
        if self._has_best():
            self._write_best(best)
        if kept is not None and self.study is not None and _finished(self.study) >= cast(int, self.max_total_trials):
            kept.unlink(missing_ok=True)
        elif interrupted or kept is not None:  # without an interruption, another process runs the same search
            print(f"The search {'was interrupted' if interrupted else 'is not finished'}; {self._to_continue(kept)}")
        if interrupted:
            raise KeyboardInterrupt

    @contextlib.contextmanager
    def _told_disk(self, kept: Path | None) -> Iterator[None]:
        """Say what is wrong with the disk. Optuna raises an AssertionError from it, "Should not reach."."""
        try:
            yield
        except (AssertionError, OSError) as error:
            cause = error if isinstance(error, OSError) else error.__context__
            if not isinstance(cause, OSError) or (remedy := remedy_of(cause)) is None:
                raise
            said = f"{cause.strerror}: {remedy}, then {self._to_continue(kept)}"
            raise OSError(cause.errno, said, cause.filename or self.storage) from cause

    def _to_continue(self, kept: Path | None) -> str:
        """:return: how to continue the search"""
        if kept is not None:
            return f"repeat the command to continue. Its trials are in {kept}."
        if self.study_name is None and self.study is not None:
            return f"repeat the command with --study-name {self.study.study_name} to continue."
        return "repeat the command to continue."

    def _has_best(self) -> bool:
        """:return: whether this worker tried something, and a trial is complete"""
        return self.study is not None and bool(self.study.get_trials(deepcopy=False, states=[TrialState.COMPLETE]))

    def _write_best(self, path: Path) -> None:
        assert self.study is not None
        params = self._arguments_of(self.study.best_trial)
        with atomic_write(path, "yml") as file:
            file.write(yaml.safe_dump({self.env_name.gym_id: as_yaml(update(self.recipe, params))}).encode())
        tell_best(self.algo, self.env_name.gym_id, path)

    def _search_settings(self) -> tuple[Any, ...]:
        # The seed as given: the repeated command would get another one from rl_zoo3, and start again
        names = (
            "algo",
            "given_seed",
            "n_timesteps",
            "n_trials",
            "max_total_trials",
            "n_startup_trials",
            "n_evaluations",
        )
        return tuple(getattr(self, name) for name in (*names, "n_eval_episodes", "n_eval_envs", "sampler", "pruner"))

    def _bring_back(self) -> optuna.Study | None:
        """Open the storage and, if it has a name, the study, and queue trials of killed processes again."""
        assert self.storage is not None
        if self.storage.endswith(".log"):
            Path(self.storage).parent.mkdir(parents=True, exist_ok=True)
        storage = open_storage(self.storage)
        if self.study_name is None:  # Optuna will generate one
            return None
        study = optuna.create_study(
            storage=storage, study_name=self.study_name, direction="maximize", load_if_exists=True
        )
        check_trials(study, self.storage)
        count, finished = bring_back(study), _finished(study)
        enlist(study)
        if finished or count:
            print(f"The search continues after {finished} finished trials; {count} killed trials are repeated.")
        return study

    def objective(self, trial: optuna.Trial) -> float:
        """
        Train with the hyperparameters of a trial.

        :param trial: trial to sample hyperparameters for
        :return: mean reward of the last evaluation
        """
        try:
            return self._value(trial)
        except optuna.TrialPruned:
            raise
        except BaseException:
            if not self.pressed.is_set():
                raise
            optuna.logging.set_verbosity(optuna.logging.ERROR)  # a warning would show the traceback
            raise KeyboardInterrupt from None

    def _value(self, trial: optuna.Trial) -> float:
        self.study = trial.study
        sign(trial)
        env = self.create_envs(self.n_envs, no_log=True)
        eval_env = self.create_envs(self.n_eval_envs, eval_env=True)
        try:
            arguments = {
                "using_her_replay_buffer": self._hyperparams.get("replay_buffer_class") == HerReplayBuffer,
                "her_kwargs": self._hyperparams.get("replay_buffer_kwargs", {}),
                "env": env,
                "hyperparams": self._hyperparams,
                "policy_arguments": arguments_of(policy_class(self.algo, self._hyperparams["policy"]) or BasePolicy),
            }
            sampled = HYPERPARAMS_SAMPLER[self.algo](trial, self.n_actions, self.n_envs, arguments)
            model = ALGOS[self.algo](
                env=env,
                seed=None,  # as in rl_zoo3, so that trials differ
                verbose=self.verbose if self.verbose >= 2 else 0,
                device=self.device,
                **update(self._hyperparams, sampled),
            )
            evaluation = self._trial_evaluation(trial, eval_env, env.num_envs)
            callbacks = get_callback_list({"callback": self.specified_callbacks})
            try:
                self.learns = True
                if self.pressed.is_set():
                    raise KeyboardInterrupt
                model.learn(self.n_timesteps, callback=[*callbacks, evaluation])
            except (AssertionError, ValueError) as error:
                if not diverged(model):
                    raise
                print(f"Trial {trial.number} diverged with {sampled}: {error}")
                raise optuna.TrialPruned from error
            finally:
                self.learns = False
        finally:
            env.close()
            eval_env.close()
        if evaluation.is_pruned:
            raise optuna.TrialPruned
        return evaluation.last_mean_reward

    def _trial_evaluation(self, trial: optuna.Trial, eval_env: VecEnv, n_envs: int) -> TrialEvalCallback:
        path = None
        if self.optimization_log_path is not None:
            path = str(Path(self.optimization_log_path, f"trial_{trial.number}"))
        return TrialEvalCallback(
            eval_env,
            trial,
            best_model_save_path=path,
            log_path=path,
            n_eval_episodes=self.n_eval_episodes,
            eval_freq=max(self.n_timesteps // self.n_evaluations // n_envs, 1),
            deterministic=self.deterministic_eval,
        )

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        """
        Save the model and remove checkpoints that are no longer needed.

        :param model: the trained model
        :raises KeyboardInterrupt: after that, if the training was interrupted
        """
        super().save_trained_model(model)
        if self.checkpoint is not None and model.num_timesteps >= model._total_timesteps:  # not interrupted
            shutil.rmtree(self.checkpoint.folder, ignore_errors=True)
        if model.ep_info_buffer:
            rewards = [episode["r"] for episode in model.ep_info_buffer]
            print(f"Mean reward: {safe_mean(rewards):.4g} in the last {len(rewards)} episodes of training")
        print(f"Model:       {self.save_path}/{self.env_name}.zip")
        print(f"Logs:        {self.save_path}")
        if self.tensorboard_log:
            print(f"TensorBoard: tensorboard --logdir {self.tensorboard_log}")
        if self.interrupted:
            raise KeyboardInterrupt


class _Replaying:
    """Wrapper class for ``make_vec_env`` that applies ``Replayable`` before the recipe's wrapper."""

    def __init__(self, outer: Callable[[gymnasium.Env], gymnasium.Env] | None):
        self.outer = outer

    def __call__(self, env: gymnasium.Env) -> gymnasium.Env:
        env = Replayable(env)
        return env if self.outer is None else self.outer(env)


class RegularTables(LogEveryNTimesteps):
    """Logs a table and a point of each curve every ``n_steps`` timesteps and at the end."""

    def _on_training_start(self) -> None:
        self.last_time_trigger = self.num_timesteps  # a continued training keeps its step count

    def _on_training_end(self) -> None:
        self.num_timesteps = self.model.num_timesteps
        if self.num_timesteps > self.last_time_trigger:
            self._on_event()


def claim_folder(prefix: str, first: int, suffix: str = "") -> Path:
    """
    Create a new folder ``PREFIX_NUMBER``, also if several processes do so at the same time.

    :param prefix: path without the number
    :param first: lowest number
    :param suffix: text after the number
    :return: path of the folder
    """
    Path(prefix).parent.mkdir(parents=True, exist_ok=True)
    for number in itertools.count(first):
        folder = Path(f"{prefix}_{number}{suffix}")
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        return folder
    raise AssertionError  # there is always another number


def as_yaml(recipe: dict[str, Any]) -> dict[str, Any]:
    """
    :param recipe: a recipe, which may hold classes of ``torch.nn``
    :return: the recipe, where values that YAML cannot hold are text for ``parse_literal``
    """
    plain = {}
    for key, value in recipe.items():
        try:
            yaml.safe_dump(value)
            plain[key] = value
        except yaml.YAMLError:
            plain[key] = format_literal(value)
    return plain


def _finished(study: optuna.Study) -> int:
    return len(study.get_trials(deepcopy=False, states=[TrialState.COMPLETE, TrialState.PRUNED]))


def _make_tables(url: str) -> None:
    """Create the tables of a study in a database, with retries if several workers do so at the same time."""
    for attempt in range(20):
        try:
            optuna.storages.RDBStorage(url)
        except DBAPIError as error:
            if attempt == 19:
                raise _no_database(url, error) from error
            time.sleep(0.25)
        else:
            return


def _no_database(url: str, error: DBAPIError) -> ValueError:
    return ValueError(f"--storage {url} cannot be opened: {' '.join(str(error.orig).split())}.")


def update(hyperparams: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """
    Merge the changes of a trial over a recipe, including the arguments of the policy.

    :param hyperparams: hyperparameters of a recipe
    :param changes: hyperparameters of a trial
    :return: the merged hyperparameters
    """
    changed = {**hyperparams, **changes}
    policy_kwargs = hyperparams.get("policy_kwargs") or {}
    if isinstance(policy_kwargs, str):  # text of a recipe
        policy_kwargs = parse_literal(policy_kwargs)
    if "policy_kwargs" in changes:
        changed["policy_kwargs"] = {**policy_kwargs, **changes["policy_kwargs"]}
    return changed


def diverged(model: BaseAlgorithm) -> bool:
    """
    :param model: a model after an error
    :return: whether a weight of its networks is NaN or infinite
    """
    return any(not weight.isfinite().all() for weight in model.policy.parameters())
