"""MADDPG for Stable-Baselines3: decentralised actors, centralised critics, all kinds of actions."""

from sb3_maddpg.starting import end_on_interrupt

end_on_interrupt()  # before the imports, which take seconds

# ruff: noqa: E402
from importlib.metadata import version

from sb3_maddpg.common.agent_policy import AgentPolicy
from sb3_maddpg.common.buffers import PrioritizedTeamReplayBuffer, TeamReplayBuffer
from sb3_maddpg.common.callbacks import CurriculumCallback, DashboardCallback, MetricsCallback
from sb3_maddpg.common.env_checker import check_team_env
from sb3_maddpg.common.policies import MADDPGPolicy
from sb3_maddpg.files.registry import allow_in_files
from sb3_maddpg.hub.pretrained import pretrained
from sb3_maddpg.iddpg.iddpg import IDDPG
from sb3_maddpg.images.cnn_policy import CnnPolicy
from sb3_maddpg.maddpg.maddpg import MADDPG
from sb3_maddpg.masac.masac import MASAC
from sb3_maddpg.matd3.matd3 import MATD3
from sb3_maddpg.relational.policy import PairPolicy
from sb3_maddpg.team.pettingzoo import TeamEnv
from sb3_maddpg.vec_env.normalize import SafeVecNormalize

__version__ = version("sb3-maddpg")
__all__ = [
    "IDDPG",
    "MADDPG",
    "MASAC",
    "MATD3",
    "AgentPolicy",
    "CnnPolicy",
    "CurriculumCallback",
    "DashboardCallback",
    "MADDPGPolicy",
    "MetricsCallback",
    "PairPolicy",
    "PrioritizedTeamReplayBuffer",
    "SafeVecNormalize",
    "TeamEnv",
    "TeamReplayBuffer",
    "allow_in_files",
    "check_team_env",
    "pretrained",
]
