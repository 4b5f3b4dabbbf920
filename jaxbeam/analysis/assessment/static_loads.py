"""Largest static effects of trains and of LM71 from influence lines."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.analysis.assessment.formulas import code_numbers
from jaxbeam.analysis.sections.characteristic_points import spans
from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.model.along_beam import SETTLED, refined
from jaxbeam.model.influence import held_positions, influence_line

LINE_POINTS = 801  # along the beam, between which influence lines are linear
FRONT_POSITIONS = 8001  # of the first axle of a train
SPAN_POSITIONS = 11  # of a span, between which its largest moment is searched


class CheckedSection(NamedTuple):
    """Place (m) along the beam where a quantity is compared, and its name there.

    Of a shear force also on which `side` of the place, "left" or "right".
    """

    name: str
    quantity: str
    x: float
    side: str = "right"


class TabulatedLine(NamedTuple):
    """Influence line (per newton) at load positions (m); zero off the beam."""

    positions: Float[np.ndarray, " position"]
    values: Float[np.ndarray, " position"]

    def at(self, x: Float[np.ndarray, "*place"]) -> Float[np.ndarray, "*place"]:
        """Values at positions x (m)."""
        return np.interp(x, self.positions, self.values, left=0.0, right=0.0)


def tabulated_line(case: Case, section: CheckedSection) -> TabulatedLine:
    """Influence line of a section, with a point at its kink."""
    length = float(concrete(case.beam.length))
    places = np.linspace(0.0, length, LINE_POINTS)
    # Shear forces jump at the section: a point on both sides of it.
    beside = section.x + 1e-9 * length * np.array([-1.0, 0.0, 1.0])
    places = np.unique(np.concatenate([places, np.clip(beside, 0, length), held_positions(case)]))
    line = influence_line(case, section.x, places, quantity=section.quantity, side=section.side)
    return TabulatedLine(places, np.asarray(line))


def largest_moments(case: Case) -> list[CheckedSection]:
    """Sections of the largest sagging moments of spans under LM71, where midspans have less.

    In the end spans of continuous beams they are at about 0.4 of the span.
    """

    def at(x):
        lines = [tabulated_line(case, CheckedSection("", "moment", float(one))) for one in x]
        positive = (TabulatedLine(line.positions, np.maximum(line.values, 0.0)) for line in lines)
        return np.array([largest_under_lm71(line) for line in positive])

    def curves(found):
        return found[:, None], np.max(np.abs(found)), [np.zeros((found.size, 0))]

    sections = []
    for i, (a, b) in enumerate(spans(case), 1):
        x, found = refined(case, at, curves, np.linspace(a, b, SPAN_POSITIONS))
        best = int(np.argmax(found))
        if found[best] > (1 + SETTLED) * found[np.argmin(np.abs(x - (a + b) / 2))]:
            name = f"largest moment in span {i}, at {x[best]:.4g} m"
            sections.append(CheckedSection(name, "moment", float(x[best])))
    return sections


def largest_under_train(line: TabulatedLine, offsets, forces) -> float:
    """Largest absolute static effect of axles (N) at offsets (m) behind the first."""
    length = line.positions[-1]
    fronts = np.linspace(0.0, length + offsets[-1], FRONT_POSITIONS)
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
        signed = TabulatedLine(line.positions, sign * line.values)
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
