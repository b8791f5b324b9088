"""Evaluation of policies over held-out episodes, and statistical inference from the results."""

from quad_swarm.evaluation.evaluation import evaluate, fly_all, summarise
from quad_swarm.evaluation.flight import Condition, Flight, fly, run_episodes
from quad_swarm.evaluation.inference import SAFETY_MARGIN, Comparison, wilson_interval

__all__ = [
    "SAFETY_MARGIN",
    "Comparison",
    "Condition",
    "Flight",
    "evaluate",
    "fly",
    "fly_all",
    "run_episodes",
    "summarise",
    "wilson_interval",
]
