"""The callbacks under the path that recipes name."""

from sb3_maddpg.common.callbacks import CurriculumCallback, DashboardCallback, MetricsCallback

__all__ = ["CurriculumCallback", "DashboardCallback", "MetricsCallback"]
