"""A generator of environments that misbehave, and a short training in one."""

import warnings

import gymnasium
import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_maddpg import MADDPG
from toys import SMALL

OBSERVATIONS = (
    spaces.Box(-1, 1, (3,)),
    spaces.Box(-1, 1, (2, 2), np.float64),
    spaces.Box(0, 255, (2,), np.uint8),
    spaces.Discrete(4, start=1),
    spaces.MultiDiscrete([2, 3]),
    spaces.MultiBinary(3),
    spaces.Dict({"where": spaces.Box(-1, 1, (2,)), "what": spaces.Discrete(3)}),
    spaces.Tuple([spaces.Discrete(2), spaces.Box(-1, 1, (1,))]),
    spaces.Text(4, charset="abc"),
)
ACTIONS = (
    spaces.MultiBinary(2),
    spaces.Discrete(3, start=-1),
    spaces.MultiDiscrete([2, 3]),
    spaces.Box(-1, 1, (2,)),
    spaces.Box(0, 9, (2,), np.uint8),
)
BAD_SPACES = (
    None,
    "Box",
    spaces.Text(3),
    spaces.Box(0, 1, (0,)),
    spaces.Box(-np.inf, np.inf, (2,)),
    spaces.Graph(spaces.Box(0, 1, (2,)), None),
    spaces.Sequence(spaces.Discrete(2)),
    spaces.Dict({}),
)
BAD_VALUES = (
    None,
    "x",
    b"x",
    np.nan,
    np.inf,
    -1,
    7,
    1.5,
    1e300,
    10**400,
    [],
    {},
    [[1.0], [1.0, 2.0]],
    np.array([1.0]),
    np.full(3, np.nan),
    np.full(3, -np.inf),
    np.full((2, 2), 1e300),
    np.array(["a", "b", "c"]),
    np.array([None, 1.0, 2.0]),
    np.array([1 + 1j, 0, 0]),
    {"where": np.zeros(2)},
    {"where": np.array([np.nan, 0]), "what": 2},
    (1,),
    object(),
)
DICTS = ("observations", "rewards", "terminations", "truncations", "infos")


class Faulty(ParallelEnv):
    """
    Three agents with spaces, an agent and a fault that the seed draws.

    :param seed: of the draw
    """

    metadata = {"name": "faulty", "render_modes": []}  # noqa: RUF012

    def __init__(self, seed: int):
        rng = np.random.default_rng(seed)
        self.possible_agents = ["ann", "bob", "cid"]
        self.observes = {agent: OBSERVATIONS[rng.integers(len(OBSERVATIONS))] for agent in self.possible_agents}
        self.acts = {agent: ACTIONS[rng.integers(len(ACTIONS))] for agent in self.possible_agents}
        self.agent = self.possible_agents[rng.integers(3)]
        self.fault = ("value", "value", "value", "missing", "dict", "return", "space", "agents")[rng.integers(8)]
        self.where = DICTS[rng.integers(5)]
        self.value = BAD_VALUES[rng.integers(len(BAD_VALUES))]
        self.when = int(rng.integers(4))  # after reset(), in the middle, in the last step
        if self.fault == "space":
            table = self.observes if rng.random() < 0.5 else self.acts
            table[self.agent] = BAD_SPACES[rng.integers(len(BAD_SPACES))]
        for space in (*self.observes.values(), *self.acts.values()):
            if isinstance(space, spaces.Space):
                space.seed(seed)

    def __repr__(self) -> str:
        return f"Faulty({self.fault}, {self.where}, {self.agent}, {self.value!r}, step {self.when})"

    def observation_space(self, agent):
        return self.observes[agent]

    def action_space(self, agent):
        return self.acts[agent]

    def spoilt(self, *parts: dict):
        if self.time != self.when or self.fault == "space":
            return parts
        if self.fault == "return":
            return self.value if self.value is not None else parts[:-1]
        if self.fault == "agents":
            self.agents = [self.agent, "eve"] if isinstance(self.value, str) else self.value
            return parts
        index = min(DICTS.index(self.where), len(parts) - 1)
        if self.fault == "dict":
            return *parts[:index], self.value, *parts[index + 1 :]
        if self.fault == "missing":
            parts[index].pop(self.agent)
        else:
            parts[index][self.agent] = self.value
        return parts

    def reset(self, seed=None, options=None):
        self.agents, self.time = list(self.possible_agents), 0
        return self.spoilt(
            {agent: self.observes[agent].sample() for agent in self.agents}, {a: {} for a in self.agents}
        )

    def step(self, actions):
        self.time += 1
        acted, over = self.agents, self.time == 3
        self.agents = [] if over else list(acted)
        return self.spoilt(
            {agent: self.observes[agent].sample() for agent in acted},
            {agent: float(len(agent)) for agent in acted},
            dict.fromkeys(acted, False),
            dict.fromkeys(acted, over),
            {agent: {} for agent in acted},
        )


def trained(env: Faulty) -> MADDPG | Exception:
    """:return: the model after eighteen steps, or the error that refused the environment"""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Gymnasium's and NumPy's, of spaces and overflows
            model = MADDPG("MlpPolicy", env, **{**SMALL, "learning_starts": 6, "train_freq": 3, "batch_size": 8})
            return model.learn(18)
    except (ValueError, gymnasium.error.ResetNeeded) as error:
        return error
