"""What may be written to files, and is read without running code."""

from sb3_maddpg.files.registry import allow_in_files

__all__ = ["allow_in_files"]
