"""rl_zoo3's experiment manager, with its known faults around environment arguments and resuming mended."""

import inspect
from typing import Any

import gymnasium
import optuna
from gymnasium.envs.registration import load_env_creator
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.utils import ALGOS
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from sb3_maddpg import parallel
from sb3_maddpg.utils import describe_env, suggest
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
COMMAND_LINE = {"self", "env", "tensorboard_log", "seed", "verbose", "device", "_init_setup_model"}

# Off-policy algorithms log every so many episodes, unless --log-interval says otherwise; SB3's four fill the screen.
LOG_EPISODES = 20

NET_ARCHS = {"small": [64, 64], "medium": [128, 128], "large": [256, 256]}


class TeamExperimentManager(ExperimentManager):
    """
    - ``--env-kwargs`` are merged over the recipe's ``env_kwargs``, and both reach the evaluation environment, there
      with ``eval_env_kwargs`` and ``--eval-env-kwargs`` merged over them;
    - unknown keys are refused, with the nearest known one;
    - ``vec_env: gymnasium`` takes the environment's own Gymnasium vector environment, see ``GymnasiumVecEnv``;
    - every model, not only MADDPG's, carries the environment it was trained in as ``env_spec``;
    - resuming (``-i``) goes on with the counters, the schedules and without a second random warm-up.
    """

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        # rl_zoo3 would replace the recipe's arguments by these
        given, self.env_kwargs = self.env_kwargs, {}
        hyperparams, _ = super().read_hyperparameters()
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

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """
        :param n_envs: number of environments
        :param eval_env: whether they are for evaluation
        :param no_log: write no monitor file
        """
        if eval_env or not self.own_vec_env:
            return super().create_envs(n_envs, eval_env, no_log)
        envs = gymnasium.make_vec(self.env_name.gym_id, num_envs=n_envs, **self.env_kwargs)
        env = VecMonitor(GymnasiumVecEnv(envs), None if no_log else f"{self.save_path}/0")
        env.seed(self.seed)
        return self._maybe_normalize(env, eval_env)

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: Any) -> BaseAlgorithm:
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

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        """
        :param model: the trained model
        """
        super().save_trained_model(model)
        print(f"Model:       {self.save_path}/{self.env_name}.zip")
        print(f"Logs:        {self.save_path}")
        if self.tensorboard_log:
            print(f"TensorBoard: tensorboard --logdir {self.tensorboard_log}")


def check_keys(algo: str, hyperparams: dict[str, Any]) -> None:
    """
    Refuse a recipe with keys that nothing reads.

    :param algo: name of the algorithm
    :param hyperparams: the recipe
    """
    arguments = inspect.signature(ALGOS[algo].__init__).parameters
    known = ZOO_KEYS | (set(arguments) - COMMAND_LINE)
    for key in hyperparams:
        if key not in known:
            raise ValueError(suggest(f"key in the recipe for {algo}", key, known))
    policy = ALGOS[algo].policy_aliases.get(hyperparams.get("policy", ""))
    policy_kwargs = hyperparams.get("policy_kwargs")
    if policy is not None and isinstance(policy_kwargs, dict):
        known = set(inspect.signature(policy.__init__).parameters)
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


def sample_maddpg_params(
    trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """
    Sampler for MADDPG hyperparameters.

    :param trial: of the study
    :param n_actions: unused, as the following, but part of rl_zoo3's interface
    :param n_envs: unused
    :param additional_args: unused
    :return: arguments of the algorithm
    """
    trial.suggest_float("learning_rate", 1e-4, 2e-2, log=True)
    trial.suggest_categorical("batch_size", [256, 512, 1024, 2048])
    trial.suggest_float("tau", 1e-3, 5e-2, log=True)
    trial.suggest_float("one_minus_gamma", 1e-3, 1e-1, log=True)
    trial.suggest_categorical("net_arch", list(NET_ARCHS))
    trial.suggest_categorical("estimator", ["expected", "straight_through", "score"])
    trial.suggest_float("policy_regularization", 1e-5, 1e-2, log=True)
    return convert_maddpg_params(trial.params)


def convert_maddpg_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: parameters of a trial
    :return: arguments of the algorithm
    """
    params = dict(sampled_params)
    params["gamma"] = 1 - params.pop("one_minus_gamma")
    params["policy_kwargs"] = {"net_arch": NET_ARCHS[params.pop("net_arch")]}
    return params
