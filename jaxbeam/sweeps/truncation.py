"""Warning of what few modes miss of curvatures, strains and moments, whose peaks sweeps follow."""

import warnings

from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.quantities import QUANTITIES
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.static_correction import is_supported, residual_flexibility
from jaxbeam.model.statics import influence_line

NEGLIGIBLE_SHARE = 1e-3


class TruncationWarning(UserWarning):
    """Warning of a quantity that the modes of a case miss in part."""


def warn_of_truncation(case: Case) -> None:
    """Warn of sensors at which the modes miss part of the static value under a load there.

    The share is that of the residual of the modes (see `residual_flexibility`) in the influence
    line, with load and section at the sensor.
    """
    case = concrete_case(case)
    layout = mesh_layout(case)
    if not is_supported(case, layout):
        return
    for i, sensor in enumerate(case.sensors):
        derivative, x = QUANTITIES[sensor.quantity].x_derivative, sensor.position
        if not sensor.bends:
            continue
        exact = float(influence_line(case, x, x, derivative, layout))
        missing = float(residual_flexibility(case, x, x, derivative, layout))
        share = abs(missing / exact) if exact else 0.0
        if share > NEGLIGIBLE_SHARE:
            warnings.warn(
                f"peaks of sensors.{i} ({sensor.quantity}) are sums of {case.beam.modes} modes,"
                f" which miss {share:.1%} of the static value under a load there: keep more modes"
                " (beam.modes), or simulate single runs, whose readings are corrected",
                TruncationWarning,
                stacklevel=3,
            )
