"""Modes (natural frequencies, damping ratios) identified from logs of unknown excitation."""

from tuning.modal.forced.measured_responses import MeasuredResponses, measured_responses
from tuning.modal.setups import MultiSetupFit, merge_setups

__all__ = ["MeasuredResponses", "MultiSetupFit", "measured_responses", "merge_setups"]
