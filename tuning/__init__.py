"""tuning: what measured logs say about a rig, and controllers tuned for it."""

from tuning.faults import find_faults, mask
from tuning.identify import Fit, identify
from tuning.load_cases import LoadCases, grid, read_load_cases
from tuning.logs import Log
from tuning.modal import ModalFit, identify_modes
from tuning.objective import Objective
from tuning.proof import Tuned
from tuning.reading import read_log, read_logs
from tuning.stable import Stable
from tuning.tune import tune

__all__ = [
    "Fit",
    "LoadCases",
    "Log",
    "ModalFit",
    "Objective",
    "Stable",
    "Tuned",
    "find_faults",
    "grid",
    "identify",
    "identify_modes",
    "mask",
    "read_load_cases",
    "read_log",
    "read_logs",
    "tune",
]
