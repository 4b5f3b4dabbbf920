"""Checks of effects of trains over speed."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxbeam.analysis.assessment.assessment import (
    LM71_GOVERNS,
    NOT_SATISFIED,
    SATISFIED,
    TRAINS_GOVERN,
    CodeCheck,
    TrainCurve,
    TrainEffects,
    code_numbers,
    static_dynamic_factor,
    track_factor,
)
from jaxbeam.analysis.assessment.high_speed import TrainResponse, train_response
from jaxbeam.analysis.assessment.static_checks import (
    CheckedSection,
    largest_moments,
    largest_under_lm71,
    largest_under_train,
    tabulated_line,
)
from jaxbeam.analysis.sections import characteristic_points
from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.case.quantities import QUANTITIES
from jaxbeam.case.sensors import Sensor
from jaxbeam.library.published import trains as library
from jaxbeam.model.statics import REACTION


class TrackState(NamedTuple):
    """Inputs of the factors of the code: L_phi (m), n0 (Hz), state of the track, alpha."""

    length: float
    frequency: float
    track: str
    classification: float


def train_checks(
    case: Case, trains: Sequence[str], speeds: tuple[float, float], deck: str, state: TrackState
) -> tuple[list[CodeCheck], TrainEffects]:
    """Checks of the effects of trains between two speeds (m/s), and the curves of all effects.

    Deck acceleration against its limit; each section force, reaction and displacement against
    LM71. Calculated values are multiplied by the factor for the track.
    """
    decks = [p for p in characteristic_points(case) if not p.name.startswith("support")]
    sections = checked_sections(case)
    inner = [section for section in sections if section.quantity == REACTION]
    measured = [section for section in sections if section.quantity != REACTION]
    sections = [*measured, *inner]
    sensors = (
        *(Sensor(p.x, "acceleration") for p in decks),
        *(Sensor(p.x, p.quantity, side=p.side if p.quantity == "shear" else "") for p in measured),
    )
    reactions = tuple(section.x for section in inner)
    responses = [train_response(case, train, sensors, *speeds, reactions) for train in trains]
    curves = [
        TrainCurve(
            one.train,
            one.speeds,
            one.peaks
            * np.asarray(track_factor(one.speeds, state.length, state.frequency, state.track))[
                :, None
            ],
        )
        for one in responses
    ]
    lines = [tabulated_line(case, section) for section in sections]
    static_factor = float(static_dynamic_factor(state.length, state.track))
    limits = [state.classification * static_factor * largest_under_lm71(line) for line in lines]
    effects = TrainEffects(
        (*(f"deck acceleration at {p.name}" for p in decks), *(s.name for s in sections)),
        (*("acceleration" for _ in decks), *(s.quantity for s in sections)),
        (*("m/s^2" for _ in decks), *map(_unit, sections)),
        (*(code_numbers()["acceleration"][deck] for _ in decks), *limits),
        tuple(curves),
    )
    checks = [_acceleration_check(case, effects, len(decks), responses, deck, speeds, state)]
    for i, (section, line) in enumerate(zip(sections, lines, strict=True)):
        line = line if case.track is None else line.spread(case.track.kernel())
        checks.append(_section_check(effects, len(decks) + i, section, line, responses, state))
    return checks, effects


def checked_sections(case: Case) -> list[CheckedSection]:
    """Sections whose effects are compared with those of LM71.

    Moments at midspans and inner supports, and where a span has its largest; deflections at
    midspans, shear forces on both sides of supports, rotations of the ends of the deck, reactions.
    """
    points, length = characteristic_points(case), float(concrete(case.beam.length))
    middles = [p for p in points if p.name.startswith("midspan")]
    supports = [p for p in points if p.name.startswith("support")]
    inner = [p for p in supports if 0 < p.x < length]
    sections = [CheckedSection(f"moment at {p.name}", "moment", p.x) for p in (*middles, *inner)]
    sections += largest_moments(case)
    sections += [CheckedSection(f"deflection at {p.name}", "deflection", p.x) for p in middles]
    for p in supports:
        sides = [side for side, end in (("left", 0.0), ("right", length)) if p.x != end]
        for side in sides:
            words = f"shear {side} of {p.name}"
            sections.append(CheckedSection(words, "shear", p.x, side))
        if len(sides) == 1:
            sections.append(CheckedSection(f"end rotation at {p.name}", "rotation", p.x))
    sections += [CheckedSection(f"reaction at {p.name}", REACTION, p.x) for p in supports]
    return sections


def _unit(section: CheckedSection) -> str:
    return "N" if section.quantity == REACTION else QUANTITIES[section.quantity].unit


def _largest(effects: TrainEffects, columns: Sequence[int]) -> tuple[int, int, int]:
    """Indices of curve, speed and effect of the largest value among some columns of effects."""
    curve = int(np.argmax(effects.largest()[:, columns].max(axis=1)))
    values = effects.curves[curve].values[:, columns]
    speed, column = np.unravel_index(np.argmax(values), values.shape)
    return curve, int(speed), columns[int(column)]


def _track_words(state: TrackState, speed: float) -> str:
    factor = float(track_factor(speed, state.length, state.frequency, state.track))
    phi = {"standard": "1 + phi''", "maintained": "1 + phi''/2"}[state.track]
    return f"{phi} = {factor:.4g} for the {state.track} track included"


def _acceleration_check(
    case: Case,
    effects: TrainEffects,
    decks: int,
    responses: list[TrainResponse],
    deck: str,
    speeds: tuple[float, float],
    state: TrackState,
) -> CodeCheck:
    numbers = code_numbers()["acceleration"]
    curve, at, place = _largest(effects, range(decks))
    worst = effects.curves[curve]
    value, speed = float(worst.values[at, place]), float(worst.speeds[at])
    change = max(one.change for one in responses)
    remark = (
        f"{worst.train} at {3.6 * speed:.4g} km/h, {effects.names[place].partition(' at ')[2]};"
        f" {_track_words(state, speed)}; {case.beam.modes} modes count; {3.6 * speeds[0]:.4g} to"
        f" {3.6 * speeds[1]:.4g} km/h, the last refinement of the speeds changed the largest"
        f" responses by {100 * change:.2g} %"
    )
    return CodeCheck(
        f"deck acceleration, {deck} track",
        numbers["clause"],
        value,
        numbers[deck],
        "m/s^2",
        SATISFIED if value <= numbers[deck] else NOT_SATISFIED,
        remark,
    )


def _section_check(
    effects: TrainEffects,
    column: int,
    section: CheckedSection,
    line,
    responses: list[TrainResponse],
    state: TrackState,
) -> CodeCheck:
    """Check of the largest effect of the trains at a section against alpha Phi LM71."""
    curve, at, _ = _largest(effects, [column])
    worst = effects.curves[curve]
    value, speed, limit = float(worst.values[at, column]), worst.speeds[at], effects.limits[column]
    train = library()[worst.train]
    static = largest_under_train(line, train.offsets, train.forces)
    increment = float(responses[curve].peaks[at, column]) / static - 1
    return CodeCheck(
        f"trains against LM71, {section.name}",
        "EN 1991-2, 6.4.6.5",
        value,
        limit,
        effects.units[column],
        TRAINS_GOVERN if value > limit else LM71_GOVERNS,
        f"{worst.train} at {3.6 * speed:.4g} km/h, phi'_dyn = {increment:.4g};"
        f" {_track_words(state, float(speed))}",
    )
