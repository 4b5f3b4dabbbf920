"""Deflection under the load, and the number of modes that it needs: Figs 5.10 and 5.11."""

from collections.abc import Mapping

import numpy as np

import jaxbeam as jb
from experiments.thesis.cases import one_span, with_duration, with_modes
from experiments.thesis.chapter5 import published
from experiments.thesis.verdicts import Finding, make_finding

MODE_COUNTS = (1, 2, 3, 6)


def mode_truncation(load_rig) -> Finding:
    """Shortfall (%) of the largest deflection under the load with fewer modes, bare beam."""
    case = jb.replace(one_span(load_rig), {"loads.0.mass": 0.261, "loads.0.speed": 0.55})
    case = with_duration(case, case.beam.length / case.loads[0].speed)
    largest = {
        modes: largest_deflection_under_load(jb.simulate(with_modes(case, modes)))[1]
        for modes in MODE_COUNTS
    }

    def shortfall(few: int, many: int) -> float:
        return 100 * (1 - largest[few] / largest[many])

    alternatives = {
        "two modes against six": shortfall(2, 6),
        "one mode against three": shortfall(1, 3),
    }
    return make_finding(published.MODE_TRUNCATION, shortfall(2, 3), alternatives)


def deepest_position(records: Mapping[str, jb.Record]) -> Finding:
    """Position (m) of the load at its largest deflection, by records named by their control."""
    positions = {name: largest_deflection_under_load(one)[0] for name, one in records.items()}
    (_, uncontrolled), *others = positions.items()
    return make_finding(published.DEEPEST_POSITION, uncontrolled, dict(others))


def largest_deflection_under_load(record: jb.Record) -> tuple[float, float]:
    """Position (m) of the first load where the beam under it is lowest, and the deflection (m)."""
    case, times = record.case, np.asarray(record.times)
    positions = float(case.loads[0].speed) * times
    on_beam = positions < float(case.beam.length)
    shapes = np.asarray(record.modes.shapes(positions[on_beam], 0))
    deflection = np.sum(shapes * np.asarray(record.coordinates)[on_beam], axis=1)
    lowest = np.argmin(deflection)
    return float(positions[on_beam][lowest]), float(-deflection[lowest])
