"""Checks of a bridge: static effects of the loads of the code, and effects of trains over speed.

The largest responses to trains are refined around resonance.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.analysis.assessment.assessment import (
    INFORMATION,
    LM71_GOVERNS,
    NOT_REQUIRED,
    NOT_SATISFIED,
    REQUIRED,
    SATISFIED,
    TRAINS_GOVERN,
    CodeCheck,
    TrainCurve,
    TrainEffects,
    code_numbers,
    frequency_limits,
    irregularity_factor,
    running_factor,
    static_dynamic_factor,
    track_factor,
)
from jaxbeam.analysis.critical_speeds import regular_spacing, resonance_speeds
from jaxbeam.analysis.load_models import TabulatedLine, influence_at
from jaxbeam.analysis.sections import characteristic_points, spans
from jaxbeam.case.beam import MATERIALS
from jaxbeam.case.case import Case, Run
from jaxbeam.case.fields import concrete
from jaxbeam.case.library.published import trains as library
from jaxbeam.case.loads.axles import Axles
from jaxbeam.case.sensors import Sensor
from jaxbeam.model.along_beam import SETTLED, refined
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.modes import modes
from jaxbeam.model.output_rows import (
    SIDE_DISTANCE,
    LinearOutputs,
    linear_outputs,
    sensor_rows,
    static_correction,
)
from jaxbeam.model.statics import REACTION, unit_of_effect
from jaxbeam.runtime.progress import ProgressBar
from jaxbeam.simulation.integrator.force_peaks import force_paths, force_wheels, peaks_of_forces
from jaxbeam.simulation.integrator.force_system import force_responses, force_system
from jaxbeam.simulation.sweeps.computation import failure_sentence, peaks_in_memory
from jaxbeam.simulation.sweeps.force_runner import PHASE
from jaxbeam.simulation.sweeps.specification import sweep_specification

LINE_POINTS = 801  # along the beam, between which influence lines are linear
FRONT_POSITIONS = 8001  # of the first axle of a train
SPAN_POSITIONS = 11  # of a span, between which its largest moment is searched


class CheckedSection(NamedTuple):
    """Section of the beam at which an effect is compared: name, quantity and position x (m).

    `side`, "left" or "right" of x, counts for shear forces.
    """

    name: str
    quantity: str
    x: float
    side: str = "right"


def tabulated_line(case: Case, section: CheckedSection) -> TabulatedLine:
    """Influence line of a section, with points at its kink."""
    return influence_at(case, section.x, section.quantity, section.side, LINE_POINTS)


def largest_moments(case: Case) -> list[CheckedSection]:
    """Sections of the largest sagging moments of spans under LM71, where midspans have less.

    In the end spans of continuous beams they are at about 0.4 of the span.
    """

    def at(x):
        lines = [tabulated_line(case, CheckedSection("", "moment", float(one))) for one in x]
        positive = (line._replace(values=np.maximum(line.values, 0.0)) for line in lines)
        return np.array([largest_under_lm71(line) for line in positive])

    def curves(found):
        return found[:, None], np.max(np.abs(found)), [np.zeros((found.size, 0))]

    sections = []
    for i, (a, b) in enumerate(spans(case), 1):
        x, found = refined(case, at, curves, np.linspace(a, b, SPAN_POSITIONS))
        best = int(np.argmax(found))
        if found[best] > (1 + SETTLED) * found[np.argmin(np.abs(x - (a + b) / 2))]:
            name = f"moment at {x[best]:.4g} m, where LM71 has its largest in span {i}"
            sections.append(CheckedSection(name, "moment", float(x[best])))
    return sections


def largest_under_train(line: TabulatedLine, offsets, forces) -> float:
    """Largest absolute static effect of axles (N) at offsets (m) behind the first."""
    start, end = line.positions[[0, -1]]
    fronts = np.linspace(start, end + offsets[-1], FRONT_POSITIONS)
    kinks = line.positions[np.argmax(np.abs(line.values))] + offsets  # an axle at the peak
    fronts = np.concatenate([fronts, kinks])
    total = np.zeros(fronts.size)
    for offset, force in zip(offsets, forces, strict=True):
        total += force * line.at(fronts - offset)
    return float(np.max(np.abs(total)))


def largest_under_lm71(line: TabulatedLine) -> float:
    """Largest absolute effect of LM71 (characteristic, no factors) for a line per newton.

    Four axles, and 80 kN/m from 0.8 m beyond them where it is unfavourable; they are on the beam,
    in part or wholly, at the worst place. Axles that relieve are not left out.
    """
    numbers = code_numbers()["load_model_71"]
    axles, gap = np.array(numbers["axles"]), numbers["gap"]
    length = line.positions[-1]
    first = np.linspace(-axles[-1], length, FRONT_POSITIONS)
    peak = line.positions[np.argmax(np.abs(line.values))]
    first = np.concatenate([first, peak - axles])
    effect = []
    for sign in (1.0, -1.0):
        signed = line._replace(values=sign * line.values)
        unfavourable = np.maximum(signed.values, 0.0)
        steps = np.diff(signed.positions) * (unfavourable[1:] + unfavourable[:-1]) / 2
        area = np.concatenate([[0.0], np.cumsum(steps)])
        inside = [
            np.interp(end, signed.positions, area) for end in (first - gap, first + axles[-1] + gap)
        ]
        loaded = area[-1] - (inside[1] - inside[0])
        from_axles = signed.at(first[:, None] + axles).sum(axis=1)
        total = numbers["axle_force"] * from_axles + numbers["line_load"] * loaded
        effect.append(float(np.max(total)))
    return max(effect)


def frequency_check(length: float, frequency: float) -> CodeCheck:
    """Check of the first natural frequency (Hz) against its limits at a determinant length (m)."""
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


def analysis_check(length: float, frequency: float, speed: float) -> CodeCheck:
    """Check whether a dynamic analysis is required, by the public part of the flow chart."""
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


def damping_checks(case: Case, added: float) -> list[CodeCheck]:
    """Checks of the damping ratios, against table 6.6 if a material was named."""
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


def factor_checks(length, frequency, speed, track: str) -> list[CodeCheck]:
    """Dynamic factors at the line speed (m/s), of real trains and of LM71, as checks."""
    annex, factors = code_numbers()["annex_c"], code_numbers()["dynamic_factors"]
    first = float(running_factor(speed, length, frequency))
    second = float(irregularity_factor(speed, length, frequency))
    own = factors[track]
    fraction = own["track_irregularity"]
    static = float(static_dynamic_factor(length, track))
    remark = (
        f"phi' = {first:.4g}, phi'' = {second:.4g}, of which {fraction:g} for the {track} track"
    )
    return [
        CodeCheck(
            "1 + phi' + phi'' of real trains at line speed",
            annex["clause"],
            1 + first + fraction * second,
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
            f"{track} track",
        ),
    ]


# Ratio of speeds: N axles at a spacing build up resonance of order i over a fraction 2 / (N i) of
# the speed, 3 % for the longest trains at third order, with at least one speed within.
SPEED_RATIO = 1.02
SETTLED_SPEEDS = 0.01  # change of the largest response, relative, at which speeds are fine enough
NEAR_LARGEST = 0.8  # fraction of the largest response from which on a peak over speed is refined
MAX_ROUNDS = 4
TOLERANCE = 1e-4  # of peaks
NEAR = 1e-6  # m, from a support to a sensor next to it
MOST_PERIODS = 1e7  # of the highest mode that counts, over the first speeds of a train: 3 s
RUNS_AT_ONCE = 8  # whose reactions are computed together
FREE_PERIODS = 2.0  # of the first mode, simulated after a train has left


class TrainResponse(NamedTuple):
    """Peaks of sensors over the speeds (m/s) of one train, and their change by the refinement.

    `change` is the relative growth of the largest peak of each quantity in the last refinement.
    """

    train: str
    speeds: Float[np.ndarray, " speed"]
    peaks: Float[np.ndarray, "speed sensor"]
    change: float


def train_response(
    case: Case,
    train: str,
    sensors: tuple[Sensor, ...],
    lowest: float,
    highest: float,
    reactions: tuple[float, ...] = (),
) -> TrainResponse:
    """Peaks of sensors under a train of the library at speeds (m/s) between two, refined.

    Followed by those of the reactions of the supports at some positions (m): where the beam has
    repeated poles the sum of the shear forces on both sides, which is no smaller.

    First in steps of 2 %, and at the resonance speeds of the first mode; then around every peak
    near the largest one, until it changes by less than a hundredth. Raises RuntimeError if a run
    fails, ValueError if there are more periods to follow than in any bridge.
    """
    offsets, forces = library()[train].offsets, library()[train].forces
    load = Axles(speed=highest, offsets=offsets, forces=forces)
    loaded = dataclasses.replace(
        case, sensors=sensors, loads=(load,), run=Run(1.0, sample_rate=20.0)
    )
    way = float(concrete(case.beam.length)) + float(offsets[-1])
    free = FREE_PERIODS / float(concrete(modes(case).frequencies)[0])

    def peaks_at(speeds) -> Float[np.ndarray, "speed sensor"]:
        """Peaks at speeds (m/s). Raises RuntimeError if a run fails."""
        over = {"loads.0.speed": speeds, "run.duration": way / speeds + free}
        plan = sweep_specification(loaded, over, True, False, TOLERANCE, "double")
        found = peaks_in_memory(plan)
        if found.failed_runs:
            raise RuntimeError(f"under {train} {failure_sentence(found)}")
        columns = [found[f"peak_{s.quantity}"].to_numpy()[:, i] for i, s in enumerate(sensors)]
        peaks = np.stack(columns, axis=-1)
        if not reactions:
            return peaks
        values = np.stack([over[name] for name in over], axis=-1)
        found = reaction_peaks(loaded, reactions, tuple(over), values)
        if found is None:
            near = [
                [s.quantity == "shear" and abs(float(s.position) - x) < NEAR for s in sensors]
                for x in reactions
            ]
            found = peaks @ np.array(near, float).T
        return np.concatenate([peaks, found], axis=-1)

    speeds = _first_speeds(loaded, lowest, highest)
    frequencies = concrete(modes(case).frequencies)
    periods = float(frequencies[-1] * np.sum(way / speeds + free))
    if periods > MOST_PERIODS:
        raise ValueError(
            f"the dynamic analysis would follow {periods:.1e} periods under {train} alone, as the"
            f" beam has a first frequency of {frequencies[0]:.4g} Hz and {speeds.size} speeds at or"
            f" next to its resonances: is beam.flexural_rigidity in N m^2 and beam.mass_per_length"
            " in kg/m? Or else give a higher lowest_speed"
        )
    count, peaks, change = speeds.size, peaks_at(speeds), np.inf
    quantities = [sensor.quantity for sensor in sensors] + ["reaction"] * len(reactions)
    quantities = np.array(quantities)
    for _ in range(MAX_ROUNDS):
        before = _largest(peaks, quantities)
        added = _between(speeds, peaks, quantities, count)
        speeds = np.concatenate([speeds, added])
        peaks = np.concatenate([peaks, peaks_at(added)])
        order = np.argsort(speeds)
        speeds, peaks = speeds[order], peaks[order]
        change = max(_largest(peaks, quantities) / before) - 1
        if change < SETTLED_SPEEDS:
            break
    return TrainResponse(train, speeds, peaks, float(change))


def reaction_peaks(
    case: Case, positions: Sequence[float], addresses: Sequence[str], values
) -> Float[np.ndarray, "run reaction"] | None:
    """Largest absolute reactions (N) at positions (m) in runs that differ in values at addresses.

    A reaction is the jump of the shear force, S(x+) - S(x-), in closed form under the forces of a
    train. None where poles of the beam are repeated.
    """
    length, model = float(concrete(case.beam.length)), modal_model(case)
    step, sensors, weights = 4 * SIDE_DISTANCE * length, [], []
    for number, x in enumerate(positions):
        for place, sign, beyond in ((x - step, -1.0, x == 0), (x, 1.0, x == length)):
            if not beyond:
                sensors.append(Sensor(place, "shear"))
                weights.append(sign * (np.arange(len(positions)) == number))
    rows = sensor_rows(model, case, sensors)
    outputs = linear_outputs(model, rows, static_correction(model, case, sensors, rows))
    assert outputs.influence is not None
    jumps = np.array(weights).T
    influence = eqx.tree_at(
        lambda one: one.series, outputs.influence, outputs.influence.series @ jumps.T
    )
    combined = LinearOutputs(jumps @ np.asarray(outputs.rows), influence)
    system = force_system(model, combined, np.array(positions))
    if system is None:
        return None
    found, wheels = [], force_wheels(case)
    for part in np.array_split(values, -(-len(values) // RUNS_AT_ONCE)):
        paths = force_paths(case, wheels, addresses, part)
        responses = force_responses(system, np.unique(paths.speed))
        found.append(peaks_of_forces(responses, paths, PHASE).peak_deflection[:, 0])
    return np.concatenate(found)


def _first_speeds(case: Case, lowest: float, highest: float) -> Float[np.ndarray, " speed"]:
    steps = int(np.ceil(np.log(highest / lowest) / np.log(SPEED_RATIO)))
    speeds = np.geomspace(lowest, highest, max(steps, 1) + 1)
    spacing = regular_spacing(case)
    if spacing is not None:
        found = resonance_speeds(case, spacing, lowest, highest)
        speeds = np.union1d(speeds, [critical.speed for critical in found])
    return speeds


def _largest(peaks, quantities) -> Float[np.ndarray, " quantity"]:
    return np.array([peaks[:, quantities == q].max() for q in np.unique(quantities)])


def _between(speeds, peaks, quantities, count: int) -> Float[np.ndarray, " added"]:
    """Speeds (`count`) in the intervals next to the peaks over speed that are near the largest."""
    next_to_peak = np.zeros(speeds.size - 1, bool)
    for quantity in np.unique(quantities):
        largest = peaks[:, quantities == quantity].max(axis=1)
        padded = np.concatenate([[-np.inf], largest, [-np.inf]])
        is_peak = (largest >= padded[:-2]) & (largest >= padded[2:])
        for i in np.flatnonzero(is_peak & (largest >= NEAR_LARGEST * largest.max())):
            next_to_peak[max(i - 1, 0) : i + 1] = True
    intervals = np.flatnonzero(next_to_peak)
    counts = np.diff(np.linspace(0, count, intervals.size + 1).astype(int))
    added = [
        np.linspace(speeds[i], speeds[i + 1], number + 2)[1:-1]
        for i, number in zip(intervals, counts, strict=True)
    ]
    return np.concatenate(added)


class TrackState(NamedTuple):
    """Inputs of the factors of the code: L_phi (m), n0 (Hz), state of the track, alpha."""

    length: float
    frequency: float
    track: str
    classification: float


def train_checks(
    case: Case,
    trains: Sequence[str],
    speeds: tuple[float, float],
    deck: str,
    state: TrackState,
    progress: bool = False,
) -> tuple[list[CodeCheck], TrainEffects]:
    """Checks of the effects of trains between two speeds (m/s), and the curves of all effects.

    Deck acceleration against its limit; each section force, reaction and displacement against
    LM71. Calculated values are multiplied by the factor for the track. A bar shows the `progress`.
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
    responses = []
    with ProgressBar(len(trains), "train", shown=progress) as bar:
        for train in trains:
            responses.append(train_response(case, train, sensors, *speeds, reactions))
            bar.update()
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
        (*("m/s^2" for _ in decks), *(unit_of_effect(section.quantity) for section in sections)),
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


def _largest_of(effects: TrainEffects, columns: Sequence[int]) -> tuple[int, int, int]:
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
    curve, at, place = _largest_of(effects, range(decks))
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
    curve, at, _ = _largest_of(effects, [column])
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
