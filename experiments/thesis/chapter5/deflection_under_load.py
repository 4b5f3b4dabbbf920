"""Deflection under the load, and the number of modes that it needs: Figs 5.10 and 5.11."""

from collections.abc import Mapping

import numpy as np

import jaxbeam as jb
from experiments.thesis.cases import one_span, with_duration, with_modes
from experiments.thesis.chapter5 import published
from experiments.thesis.verdicts import Finding, make_finding
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.modes import mesh_layout

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

    return make_finding(
        published.MODE_TRUNCATION,
        shortfall(2, 3),
        {"two modes against six": shortfall(2, 6)},
        null=("one mode against three", shortfall(1, 3)),
    )


def deepest_position(uncontrolled: Mapping[str, jb.Record]) -> Finding:
    """Position (m) of the load at its largest deflection without control, by interpretation."""
    positions = {name: largest_deflection_under_load(one)[0] for name, one in uncontrolled.items()}
    (_, literal), *others = positions.items()
    null = ("static deflection on the shaker of 12000 N/m", _static_position(uncontrolled))
    return make_finding(published.DEEPEST_POSITION, literal, dict(others), null=null)


def _static_position(records: Mapping[str, jb.Record]) -> float:
    """Position (m) of a weight that sinks most, on the beam of the first record."""
    case = next(iter(records.values())).case
    model = modal_model(case, mesh_layout(case))
    positions = np.linspace(0.0, float(case.beam.length), 1201)
    shapes = np.asarray(model.modes.shapes(positions, 0))
    sinking = np.sum(shapes.T * np.linalg.solve(np.asarray(model.stiffness()), shapes.T), axis=0)
    return float(positions[np.argmax(sinking)])


def largest_deflection_under_load(record: jb.Record) -> tuple[float, float]:
    """Position (m) of the first load where the beam under it is lowest, and the deflection (m)."""
    case, times = record.case, np.asarray(record.times)
    positions = float(case.loads[0].speed) * times
    on_beam = positions < float(case.beam.length)
    shapes = np.asarray(record.modes.shapes(positions[on_beam], 0))
    deflection = np.sum(shapes * np.asarray(record.coordinates)[on_beam], axis=1)
    lowest = np.argmin(deflection)
    return float(positions[on_beam][lowest]), float(-deflection[lowest])
