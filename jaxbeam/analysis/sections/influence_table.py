"""Influence lines of many sections on common load positions, for tables and figures."""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxbeam.analysis.sections.characteristic_points import characteristic_points
from jaxbeam.case.beam import END_CONDITIONS
from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.case.quantities import QUANTITIES
from jaxbeam.model.along_beam import LEFT_SHARE, positions_along, refined
from jaxbeam.model.influence import (
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
    Shear forces are those right of a section (at the right end, left of it). Positions of the load
    are by default those of `model.along_beam`, with more around the extremes of each line. Raises
    ValueError as `influence_line` does.
    """
    parameters = {"fibre_distance": fibre_distance, "section_modulus": section_modulus}
    lines = _sections(case, quantities, x)

    def at(positions) -> dict[str, np.ndarray]:
        columns = [
            influence_line(case, place, positions, quantity=quantity, **parameters)
            for quantity, _, place in lines
        ]
        return {"values": np.stack(list(map(np.asarray, columns)), axis=-1)}

    def curves(found):
        values = found["values"]
        sizes, near = np.abs(values).max(axis=0), np.zeros((values.shape[0], 0))
        both = np.concatenate([values, -values], axis=-1)
        return both, np.concatenate([sizes, sizes]), [near] * both.shape[-1]

    if load_positions is None:
        # A shear force jumps by the load as it passes the section: a position on each side.
        length = float(concrete(case.beam.length))
        own = np.array([place for _, _, place in lines])
        beside = [min(p + LEFT_SHARE * length, length) for q, _, p in lines if q == "shear"]
        start = positions_along(case, places=np.concatenate([own, beside]))
        found_at, found = refined(case, at, curves, start)
        positions = np.asarray(found_at)
    else:
        positions = np.asarray(load_positions, float)
        found = at(positions)
    units = ["N" if q == REACTION else QUANTITIES[q].unit for q, _, _ in lines]
    return InfluenceTable(
        positions,
        found["values"],
        tuple(quantity for quantity, _, _ in lines),
        tuple(PER_NEWTON.get(unit, f"{unit}/N") for unit in units),
        tuple(name for _, name, _ in lines),
    )


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
