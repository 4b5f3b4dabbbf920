"""tuning: what measured logs say about a rig."""

from tuning.logs import Log, read_log

__all__ = ["Log", "read_log"]
