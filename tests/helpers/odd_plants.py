"""A plant that misbehaves as the name of its vehicle says; a process of its own imports it."""

import numpy as np
from foreign import Drifting


class OddPlant(Drifting):
    """Robots drift along +x at 1 m/s."""

    def __init__(self, vehicle, drag, dt, n_swarms, n_robots):
        super().__init__("iris", drag, dt, n_swarms, n_robots)
        self.vehicle, self.kept = vehicle, None

    def step(self, state, u, air, factors):
        after = super().step(state, u, air, factors)
        if self.vehicle == "reused":
            if self.kept is None:
                self.kept = after
            self.kept[...] = after
            return self.kept
        if self.vehicle == "frozen":
            after.flags.writeable = False
        if self.vehicle == "raises":
            raise KeyError("battery")
        if self.vehicle == "written":
            state[...], u[...] = 5.0, 5.0
        return {
            "lists": after.tolist(),
            "single": after.astype(np.float32),
            "nan": after * np.nan,
            "short": after[..., :6],
            "none": None,
            "complex": after + 1j,
        }.get(self.vehicle, after)
