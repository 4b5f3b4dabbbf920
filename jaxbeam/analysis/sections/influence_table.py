"""Influence lines of many sections on common load positions, for tables and figures."""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxbeam.analysis.sections.characteristic_points import characteristic_points
from jaxbeam.case.beam import END_CONDITIONS
from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.case.quantities import QUANTITIES
from jaxbeam.model.influence import (
    DEFAULT_POSITIONS,
    REACTION,
    held_positions,
    influence_line,
)

PER_NEWTON = {"N": "1", "N m": "m"}  # other units are written with /N


@dataclasses.dataclass(frozen=True)
class InfluenceTable:
    """Influence lines (position, line) per newton downwards at load `positions` (m).

    Each line has a quantity, a unit and the place of its section, as "midspan 1".
    """

    positions: Float[np.ndarray, " position"]
    values: Float[np.ndarray, "position line"]
    quantities: tuple[str, ...]
    units: tuple[str, ...]
    places: tuple[str, ...]

    @property
    def columns(self) -> dict[str, Float[np.ndarray, " position"]]:
        """Load positions and lines by head, as "moment at midspan 1 (m)"."""
        heads = {"load position (m)": self.positions}
        for i, (quantity, unit, place) in enumerate(
            zip(self.quantities, self.units, self.places, strict=True)
        ):
            heads[f"{quantity} at {place} ({unit})"] = self.values[:, i]
        return heads


def influence_table(
    case: Case,
    quantities: tuple[str, ...] = (),
    x: tuple[float, ...] = (),
    load_positions=None,
    *,
    fibre_distance=None,
    section_modulus=None,
) -> InfluenceTable:
    """Influence lines of quantities at positions x (m), by default the characteristic ones.

    By default moments at midspans and over supports that bend, deflections at midspans, and
    reactions; one quantity alone is at all characteristic points, a reaction at all supports.
    Shear forces are those right of a section (at the right end, left of it). Raises ValueError as
    `influence_line` does.
    """
    length = float(concrete(case.beam.length))
    if load_positions is None:
        grid = np.linspace(0.0, length, DEFAULT_POSITIONS)
        load_positions = np.unique(np.concatenate([grid, held_positions(case), np.array(x)]))
    positions = np.asarray(load_positions, float)
    lines, values = [], []
    for quantity, place, at in _sections(case, quantities, x):
        parameters = {"fibre_distance": fibre_distance, "section_modulus": section_modulus}
        line = influence_line(case, at, positions, quantity=quantity, **parameters)
        unit = "N" if quantity == REACTION else QUANTITIES[quantity].unit
        lines.append((quantity, PER_NEWTON.get(unit, f"{unit}/N"), place))
        values.append(np.asarray(line))
    names, units, places = zip(*lines, strict=True)
    return InfluenceTable(positions, np.stack(values, axis=-1), names, units, places)


def _sections(case: Case, quantities, x) -> list[tuple[str, str, float]]:
    """Quantity, name of the place and position (m) of each line."""
    points, held = characteristic_points(case), held_positions(case).tolist()
    if x:
        named = {point.x: point.name for point in points}
        given = [(named.get(at, f"{at:g} m"), float(at)) for at in x]
        return [(quantity, *at) for quantity in quantities or ("moment",) for at in given]
    supports = [(p.name, p.x) for p in points if p.x in held]
    if quantities:
        every = [(p.name, p.x) for p in points]
        return [
            (quantity, *at)
            for quantity in quantities
            for at in (supports if quantity == REACTION else every)
        ]
    middles = [(p.name, p.x) for p in points if p.name.startswith("midspan")]
    length = float(concrete(case.beam.length))
    turning = {0.0: case.beam.left_end, length: case.beam.right_end}
    bending = [(n, at) for n, at in supports if at not in turning or END_CONDITIONS[turning[at]][1]]
    return [
        *(("moment", *at) for at in (*middles, *bending)),
        *(("deflection", *at) for at in middles),
        *((REACTION, *at) for at in supports),
    ]
