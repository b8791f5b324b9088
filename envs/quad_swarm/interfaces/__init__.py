"""The task as Gymnasium and PettingZoo environments."""
