"""Modes of a structure over time: from a folder of logs to tracks, and alarms when they change."""

from tuning.monitoring.history import AnalysisSettings
from tuning.monitoring.monitor import Monitoring, monitor

__all__ = ["AnalysisSettings", "Monitoring", "monitor"]
