"""Teams of agents: their spaces and names, and PettingZoo environments as environments of a team."""

from sb3_maddpg.team.pettingzoo import TeamEnv, make
from sb3_maddpg.team.spaces import CategoricalActions, MixedActions, TeamObservation
from sb3_maddpg.team.team import Team, TeamAttributes, TeamEnvironment, TeamInfo

__all__ = [
    "CategoricalActions",
    "MixedActions",
    "Team",
    "TeamAttributes",
    "TeamEnv",
    "TeamEnvironment",
    "TeamInfo",
    "TeamObservation",
    "make",
]
