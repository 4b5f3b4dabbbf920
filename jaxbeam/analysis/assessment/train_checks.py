"""Checks of a bridge by a dynamic analysis: deck acceleration, and HSLM against LM71."""

from typing import Any

import numpy as np

from jaxbeam.analysis.assessment.assessment import NOT_SATISFIED, SATISFIED, CodeCheck
from jaxbeam.analysis.assessment.formulas import (
    code_numbers,
    irregularity_factor,
    static_dynamic_factor,
)
from jaxbeam.analysis.assessment.high_speed import TrainResponse, train_response
from jaxbeam.analysis.assessment.static_loads import (
    CheckedSection,
    largest_under_lm71,
    largest_under_train,
    tabulated_line,
)
from jaxbeam.analysis.sections.characteristic_points import characteristic_points
from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.case.sensors import Sensor
from jaxbeam.vehicles.trains import trains as library


def train_checks(case, trains, speeds, track, factors) -> list[CodeCheck]:
    """Deck acceleration, and each moment and deflection against LM71."""
    points = characteristic_points(case)
    decks = [p for p in points if not p.name.startswith("support")]
    middles = [p for p in points if p.name.startswith("midspan")]
    inner = [
        p
        for p in points
        if p.name.startswith("support") and 0 < p.x < float(concrete(case.beam.length))
    ]
    sections = [
        *(CheckedSection(f"moment at {p.name}", "moment", p.x) for p in (*middles, *inner)),
        *(CheckedSection(f"deflection at {p.name}", "deflection", p.x) for p in middles),
    ]
    sensors = (
        *(Sensor(p.x, "acceleration") for p in decks),
        *(Sensor(section.x, section.quantity) for section in sections),
    )
    responses = [train_response(case, train, sensors, *speeds) for train in trains]
    return [
        _acceleration_check(case, decks, responses, track, speeds),
        *_section_checks(case, sections, responses, len(decks), factors),
    ]


def _acceleration_check(case, decks, responses, track: str, speeds) -> CodeCheck:
    numbers = code_numbers()["acceleration"]
    worst = max(responses, key=lambda one: one.peaks[:, : len(decks)].max())
    at, place = np.unravel_index(
        np.argmax(worst.peaks[:, : len(decks)]), (worst.speeds.size, len(decks))
    )
    value = float(worst.peaks[at, place])
    change = max(one.change for one in responses)
    remark = (
        f"{worst.train} at {3.6 * worst.speeds[at]:.4g} km/h, {decks[place].name};"
        f" {case.beam.modes} modes count; {3.6 * speeds[0]:.4g} to {3.6 * speeds[1]:.4g} km/h, the"
        f" last refinement of the speeds changed the largest responses by {100 * change:.2g} %"
    )
    return CodeCheck(
        f"deck acceleration, {track} track",
        numbers["clause"],
        value,
        numbers[track],
        "m/s^2",
        SATISFIED if value <= numbers[track] else NOT_SATISFIED,
        remark,
    )


def _section_checks(
    case: Case,
    sections: list[CheckedSection],
    responses: list[TrainResponse],
    first: int,
    factors: Any,
) -> list[CodeCheck]:
    """HSLM with irregularities of the track, against alpha Phi LM71, at each section."""
    length, frequency, highest, maintenance, classification = factors
    share = code_numbers()["dynamic_factors"][maintenance]["track_irregularity"]
    irregular = share * float(irregularity_factor(highest, length, frequency))
    static_factor = float(static_dynamic_factor(length, maintenance))
    checks = []
    for i, section in enumerate(sections):
        line = tabulated_line(case, section)
        limit = classification * static_factor * largest_under_lm71(line)
        found = []
        for one in responses:
            train = library()[one.train]
            static = largest_under_train(line, train.offsets, train.forces)
            peaks = one.peaks[:, first + i]
            at = int(np.argmax(peaks))
            total = float(peaks[at]) + irregular * static
            found.append((total, one.train, one.speeds[at], float(peaks[at]) / static - 1))
        total, train, speed, increment = max(found)
        remark = f"{train} at {3.6 * speed:.4g} km/h, phi'_dyn = {increment:.4g}"
        governs = total > limit
        remark += "; HSLM governs the design" if governs else "; LM71 governs the design"
        checks.append(
            CodeCheck(
                f"HSLM against LM71, {section.name}",
                "EN 1991-2, 6.4.6.5",
                total,
                limit,
                "N m" if section.quantity == "moment" else "m",
                NOT_SATISFIED if governs else SATISFIED,
                remark,
            )
        )
    return checks
