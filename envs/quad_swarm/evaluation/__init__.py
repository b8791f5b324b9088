"""Policies flown over held-out episodes, and what their figures allow to say."""
