"""Fits of a case to logs: datasets, least squares, results, validation, experiment design."""

from tuning.fit.frequency_responses import Responses, responses_of
from tuning.fit.modal_parameters import ModalParameterFit
from tuning.fit.model_validation import compare_fits, cross_validate, predict_held_out
from tuning.fit.report import write_report
from tuning.fit.uncertainty import profile, sample

__all__ = [
    "ModalParameterFit",
    "Responses",
    "compare_fits",
    "cross_validate",
    "predict_held_out",
    "profile",
    "responses_of",
    "sample",
    "write_report",
]
