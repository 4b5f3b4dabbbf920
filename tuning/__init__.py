"""tuning: what measured logs say about a rig, and controllers tuned for it."""

from tuning.identify import Fit, identify
from tuning.load_cases import LoadCases, grid, read_load_cases
from tuning.logs import Log, read_log
from tuning.modal import ModalFit, identify_modes
from tuning.objective import Objective
from tuning.proof import Tuned
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
    "grid",
    "identify",
    "identify_modes",
    "read_load_cases",
    "read_log",
    "tune",
]
