"""Runs that survive: checkpoints from which a training continues exactly."""

from sb3_maddpg.checkpoints.callback import RunCheckpoint
from sb3_maddpg.checkpoints.commit import locked, newest
from sb3_maddpg.checkpoints.fingerprints import fingerprint
from sb3_maddpg.checkpoints.resume import resume
from sb3_maddpg.checkpoints.state import digest

__all__ = ["RunCheckpoint", "digest", "fingerprint", "locked", "newest", "resume"]
