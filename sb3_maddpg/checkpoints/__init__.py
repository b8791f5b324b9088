"""Runs that survive: checkpoints from which a training continues exactly."""

from sb3_maddpg.checkpoints.checkpoints import RunCheckpoint, digest, fingerprint, locked, newest, resume

__all__ = ["RunCheckpoint", "digest", "fingerprint", "locked", "newest", "resume"]
