"""tuning: what measured logs say about a rig, and controllers tuned for it."""

import os

# XLA's threads hand each other the matrices of a batch and wait for them. Where all wait at once,
# nothing goes on for ever, as was seen with two threads and gradients of many runs; with eight it
# was not. XLA reads this before it computes anything; a setting given stays.
os.environ.setdefault("PJRT_NPROC", str(max(8, os.cpu_count() or 1)))

from tuning.account import write_report
from tuning.belief import Belief
from tuning.choices import tune_choices
from tuning.criticism import compare_fits, cross_validate, hold_out
from tuning.design import sharpen
from tuning.faults import find_faults, mask
from tuning.identify import Fit, identify
from tuning.keeping import load_fit, save_fit
from tuning.load_cases import LoadCases, draws, grid, read_load_cases
from tuning.logs import Log
from tuning.modal import ModalFit, identify_modes
from tuning.objective import Objective
from tuning.pareto import lexicographic, pareto
from tuning.plants import adopt, draw_plants
from tuning.posterior import sample
from tuning.profile import profile
from tuning.proof import Tuned
from tuning.reading import read_log, read_logs
from tuning.reduced import tune_reduced
from tuning.responses import Responses, identify_responses, responses_of
from tuning.stable import Stable
from tuning.tune import tune
from tuning.weigh import weigh

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
