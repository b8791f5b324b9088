"""``sb3-maddpg tune``: a search for hyperparameters with Optuna, alone or with other workers."""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import optuna
import yaml
from optuna.study import MaxTrialsCallback
from optuna.trial import TrialState
from sqlalchemy.exc import DBAPIError
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import EvalCallback

from sb3_maddpg.cli.algorithms import ALGORITHMS
from sb3_maddpg.cli.environments import is_stochastic
from sb3_maddpg.cli.experiment import Experiment, begin, given_recipe, merged
from sb3_maddpg.cli.options import check_writable
from sb3_maddpg.cli.recipe import callbacks_of, policy_class
from sb3_maddpg.cli.safety import as_yaml, check_names
from sb3_maddpg.cli.search import (
    STUDY,
    as_absolute,
    best_recipe,
    check_trials,
    kept_search,
    mark_owner,
    open_storage,
    register_worker,
    retry_lost_trials,
    search,
    tell_best,
)
from sb3_maddpg.cli.terminal import aligned, tell
from sb3_maddpg.cli.tuning import SPACES, Searched, convert_params
from sb3_maddpg.common.evaluation import MEAN_REWARD
from sb3_maddpg.errors import InvalidArgumentError, InvalidFileError
from sb3_maddpg.files.model_files import trusted
from sb3_maddpg.starting import uninterrupted
from sb3_maddpg.utils import arguments_of, atomic_write, remedy_of, shown, suggest, told

# Trials that count towards the maximum. Those that run do too: otherwise each worker could start one too many.
_COUNTED = (TrialState.COMPLETE, TrialState.RUNNING, TrialState.PRUNED)
_FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)
MOST_SHOWN = 4  # trials in the table of the best ones
# What the trials of a search without a storage depend on
_SETTINGS = (
    *("algo", "n_timesteps", "n_trials", "max_total_trials", "n_startup_trials", "n_evaluations", "eval_episodes"),
    *("n_eval_envs", "sampler", "pruner"),
)


def tune(args: argparse.Namespace, words: list[str]) -> int:
    """
    Search hyperparameters, and write the best trial as a recipe.

    :param args: options of ``tune``
    :param words: the options as they were given
    :return: exit status
    :raises KeyboardInterrupt: after that, if the search was interrupted
    """
    if args.algo not in SPACES:
        raise InvalidArgumentError(suggest("algorithm with a search space", args.algo, SPACES))
    if args.best_by != MEAN_REWARD:
        raise InvalidArgumentError("--best-by is an option of train: trials are compared by the team's mean return.")
    if args.jobs not in (None, 1) or args.engine != "local" or args.address is not None:
        return search(args, words)
    given_seed = None if args.seed < 0 else args.seed  # a repeated command would draw another one
    begin(args)
    Search(args, Experiment(args, *given_recipe(args)), given_seed).run()
    return 0


class Search:
    """
    A search of one worker.

    :param args: options of ``tune``
    :param experiment: the recipe whose hyperparameters are searched
    :param given_seed: value of ``--seed``
    """

    def __init__(self, args: argparse.Namespace, experiment: Experiment, given_seed: int | None):
        self.args, self.experiment = args, experiment
        self.folder = Path(args.log_folder, args.algo)
        self.n_evaluations = args.n_evaluations or max(1, experiment.n_timesteps // 100_000)
        self.kept: Path | None = None
        self.storage, self.study_name, self.most = args.storage, args.study_name, args.max_total_trials
        if args.storage is None:
            settings = (experiment.recipe, given_seed, *(getattr(args, key) for key in _SETTINGS))
            self.kept = kept_search(self.folder, experiment.name, settings)
            self.storage, self.study_name = str(self.kept), STUDY
            self.most = args.max_total_trials or args.n_trials
        elif not args.storage.endswith(".log"):
            _make_tables(args.storage)
        self.storage = as_absolute(self.storage)
        # Otherwise workers with the same --seed and continued searches would repeat trials
        self.draws_anew = self.kept is None or self.kept.is_file()
        self.study: optuna.Study | None = None
        self._interruptible: Callable[[], contextlib.AbstractContextManager[None]] = contextlib.nullcontext

    def run(self) -> None:
        """
        Search until all trials are finished, and write the best one.

        :raises KeyboardInterrupt: after that, if the search was interrupted
        """
        best = best_recipe(self.folder, self.experiment.name)
        check_writable(best)
        verbosity, interrupted = optuna.logging.get_verbosity(), False
        optuna.logging.set_verbosity(optuna.logging.WARNING)  # `_tell` is shorter
        try:
            with self._told_disk():
                self.study = self._open()
                self._optimize(self.study)
        except KeyboardInterrupt:
            interrupted = True
        finally:
            optuna.logging.set_verbosity(verbosity)
        study = self.study
        if study is not None and study.get_trials(deepcopy=False, states=[TrialState.COMPLETE]):
            self._report(study)
            self._write_best(study, best)
        elif not interrupted:
            raise ValueError("No trials are completed yet: all were pruned, or diverged.")
        if study is not None and self.kept is not None and _count(study, _FINISHED) >= self.most:
            self.kept.unlink(missing_ok=True)
        elif interrupted or self.kept is not None:  # without an interruption, another process runs the same search
            print(f"The search {'was interrupted' if interrupted else 'is not finished'}; {self._to_continue()}")
        if interrupted:
            raise KeyboardInterrupt

    def _open(self) -> optuna.Study:
        """:return: the study, where trials of killed processes are queued again"""
        if self.storage.endswith(".log"):
            Path(self.storage).parent.mkdir(parents=True, exist_ok=True)
        storage = open_storage(self.storage)
        study = optuna.create_study(
            sampler=self._sampler(),
            pruner=self._pruner(),
            storage=storage,
            study_name=self.study_name,
            load_if_exists=True,
            direction="maximize",
        )
        if self.study_name is None:
            print(f"Study {study.study_name}")
            return study
        check_trials(study, self.storage)
        count, finished = retry_lost_trials(study), _count(study, _FINISHED)
        register_worker(study)
        if finished or count:
            print(f"The search continues after {finished} finished trials; {count} killed trials are repeated.")
        return study

    def _optimize(self, study: optuna.Study) -> None:
        limits: dict[str, Any] = {"n_trials": self.args.n_trials}
        callbacks: list[Callable[[optuna.Study, optuna.trial.FrozenTrial], None]] = [self._tell]
        if self.most is not None:
            if _count(study, _COUNTED) >= self.most:
                return
            limits = {}
            callbacks.append(MaxTrialsCallback(self.most, states=_COUNTED))
        # An interrupt within Optuna itself raises another error there; threads of several jobs have none
        held = uninterrupted() if self.args.n_jobs == 1 else contextlib.nullcontext(contextlib.nullcontext)
        # Without collecting garbage, environments and models of finished trials stay in memory
        with held as self._interruptible:
            study.optimize(self._objective, n_jobs=self.args.n_jobs, gc_after_trial=True, callbacks=callbacks, **limits)

    def _tell(self, study: optuna.Study, trial: optuna.trial.FrozenTrial) -> None:
        """Print a line about a finished trial."""
        finished, most = _count(study, _FINISHED), self.most or self.args.n_trials
        seconds = f", {trial.duration.total_seconds():.0f} s" if trial.duration is not None else ""
        outcome = "failed"
        if trial.state == TrialState.PRUNED:
            outcome = "pruned"
        elif trial.value is not None:
            best = study.best_trial
            outcome = f"{trial.value:.4g}" + (
                ", the best so far" if best.number == trial.number else f" (best {best.value:.4g}, trial {best.number})"
            )
        tell(f"trial {trial.number}, {finished} of {most}: {outcome}{seconds}")

    def _sampler(self) -> optuna.samplers.BaseSampler:
        sampler: optuna.samplers.BaseSampler
        if self.args.sampler == "tpe":
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
                # In groups, because some hyperparameters exist only with certain values of others
                sampler = optuna.samplers.TPESampler(
                    n_startup_trials=self.args.n_startup_trials, seed=self.args.seed, multivariate=True, group=True
                )
        elif self.args.sampler == "random":
            sampler = optuna.samplers.RandomSampler(seed=self.args.seed)
        else:
            import optunahub

            sampler = optunahub.load_module("samplers/auto_sampler").AutoSampler(seed=self.args.seed)
        if self.draws_anew:
            sampler.reseed_rng()
        return sampler

    def _pruner(self) -> optuna.pruners.BasePruner:
        if self.args.pruner == "halving":
            return optuna.pruners.SuccessiveHalvingPruner(1, reduction_factor=4, min_early_stopping_rate=0)
        if self.args.pruner == "median":
            return optuna.pruners.MedianPruner(self.args.n_startup_trials, n_warmup_steps=self.n_evaluations // 3)
        return optuna.pruners.NopPruner()

    def _objective(self, trial: optuna.Trial) -> float:
        """:return: mean return of the last evaluation"""
        try:
            with self._interruptible():
                return self._value(trial)
        except KeyboardInterrupt:
            optuna.logging.set_verbosity(optuna.logging.ERROR)  # a warning would show the traceback
            raise

    def _value(self, trial: optuna.Trial) -> float:
        mark_owner(trial)
        experiment, environments, args = self.experiment, self.experiment.environments, self.args
        env = environments.make(experiment.n_envs, experiment.env_kwargs)
        eval_env = environments.make(args.n_eval_envs, experiment.eval_env_kwargs, evaluates=True)
        try:
            hyperparams = experiment.arguments(env)
            policy = policy_class(args.algo, hyperparams["policy"])
            names = set() if policy is None else arguments_of(policy)
            sampled = SPACES[args.algo](trial, Searched(env, hyperparams, names, experiment.n_envs))
            # Without a seed, so that trials differ
            model = experiment.new_model(
                env, verbose=args.verbose if args.verbose >= 2 else 0, **merged(hyperparams, sampled)
            )
            path = None
            if args.optimization_log_path is not None:
                path = str(Path(args.optimization_log_path, f"trial_{trial.number}"))
            evaluation = _TrialEvaluation(
                trial,
                eval_env,
                best_model_save_path=path,
                log_path=path,
                n_eval_episodes=args.eval_episodes,
                eval_freq=max(experiment.n_timesteps // self.n_evaluations // env.num_envs, 1),
                deterministic=not is_stochastic(args.env),
                verbose=0,
            )
            try:
                model.learn(experiment.n_timesteps, callback=[*callbacks_of(experiment.callback), evaluation])
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

    @contextlib.contextmanager
    def _told_disk(self) -> Iterator[None]:
        """Say what is wrong with the disk. Optuna raises an AssertionError from it, "Should not reach."."""
        try:
            yield
        except (AssertionError, OSError) as error:
            cause = error if isinstance(error, OSError) else error.__context__
            if not isinstance(cause, OSError) or (remedy := remedy_of(cause)) is None:
                raise
            text = f"{cause.strerror}: {remedy}, then {self._to_continue()}"
            raise OSError(cause.errno, text, cause.filename or self.storage) from cause

    def _to_continue(self) -> str:
        """:return: how to continue the search"""
        if self.kept is not None:
            return f"repeat the command to continue. Its trials are in {self.kept}."
        if self.study_name is None and self.study is not None:
            return f"repeat the command with --study-name {self.study.study_name} to continue."
        return "repeat the command to continue."

    def _report(self, study: optuna.Study) -> None:
        best = study.best_trial
        print(f"Best of {len(study.trials)} trials: number {best.number} with a mean return of {best.value:.6g}")
        done = sorted(study.get_trials(deepcopy=False, states=[TrialState.COMPLETE]), key=_value_of, reverse=True)
        shown_trials = done[:MOST_SHOWN]
        lines = [["", *(f"trial {one.number}" for one in shown_trials)]]
        lines.append(["mean return", *(f"{one.value:.4g}" for one in shown_trials)])
        for key in best.params:
            lines.append([key, *(_short(one.params.get(key, "")) for one in shown_trials)])
        print(aligned(lines))
        name = f"report_{self.experiment.name}_{self.args.n_trials}-trials-{self.experiment.n_timesteps}"
        path = self.folder / f"{name}-{self.args.sampler}-{self.args.pruner}_{int(time.time())}.csv"
        study.trials_dataframe().to_csv(path)
        print(f"Report: {path}")
        if not self.args.no_optim_plots and sys.stdout.isatty():
            with contextlib.suppress(ImportError, ValueError, RuntimeError):  # plotly is optional
                optuna.visualization.plot_optimization_history(study).show()
                optuna.visualization.plot_param_importances(study).show()

    def _write_best(self, study: optuna.Study, path: Path) -> None:
        params = _arguments_of(study.best_trial, self.args)
        recipe = as_yaml(merged(self.experiment.recipe, params))
        with atomic_write(path, "yml") as file:
            file.write(yaml.safe_dump({self.args.env: recipe}, sort_keys=False).encode())
        tell_best(self.args.algo, self.args.env, path)


class _TrialEvaluation(EvalCallback):
    """
    Evaluations of a trial, after which it may be pruned.

    :param trial: the trial
    """

    def __init__(self, trial: optuna.Trial, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.trial, self.evaluations, self.is_pruned = trial, 0, False

    def _on_step(self) -> bool:
        if self.n_calls % self.eval_freq == 0:
            super()._on_step()
            self.evaluations += 1
            self.trial.report(self.last_mean_reward, self.evaluations)
            self.is_pruned = self.trial.should_prune()
        return not self.is_pruned


def _value_of(trial: optuna.trial.FrozenTrial) -> float:
    assert trial.value is not None
    return trial.value


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def trial_of(args: argparse.Namespace) -> dict[str, Any]:
    """
    :param args: options of ``train``, with ``--trial-id``
    :return: the algorithm's arguments in this trial of the study given by ``--storage`` and ``--study-name``
    :raises ValueError: if there is no such trial
    """
    if not args.storage or not args.study_name:
        raise InvalidArgumentError(f"--trial-id {args.trial_id} needs a study: pass --storage and --study-name.")
    if args.algo not in SPACES:
        raise InvalidArgumentError(suggest("algorithm with a search space", args.algo, ALGORITHMS))
    if args.storage.endswith(".log") and not Path(args.storage).is_file():  # Optuna would create an empty file
        raise FileNotFoundError(f"There is no file {args.storage}.")
    storage = open_storage(args.storage)
    try:
        study = optuna.load_study(storage=storage, study_name=args.study_name)
    except KeyError:
        names = optuna.get_all_study_names(storage)
        raise InvalidArgumentError(suggest(f"study in {args.storage}", args.study_name, names)) from None
    except DBAPIError as error:
        raise _no_database(args.storage, error) from error
    check_trials(study, args.storage)
    for trial in study.get_trials(deepcopy=False):
        if trial.number == args.trial_id:
            return _arguments_of(trial, args)
    raise InvalidArgumentError(
        f"Study {args.study_name} has no trial {args.trial_id}, only {len(study.trials)}, counted from 0."
    )


def _arguments_of(trial: optuna.trial.FrozenTrial, args: argparse.Namespace) -> dict[str, Any]:
    """:return: the algorithm's arguments in a trial, which someone else may have written"""
    source = f"trial {trial.number} of {args.storage}"
    try:
        found = convert_params(trial.params)
    except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError) as error:
        raise InvalidFileError(
            f"{source} has {shown(trial.params)}, which are no parameters of {args.algo} ({told(error)})."
        ) from error
    if not trusted(None):
        check_names(found, args.env, source)
    return found


def _count(study: optuna.Study, states: tuple[TrialState, ...]) -> int:
    return len(study.get_trials(deepcopy=False, states=states))


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
    return InvalidArgumentError(f"--storage {url} cannot be opened: {' '.join(str(error.orig).split())}.")


def diverged(model: BaseAlgorithm) -> bool:
    """
    :param model: a model after an error
    :return: whether a weight of its networks is NaN or infinite
    """
    return any(not weight.isfinite().all() for weight in model.policy.parameters())
