"""tuning: what measured logs say about a rig, and controllers tuned for it."""

import os

# XLA's threads hand each other the matrices of a batch and wait for them. Where all wait at once,
# nothing goes on for ever, as was seen with two threads and gradients of many runs; with eight it
# was not. XLA reads this before it computes anything; a setting given stays.
os.environ.setdefault("PJRT_NPROC", str(max(8, os.cpu_count() or 1)))

from tuning.control.integer_choices import tune_choices
from tuning.control.load_cases import LoadCases, draws, grid, read_load_cases
from tuning.control.objective import Objective
from tuning.control.pareto import lexicographic, pareto
from tuning.control.plants import adopt, draw_plants
from tuning.control.reduced_order import tune_reduced
from tuning.control.stability_constraint import Stable
from tuning.control.tune import tune
from tuning.control.tuning_result import Tuned
from tuning.fit.experiment_design import sharpen
from tuning.fit.frequency_responses import Responses, identify_responses, responses_of
from tuning.fit.identify import Fit, identify
from tuning.fit.model_validation import compare_fits, cross_validate, hold_out
from tuning.fit.report import write_report
from tuning.fit.storage import load_fit, save_fit
from tuning.fit.uncertainty.posterior import sample
from tuning.fit.uncertainty.profile import profile
from tuning.fit.weigh import weigh
from tuning.logs.log import Log
from tuning.logs.quality import find_faults, mask
from tuning.logs.reading import read_log, read_logs
from tuning.modal.modal import ModalFit, identify_modes
from tuning.parameters.prior import Belief

__all__ = [
    "Belief",
    "Fit",
    "LoadCases",
    "Log",
    "ModalFit",
    "Objective",
    "Responses",
    "Stable",
    "Tuned",
    "adopt",
    "compare_fits",
    "cross_validate",
    "draw_plants",
    "draws",
    "find_faults",
    "grid",
    "hold_out",
    "identify",
    "identify_modes",
    "identify_responses",
    "lexicographic",
    "load_fit",
    "mask",
    "pareto",
    "profile",
    "read_load_cases",
    "read_log",
    "read_logs",
    "responses_of",
    "sample",
    "save_fit",
    "sharpen",
    "tune",
    "tune_choices",
    "tune_reduced",
    "weigh",
    "write_report",
]
