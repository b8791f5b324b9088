"""MADDPG for Stable-Baselines3: decentralised actors, centralised critics, all kinds of actions."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sb3_maddpg.starting import end_on_interrupt

end_on_interrupt()  # before other imports, which take seconds

if TYPE_CHECKING:
    from sb3_maddpg.common.agent_policy import AgentPolicy
    from sb3_maddpg.common.buffers import PrioritizedTeamReplayBuffer, TeamReplayBuffer
    from sb3_maddpg.common.callbacks import CurriculumCallback, DashboardCallback, MetricsCallback
    from sb3_maddpg.common.env_checker import check_team_env
    from sb3_maddpg.common.evaluation import TeamEvalCallback
    from sb3_maddpg.common.policies import MADDPGPolicy
    from sb3_maddpg.files.registry import allow_in_files
    from sb3_maddpg.files.trust import untrusted
    from sb3_maddpg.hub.pretrained import pretrained
    from sb3_maddpg.iddpg.iddpg import IDDPG
    from sb3_maddpg.images.cnn_policy import CnnPolicy
    from sb3_maddpg.maddpg.maddpg import MADDPG
    from sb3_maddpg.masac.masac import MASAC
    from sb3_maddpg.matd3.matd3 import MATD3
    from sb3_maddpg.relational.policy import PairPolicy
    from sb3_maddpg.team.pettingzoo import TeamEnv
    from sb3_maddpg.vec_env.normalize import SafeVecNormalize
    from sb3_maddpg.vec_env.wrap import make_vec_env

    __version__: str

_MODULES = {
    "AgentPolicy": "common.agent_policy",
    "CnnPolicy": "images.cnn_policy",
    "CurriculumCallback": "common.callbacks",
    "DashboardCallback": "common.callbacks",
    "IDDPG": "iddpg.iddpg",
    "MADDPG": "maddpg.maddpg",
    "MADDPGPolicy": "common.policies",
    "MASAC": "masac.masac",
    "MATD3": "matd3.matd3",
    "MetricsCallback": "common.callbacks",
    "PairPolicy": "relational.policy",
    "PrioritizedTeamReplayBuffer": "common.buffers",
    "SafeVecNormalize": "vec_env.normalize",
    "TeamEnv": "team.pettingzoo",
    "TeamEvalCallback": "common.evaluation",
    "TeamReplayBuffer": "common.buffers",
    "allow_in_files": "files.registry",
    "check_team_env": "common.env_checker",
    "make_vec_env": "vec_env.wrap",
    "pretrained": "hub.pretrained",
    "untrusted": "files.trust",
}

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
    "TeamEvalCallback",
    "TeamReplayBuffer",
    "allow_in_files",
    "check_team_env",
    "make_vec_env",
    "pretrained",
    "untrusted",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that the command line answers before PyTorch is loaded."""
    if name == "__version__":
        from importlib.metadata import version

        found = version("sb3-maddpg")
    elif name in _MODULES:
        found = getattr(import_module(f"sb3_maddpg.{_MODULES[name]}"), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})
