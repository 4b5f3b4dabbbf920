"""tuning: what measured logs say about a rig."""

from tuning.logs import Log, read_log
from tuning.modal import ModalFit, identify_modes

__all__ = ["Log", "ModalFit", "identify_modes", "read_log"]
