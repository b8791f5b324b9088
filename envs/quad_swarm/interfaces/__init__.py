"""Gymnasium and PettingZoo environments of the task."""
