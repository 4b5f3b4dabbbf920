"""Assessment of a railway bridge by EN 1991-2, section 6.4: the checks in their order."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from jaxbeam.analysis.assessment.assessment import REQUIRED, Assessment, code_numbers
from jaxbeam.analysis.assessment.checks import (
    TrackState,
    analysis_check,
    damping_checks,
    factor_checks,
    frequency_check,
    train_checks,
)
from jaxbeam.analysis.sections import spans
from jaxbeam.case.case import Case, Run, check_is_case
from jaxbeam.case.fields import OUTSIDE, concrete, refuses_traced, suggestion
from jaxbeam.case.library.published import trains as library
from jaxbeam.case.toml_file import number_in_si
from jaxbeam.case.track import THREE_SLEEPERS, Track, track_of
from jaxbeam.case.validation import check_case
from jaxbeam.model.modes import modes
from jaxbeam.model.output_rows import counted_frequency
from jaxbeam.model.plausibility.check import warn_if_implausible

CODES = ("en1991-2",)
DECKS = ("ballasted", "slab")
TRACKS = ("standard", "maintained")
HSLM_A = tuple(f"HSLM-A{i}" for i in range(1, 11))
FASTEST = 150.0  # m/s, 540 km/h: no train in service or on trial comes near
MANY_MODES = 60  # among which those that count for accelerations are found


@refuses_traced("an assessment", f"{OUTSIDE}, or differentiate jaxbeam.simulate under a train")
def assess(
    case: Case,
    line_speed,
    *,
    code: str = "en1991-2",
    deck: str = "ballasted",
    track: str = "standard",
    spread: str | Track | None = None,
    classification: float = 1.0,
    determinant_length=None,
    added_damping: float = 0.0,
    lowest_speed=None,
    trains: Sequence[str] = HSLM_A,
    dynamic: bool | None = None,
    progress: bool = True,
) -> Assessment:
    """Checks of a railway bridge by EN 1991-2, section 6.4, and EN 1990, annex A2.

    Beam, supports and track are those of the case; its loads, sensors and run are not used.
    `line_speed` is the maximum line speed at the site, in m/s or with a unit ("250 km/h"). Limits
    of the deck acceleration are those of a "ballasted" or "slab" `deck`. The state of the `track`,
    "standard" or carefully "maintained", chooses Phi_3 or Phi_2 of LM71, and 1 + phi'' or
    1 + phi''/2, by which all calculated effects of the trains are multiplied (as commonly stated).
    The axles of the trains are spread by the track of the case, or by a `spread` in its place: a
    `Track`, "3 sleepers", or a length ("2.4 m"); LM71 is not.
    `classification` is the factor alpha of LM71. The `determinant_length` L_phi (m, table 6.2) is
    the span of a single span, and must be given for others. `added_damping` (6.4.6.4) is added to
    the modal damping ratios.

    The dynamic analysis under `trains` of the library is made where it is required (or as `dynamic`
    says), from `lowest_speed` (m/s, by default 40) to 1.2 times the line speed, with the modes that
    count for accelerations: up to the largest of 30 Hz, 1.5 f_1 and f_3. Moments, deflections,
    shear forces on both sides of supports, end rotations and reactions of the trains are compared
    with those of LM71; where they are larger the trains govern the design, which is a finding, not
    a failed check. `effects` of the result has them for every train over speed. Numbers of the
    code, their clauses and open sources are in `analysis/assessment/en1991_2.toml`; what has no
    open source is left out and named in the report.

    Raises ValueError for an unknown code, deck, track or train, a track of layers, a controlled
    case, several spans without a determinant length, a beam that can move as a rigid body, one
    so stiff that a train lasts too many of its periods to be analysed, or numbers that are out of
    range or traced by JAX. A line shows the `progress` of the dynamic analysis, train by train.

    >>> import jaxbeam as jb
    >>> bridge = jb.Case(jb.Beam(25.0, 3e10, 15000.0, damping_ratio=0.01))
    >>> found = jb.assess(bridge, "160 km/h")
    >>> print(found.checks[1].subject, found.checks[1].outcome)
    dynamic analysis not required
    """
    check_is_case(case)
    if track in DECKS:
        raise ValueError(f"track is its state, {' or '.join(TRACKS)}; {track!r} is the deck")
    given = dict(deck=deck, track=track, code=code)
    for (name, word), allowed in zip(given.items(), (DECKS, TRACKS, CODES), strict=True):
        if word not in allowed:
            raise ValueError(f"{name} cannot be {word!r}; {suggestion(word, allowed)}")
    trains = (trains,) if isinstance(trains, str) else tuple(trains)
    for train in trains:
        if train not in library() or library()[train].forces is None:
            raise ValueError(f"{train!r} is no train of forces; {suggestion(train, HSLM_A)}")
    numbers = code_numbers()
    classification = number_in_si(classification, "1", "classification")
    added_damping = number_in_si(added_damping, "1", "added_damping")
    speed = number_in_si(line_speed, "m/s", "line_speed")
    lowest = numbers["line_speed"]["lowest"] if lowest_speed is None else lowest_speed
    lowest = number_in_si(lowest, "m/s", "lowest_speed")
    positive = {"line_speed": speed, "lowest_speed": lowest, "classification": classification}
    for name, number in positive.items():
        if not 0 < number < np.inf:
            raise ValueError(f"{name} must be positive; it is {number:g}")
    if speed > FASTEST:
        raise ValueError(
            f"line_speed is {speed:g} m/s, {3.6 * speed:.4g} km/h, faster than any train: a number"
            f" is in m/s; write '{speed:g} km/h', say"
        )
    if not 0 <= added_damping < 1:
        raise ValueError(f"added_damping is a ratio, as 0.005; it is {added_damping:g}")
    if spread is not None:
        given = spread if isinstance(spread, Track) else track_of(spread)
        case = dataclasses.replace(case, track=given)
    if case.on_rail:
        raise ValueError(
            "track.rail_rigidity: the trains of the code are forces on the beam; spread them by a"
            f" rule, as track.spread = {THREE_SLEEPERS!r}, or leave the track out"
        )
    bridge = _bridge(case)
    warn_if_implausible(bridge)
    length = _determinant_length(bridge, determinant_length)
    frequencies, bridge = _with_counted_modes(bridge, added_damping)
    checks = [
        frequency_check(length, frequencies[0]),
        analysis_check(length, frequencies[0], speed),
        *damping_checks(bridge, added_damping),
        *factor_checks(length, frequencies[0], speed, track),
    ]
    effects, is_required = None, checks[1].outcome == REQUIRED
    if dynamic or (dynamic is None and is_required):
        highest = numbers["line_speed"]["design_factor"] * speed
        lowest = min(lowest, highest / 1.2)
        state = TrackState(length, float(frequencies[0]), track, classification)
        found, effects = train_checks(bridge, trains, (lowest, highest), deck, state, progress)
        checks += found
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
        "deck": deck,
        "track": track,
        "spread of axles": "none" if bridge.track is None else repr(bridge.track),
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
        effects,
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
        length = number_in_si(given, "m", "determinant_length")
        if not 0 < length < np.inf:
            raise ValueError(f"determinant_length must be positive; it is {length:g} m")
        return length
    found = spans(case)
    if len(found) > 1:
        raise ValueError(
            f"the beam has {len(found)} spans; give their determinant length L_phi by table 6.2 of"
            " EN 1991-2, as determinant_length or --determinant-length"
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
