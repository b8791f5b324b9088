"""One robot in a process of its own: it is told what it perceives, asks for plans by message, and returns set-points.

Needs NumPy, CasADi and pydantic, and ONNX Runtime for a learned policy; no PyTorch and no Gymnasium.
"""

from quad_swarm.robot.policies import Actor, Policy, RulePolicy
from quad_swarm.robot.robot import Plan, Robot

__all__ = ["Actor", "Plan", "Policy", "Robot", "RulePolicy"]
