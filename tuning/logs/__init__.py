"""Logs of measured runs: files, units, faults."""

from tuning.logs.alignment import align_logs
from tuning.logs.quality import find_faults, mask

__all__ = ["align_logs", "find_faults", "mask"]
