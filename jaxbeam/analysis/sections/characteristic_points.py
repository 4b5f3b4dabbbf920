"""Characteristic sections of a beam: midspans, quarter points, supports."""

import itertools
from typing import NamedTuple

from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.model.influence import held_positions


class CharacteristicPoint(NamedTuple):
    """Point of a beam by name, as "midspan 1", with its distance from the left end (m)."""

    name: str
    x: float


def spans(case: Case) -> list[tuple[float, float]]:
    """Ends (m) of the spans between held points, overhangs included, from left to right."""
    length = float(concrete(case.beam.length))
    marks = sorted({0.0, *held_positions(case).tolist(), length})
    return [(a, b) for a, b in itertools.pairwise(marks) if b - a > 1e-9 * length]


def characteristic_points(case: Case) -> list[CharacteristicPoint]:
    """Supports, quarter points and midspans of all spans, hinges and free ends, left to right.

    Spans and supports are counted from 1; of an overhang the points are those of a span.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> print([point[0] for point in jb.characteristic_points(jb.Case(beam))][:2])
    ['support 1', 'quarter 1']
    """
    length, held = float(concrete(case.beam.length)), set(held_positions(case).tolist())
    points = [CharacteristicPoint(f"support {i}", x) for i, x in enumerate(sorted(held), 1)]
    for i, (a, b) in enumerate(spans(case), 1):
        for name, share in (("quarter", 0.25), ("midspan", 0.5), ("three quarters", 0.75)):
            points.append(CharacteristicPoint(f"{name} {i}", a + share * (b - a)))
    hinges = sorted(float(concrete(hinge.position)) for hinge in case.beam.hinges)
    points += [CharacteristicPoint(f"hinge {i}", x) for i, x in enumerate(hinges, 1)]
    for name, x in (("left end", 0.0), ("right end", length)):
        if x not in held:
            points.append(CharacteristicPoint(name, x))
    return sorted(points, key=lambda point: point.x)
