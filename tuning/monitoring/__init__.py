"""Modes of a structure over time: from a folder of logs to tracks, and alarms when they change."""

from tuning.monitoring.chart import ConditionEffect, ControlChart, chart_of
from tuning.monitoring.history import LogModes, ModeHistory, analyse, read_history
from tuning.monitoring.monitor import Monitoring, monitor
from tuning.monitoring.tracks import ModeTrack, tracks_of

__all__ = [
    "ControlChart",
    "ConditionEffect",
    "LogModes",
    "ModeHistory",
    "Monitoring",
    "ModeTrack",
    "analyse",
    "chart_of",
    "monitor",
    "read_history",
    "tracks_of",
]
