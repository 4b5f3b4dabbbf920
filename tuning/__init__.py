"""Identification of models from measured logs, and tuning of controllers for them."""

import os

# XLA's threads pass the matrices of a batch to each other and wait for them. With two threads and
# gradients of many runs they were seen to wait for each other for ever; with eight they were not.
# XLA reads this variable before its first computation; a setting by the user prevails.
os.environ.setdefault("PJRT_NPROC", str(max(8, os.cpu_count() or 1)))

from tuning.control.integer_choices import tune_integers
from tuning.control.load_cases import LoadCases, full_grid, latin_hypercube, read_load_cases
from tuning.control.objective import Objective
from tuning.control.pareto import lexicographic, pareto
from tuning.control.penalised_objective import StabilityConstraint
from tuning.control.reduced_order import tune_reduced
from tuning.control.run_set import draw_plants, with_identified_plant
from tuning.control.tune import tune
from tuning.control.tuning_result import TuningResult
from tuning.fit.experiment_design import design_experiment
from tuning.fit.frequency_responses import Responses, identify_responses, responses_of
from tuning.fit.identify import Fit, identify
from tuning.fit.modal_parameters import ModalParameterFit, identify_from_modes
from tuning.fit.model_validation import compare_fits, cross_validate, predict_held_out
from tuning.fit.report import write_report
from tuning.fit.storage import load_fit, save_fit
from tuning.fit.uncertainty.posterior import sample
from tuning.fit.uncertainty.profile import profile
from tuning.logs.alignment import align_logs
from tuning.logs.log import Log
from tuning.logs.quality import find_faults, mask
from tuning.logs.reading import read_log, read_logs
from tuning.modal.arguments import ModalSettings
from tuning.modal.fit import ModalFit
from tuning.modal.forced.measured_responses import MeasuredResponses, measured_responses
from tuning.modal.identify_modes import identify_modes
from tuning.modal.setups.merge import MultiSetupFit, merge_setups
from tuning.parameters.prior import Prior
from tuning.weighing.axles import AxleWeighing, weigh_axles
from tuning.weighing.influence_lines import (
    InfluenceLines,
    calibrate_influence_lines,
    model_influence_lines,
)
from tuning.weighing.weigh import weigh

__all__ = [
    "AxleWeighing",
    "Fit",
    "InfluenceLines",
    "LoadCases",
    "Log",
    "MeasuredResponses",
    "ModalFit",
    "ModalParameterFit",
    "ModalSettings",
    "MultiSetupFit",
    "Objective",
    "Prior",
    "Responses",
    "StabilityConstraint",
    "TuningResult",
    "align_logs",
    "calibrate_influence_lines",
    "compare_fits",
    "cross_validate",
    "design_experiment",
    "draw_plants",
    "find_faults",
    "full_grid",
    "identify",
    "identify_from_modes",
    "identify_modes",
    "identify_responses",
    "latin_hypercube",
    "lexicographic",
    "load_fit",
    "mask",
    "measured_responses",
    "merge_setups",
    "model_influence_lines",
    "pareto",
    "predict_held_out",
    "profile",
    "read_load_cases",
    "read_log",
    "read_logs",
    "responses_of",
    "sample",
    "save_fit",
    "tune",
    "tune_integers",
    "tune_reduced",
    "weigh",
    "weigh_axles",
    "with_identified_plant",
    "write_report",
]
