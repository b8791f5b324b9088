"""A tolerated rate of collisions instead of a price, for docs/flight_experiments.md.

``sb3-maddpg train --env QuadSwarm-v0 --conf-file zoo_configs/quad_swarm_flight_v2.yml
--gym-packages studies --hyperparams callback:"{'studies.swarm.dual.TolerateCollisions': {'rate': 0.005}}"``
"""

from __future__ import annotations

import math

from stable_baselines3.common.callbacks import BaseCallback

# Prices at the thresholds 0 and 1, over the price
WIDTH = 2.0
# Prices of the recipe, to which it is limited, since a policy that has not learned yet collides at any price
LOWEST, HIGHEST = 0.003, 3.0


class TolerateCollisions(BaseCallback):
    """Callback that makes the price of requests a dual variable: it rises while fewer training episodes collide than
    tolerated, and falls with each that does. A threshold of 0.5 then pays this price.

    :param rate: tolerated share of episodes
    :param step: by how much a collision reduces the logarithm of the price
    :param price: the price at first
    """

    def __init__(self, rate: float = 0.005, step: float = 1.0, price: float = 0.03):
        super().__init__()
        self.rate, self.step = rate, step
        self.log_price = math.log(price)

    def _set(self) -> None:
        price = math.exp(self.log_price)
        self.model.threshold_price = (price / WIDTH, price * WIDTH)  # type: ignore[attr-defined]

    def _on_training_start(self) -> None:
        self._set()

    def _on_step(self) -> bool:
        for done, info in zip(self.locals["dones"], self.locals["infos"], strict=True):
            if done:
                collided = not info["TimeLimit.truncated"] and not info["is_success"]
                price = self.log_price + self.step * (self.rate - collided)
                self.log_price = min(max(price, math.log(LOWEST)), math.log(HIGHEST))
                self.logger.record_mean("rollout/collided", float(collided))
        self._set()
        self.logger.record("train/price", math.exp(self.log_price))
        return True
