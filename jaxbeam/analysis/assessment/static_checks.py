"""Checks of a bridge without a dynamic analysis: frequency, damping, dynamic factors."""

import numpy as np

from jaxbeam.analysis.assessment.assessment import (
    INFORMATION,
    NOT_REQUIRED,
    REQUIRED,
    CodeCheck,
)
from jaxbeam.analysis.assessment.formulas import (
    code_numbers,
    frequency_limits,
    irregularity_factor,
    running_factor,
    static_dynamic_factor,
)
from jaxbeam.analysis.sections.characteristic_points import spans
from jaxbeam.case.beam_parts.damping import MATERIALS
from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete


def frequency_check(case: Case, length: float, frequency: float) -> CodeCheck:
    """First natural frequency (Hz) beside its limits at a determinant length (m)."""
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


def damping_checks(case: Case, added: float) -> list[CodeCheck]:
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


def factor_checks(length, frequency, speed, track: str) -> list[CodeCheck]:
    """Dynamic factors at the line speed (m/s), of real trains and of LM71."""
    annex, factors = code_numbers()["annex_c"], code_numbers()["dynamic_factors"]
    first = float(running_factor(speed, length, frequency))
    second = float(irregularity_factor(speed, length, frequency))
    own = factors[track]
    share = own["track_irregularity"]
    static = float(static_dynamic_factor(length, track))
    remark = f"phi' = {first:.4g}, phi'' = {second:.4g}, of which {share:g} for the {track} track"
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
            f"{track} track",
        ),
    ]
