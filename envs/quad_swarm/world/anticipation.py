"""Robots predict others whose plan they do not know, by a network that learned how robots of their team move.

Without one, they predict a constant velocity. The network sees what every robot perceives: where all robots and
obstacles are and how fast, and how the velocity of the one that it predicts has changed. It knows no goals. See
`quad_swarm.native.anticipation` for the network; ``studies.swarm.anticipation`` trains one.
"""

from __future__ import annotations

import functools
import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quad_swarm.errors import shown, unknown_name
from quad_swarm.native import anticipation
from quad_swarm.quadrotor import POSITION, VELOCITY
from quad_swarm.states import like
from quad_swarm.world.obstacles import Obstacles

_PACKAGED = Path(__file__).with_name("predictors")
# Name -> file
PREDICTORS = {path.stem: path for path in sorted(_PACKAGED.glob("*.npz"))}
SUFFIX = ".npz"
_LARGEST_FILE, _WIDEST = 10_000_000, 1024
_LARGEST_WEIGHT = 1e3  # five layers of the widest stay below the largest float32


class Predictor(NamedTuple):
    """A network that predicts robots, see `quad_swarm.native.anticipation`.

    :param weights: its weights, float32
    :param hidden: width of the layers for each body
    :param width: width of the layers after them
    :param horizon: number of stages N that it predicts
    :param dt: length of a stage (s)
    :param about: what it was trained in, JSON: the worlds' common fields under "world"
    """

    weights: np.ndarray
    hidden: int
    width: int
    horizon: int
    dt: float
    about: str = "{}"

    @property
    def trained_in(self) -> dict[str, Any]:
        """The fields of the world that it was trained in, as far as they are known, by the names that ``--world``
        has."""
        return dict(json.loads(self.about).get("world", {}))

    def save(self, path: Path) -> None:
        """Write the network to a file, which `load_predictor` reads."""
        with path.open("wb") as file:
            fields: dict[str, Any] = {name: np.array(value) for name, value in self._asdict().items()}
            np.savez_compressed(file, **fields)


def load_predictor(name: str) -> Predictor:
    """Load a network. No code of the file is run.

    :param name: a name of `PREDICTORS`, or the path of a file, which ends with .npz
    :raises ValueError: if the name is unknown, or the file is missing, or holds no network; the message names it
    """
    if not name.endswith(SUFFIX):
        if name not in PREDICTORS:
            raise unknown_name("predictor", name, [*PREDICTORS, "FILE.npz"])
        return _load(str(PREDICTORS[name]), ())
    try:
        found = os.stat(name)
    except OSError:
        raise ValueError(
            f"predictor={shown(name)}: there is no such file; use one of {', '.join(PREDICTORS)}, or a file that "
            "`python -m studies.swarm.anticipation --out` wrote."
        ) from None
    return _load(name, (found.st_mtime_ns, found.st_size, found.st_ino))


@functools.lru_cache(maxsize=16)
def _load(name: str, version: tuple[int, ...]) -> Predictor:
    path = Path(name)
    try:
        if not path.is_file():
            raise ValueError("it is not a file")
        with zipfile.ZipFile(path) as archive:
            if sum(one.file_size for one in archive.infolist()) > _LARGEST_FILE:
                raise ValueError("it is too large")
        with np.load(path, allow_pickle=False) as content:
            found = {field: content[field] for field in Predictor._fields}
        hidden, width, horizon = (int(found[field]) for field in ("hidden", "width", "horizon"))
        predictor = Predictor(
            np.ascontiguousarray(found["weights"]), hidden, width, horizon, float(found["dt"]), str(found["about"])
        )
        if not (
            0 < hidden <= _WIDEST and 0 < width <= _WIDEST and 0 < horizon <= _WIDEST and 0 < predictor.dt < np.inf
        ):
            raise ValueError("its sizes are out of range")
        if predictor.weights.dtype != np.float32 or predictor.weights.shape != (
            anticipation.count_weights(hidden, width, horizon),
        ):
            raise ValueError("its weights do not fit its sizes")
        if not (np.abs(predictor.weights) <= _LARGEST_WEIGHT).all():
            raise ValueError(f"a weight is not finite, or larger than {_LARGEST_WEIGHT:g}")
        about = json.loads(predictor.about)
        if not isinstance(about, dict) or not isinstance(about.get("world", {}), dict):
            raise ValueError("it does not say what it is")
    except Exception as error:  # readers of damaged archives and arrays raise what they like
        raise ValueError(
            f"predictor={shown(name)}: this is no file of `python -m studies.swarm.anticipation --out` "
            f"({shown(str(error))}). Write it anew."
        ) from None
    return predictor


class Scene(NamedTuple):
    """What robots see beside the others.

    :param estimate: estimates of their own states, (E, n, 9)
    :param obstacles: the obstacles, None without any
    """

    estimate: np.ndarray
    obstacles: Obstacles | None


class Outlook:
    """Predictions from what robots see at one time, computed when they are asked for.

    :param predictor: the network
    :param horizon: number of steps N to predict
    :param sight: all bodies; whom to predict is left open
    :param rows: places of the robots and of their others among the bodies, (n,) and (n, n - 1)
    :param changes: changes of the bodies' velocities, (E, n, K, 2, 3), see `quad_swarm.native.anticipation.Sight`
    """

    def __init__(
        self,
        predictor: Predictor,
        horizon: int,
        sight: anticipation.Sight,
        rows: tuple[np.ndarray, np.ndarray],
        changes: np.ndarray,
    ):
        self._predictor, self._horizon, self.sight = predictor, horizon, sight
        self._rows, self._changes = rows, changes

    def sight_of(self, place: np.ndarray, skipped: np.ndarray | None = None) -> anticipation.Sight:
        """Return what is seen of some of the bodies.

        :param place: their places, (n, T)
        :param skipped: whom not to predict, (E, n, T) bool, None to predict all
        """
        changes = self._changes[:, np.arange(len(place))[:, None], place]
        skipped = np.zeros(changes.shape[:3], bool) if skipped is None else skipped
        return self.sight._replace(place=place, changes=np.ascontiguousarray(changes), skipped=skipped)

    @property
    def of_others(self) -> anticipation.Sight:
        """What is seen of all others."""
        return self.sight_of(self._rows[1])

    def others(self, skipped: np.ndarray) -> np.ndarray:
        """Predict the others.

        :param skipped: whom not to predict, (E, n, n - 1) bool
        :return: positions now and at the next N steps, (E, n, n - 1, N + 1, 3), world frame (m)
        """
        return self._anticipate(self.sight_of(self._rows[1], skipped))

    @functools.cached_property
    def own(self) -> np.ndarray:
        """What a robot predicts of itself, so what others without its plan expect of it, (E, n, N + 1, 3) (m)."""
        return self._anticipate(self.sight_of(self._rows[0][:, None]))[:, :, 0]

    def _anticipate(self, sight: anticipation.Sight) -> np.ndarray:
        weights, hidden, width, horizon, dt, _ = self._predictor
        return anticipation.anticipate(sight, weights, hidden, width, horizon, dt)[..., : self._horizon + 1, :]


class Anticipation:
    """What n robots in E swarms know of how all of them moved, as far as predictions need it.

    :param predictor: the network
    :param horizon: number of steps N to predict
    :param n_swarms: number of swarms E
    :param order: places of each robot's others among the bodies that it sees, (n, n - 1); it has the place that is left
    """

    def __init__(self, predictor: Predictor, horizon: int, n_swarms: int, order: np.ndarray):
        self.predictor, self.horizon = predictor, horizon
        n, m = order.shape
        places = np.arange(m + 1)
        self._others = np.ascontiguousarray(order, np.int64)
        self._self = np.array([np.setdiff1d(places, row)[0] for row in order], np.int64)
        # Velocities of the last steps, the newest first, and how many of them are known
        self._past = np.zeros((n_swarms, n, m + 1, max(anticipation.LAGS), 3))
        self._known = np.zeros(self._past.shape[:3], np.int64)
        self._vel = self._past[..., 0, :]

    def look(self, pos: np.ndarray, vel: np.ndarray, scene: Scene) -> Outlook:
        """See where everybody is.

        :param pos: positions of the others, (E, n, n - 1, 3), world frame (m)
        :param vel: velocities of the others, (E, n, n - 1, 3), world frame (m/s)
        :param scene: what robots see beside them
        """
        n_swarms, n, m, _ = pos.shape
        bodies = np.empty((2, n_swarms, n, m + 1, 3))
        rows = np.arange(n)
        for array, of_others, own in zip(bodies, (pos, vel), (POSITION, VELOCITY), strict=True):
            array[:, rows[:, None], self._others] = of_others
            array[:, rows, self._self] = scene.estimate[..., own]
        self._vel = bodies[1]
        before = [self._ago(lag) for lag in anticipation.LAGS]
        changes = np.stack([self._vel - before[0], before[0] - before[1]], axis=-2)
        around = Obstacles(n_swarms, 0) if scene.obstacles is None else scene.obstacles
        nobody = np.zeros((n_swarms, n, 0))
        sight = anticipation.Sight(
            pos=bodies[0],
            vel=bodies[1],
            place=np.zeros((n, 0), np.int64),
            changes=np.zeros((*nobody.shape, 2, 3)),
            skipped=nobody.astype(bool),
            centres=around.position,
            velocities=around.velocity,
            factors=around.factors,
            radius=around.radius,
        )
        return Outlook(self.predictor, self.horizon, sight, (self._self, self._others), changes)

    def _ago(self, lag: int) -> np.ndarray:
        """Return the velocities of some steps ago, or the oldest that are known, (E, n, K, 3)."""
        place = np.minimum(self._known, lag) - 1
        found = np.take_along_axis(self._past, np.maximum(place, 0)[..., None, None], axis=-2)[..., 0, :]
        return np.where(place[..., None] >= 0, found, self._vel)

    def advance(self) -> None:
        """Let a step pass after `look`."""
        self._past = np.concatenate([self._vel[..., None, :], self._past[..., :-1, :]], axis=-2)
        self._known = np.minimum(self._known + 1, self._past.shape[-2])

    def forget(self, swarms: np.ndarray) -> None:
        """Forget how robots of some swarms moved (indices or mask)."""
        self._known[swarms] = 0

    def forget_others(self, slots: np.ndarray) -> None:
        """Forget how some of the others moved, (E, n, n - 1) bool."""
        rows = np.arange(len(self._others))[:, None]
        self._known[:, rows, self._others] *= ~slots

    def kept(self, swarms: np.ndarray) -> Anticipation:
        """Return the same of some swarms (indices or mask)."""
        other = object.__new__(Anticipation)
        other.__dict__.update(self.__dict__)
        other._past, other._known, other._vel = self._past[swarms], self._known[swarms], self._vel[swarms]
        return other

    def state_dict(self) -> dict[str, np.ndarray]:
        """Return the state, see `load_state_dict`."""
        return {"past": self._past.copy(), "known": self._known.copy()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state from `state_dict`.

        :raises ValueError: if it belongs to other swarms
        """
        self._past = like(self._past, state["past"], "past velocities")
        self._known = like(self._known, state["known"], "numbers of past velocities", 0, self._past.shape[-2])
