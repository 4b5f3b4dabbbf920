"""The deflection where the load is, and how many modes it takes: Figs 5.10 and 5.11."""

import dataclasses
from collections.abc import Mapping

import numpy as np

import jaxbeam as jb
from experiments.thesis import published
from experiments.thesis.beams import one_span, with_modes
from experiments.thesis.verdicts import Finding, finding

COUNTS = (1, 2, 3, 6)  # modes


def modes_kept(load) -> Finding:
    """By how much fewer modes make the largest deflection under the load smaller, bare beam."""
    case = jb.replace(one_span(load), {"loads.0.mass": 0.261, "loads.0.speed": 0.55})
    run = dataclasses.replace(case.run, duration=case.beam.length / case.loads[0].speed)
    case = dataclasses.replace(case, run=run)
    largest = {n: deepest(jb.simulate(with_modes(case, n)))[1] for n in COUNTS}

    def missing(few: int, many: int) -> float:
        return 100 * (1 - largest[few] / largest[many])

    others = {
        "two modes against six": missing(2, 6),
        "one mode against three": missing(1, 3),
    }
    return finding(
        published.MODES_KEPT,
        missing(2, 3),
        {word: np.atleast_1d(value) for word, value in others.items()},
    )


def deepest_place(records: Mapping[str, jb.Record]) -> Finding:
    """Where the load is when the beam is deepest under it, by records named by their control."""
    places = [deepest(record)[0] for record in records.values()]
    others = zip(list(records)[1:], places[1:], strict=True)
    return finding(
        published.DEEPEST, places[0], {word: np.atleast_1d(place) for word, place in others}
    )


def deepest(record: jb.Record) -> tuple[float, float]:
    """Where (m) the first load presses the beam down most, and how far (m)."""
    case, times = record.case, np.asarray(record.times)
    places = float(case.loads[0].speed) * times
    on = places < float(case.beam.length)
    shapes = np.asarray(record.modes.shapes(places[on], 0))
    under = np.sum(shapes * np.asarray(record.coordinates)[on], axis=1)
    lowest = np.argmin(under)
    return float(places[on][lowest]), float(-under[lowest])
