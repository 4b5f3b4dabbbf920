"""Static checks of a bridge: loads of the code, and their effects."""

from typing import NamedTuple

import numpy as np

from jaxbeam.analysis.assessment.assessment import (
    INFORMATION,
    NOT_REQUIRED,
    REQUIRED,
    CodeCheck,
    code_numbers,
    frequency_limits,
    irregularity_factor,
    running_factor,
    static_dynamic_factor,
)
from jaxbeam.analysis.load_models import TabulatedLine, influence_at
from jaxbeam.analysis.sections import spans
from jaxbeam.case.beam import MATERIALS
from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.model.along_beam import SETTLED, refined

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


def frequency_check(case: Case, length: float, frequency: float) -> CodeCheck:
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
