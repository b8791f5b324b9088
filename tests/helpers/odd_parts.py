"""What users plug in: solvers, plants, rules, policies, scenarios, observations, and parts of a training, that misbehave."""

# ruff: noqa: C901, E501 - long tables and lists of cases

import random
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import torch as th
from cases import Case, Silent, Theirs
from known import TRAINED, Giver, Known, check_stored
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise

import sb3_maddpg.team.toys  # noqa: F401 - registers the tasks
from quad_swarm.evaluation.flight import Condition, run_episodes
from quad_swarm.planner import SOLVERS, RtiSolver, Solution
from quad_swarm.plants.base import SIMULATORS, Simulator
from quad_swarm.task.observation import GROUPS
from quad_swarm.task.rules import RULES
from quad_swarm.world.presets import make_config
from quad_swarm.world.scenarios import SCENARIOS
from sb3_maddpg import MADDPG, PrioritizedTeamReplayBuffer, TeamReplayBuffer

STEPS = 8
FLIGHT = {
    "world": {"substeps": 5, "clock_skew": 0.8, "mismatch": 0.1, "noise": {"vel": 0.02}, "sensing": {"pos": 0.01},
              "radio": {"delay": 1, "jitter": 1}},
}  # fmt: skip


def theirs(*_: Any, **__: Any) -> Any:
    raise Theirs("broken")


def _env(**arguments: Any) -> gymnasium.Env:
    arguments = {"solver": "rti", "scenario": "symmetric_swap", "max_steps": STEPS, **arguments}
    return gymnasium.make("QuadSwarm-v0", disable_env_checker=True, **arguments)


def fly(env: gymnasium.Env) -> np.ndarray:
    """:return: the states of an episode with random requests, and their observations, all in one array"""
    rng, found = np.random.default_rng(0), []
    obs, _ = env.reset(seed=3)
    over = False
    while not over:
        swarm = env.unwrapped.task.swarm
        found.append(np.concatenate([swarm.state.ravel(), obs.ravel()]))
        if not np.isfinite(found[-1]).all():
            raise Silent("observation or state is not finite")
        obs, reward, terminated, truncated, _ = env.step(rng.integers(0, 2, env.action_space.shape))
        if not np.isfinite(reward):
            raise Silent(f"the reward is {reward}")
        over = terminated or truncated
    return np.array(found)


# Solvers


class Odd:
    """The solver of the planner, whose solution is changed."""

    name = "odd"

    def __init__(self, problem: Any, change: Callable[[Solution], Any]):
        self.inner, self.change = RtiSolver(problem), change
        self.inner.compile()

    def solve(self, problems, x_guess, u_guess):
        return self.change(self.inner.solve(problems, x_guess, u_guess))


class Kept(Odd):
    """Returns the same arrays always, and writes into them first."""

    def __init__(self, problem: Any, poison: float):
        super().__init__(problem, lambda solution: solution)
        self.kept: dict[Any, Solution] = {}
        self.poison = poison

    def solve(self, problems, x_guess, u_guess):
        for one in self.kept.values():
            one.x[...] = one.u[...] = self.poison
        found = super().solve(problems, x_guess, u_guess)
        kept = self.kept.setdefault(len(found.x), Solution(*map(np.copy, found)))
        for mine, new in zip(kept, found, strict=True):
            mine[...] = new
        return kept


class Writes(Odd):
    """Writes into what it gets, once it has solved."""

    def __init__(self, problem: Any, where: str):
        super().__init__(problem, lambda solution: solution)
        self.where = where

    def solve(self, problems, x_guess, u_guess):
        found = Solution(*map(np.copy, super().solve(problems, x_guess, u_guess)))
        {"x_guess": x_guess, "u_guess": u_guess, **problems._asdict()}[self.where][...] = 3.0
        return found


def _frozen(solution: Solution) -> Solution:
    copies = Solution(*map(np.copy, solution))
    for one in copies:
        one.flags.writeable = False
    return copies


# What comes of the solution: "same" as of the right one, or "fails", so that robots brake or go on
SOLUTIONS: dict[str, tuple[Callable[[Solution], Any], str]] = {
    "read-only": (_frozen, "same"),
    "Fortran order": (lambda s: Solution(*map(np.asfortranarray, s)), "same"),
    "lists": (lambda s: Solution(*(one.tolist() for one in s)), "same"),
    "a plain tuple": (tuple, "same"),
    "a list": (list, "same"),
    "long doubles": (lambda s: s._replace(x=s.x.astype(np.longdouble)), "same"),
    "iterations of int8": (lambda s: s._replace(iterations=s.iterations.astype(np.int8)), "same"),
    "iterations of floats": (lambda s: s._replace(iterations=s.iterations * 1.0), "same"),
    "strided": (lambda s: s._replace(u=np.repeat(s.u, 2, axis=2)[..., ::2]), "same"),
    "torch": (lambda s: s._replace(u=th.as_tensor(s.u)), "same"),
    "success of objects": (lambda s: s._replace(success=s.success.astype(object)), "fails"),
    "success of ints": (lambda s: s._replace(success=s.success.astype(int)), "fails"),
    "no success": (lambda s: s._replace(success=s.success & False), "fails"),
    "nan inputs": (lambda s: s._replace(u=s.u * np.nan), "fails"),
    "inf states": (lambda s: s._replace(x=s.x + np.inf), "fails"),
    "huge states": (lambda s: s._replace(x=s.x * 0 + 1e300), "fails"),
    "large states": (lambda s: s._replace(x=s.x * 0 + 1e40), "fails"),
    "one stage less": (lambda s: s._replace(x=s.x[:, :-1]), "fails"),
    "one robot less": (lambda s: Solution(*(one[:-1] for one in s)), "fails"),
    "flat": (lambda s: s._replace(u=s.u.reshape(len(s.u), -1)), "fails"),
    "complex": (lambda s: s._replace(u=s.u + 1j), "fails"),
    "three arrays": (lambda s: s[:3], "fails"),
    "None": (lambda s: None, "fails"),
    "u None": (lambda s: s._replace(u=None), "fails"),
    "iterations None": (lambda s: s._replace(iterations=None), "fails"),
    "text": (lambda s: "solved", "fails"),
    "masked": (lambda s: s._replace(u=np.ma.array(s.u, mask=s.u > 0)), "fails"),
    "raises": (theirs, "fails"),
}  # fmt: skip


def _solver(create: Any, expected: str, **arguments: Any) -> None:
    right = fly(_env(**arguments))
    SOLVERS["odd"] = create
    env = _env(solver="odd", **arguments)
    found = fly(env)
    plans = env.unwrapped.task.swarm._plans
    if expected == "same" and not (found.shape == right.shape and np.array_equal(found, right)):
        raise Silent(f"robots fly elsewhere, by {np.abs(found[: len(right)] - right[: len(found)]).max()}")
    if expected == "fails" and not (plans.status > 0).all():
        raise Silent(f"the solution counts as solved: {plans.status}")


# Rules and policies: what becomes of the requests (E, n, n - 1) of "all", as a right answer or None


def _mutates(view: Any, name: str) -> np.ndarray:
    getattr(view, name)[...] = 0.3
    return np.ones(view.pos.shape[:-1], bool)


ANSWERS: dict[str, tuple[Callable[[np.ndarray], Any], bool]] = {
    "bools": (lambda ones: ones, True),
    "read-only": (lambda ones: np.broadcast_to(True, ones.shape), True),
    "ints": (lambda ones: ones.astype(int), True),
    "floats": (lambda ones: ones.astype(float), True),
    "lists": (lambda ones: ones.tolist(), True),
    "torch": (lambda ones: th.as_tensor(ones), True),
    "objects": (lambda ones: ones.astype(object), True),
    "halves": (lambda ones: ones * 0.5, False),
    "0.7": (lambda ones: ones * 0.7, False),
    "twos": (lambda ones: ones * 2, False),
    "minus": (lambda ones: ones * -1.0, False),
    "nan": (lambda ones: ones * np.nan, False),
    "inf": (lambda ones: ones * np.inf, False),
    "one swarm less": (lambda ones: ones[:-1], False),
    "one more axis": (lambda ones: ones[..., None], False),
    "one number": (lambda ones: True, False),
    "one robot": (lambda ones: ones[:, :1], False),
    "turned": (lambda ones: np.moveaxis(ones, 1, 2), False),
    "None": (lambda ones: None, False),
    "text": (lambda ones: "all", False),
    "words": (lambda ones: ones.astype(str), False),
    "complex": (lambda ones: ones * 1j, False),
    "ragged": (lambda ones: [[1], [1, 0]], False),
    "masked": (lambda ones: np.ma.array(ones, mask=ones), False),
    "dates": (lambda ones: ones.astype("datetime64[s]"), False),
    "raises": (theirs, False),
}  # fmt: skip


def _flown(policy: Any) -> list[dict[str, float]]:
    condition = Condition(policy, "random", make_config("paper"), max_steps=4, solver="rti")
    rows = run_episodes(condition, [10**9, 10**9 + 1])
    return [{name: value for name, value in row.items() if name != "solve_seconds"} for row in rows]


def _check_rows(policy: Any, right: bool) -> None:
    found = _flown(policy)
    if not right:
        raise Silent(f"was taken for requests: {found[0]}")
    if found != _flown("full"):
        raise Silent(f"flies otherwise: {found[0]}")


def _rule(answer: Callable[[np.ndarray], Any], right: bool) -> None:
    RULES["odd"] = (lambda: lambda view: answer(np.ones(view.pos.shape[:-1], bool)), ())
    _check_rows("odd", right)


def _policy(answer: Callable[[np.ndarray], Any], right: bool) -> None:
    class Policy:
        def predict(self, observation):
            return answer(np.ones((len(observation), 12), bool))

    _check_rows(Policy(), right)


# Observations


class Wavering:
    """Has another number of columns each time."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, pair: Any) -> np.ndarray:
        self.calls += 1
        return np.ones((*pair.view.pos.shape[:3], 1 + self.calls % 2))


FEATURES: dict[str, tuple[Callable[[Any], Any], str]] = {
    "read-only": (lambda pair: np.broadcast_to(1.0, (*pair.view.pos.shape[:3], 2)), "works"),
    "ints": (lambda pair: np.ones((*pair.view.pos.shape[:3], 2), int), "works"),
    "bools": (lambda pair: np.ones((*pair.view.pos.shape[:3], 2), bool), "works"),
    "lists": (lambda pair: np.ones((*pair.view.pos.shape[:3], 2)).tolist(), "works"),
    "none": (lambda pair: np.ones((*pair.view.pos.shape[:3], 0)), "works"),
    "wavering": (Wavering(), "refused"),
    "no last axis": (lambda pair: np.ones(pair.view.pos.shape[:3]), "refused"),
    "one robot": (lambda pair: np.ones((len(pair.view.pos), 1, 3, 2)), "refused"),
    "flat": (lambda pair: np.ones(2), "refused"),
    "a number": (lambda pair: 1.0, "refused"),
    "None": (lambda pair: None, "refused"),
    "text": (lambda pair: np.full((*pair.view.pos.shape[:3], 2), "x"), "refused"),
    "complex": (lambda pair: np.ones((*pair.view.pos.shape[:3], 2)) * 1j, "refused"),
    "nan": (lambda pair: np.full((*pair.view.pos.shape[:3], 2), np.nan), "refused"),
    "inf": (lambda pair: np.full((*pair.view.pos.shape[:3], 2), np.inf), "refused"),
    "1e39": (lambda pair: np.full((*pair.view.pos.shape[:3], 2), 1e39), "refused"),
    "raises": (theirs, "refused"),
}  # fmt: skip
VIEWED = ("pos", "vel", "own_pos", "own_vel", "goal", "plan", "absolute_plans", "current_plans", "age", "drift")


def _features(group: Callable[[Any], Any], expected: str) -> None:
    right = fly(_env(observation="state+plan"))
    GROUPS["odd"] = group
    found = fly(_env(observation="state+plan+odd"))
    if expected == "refused":
        raise Silent("was taken for features")
    if not np.array_equal(found[:, :36], right[:, :36]):
        raise Silent("robots fly otherwise")


def _writing_group(name: str) -> None:
    def group(pair: Any) -> np.ndarray:
        getattr(pair.view, name)[...] = 0.3
        return np.ones((*pair.view.pos.shape[:3], 1))

    try:
        _features(group, "works")
    except ValueError as error:
        if "read-only" in str(error):  # by NumPy, in their code
            raise Theirs(str(error)) from error
        raise


def _writing_rule(name: str) -> None:
    RULES["odd"] = (lambda: lambda view: _mutates(view, name), ())
    try:
        _check_rows("odd", True)
    except ValueError as error:
        if "read-only" in str(error):
            raise Theirs(str(error)) from error
        raise


# Scenarios


def _rows(n: int, x: float) -> np.ndarray:
    return np.column_stack([np.arange(n) - n / 2, np.full(n, x), np.full(n, 1.5)])


PLACES: dict[str, tuple[Callable[..., Any], bool]] = {
    "rows": (lambda n, space, rng: (_rows(n, -2), _rows(n, 2)), True),
    "lists": (lambda n, space, rng: (_rows(n, -2).tolist(), _rows(n, 2).tolist()), True),
    "starts overlap": (lambda n, space, rng: (_rows(n, -2) * 0 + 1, _rows(n, 2)), False),
    "starts touch": (lambda n, space, rng: (_rows(n, -2) * [0.3, 1, 1], _rows(n, 2)), False),
    "goals overlap": (lambda n, space, rng: (_rows(n, -2), _rows(n, 2) * 0 + 1), False),
    "outside": (lambda n, space, rng: (_rows(n, -2), _rows(n, 40)), False),
    "under the floor": (lambda n, space, rng: (_rows(n, -2), _rows(n, 2) * [1, 1, -1]), False),
    "nan": (lambda n, space, rng: (_rows(n, np.nan), _rows(n, 2)), False),
    "inf": (lambda n, space, rng: (_rows(n, -2), _rows(n, np.inf)), False),
    "one less": (lambda n, space, rng: (_rows(n, -2)[1:], _rows(n, 2)), False),
    "flat": (lambda n, space, rng: (_rows(n, -2).ravel(), _rows(n, 2)), False),
    "in the plane": (lambda n, space, rng: (_rows(n, -2)[:, :2], _rows(n, 2)), False),
    "starts only": (lambda n, space, rng: _rows(n, -2), False),
    "None": (lambda n, space, rng: None, False),
    "complex": (lambda n, space, rng: (_rows(n, -2) * 1j, _rows(n, 2)), False),
    "masked": (lambda n, space, rng: (np.ma.array(_rows(n, -2), mask=_rows(n, -2) > 0), _rows(n, 2)), False),
    "raises": (theirs, False),
}  # fmt: skip


def _scenario(places: Callable[..., Any], right: bool) -> None:
    SCENARIOS["odd"] = places
    fly(_env(scenario="odd"))
    _flown_in = run_episodes(Condition("none", "odd", make_config("paper"), max_steps=3, solver="rti"), [10**9])
    if not right:
        raise Silent(f"was flown: {_flown_in}")


class Remembering:
    """Returns the same arrays in every episode."""

    starts, goals = _rows(4, -2), _rows(4, 2)

    def __call__(self, n, space, rng):
        return self.starts, self.goals


def _remembering() -> None:
    place = Remembering()
    SCENARIOS["odd"] = place
    env = _env(scenario="odd")
    first, second = fly(env), fly(env)
    if not (np.array_equal(first, second) and np.array_equal(place.starts, _rows(4, -2))):
        raise Silent("the second episode differs")


# Plants, in a process of their own

VEHICLES = (
    "odd",
    "reused",
    "frozen",
    "lists",
    "single",
    "written",
    "nan",
    "raises",
    "short",
    "none",
    "complex",
)


def _plant(vehicle: str) -> None:
    SIMULATORS["odd"] = Simulator("odd_plants:OddPlant", VEHICLES)
    env = _env(world={"plant": f"odd:{vehicle}"})
    found = fly(env)
    if vehicle in VEHICLES[:6]:
        SIMULATORS["odd"] = Simulator("odd_plants:OddPlant", VEHICLES)
        right = fly(_env(world={"plant": "odd:odd"}))
        if not np.allclose(found, right, atol=1e-5):
            raise Silent("robots fly elsewhere")
    else:
        raise Silent("was taken for states")


# Parts of a training


def learn(steps: int = 40, callback: Any = None, **arguments: Any) -> MADDPG:
    model = MADDPG("MlpPolicy", "OwnBit-v0", **{**TRAINED, **arguments})
    model.learn(steps, callback=callback)
    for name, tensor in model.policy.state_dict().items():
        if not th.isfinite(tensor).all():
            raise Silent(f"{name} is not finite")
    return model


class Still(th.optim.SGD):
    """Changes nothing, or something else, in a step."""

    to: float | None = None

    def step(self, closure=None):
        for group in self.param_groups:
            for parameter in group["params"]:
                if self.to is not None:
                    parameter.data.fill_(self.to)


class ToNan(Still):
    to = float("nan")


class ToInf(Still):
    to = float("inf")


class Raises(Still):
    def step(self, closure=None):
        theirs()


class NoEps(th.optim.SGD):
    def __init__(self, params, lr):
        super().__init__(params, lr)


class NoLr(th.optim.SGD):
    def __init__(self, params):
        super().__init__(params, 0.1)


OPTIMIZERS: dict[str, Any] = {
    "still": Still, "nan": ToNan, "inf": ToInf, "raises": Raises, "without eps": NoEps, "without lr": NoLr,
    "a function": lambda params, lr: th.optim.SGD(params, lr), "an instance": th.optim.SGD([th.zeros(1, requires_grad=True)], 1),
    "LBFGS": th.optim.LBFGS, "RMSprop": th.optim.RMSprop, "SparseAdam": th.optim.SparseAdam, "AdamW": th.optim.AdamW,
    "Optimizer": th.optim.Optimizer, "Module": th.nn.Linear,
}  # fmt: skip
SCHEDULES: dict[str, Callable[[float], Any]] = {
    "numpy": lambda p: np.float64(1e-3), "0-d": lambda p: np.array(1e-3), "torch": lambda p: th.tensor(1e-3),
    "size 1": lambda p: np.array([1e-3]), "nan": lambda p: np.nan, "nan later": lambda p: 1e-3 if p > 0.5 else np.nan,
    "negative": lambda p: -1e-3, "text": lambda p: "x", "None": lambda p: None, "huge": lambda p: 1e30,
    "complex": lambda p: 1e-3 + 1j, "raises": theirs, "bool": lambda p: True,
}  # fmt: skip


class Noise(ActionNoise):
    def __init__(self, answer: Callable[[], Any]):
        super().__init__()
        self.answer, self.calls = answer, 0

    def __call__(self):
        self.calls += 1
        return self.answer(self.calls)  # type: ignore[call-arg]


NOISES: dict[str, Callable[[int], Any]] = {
    "array": lambda call: np.full(2, 0.1), "a number": lambda call: 0.1, "list": lambda call: [0.1, 0.2],
    "float16": lambda call: np.full(2, 0.1, np.float16), "torch": lambda call: th.full((2,), 0.1),
    "three": lambda call: np.zeros(3), "nan": lambda call: np.full(2, np.nan), "None": lambda call: None,
    "nan later": lambda call: np.full(2, np.nan if call > 20 else 0.0),
    "three later": lambda call: np.zeros(3 if call > 20 else 2), "text": lambda call: "x",
    "raises later": lambda call: theirs() if call > 20 else np.zeros(2), "huge": lambda call: np.full(2, 1e300),
    "complex": lambda call: np.full(2, 1j), "inf later": lambda call: np.full(2, np.inf if call > 20 else 0.0),
}  # fmt: skip


class Calls(BaseCallback):
    """Does something in the tenth step, and in every later one."""

    def __init__(self, do: Callable[[Any], Any]):
        super().__init__()
        self.do = do

    def _on_step(self):
        answer = self.do(self) if self.n_calls >= 14 else None
        return True if answer is None else answer


def _fill(name: str, value: float) -> Callable[[Any], None]:
    def fill(callback: Any) -> None:
        callback.locals[name][...] = value

    return fill


def _first_parameter(value: float) -> Callable[[Any], None]:
    def change(callback: Any) -> None:
        next(iter(callback.model.actor.parameters())).data.fill_(value)

    return change


def _set(name: str, value: Any) -> Callable[[Any], None]:
    return lambda callback: setattr(callback.model, name, value)


def _nothing(_: Any) -> None:
    """A callback that returns nothing goes on."""


CALLBACKS: dict[str, Callable[[Any], Any]] = {
    "False": lambda c: False, "0": lambda c: 0, "numpy False": lambda c: np.bool_(False), "text": lambda c: "x",
    "raises": theirs,
    "rewards": _fill("rewards", 7.0), "rewards nan": _fill("rewards", np.nan),
    "dones": _fill("dones", True), "new_obs": _fill("new_obs", 9.0), "new_obs nan": _fill("new_obs", np.nan),
    "actions": _fill("actions", 1), "buffer_actions": _fill("buffer_actions", 0.3),
    "infos": lambda c: c.locals["infos"][0].clear(),
    "agents' rewards": lambda c: c.locals["infos"][0].update(agent_rewards=np.array([np.nan, 0])),
    "weights nan": _first_parameter(np.nan), "weights inf": _first_parameter(np.inf), "weights 1e30": _first_parameter(1e30),
    "reset": lambda c: _nothing(c.training_env.reset()), "step": lambda c: _nothing(c.training_env.step(np.zeros((1, 2)))),
    "close": lambda c: c.training_env.close(), "empty buffer": lambda c: c.model.replay_buffer.reset(),
    "learn": lambda c: c.model.learn(5) and None, "train": lambda c: c.model.train(1, 4),
    "gamma nan": _set("gamma", np.nan), "gamma 2": _set("gamma", 2.0), "batch_size 0": _set("batch_size", 0),
    "learning_rate nan": _set("learning_rate", np.nan), "tau 2": _set("tau", 2.0), "temperature 0": _set("temperature", 0.0),
    "exploration nan": _set("exploration_noise", np.nan),
    "save": lambda c: c.model.save("x") and None, "set_env": lambda c: c.model.set_env(gymnasium.make("OwnBit-v0")),
    "default dtype": lambda c: th.set_default_dtype(th.float64),
    "eval": lambda c: c.model.policy.set_training_mode(False), "seed": lambda c: c.model.set_random_seed(1),
}  # fmt: skip


class NanSamples(TeamReplayBuffer):
    def sample(self, *args, **kwargs):
        samples = super().sample(*args, **kwargs)
        return samples._replace(rewards=samples.rewards * np.nan)


class ShortSamples(TeamReplayBuffer):
    def sample(self, *args, **kwargs):
        samples = super().sample(*args, **kwargs)
        return samples._replace(rewards=samples.rewards[:, :1])


class Double(TeamReplayBuffer):
    def sample(self, *args, **kwargs):
        samples = super().sample(*args, **kwargs)
        return samples._replace(observations=samples.observations.double())


class Forgets(TeamReplayBuffer):
    def add(self, *args, **kwargs):
        pass


class RaisingBuffer(TeamReplayBuffer):
    def add(self, *args, **kwargs):
        theirs()


class NanErrors(PrioritizedTeamReplayBuffer):
    def update_priorities(self, indices, errors):
        super().update_priorities(indices, errors * np.nan)


BUFFERS = (NanSamples, ShortSamples, Double, Forgets, RaisingBuffer, NanErrors)


class Extractor(th.nn.Module):
    """Of another library's kind."""


def _known_with(do: Callable[[Any], Any]) -> None:
    model = MADDPG("MlpPolicy", Known(Giver("", lambda value: value)), **{**TRAINED, "learning_starts": 100})
    model.learn(28, callback=Calls(do))
    check_stored(model)


def parts(rng: random.Random) -> Iterator[Case]:
    """:return: extension points that misbehave"""
    for name, (change, expected) in SOLUTIONS.items():
        for arguments in ({}, FLIGHT, {"observation": "state+plan+told"}):
            yield Case(
                f"solver: {name} in {arguments}",
                lambda c=change, e=expected, a=arguments: _solver(lambda problem: Odd(problem, c), e, **a),
            )
    for poison in (0.0, np.nan, 1e6):
        for arguments in ({}, FLIGHT, {"observation": "state+plan+told"}):
            yield Case(
                f"solver: reused, {poison}, in {arguments}",
                lambda p=poison, a=arguments: _solver(lambda problem: Kept(problem, p), "same", **a),
            )
    for where in ("x", "goal", "others", "x_guess", "u_guess"):
        for arguments in ({}, FLIGHT):
            yield Case(
                f"solver: writes into {where} in {arguments}",
                lambda w=where, a=arguments: _written_problem(w, a),
            )
    for name, create in {"None": lambda problem: None, "raises": theirs, "class": lambda problem: Odd, "int": 5,
                         "object": lambda problem: object(), "no arguments": lambda: None}.items():  # fmt: skip
        yield Case(f"solver: {name}", lambda create=create: _solver(create, "fails"))
    for name, (answer, right) in ANSWERS.items():
        yield Case(f"rule: {name}", lambda a=answer, r=right: _rule(a, r))
        yield Case(f"rule: {name} & full", lambda a=answer, r=right: _joined(a, r, "odd&full"))
        right |= name == "one more axis"  # the bits of a policy may have any shape
        yield Case(f"policy: {name}", lambda a=answer, r=right: _policy(a, r))
    for name in VIEWED:
        yield Case(f"rule: writes into {name}", lambda name=name: _writing_rule(name))
        yield Case(f"observation: writes into {name}", lambda name=name: _writing_group(name))
    for name, (group, expected) in FEATURES.items():
        yield Case(f"observation: {name}", lambda g=group, e=expected: _features(g, e))
    for name, (places, right) in PLACES.items():
        yield Case(f"scenario: {name}", lambda p=places, r=right: _scenario(p, r))
    yield Case("scenario: the same arrays", _remembering)
    for vehicle in VEHICLES:
        yield Case(f"plant: {vehicle}", lambda vehicle=vehicle: _plant(vehicle))
    for name, optimizer in OPTIMIZERS.items():
        kwargs = {"net_arch": [8], "optimizer_class": optimizer}
        yield Case(f"optimizer: {name}", lambda kwargs=kwargs: learn(policy_kwargs=kwargs))
    for name, schedule in SCHEDULES.items():
        yield Case(f"learning_rate: {name}", lambda s=schedule: learn(learning_rate=s))
        yield Case(f"temperature: {name}", lambda s=schedule: learn(temperature=s, estimator="gumbel_softmax"))
    for name, noise in NOISES.items():
        yield Case(f"noise: {name}", lambda n=noise: learn(action_noise=Noise(n)))
        yield Case(f"noise in a continuous team: {name}", lambda n=noise: _continuous(Noise(n)))
    yield Case("noise: of a class", lambda: learn(action_noise=NormalActionNoise))
    for name, do in CALLBACKS.items():
        yield Case(f"callback: {name}", lambda do=do: learn(callback=Calls(do)))
    for name in ("rewards", "rewards nan", "reset", "step", "actions", "save", "seed", "train"):
        yield Case(f"callback in a known team: {name}", lambda do=CALLBACKS[name], name=name: _known_with(do))
    for buffer in BUFFERS:
        yield Case(f"buffer: {buffer.__name__}", lambda buffer=buffer: learn(replay_buffer_class=buffer))
    for kwargs in ({"features_extractor_class": Extractor}, {"features_extractor_kwargs": {}}, {"activation_fn": Extractor},
                   {"activation_fn": th.relu}, {"activation_fn": th.nn.Softmax}, {"activation_fn": th.nn.Dropout}):  # fmt: skip
        yield Case(f"policy_kwargs={kwargs}", lambda kwargs=kwargs: learn(policy_kwargs={"net_arch": [8], **kwargs}))


def _continuous(noise: ActionNoise) -> None:
    from known_wrapped import BOX, KnownActs

    model = MADDPG("MlpPolicy", KnownActs(True, BOX), **{**TRAINED, "action_noise": noise})
    check_stored(model.learn(28))
    if not np.isfinite(model.replay_buffer.actions).all() or np.abs(model.replay_buffer.actions).max() > 1:
        raise Silent("actions are out of their space")


def _joined(answer: Callable[[np.ndarray], Any], right: bool, text: str) -> None:
    RULES["odd"] = (lambda: lambda view: answer(np.ones(view.pos.shape[:-1], bool)), ())
    _check_rows(text, right)


def _written_problem(where: str, arguments: dict[str, Any]) -> None:
    """The states stay as they are, or the writing fails, and robots brake."""
    SOLVERS["odd"] = lambda problem: Writes(problem, where)
    env = _env(solver="odd", **arguments)
    right = fly(_env(**arguments))
    found = fly(env)
    swarm = env.unwrapped.task.swarm
    if (swarm._plans.status > 0).all():
        return
    if not np.array_equal(found, right):
        raise Silent("robots fly elsewhere")
