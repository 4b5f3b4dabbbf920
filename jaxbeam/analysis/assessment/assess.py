"""Assessment of a railway bridge by EN 1991-2, section 6.4: the checks in their order."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxbeam.analysis.assessment.assessment import (
    INFORMATION,
    NOT_REQUIRED,
    NOT_SATISFIED,
    REQUIRED,
    SATISFIED,
    Assessment,
    CodeCheck,
)
from jaxbeam.analysis.assessment.formulas import (
    code_numbers,
    frequency_limits,
    irregularity_factor,
    running_factor,
    static_dynamic_factor,
)
from jaxbeam.analysis.assessment.high_speed import TrainResponse, train_response
from jaxbeam.analysis.assessment.static_loads import (
    Section,
    largest_under_lm71,
    largest_under_train,
    tabulated_line,
)
from jaxbeam.analysis.sections.characteristic_points import characteristic_points, spans
from jaxbeam.case.beam_parts.damping import MATERIALS
from jaxbeam.case.case import Case, Run
from jaxbeam.case.declared_checks import suggestion
from jaxbeam.case.fields import concrete
from jaxbeam.case.reading.units import in_si
from jaxbeam.case.sensors import Sensor
from jaxbeam.case.validation import check_case
from jaxbeam.model.modes import modes
from jaxbeam.model.sensing.mode_band import counted_frequency
from jaxbeam.vehicles.trains import trains as library

CODES = ("en1991-2",)
TRACKS = ("ballasted", "slab")
MAINTENANCE = ("careful", "standard")
HSLM_A = tuple(f"HSLM-A{i}" for i in range(1, 11))
MANY_MODES = 60  # among which those that count for accelerations are found


def assess(
    case: Case,
    line_speed,
    *,
    code: str = "en1991-2",
    track: str = "ballasted",
    maintenance: str = "standard",
    classification: float = 1.0,
    determinant_length=None,
    added_damping: float = 0.0,
    lowest_speed=None,
    trains: Sequence[str] = HSLM_A,
    dynamic: bool | None = None,
) -> Assessment:
    """Checks of a railway bridge by EN 1991-2, section 6.4, and EN 1990, annex A2.

    Beam and supports are those of the case; its loads, sensors and run are not used. `line_speed`
    is the maximum line speed at the site, in m/s or with a unit ("250 km/h"). Limits of the deck
    acceleration are those of a "ballasted" or "slab" `track`; "careful" or "standard" `maintenance`
    chooses Phi_2 or Phi_3 and the share of phi''. `classification` is the factor alpha of LM71.
    The `determinant_length` L_phi (m, table 6.2) is the span of a single span, and must be given
    for others. `added_damping` (6.4.6.4) is added to the modal damping ratios. The dynamic analysis
    under `trains` of the library is made where it is required (or as `dynamic` says), from
    `lowest_speed` (m/s, by default 40) to 1.2 times the line speed, with the modes that count for
    accelerations: up to the largest of 30 Hz, 1.5 f_1 and f_3. Numbers of the code, their clauses
    and open sources are in `analysis/assessment/en1991_2.toml`; what has no open source is left out
    and named in the report.

    Raises ValueError for an unknown code, track, maintenance or train, a controlled case, several
    spans without a determinant length, a beam that can move as a rigid body, or numbers out of
    range.

    >>> import jaxbeam as jb
    >>> bridge = jb.Case(jb.Beam(25.0, 3e10, 15000.0, damping_ratio=0.01))
    >>> found = jb.assess(bridge, "160 km/h")
    >>> print(found.checks[1].subject, found.checks[1].outcome)
    dynamic analysis not required
    """
    given = dict(track=track, maintenance=maintenance, code=code)
    for (name, word), allowed in zip(given.items(), (TRACKS, MAINTENANCE, CODES), strict=True):
        if word not in allowed:
            raise ValueError(f"{name} cannot be {word!r}; {suggestion(word, allowed)}")
    for train in trains:
        if train not in library() or library()[train].forces is None:
            raise ValueError(f"{train!r} is no train of forces; {suggestion(train, HSLM_A)}")
    numbers = code_numbers()
    speed = float(in_si(line_speed, "m/s", "line_speed"))
    lowest = numbers["line_speed"]["lowest"] if lowest_speed is None else lowest_speed
    lowest = float(in_si(lowest, "m/s", "lowest_speed"))
    positive = {"line_speed": speed, "lowest_speed": lowest, "classification": classification}
    for name, number in positive.items():
        if not 0 < number < np.inf:
            raise ValueError(f"{name} must be positive; it is {number:g}")
    if not 0 <= added_damping < 1:
        raise ValueError(f"added_damping is a ratio, as 0.005; it is {added_damping:g}")
    bridge = _bridge(case)
    length = _determinant_length(bridge, determinant_length)
    frequencies, bridge = _with_counted_modes(bridge, added_damping)
    checks = [
        _frequency_check(bridge, length, frequencies[0]),
        _analysis_check(length, frequencies[0], speed),
        *_damping_checks(bridge, added_damping),
        *_factor_checks(length, frequencies[0], speed, maintenance),
    ]
    is_required = checks[1].outcome == REQUIRED
    if dynamic or (dynamic is None and is_required):
        highest = numbers["line_speed"]["design_factor"] * speed
        lowest = min(lowest, highest / 1.2)
        factors = length, frequencies[0], highest, maintenance, classification
        checks += _train_checks(bridge, trains, (lowest, highest), track, factors)
    left_out = list(numbers["left_out"]["items"])
    if not (dynamic or (dynamic is None and is_required)):
        left_out.insert(0, "deck acceleration and HSLM: no dynamic analysis was made")
    clauses = {
        entry["clause"]: " ".join(entry["source"].split())
        for entry in numbers.values()
        if isinstance(entry, dict) and "clause" in entry
    }
    inputs = {
        "line speed": f"{3.6 * speed:g} km/h",
        "determinant length": f"{length:g} m",
        "track": track,
        "maintenance": maintenance,
        "classification factor": f"{classification:g}",
        "added damping": f"{added_damping:g}",
    }
    return Assessment(
        case.title or "bridge",
        numbers["title"],
        inputs,
        tuple(checks),
        tuple(left_out),
        tuple(numbers["left_out"]["not_in_model"]),
        clauses,
    )


def _bridge(case: Case) -> Case:
    """Beam, supports and passive actuators of a case, checked."""
    if case.controller is not None:
        raise ValueError(
            "an active control cannot be certified: leave the controller out of the case"
        )
    bridge = dataclasses.replace(
        case, loads=(), sensors=(), vehicle_sensors=(), controller=None, profile=None, run=Run(1.0)
    )
    check_case(bridge)
    return bridge


def _determinant_length(case: Case, given) -> float:
    if given is not None:
        length = float(in_si(given, "m", "determinant_length"))
        if not 0 < length < np.inf:
            raise ValueError(f"determinant_length must be positive; it is {length:g} m")
        return length
    found = spans(case)
    if len(found) > 1:
        raise ValueError(
            f"the beam has {len(found)} spans; give determinant_length, L_phi in m, by table 6.2"
            " of EN 1991-2"
        )
    return found[0][1] - found[0][0]


def _with_counted_modes(case: Case, added_damping: float) -> tuple[np.ndarray, Case]:
    """Frequencies (Hz) of the modes that count, and the case with these modes and the damping."""
    beam = case.beam
    many = max(MANY_MODES, beam.modes)
    first = concrete(modes(case).frequencies)
    if first.size and not first[0] > 0:
        raise ValueError("the beam can move as a rigid body; hold its ends or add supports")
    ratios = concrete(modes(case).damping_ratios) + added_damping
    plain = dataclasses.replace(
        beam, modes=many, damping_ratio=0.0, rayleigh_damping=None, loss_factor=None, material=""
    )
    all_frequencies = concrete(modes(dataclasses.replace(case, beam=plain)).frequencies)
    limit = float(counted_frequency(all_frequencies))
    count = int(np.sum(all_frequencies <= limit))
    if count == many:
        raise ValueError(f"more than {many} modes lie below {limit:.4g} Hz: this is no bridge")
    if np.ndim(beam.damping_ratio) or beam.rayleigh_damping is not None:
        if beam.modes < count:
            raise ValueError(
                f"{count} modes count for accelerations (up to {limit:.4g} Hz): set beam.modes to"
                f" {count} or more, as its damping is given mode by mode"
            )
        ratio = ratios[:count]
    else:
        ratio = ratios[0]
    beam = dataclasses.replace(plain, modes=count, damping_ratio=ratio)
    return all_frequencies[:count], dataclasses.replace(case, beam=beam)


def _frequency_check(case: Case, length: float, frequency: float) -> CodeCheck:
    numbers = code_numbers()["frequency_limits"]
    lower, upper = frequency_limits(length)
    within = lower <= frequency <= upper and length <= numbers["longest_span"]
    remark = f"limits {float(lower):.4g} and {float(upper):.4g} Hz at {length:g} m"
    if length > numbers["longest_span"]:
        remark += ", beyond the 100 m of the figure"
    remark += "; within them" if within else "; outside them"
    return CodeCheck(
        "first natural frequency n0",
        numbers["clause"],
        float(frequency),
        None,
        "Hz",
        INFORMATION,
        remark,
    )


def _analysis_check(length: float, frequency: float, speed: float) -> CodeCheck:
    """Whether a dynamic analysis is required, as far as the flow chart is open."""
    numbers, limits = code_numbers()["line_speed"], frequency_limits(length)
    fast = 3.6 * speed > numbers["static_limit_kmh"] * (1 + 1e-9)
    longest = code_numbers()["frequency_limits"]["longest_span"]
    outside = not limits.lower <= frequency <= limits.upper or length > longest
    reasons = []
    if fast:
        reasons.append(
            "the line speed is above 200 km/h (tables v/n0 of annex F, which may waive it, are not"
            " used)"
        )
    if outside:
        reasons.append("n0 is outside the limits of figure 6.10")
    return CodeCheck(
        "dynamic analysis",
        numbers["clause"],
        3.6 * speed,
        numbers["static_limit_kmh"],
        "km/h",
        REQUIRED if reasons else NOT_REQUIRED,
        " and ".join(reasons) or "up to 200 km/h, n0 within the limits",
    )


def _damping_checks(case: Case, added: float) -> list[CodeCheck]:
    """Damping ratios of the analysis, against table 6.6 if a material was named."""
    ratios = np.atleast_1d(concrete(case.beam.damping_ratio))
    remark = f"{added:g} of it added by 6.4.6.4" if added else "nothing added by 6.4.6.4"
    span = np.float64(max(b - a for a, b in spans(case)))
    bounds = {name: float(entry.at(span)) for name, entry in MATERIALS.items()}
    listed = ", ".join(f"{name} {bound:.4g}" for name, bound in bounds.items())
    return [
        CodeCheck(
            "damping ratio",
            "EN 1991-2, 6.4.6.3.1, table 6.6",
            float(ratios.min()),
            None,
            "1",
            INFORMATION,
            f"{remark}; lower bounds for a span of {span:g} m: {listed}",
        )
    ]


def _factor_checks(length, frequency, speed, maintenance: str) -> list[CodeCheck]:
    annex, factors = code_numbers()["annex_c"], code_numbers()["dynamic_factors"]
    first = float(running_factor(speed, length, frequency))
    second = float(irregularity_factor(speed, length, frequency))
    own = factors[maintenance]
    share = own["track_irregularity"]
    static = float(static_dynamic_factor(length, maintenance))
    remark = f"phi' = {first:.4g}, phi'' = {second:.4g}, of which {share:g} by the maintenance"
    return [
        CodeCheck(
            "1 + phi' + phi'' of real trains at line speed",
            annex["clause"],
            1 + first + share * second,
            None,
            "1",
            INFORMATION,
            remark,
        ),
        CodeCheck(
            f"dynamic factor {own['name']} of LM71",
            factors["clause"],
            static,
            None,
            "1",
            INFORMATION,
            f"{maintenance} maintenance",
        ),
    ]


def _train_checks(case, trains, speeds, track, factors) -> list[CodeCheck]:
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
        *(Section(f"moment at {p.name}", "moment", p.x) for p in (*middles, *inner)),
        *(Section(f"deflection at {p.name}", "deflection", p.x) for p in middles),
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
    case: Case, sections: list[Section], responses: list[TrainResponse], first: int, factors: Any
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
