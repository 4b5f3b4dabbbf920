"""Plausibility of a case before it runs: a few numbers that an engineer knows by heart.

Wrong units make a case that computes and means nothing: E I in kN m^2, a speed in km/h, a mass in
t. What follows from them (first frequency, static deflection, mass ratio, critical speed) shows it.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterator

import numpy as np

from jaxbeam.analysis.plausible_numbers import Plausibility, plausible_numbers
from jaxbeam.case.actuators.electrodynamic import Electrodynamic
from jaxbeam.case.beam import END_CONDITIONS, Support
from jaxbeam.case.case import Case, concrete_case, crossing_times
from jaxbeam.case.trajectory import NEVER
from jaxbeam.case.validation import check_case
from jaxbeam.model.modes import Modes, modes
from jaxbeam.model.poles_zeros import poles

LEAST_SPAN_OVER_DEFLECTION = 50.0  # under loads: a beam yields, or is no longer nearly straight
LEAST_SPAN_OVER_OWN_DEFLECTION = 10.0  # under its own weight, which a camber may make up for
MOST_SPAN_OVER_DEFLECTION = 1e6  # loads that are too light by a factor of a thousand, or a beam
MOST_DAMPING = 0.2  # 5 % is a lot for a structure; above, a per cent was meant
MOST_MASS_RATIO = 10.0
LOWEST_FREQUENCY, HIGHEST_FREQUENCY = 0.01, 1e4  # Hz
MOST_SETTLEMENT = 0.01  # of the length: 25 cm of a bridge of 25 m
CLAMPING_DISTANCE = 0.01  # of the length: two supports so close hold the rotation, too
CLAMPING_STIFFNESS = 10.0  # E I / L: of two springs that do
ROAD_SPEED, RAIL_SPEED = 60.0, 120.0  # m/s; 1.2 times 350 km/h is 117 m/s
LEAST_BRIDGE = 3.0  # m: shorter beams are rigs, of other speeds
ROAD_KINDS = ("quarter-car", "half-car")


def check(case: Case) -> Plausibility:
    """Numbers by which the plausibility of a case is seen, with warnings of what looks wrong.

    Nothing is simulated; it takes a few milliseconds. Raises ValueError for an invalid case,
    `jax.errors.ConcretizationTypeError` if it is traced by `jit` or `vmap`.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(length=25.0, flexural_rigidity=30e6, mass_per_length=15e3),  # kN m^2!
    ...     sensors=[jb.Sensor(position=12.5)],
    ...     loads=[jb.MovingMass(mass=30e3, speed=25.0)],
    ...     run=jb.Run(duration=2.0),
    ... )
    >>> found = jb.check(case)
    >>> print(found.span_over_deflection < 50)
    True
    >>> print(found.warnings[0].split(":")[0])
    the beam sags by 3.186 m under its loads, 1/7.8 of its span of 25 m
    """
    check_case(case)
    case = concrete_case(case)
    with np.errstate(all="ignore"):  # of numbers that no beam has
        found = modes(case)
        numbers = plausible_numbers(case, found)
        return dataclasses.replace(numbers, warnings=tuple(_warnings(case, found, numbers)))


def _warnings(case: Case, found: Modes, numbers: Plausibility) -> Iterator[str]:
    yield from _deflection_warnings(case, numbers)
    yield from _frequency_warnings(case, found, numbers)
    yield from _mass_warnings(case, numbers)
    yield from _travel_warnings(case, numbers)
    yield from _support_warnings(case)
    yield from _inner_loop_warnings(case)
    if not case.sensors:
        yield (
            "there are no sensors, so that only contact forces are reported: write [[sensors]]"
            " with a position"
        )


def _stiffness_name(case: Case) -> str:
    """The entry of the beam that its stiffness comes from, with its unit."""
    if case.beam.flexural_rigidity is not None:
        return "beam.flexural_rigidity in N m^2"
    return "beam.youngs_modulus in Pa, and beam.height in m"


def _deflection_warnings(case: Case, numbers: Plausibility) -> Iterator[str]:
    span, length = numbers.span, float(case.beam.length)
    for sag, cause, least in (
        (numbers.deflection, "its loads", LEAST_SPAN_OVER_DEFLECTION),
        (numbers.own_deflection, "its own weight", LEAST_SPAN_OVER_OWN_DEFLECTION),
    ):
        if sag and sag > span / least:
            share = (
                "more than its length"
                if sag > length
                else f"1/{span / sag:.2g} of its span of {span:.4g} m"
            )
            yield (
                f"the beam sags by {sag:.4g} m under {cause}, {share}: is"
                f" {_stiffness_name(case)}, not in kN m^2 or GPa, and are masses in kg?"
            )
            return
    sag = numbers.deflection
    if sag and span / sag > MOST_SPAN_OVER_DEFLECTION:
        yield (
            f"the beam sags by only {sag:.3g} m under its loads, 1/{span / sag:.2g} of its span:"
            f" are masses in kg, not in t, forces in N, not in kN, and is {_stiffness_name(case)}?"
        )


def _frequency_warnings(case: Case, found: Modes, numbers: Plausibility) -> Iterator[str]:
    first = numbers.first_frequency
    if first is not None and not LOWEST_FREQUENCY <= first <= HIGHEST_FREQUENCY:
        yield (
            f"the first frequency is {first:.3g} Hz: is beam.length in m, and is"
            f" {_stiffness_name(case)}?"
        )
    ratios = np.atleast_1d(case.beam.damping_ratio)
    name = "beam.damping_ratio"
    if case.beam.rayleigh_damping is not None:
        ratios, name = found.damping_ratios[:1], "beam.rayleigh_damping"
    elif not ratios.any():  # by loss factors, of the beam or of segments, or a material
        ratios, name = found.damping_ratios, "the loss factor of the beam"
    if ratios.max() > MOST_DAMPING:
        yield (
            f"{name} makes a damping ratio of {ratios.max():.3g}: it is a share of critical"
            f" damping, 0.01 for one per cent"
        )


def _mass_warnings(case: Case, numbers: Plausibility) -> Iterator[str]:
    ratio = numbers.mass_ratio
    if ratio is not None and ratio > MOST_MASS_RATIO:
        yield (
            f"the loads on the beam have {ratio:.3g} times its mass: is the mass of the beam per"
            " metre in kg/m, not in t/m, and are the loads in kg and N?"
        )


def _travel_warnings(case: Case, numbers: Plausibility) -> Iterator[str]:
    duration, length = float(case.run.duration), float(case.beam.length)
    for i, (enter, leave) in enumerate(crossing_times(case)):
        if enter >= duration:
            when = f"it would at t = {enter:.4g} s" if enter < NEVER else "it stops before"
            yield (
                f"loads.{i} never enters the beam: {when}, and the run ends at {duration:.4g} s"
                " (run.duration)"
            )
        elif duration < leave < NEVER:
            yield (
                f"loads.{i} has not left the beam by the end of the run at {duration:.4g} s: it"
                f" leaves at t = {leave:.4g} s; lengthen run.duration, or peaks may be missed"
            )
    if numbers.speed is None:
        return
    kmh = f"{numbers.speed:.4g} m/s is {3.6 * numbers.speed:.4g} km/h"
    on_road = any(load.kind in ROAD_KINDS for load in case.loads) or (
        case.profile is not None and case.profile.kind == "iso8608"
    )
    limit, traffic = (ROAD_SPEED, "road vehicle") if on_road else (RAIL_SPEED, "train in service")
    if length >= LEAST_BRIDGE and numbers.speed > limit:
        yield (
            f"{kmh}, faster than any {traffic}: give speeds in m/s, not in km/h, or with their unit"
        )
    elif numbers.speed_ratio is not None and numbers.speed_ratio > 1:
        yield (
            f"the loads are faster than the critical speed of {numbers.critical_speed:.4g} m/s"
            f" ({kmh}): is their speed in m/s, not in km/h?"
        )


def _support_warnings(case: Case) -> Iterator[str]:
    beam = case.beam
    length = float(beam.length)
    ends = (0.0, beam.left_end, "the left end"), (length, beam.right_end, "the right end")
    held = [(x, math.inf, name) for x, end, name in ends if END_CONDITIONS[end][0]]
    held += [
        (float(support.position), _stiffness(support), f"supports.{i}")
        for i, support in enumerate(case.supports)
    ]
    for i, support in enumerate(case.supports):
        drop = 0.0 if support.settlement is None else float(support.settlement)
        if abs(drop) > MOST_SETTLEMENT * length:
            yield (
                f"supports.{i} settles by {drop:.4g} m, {abs(drop) / length:.2g} times the length"
                f" of the beam: is supports.{i}.settlement in m, not in mm?"
            )
    unit = float(beam.bending_stiffness) / length
    for (left, k, first), (right, other_k, second) in itertools.pairwise(sorted(held)):
        apart = right - left
        flexibility = sum(1 / each if each else math.inf for each in (k, other_k))
        stiff = apart * apart > CLAMPING_STIFFNESS * unit * flexibility
        if 0 < apart < CLAMPING_DISTANCE * length and stiff:
            yield (
                f"{first} and {second} are only {apart:.3g} m apart, and clamp the beam: are"
                " positions in m? Leave one out, or clamp the end"
            )


def _inner_loop_warnings(case: Case) -> Iterator[str]:
    looped = [
        f"actuators.{i}.inner_loop"
        for i, actuator in enumerate(case.actuators)
        if isinstance(actuator, Electrodynamic) and actuator.inner_loop is not None
    ]
    if not looped:
        return
    fastest = max(poles(case), key=lambda pole: pole.real)
    if fastest.real > 0:
        hertz = abs(fastest.imag) / (2 * math.pi)
        yield (
            f"the beam with {' and '.join(looped)} is unstable without any controller: it grows as"
            f" exp({fastest.real:.3g} t / s) at {hertz:.3g} Hz; lower the bandwidth or the gains of"
            " the loop, or raise its sensor_bandwidth"
        )


def _stiffness(support: Support) -> float:
    return math.inf if support.stiffness is None else float(support.stiffness)
