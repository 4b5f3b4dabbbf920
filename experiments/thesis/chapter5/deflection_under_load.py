"""The deflection where the load is, and how many modes it takes: Figs 5.10 and 5.11."""

import dataclasses
from collections.abc import Mapping

import numpy as np

import jaxbeam as jb
from experiments.thesis.cases import one_span, with_modes
from experiments.thesis.chapter5 import published
from experiments.thesis.verdicts import Finding, make_finding

MODE_COUNTS = (1, 2, 3, 6)  # modes


def mode_truncation(load_rig) -> Finding:
    """By how much fewer modes make the largest deflection under the load smaller, bare beam."""
    case = jb.replace(one_span(load_rig), {"loads.0.mass": 0.261, "loads.0.speed": 0.55})
    run = dataclasses.replace(case.run, duration=case.beam.length / case.loads[0].speed)
    case = dataclasses.replace(case, run=run)
    largest = {
        n: largest_deflection_under_load(jb.simulate(with_modes(case, n)))[1] for n in MODE_COUNTS
    }

    def shortfall(few: int, many: int) -> float:
        return 100 * (1 - largest[few] / largest[many])

    others = {
        "two modes against six": shortfall(2, 6),
        "one mode against three": shortfall(1, 3),
    }
    return make_finding(
        published.MODE_TRUNCATION,
        shortfall(2, 3),
        {word: np.atleast_1d(value) for word, value in others.items()},
    )


def deepest_position(records: Mapping[str, jb.Record]) -> Finding:
    """Where the load is when the beam is deepest under it, by records named by their control."""
    positions = [largest_deflection_under_load(record)[0] for record in records.values()]
    others = zip(list(records)[1:], positions[1:], strict=True)
    return make_finding(
        published.DEEPEST_POSITION,
        positions[0],
        {word: np.atleast_1d(place) for word, place in others},
    )


def largest_deflection_under_load(record: jb.Record) -> tuple[float, float]:
    """Where (m) the first load presses the beam down most, and how far (m)."""
    case, times = record.case, np.asarray(record.times)
    positions = float(case.loads[0].speed) * times
    on = positions < float(case.beam.length)
    shapes = np.asarray(record.modes.shapes(positions[on], 0))
    deflection = np.sum(shapes * np.asarray(record.coordinates)[on], axis=1)
    lowest = np.argmin(deflection)
    return float(positions[on][lowest]), float(-deflection[lowest])
