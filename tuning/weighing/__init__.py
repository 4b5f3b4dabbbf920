"""Weighing in motion: loads found in a log of a beam that is known."""

from tuning.weighing.accuracy import Accuracy, accuracy_class, relative_errors
from tuning.weighing.axles import AxleWeighing, weigh_axles
from tuning.weighing.calibration import calibrate_influence_lines
from tuning.weighing.influence_lines import InfluenceLines, model_influence_lines
from tuning.weighing.traffic import (
    TrafficSettings,
    WeighedTraffic,
    WeighedVehicle,
    weigh_logs,
    weigh_vehicles,
)

__all__ = [
    "Accuracy",
    "AxleWeighing",
    "InfluenceLines",
    "WeighedTraffic",
    "TrafficSettings",
    "WeighedVehicle",
    "accuracy_class",
    "calibrate_influence_lines",
    "model_influence_lines",
    "relative_errors",
    "weigh_axles",
    "weigh_logs",
    "weigh_vehicles",
]
