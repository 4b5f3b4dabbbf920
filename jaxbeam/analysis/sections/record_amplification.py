"""Dynamic amplification at the sensors of a record, where the static value is known."""

import numpy as np

from jaxbeam.analysis.sections.amplification import AMPLIFIED
from jaxbeam.case.case import Case
from jaxbeam.case.sensors import Sensor
from jaxbeam.model.influence import static_peak
from jaxbeam.model.load_set import load_set
from jaxbeam.simulation.record import Record

MAX_WHEELS = 400  # of a record with amplification, as its static peaks take about 2 ms a wheel
NEGLIGIBLE = 1e-6  # share of the largest static value of a quantity that counts as none


@np.errstate(all="ignore")  # of extreme numbers
def record_amplification(record: Record) -> list[float | None]:
    """Largest absolute over largest static value of the quantity of each sensor of a record.

    None at sensors of velocities and accelerations, where the static value vanishes, with a
    controller, for more wheels than MAX_WHEELS, and for beams whose static deflections are
    not known (see `static_peak`).
    """
    case = record.case
    wheels = load_set(case).wheel_count
    if case.controller is not None or not 0 < wheels <= MAX_WHEELS:
        return [None] * len(case.sensors)
    static = [_static(case, sensor) for sensor in case.sensors]
    largest: dict[str, float] = {}
    for sensor, value in zip(case.sensors, static, strict=True):
        largest[sensor.quantity] = max(largest.get(sensor.quantity, 0.0), value or 0.0)
    peaks = np.maximum(-np.asarray(record.smallest), np.asarray(record.largest))
    return [
        float(peak) / value if value and value > NEGLIGIBLE * largest[sensor.quantity] else None
        for sensor, peak, value in zip(case.sensors, peaks, static, strict=True)
    ]


def _static(case: Case, sensor: Sensor) -> float | None:
    """Largest static value at a sensor; None where it is not known."""
    if sensor.quantity not in AMPLIFIED:
        return None
    channel = {
        name: getattr(sensor, name) for name in ("quantity", "fibre_distance", "section_modulus")
    }
    try:
        value = float(static_peak(case, sensor.position, **channel))
    except ValueError:
        return None
    return value if np.isfinite(value) else None
