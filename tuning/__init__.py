"""tuning: what measured logs say about a rig."""

from tuning.identify import Fit, identify
from tuning.logs import Log, read_log
from tuning.modal import ModalFit, identify_modes

__all__ = ["Fit", "Log", "ModalFit", "identify", "identify_modes", "read_log"]
