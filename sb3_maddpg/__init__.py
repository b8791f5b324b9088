"""MADDPG for Stable-Baselines3: decentralised actors, centralised critics, all kinds of actions."""

from sb3_maddpg.starting import end_on_interrupt

end_on_interrupt()  # before the imports, which take seconds

# ruff: noqa: E402
from importlib.metadata import version

from sb3_maddpg.agent_policy import AgentPolicy
from sb3_maddpg.buffers import PrioritizedTeamReplayBuffer, TeamReplayBuffer
from sb3_maddpg.callbacks import CurriculumCallback, DashboardCallback, MetricsCallback
from sb3_maddpg.cnn_policy import CnnPolicy
from sb3_maddpg.env_checker import check_team_env
from sb3_maddpg.iddpg import IDDPG
from sb3_maddpg.maddpg import MADDPG
from sb3_maddpg.matd3 import MATD3
from sb3_maddpg.normalization import SafeVecNormalize
from sb3_maddpg.parallel import TeamEnv
from sb3_maddpg.policies import MADDPGPolicy
from sb3_maddpg.pretrained_models import pretrained
from sb3_maddpg.registry import allow_in_files
from sb3_maddpg.relational import PairPolicy

__version__ = version("sb3-maddpg")
__all__ = [
    "IDDPG",
    "MADDPG",
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
