"""Identification of models from measured logs, and tuning of controllers for them."""

import os

# XLA's threads pass the matrices of a batch to each other and wait for them. With two threads and
# gradients of many runs they were seen to wait for each other for ever; with eight they were not.
# XLA reads this variable before its first computation; a setting by the user prevails.
os.environ.setdefault("PJRT_NPROC", str(max(8, os.cpu_count() or 1)))

from tuning import control, fit, logs, modal, monitoring, weighing
from tuning.control.objective import Objective
from tuning.control.pareto import pareto
from tuning.control.penalised_objective import StabilityConstraint
from tuning.control.run_set import LoadCases, full_grid, latin_hypercube, read_load_cases
from tuning.control.tune import tune
from tuning.control.tuning_result import TuningResult
from tuning.fit.experiment_design import design_experiment
from tuning.fit.frequency_responses import identify_responses
from tuning.fit.identify import Fit, identify
from tuning.fit.modal_parameters import identify_from_modes
from tuning.fit.result import load_fit, save_fit
from tuning.logs.log import Log
from tuning.logs.reading import read_log, read_logs
from tuning.modal.identify_modes import ModalFit, ModalSettings, identify_modes
from tuning.parameters import Prior
from tuning.weighing.weigh import weigh

MOVED = {  # names of former versions, each with the module in which it is now
    "AxleWeighing": "weighing",
    "InfluenceLines": "weighing",
    "MeasuredResponses": "modal",
    "ModalParameterFit": "fit",
    "MultiSetupFit": "modal",
    "Responses": "fit",
    "align_logs": "logs",
    "calibrate_influence_lines": "weighing",
    "compare_fits": "fit",
    "cross_validate": "fit",
    "draw_plants": "control",
    "find_faults": "logs",
    "lexicographic": "control",
    "mask": "logs",
    "measured_responses": "modal",
    "merge_setups": "modal",
    "model_influence_lines": "weighing",
    "predict_held_out": "fit",
    "profile": "fit",
    "responses_of": "fit",
    "sample": "fit",
    "tune_integers": "control",
    "tune_reduced": "control",
    "weigh_axles": "weighing",
    "with_identified_plant": "control",
    "write_report": "fit",
}
__all__ = [
    "weighing",
    "modal",
    "monitoring",
    "logs",
    "control",
    "fit",
    "Fit",
    "LoadCases",
    "Log",
    "ModalFit",
    "ModalSettings",
    "Objective",
    "Prior",
    "StabilityConstraint",
    "TuningResult",
    "design_experiment",
    "full_grid",
    "identify",
    "identify_from_modes",
    "identify_modes",
    "identify_responses",
    "latin_hypercube",
    "load_fit",
    "pareto",
    "read_load_cases",
    "read_log",
    "read_logs",
    "save_fit",
    "tune",
    "weigh",
]


def __getattr__(name: str):
    if name in MOVED:
        raise AttributeError(f"tuning.{name} is tuning.{MOVED[name]}.{name} now")
    raise AttributeError(f"module 'tuning' has no attribute {name!r}")
