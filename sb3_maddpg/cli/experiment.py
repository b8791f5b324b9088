"""rl_zoo3's experiment manager, with its known faults around environment arguments, resuming and tuning mended."""

import functools
import inspect
import time
import warnings
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import gymnasium
import optuna
import rl_zoo3.exp_manager
from gymnasium.envs.registration import load_env_creator
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from rl_zoo3.callbacks import TrialEvalCallback
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import ALGOS, get_callback_list, get_class_by_name
from sqlalchemy.exc import DBAPIError
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from sb3_maddpg import MADDPG, parallel
from sb3_maddpg.callbacks import DashboardCallback
from sb3_maddpg.team import Team
from sb3_maddpg.utils import arguments_of, describe_env, suggest
from sb3_maddpg.vec_env import GymnasiumVecEnv

# Keys of a recipe that rl_zoo3 uses up itself; every other key is an argument of the algorithm.
ZOO_KEYS = {
    "callback",
    "env_kwargs",
    "env_wrapper",
    "eval_env_kwargs",
    "frame_stack",
    "monitor_kwargs",
    "n_envs",
    "n_timesteps",
    "noise_std",
    "noise_type",
    "normalize",
    "policy",
    "vec_env",
    "vec_env_wrapper",
}
# Arguments of the algorithm that the command line gives.
COMMAND_LINE = {"env", "tensorboard_log", "seed", "verbose", "device", "_init_setup_model"}
# Arguments of the policy that the algorithm gives.
OF_ALGORITHM = {"observation_space", "action_space", "lr_schedule"}

# Off-policy algorithms log every so many episodes, unless --log-interval says otherwise; SB3's four fill the screen.
LOG_EPISODES = 20


class TeamExperimentManager(ExperimentManager):
    """
    - ``--env-kwargs`` are merged over the recipe's ``env_kwargs``, and both reach the evaluation environment, there
      with ``eval_env_kwargs`` and ``--eval-env-kwargs`` merged over them;
    - unknown keys are refused, with the nearest known one;
    - ``vec_env: gymnasium`` takes the environment's own Gymnasium vector environment, see ``GymnasiumVecEnv``;
    - ``replay_buffer_class`` can be a dotted path, as ``policy`` can;
    - every model, not only MADDPG's, carries the environment it was trained in as ``env_spec``;
    - resuming (``-i``) goes on with the counters, the schedules and without a second random warm-up; with a team of
      another size a ``PairPolicy`` goes on with its networks alone;
    - ``--trial-id`` takes any trial of a study, also the first, whose number is 0;
    - tuning (``-optimize``) keeps the recipe's other ``policy_kwargs``, leaves no run folder behind and draws other
      hyperparameters in each worker of a study. A trial is pruned if its networks diverged; any other error ends the
      search, instead of being counted as a bad trial.
    """

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        # rl_zoo3 would replace the recipe's arguments by these
        given, self.env_kwargs = self.env_kwargs, {}
        # and would take no trial for trial 0
        trial_id, self.trial_id = self.trial_id, None
        hyperparams, _ = super().read_hyperparameters()
        if trial_id is not None:
            of_trial = self._read_trial(trial_id)
            print(f"Hyperparameters of trial {trial_id} of {self.study_name}: {of_trial}")
            hyperparams = {**update(hyperparams, of_trial), **(self.custom_hyperparams or {})}
        check_keys(self.algo, hyperparams)
        if hyperparams.get("noise_type") is None:
            hyperparams.pop("noise_type", None)
            hyperparams.pop("noise_std", None)
        self.own_vec_env = self._read_vec_env(hyperparams)
        env_kwargs = {**(hyperparams.get("env_kwargs") or {}), **given}
        eval_env_kwargs = {**(hyperparams.pop("eval_env_kwargs", None) or {}), **(self._eval_env_kwargs_args or {})}
        self.eval_env_kwargs = {**env_kwargs, **eval_env_kwargs}
        hyperparams["env_kwargs"] = env_kwargs
        saved = {**hyperparams, "eval_env_kwargs": eval_env_kwargs}
        if self.own_vec_env:
            saved["vec_env"] = "gymnasium"
        check_env_kwargs(self.env_name.gym_id, self.eval_env_kwargs)
        buffer = hyperparams.get("replay_buffer_class")
        if isinstance(buffer, str) and "." in buffer:  # other names are for rl_zoo3
            hyperparams["replay_buffer_class"] = _import_buffer(buffer)
        return hyperparams, dict(sorted(saved.items()))

    def _read_vec_env(self, hyperparams: dict[str, Any]) -> bool:
        """Whether training steps the environment's own vector environment."""
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
                f"vec_env: gymnasium in the recipe does not go with {', '.join(sorted(wrappers))}: leave one out."
            )
        return vec_env is not None

    def _read_trial(self, trial_id: int) -> dict[str, Any]:
        """The arguments of the algorithm in a trial of the study that ``--storage`` and ``--study-name`` name."""
        if not self.storage or not self.study_name:
            raise ValueError(f"--trial-id {trial_id} needs to know of which study: give --storage and --study-name.")
        storage: Any = self.storage
        if self.storage.endswith(".log"):
            if not Path(self.storage).is_file():  # optuna would make an empty one
                raise FileNotFoundError(f"There is no file {self.storage}.")
            storage = JournalStorage(JournalFileBackend(self.storage))
        try:
            study = optuna.load_study(storage=storage, study_name=self.study_name)
        except KeyError:
            names = optuna.get_all_study_names(storage)
            raise ValueError(suggest(f"study in {self.storage}", self.study_name, names)) from None
        for trial in study.get_trials(deepcopy=False):
            if trial.number == trial_id:
                return HYPERPARAMS_CONVERTER[self.algo](trial.params)
        raise ValueError(f"Study {self.study_name} has no trial {trial_id}, only {len(study.trials)}, counted from 0.")

    def create_log_folder(self) -> None:
        """Make the run's folder; a search has none, each trial's log goes to ``--optimization-log-path``."""
        if not self.optimize_hyperparameters:
            super().create_log_folder()

    def create_callbacks(self) -> None:
        """rl_zoo3's, and what TensorBoard shows beside the curves."""
        super().create_callbacks()
        if not self.tensorboard_log or self.optimize_hyperparameters:
            return
        offers = entry_points(group="sb3_maddpg.dashboards")
        name = self.env_name.gym_id
        offer = offers[name].load() if name in offers.names else None
        evaluation = next((one for one in self.callbacks if isinstance(one, EvalCallback)), None)
        if evaluation is None:  # no pictures either
            self.callbacks.append(DashboardCallback(layout=offer and offer.LAYOUT))
            return
        draw = offer and functools.partial(offer.draw, env_kwargs=self.eval_env_kwargs)
        evaluation.callback = DashboardCallback(draw, offer and offer.LAYOUT)
        evaluation.callback.parent = evaluation

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """
        :param n_envs: number of environments
        :param eval_env: whether they are for evaluation
        :param no_log: write no monitor file
        """
        no_log = no_log or self.optimize_hyperparameters
        if eval_env or not self.own_vec_env:
            return super().create_envs(n_envs, eval_env, no_log)
        envs = gymnasium.make_vec(self.env_name.gym_id, num_envs=n_envs, **self.env_kwargs)
        env = VecMonitor(GymnasiumVecEnv(envs), None if no_log else f"{self.save_path}/0")
        env.seed(self.seed)
        return self._maybe_normalize(env, eval_env)

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: Any) -> BaseAlgorithm:
        algorithm = ALGOS[self.algo]
        if hyperparams.get("policy") == "PairPolicy" and issubclass(algorithm, MADDPG):
            team = algorithm.load(self.trained_agent, device=self.device).policy.team.n_agents
            new = Team.from_spaces(env.observation_space, env.action_space).n_agents
            if team != new:
                # Its parameters fit any size of team, its counters and its memory do not
                resized = algorithm(
                    env=env, tensorboard_log=self.tensorboard_log, seed=self.seed, verbose=self.verbose, **hyperparams
                )
                resized.set_parameters(self.trained_agent)
                print(f"Going on with a team of {new} instead of {team}, from step 0")
                return resized
        model = super()._load_pretrained_agent(hyperparams, env)
        print(f"Continuing at step {model.num_timesteps}")
        buffer = getattr(model, "replay_buffer", None)
        if buffer is not None and buffer.size() == 0:
            print("There is no replay_buffer.pkl beside the model (see --save-replay-buffer): memory starts empty.")
        return model

    def learn(self, model: BaseAlgorithm) -> None:
        """
        :param model: a new or a loaded model
        """
        assert model.env is not None
        model.env_spec = describe_env(model.env)  # type: ignore[attr-defined]
        kwargs: dict[str, Any] = {}
        if self.log_interval != -1:
            kwargs["log_interval"] = max(self.log_interval, 0) or None
        elif isinstance(model, OffPolicyAlgorithm):
            kwargs["log_interval"] = LOG_EPISODES
        try:
            with warnings.catch_warnings():
                # Evaluation goes episode by episode, whatever steps the training
                warnings.filterwarnings("ignore", "Training and eval env are not of the same type")
                model.learn(
                    self.n_timesteps,
                    callback=self.callbacks or None,
                    reset_num_timesteps=not self.continue_training,
                    **kwargs,
                )
        except KeyboardInterrupt:
            print("Interrupted: saving what has been learned so far.")
            for callback in self.callbacks:  # closes the progress bar
                callback.on_training_end()
        finally:
            assert model.env is not None
            model.env.close()

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
        if self.storage is not None:
            sampler.reseed_rng()  # workers with one --seed, or a search that is continued, would repeat trials
        return sampler

    def hyperparameters_optimization(self) -> None:
        """Search, alone or with other workers."""
        if self.storage is not None and not self.storage.endswith(".log"):
            _make_tables(self.storage)
        super().hyperparameters_optimization()

    def objective(self, trial: optuna.Trial) -> float:
        """
        :param trial: to choose hyperparameters for
        :return: last mean reward of the evaluation
        """
        env = self.create_envs(self.n_envs, no_log=True)
        eval_env = self.create_envs(self.n_eval_envs, eval_env=True)
        try:
            arguments = {
                "using_her_replay_buffer": self._hyperparams.get("replay_buffer_class") == HerReplayBuffer,
                "her_kwargs": self._hyperparams.get("replay_buffer_kwargs", {}),
                "env": env,
                "hyperparams": self._hyperparams,
                "policy_arguments": arguments_of(_policy(self.algo, self._hyperparams["policy"]) or BasePolicy),
            }
            sampled = HYPERPARAMS_SAMPLER[self.algo](trial, self.n_actions, self.n_envs, arguments)
            model = ALGOS[self.algo](
                env=env,
                seed=None,  # as in rl_zoo3: each trial draws other numbers
                verbose=self.verbose if self.verbose >= 2 else 0,
                device=self.device,
                **update(self._hyperparams, sampled),
            )
            evaluation = self._trial_evaluation(trial, eval_env)
            callbacks = get_callback_list({"callback": self.specified_callbacks})
            try:
                model.learn(self.n_timesteps, callback=[*callbacks, evaluation])
            except (AssertionError, ValueError) as error:
                if not diverged(model):
                    raise
                print(f"Trial {trial.number} diverged with {sampled}: {error}")
                raise optuna.TrialPruned from error
        finally:
            env.close()
            eval_env.close()
        if evaluation.is_pruned:
            raise optuna.TrialPruned
        return evaluation.last_mean_reward

    def _trial_evaluation(self, trial: optuna.Trial, eval_env: VecEnv) -> TrialEvalCallback:
        path = None
        if self.optimization_log_path is not None:
            path = str(Path(self.optimization_log_path, f"trial_{trial.number}"))
        return TrialEvalCallback(
            eval_env,
            trial,
            best_model_save_path=path,
            log_path=path,
            n_eval_episodes=self.n_eval_episodes,
            eval_freq=max(self.n_timesteps // self.n_evaluations // self.n_envs, 1),
            deterministic=self.deterministic_eval,
        )

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        """
        :param model: the trained model
        """
        super().save_trained_model(model)
        print(f"Model:       {self.save_path}/{self.env_name}.zip")
        print(f"Logs:        {self.save_path}")
        if self.tensorboard_log:
            print(f"TensorBoard: tensorboard --logdir {self.tensorboard_log}")


def _make_tables(url: str) -> None:
    """Those of a study in a database. Workers that start together get in each other's way here, and only here."""
    for attempt in range(20):
        try:
            optuna.storages.RDBStorage(url)
        except DBAPIError:
            if attempt == 19:
                raise
            time.sleep(0.25)
        else:
            return


def update(hyperparams: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """
    :param hyperparams: of a recipe
    :param changes: of a trial
    :return: both, the changes over the recipe, also among the arguments of the policy
    """
    changed = {**hyperparams, **changes}
    policy_kwargs = hyperparams.get("policy_kwargs") or {}
    if isinstance(policy_kwargs, str):  # as rl_zoo3 does it, which comes to it only later
        policy_kwargs = eval(policy_kwargs, vars(rl_zoo3.exp_manager))
    if "policy_kwargs" in changes:
        changed["policy_kwargs"] = {**policy_kwargs, **changes["policy_kwargs"]}
    return changed


def diverged(model: BaseAlgorithm) -> bool:
    """
    :param model: after an error
    :return: whether a network has a weight that is no number
    """
    return any(not weight.isfinite().all() for weight in model.policy.parameters())


def _policy(algo: str, name: str | type[BasePolicy]) -> type[BasePolicy] | None:
    """The policy that a recipe names, or None for a dotted path, which rl_zoo3 imports later."""
    return ALGOS[algo].policy_aliases.get(name) if isinstance(name, str) else name


def _import_buffer(name: str) -> type[ReplayBuffer]:
    """The replay buffer that a recipe names by a dotted path."""
    try:
        return get_class_by_name(name)
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f"replay_buffer_class: {name} in the recipe cannot be imported ({error}). Give the dotted path of a class, "
            "such as sb3_maddpg.PrioritizedTeamReplayBuffer."
        ) from error


def check_keys(algo: str, hyperparams: dict[str, Any]) -> None:
    """
    Refuse a recipe with keys that nothing reads.

    :param algo: name of the algorithm
    :param hyperparams: the recipe
    """
    known = ZOO_KEYS | (arguments_of(ALGOS[algo]) - COMMAND_LINE)
    for key in hyperparams:
        if key not in known:
            raise ValueError(suggest(f"key in the recipe for {algo}", key, known))
    policy = _policy(algo, hyperparams.get("policy", ""))
    policy_kwargs = hyperparams.get("policy_kwargs")
    if policy is not None and isinstance(policy_kwargs, dict):
        known = arguments_of(policy) - OF_ALGORITHM
        for key in policy_kwargs:
            if key not in known:
                raise ValueError(suggest(f"key in policy_kwargs for {algo}", key, known))


def check_env_kwargs(env_id: str, env_kwargs: dict[str, Any]) -> None:
    """
    Refuse arguments that the environment does not take.

    :param env_id: Gymnasium id
    :param env_kwargs: from the recipe and the command line
    """
    known = _env_arguments(env_id)
    for key in env_kwargs:
        if known is not None and key not in known:
            raise ValueError(suggest(f"argument of {env_id}", key, known))


def _env_arguments(env_id: str) -> set[str] | None:
    """Names of the arguments an environment takes, or None if it takes any."""
    spec = gymnasium.spec(env_id)
    if spec.entry_point == parallel.ENTRY_POINT:
        return parallel.arguments(spec.kwargs["entry"])
    creator = load_env_creator(spec.entry_point) if isinstance(spec.entry_point, str) else spec.entry_point
    if creator is None:
        return None
    parameters = inspect.signature(creator).parameters.values()
    if any(parameter.kind is inspect.Parameter.VAR_KEYWORD for parameter in parameters):
        return None
    return {parameter.name for parameter in parameters}
