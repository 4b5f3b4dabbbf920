"""Smallest and largest values of a quantity along the beam, with place of the loads and time."""

from typing import TYPE_CHECKING

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete, is_concrete, refuses_traced
from jaxbeam.case.quantities import QUANTITIES
from jaxbeam.model.along_beam import moving_positions, refined, sections
from jaxbeam.model.modes import Modes
from jaxbeam.model.static_correction import Motion
from jaxbeam.runtime.arrays import Array, any_traced, take, to_numpy, xp
from jaxbeam.runtime.dataset import labelled_dataset
from jaxbeam.runtime.module import Module
from jaxbeam.runtime.printer import TableViews
from jaxbeam.simulation.section_forces import history

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX

MAX_ENTRIES = 4_000_000  # of the influence of all loads on all positions and modes in one block


class RecordEnvelope(TableViews, Module):
    """Smallest and largest values of a quantity at positions (m), from the samples of a record.

    Values are in the unit of the quantity; with each are its time (s) and the positions of the
    loads then (m, NaN off the beam), and the value of the `coincident` quantity there and then, if
    one was asked for: of a shear force, that on the side on which it is larger.
    """

    positions: Float[Array, " position"]
    smallest: Float[Array, " position"]
    smallest_time: Float[Array, " position"]
    smallest_load_position: Float[Array, "position load"]
    largest: Float[Array, " position"]
    largest_time: Float[Array, " position"]
    largest_load_position: Float[Array, "position load"]
    quantity: str = eqx.field(static=True)
    smallest_coincident: Float[Array, " position"] | None = None
    largest_coincident: Float[Array, " position"] | None = None
    coincident: str = eqx.field(static=True, default="")

    @property
    @refuses_traced("a table")
    def columns(self) -> dict[str, np.ndarray]:
        """Position (m), smallest and largest value with their times (s), by head."""
        head = _head(self.quantity)
        columns = {
            "position (m)": np.asarray(self.positions),
            f"smallest {head}": np.asarray(self.smallest),
            "time of smallest (s)": np.asarray(self.smallest_time),
            f"largest {head}": np.asarray(self.largest),
            "time of largest (s)": np.asarray(self.largest_time),
        }
        if self.coincident:
            other = _head(self.coincident)
            columns[f"{other} at smallest"] = np.asarray(self.smallest_coincident)
            columns[f"{other} at largest"] = np.asarray(self.largest_coincident)
        return columns

    @refuses_traced("a dataset")
    def to_xarray(self) -> "xarray.Dataset":
        """Labelled dataset with units."""
        unit, words = QUANTITIES[self.quantity].unit, self.quantity
        variables = {}
        for side in ("smallest", "largest"):
            values = (getattr(self, f"{side}{part}") for part in ("", "_time", "_load_position"))
            value, time, place = map(np.asarray, values)
            variables |= {
                side: ("position", value, {"units": unit, "long_name": f"{side} {words}"}),
                f"{side}_time": ("position", time, {"units": "s"}),
                f"{side}_load_position": (("position", "load"), place, {"units": "m"}),
            }
            if self.coincident:
                other = np.asarray(getattr(self, f"{side}_coincident"))
                attributes = {
                    "units": QUANTITIES[self.coincident].unit,
                    "long_name": f"{self.coincident} at the {side} {words}",
                }
                variables[f"{side}_coincident"] = ("position", other, attributes)
        x = ("position", np.asarray(self.positions), {"units": "m"})
        return labelled_dataset(variables, {"position": x}, {"quantity": self.quantity})


def _head(quantity: str) -> str:
    unit = QUANTITIES[quantity].unit
    return quantity if unit == "1" else f"{quantity} ({unit})"


def record_envelope(
    case: Case,
    modes: Modes,
    motion: Motion,
    times: Float[Array, " time"],
    quantity: str,
    positions: Float[Array, " position"] | None = None,
    fibre_distance=None,
    section_modulus=None,
    coincident: str = "",
) -> RecordEnvelope:
    """Envelope of a quantity at positions (m), by default those of `refined`.

    See `Record.envelope`. Raises ValueError as `history` does.
    """
    parameters = fibre_distance, section_modulus
    if not any_traced(case, modes, motion, times):
        case, modes, motion, times = to_numpy((case, modes, motion, times))

    def at(x):
        return _envelope_at(case, modes, motion, times, x, quantity, coincident, parameters)

    def curves(found: RecordEnvelope):
        values = xp.stack([-found.smallest, found.largest], axis=-1)
        places = found.smallest_load_position, found.largest_load_position
        return values, xp.max(xp.abs(values)), tuple(map(np.asarray, places))

    numbers = case, modes, motion, times, parameters
    leaves = jax.tree.leaves(numbers)
    if positions is None and any_traced(leaves) and all(map(is_concrete, leaves)):
        # Positions of the extremes of the concrete numbers, where the values are differentiated.
        plain = jax.tree.map(lambda n: concrete(n) if any_traced(n) else n, numbers)
        own_case, own_modes, own_motion, own_times, (fibre, modulus) = plain
        run = own_case, own_modes, own_motion, own_times
        found = record_envelope(*run, quantity, None, fibre, modulus)
        at_extremes = [
            motion.load_position[np.searchsorted(own_times, time)]
            for time in (found.smallest_time, found.largest_time)
        ]
        load_places = xp.concatenate(at_extremes, axis=1).T
        positions, _ = moving_positions(case, np.asarray(found.positions), list(load_places))
    if positions is not None:
        return at(xp.asarray(positions, float))
    return refined(case, at, curves)[1]


def _envelope_at(case, modes, motion, times, x, quantity, coincident, parameters):
    """Envelope at positions x (m), in blocks of samples."""
    points, at_coincident = sections(case, x, quantity), sections(case, x, coincident or quantity)
    size = max(1, len(case.loads), motion.load_position.shape[1])
    size *= points.points.shape[0] + motion.coordinates.shape[1]
    count = -(-times.shape[0] * size // MAX_ENTRIES)
    found: dict[float, tuple] = {}
    for block in np.array_split(np.arange(times.shape[0]), min(count, times.shape[0])):
        own = Motion(*(part[block] for part in motion))
        values = history(case, modes, own, points.points, quantity, *parameters)
        other = None
        if coincident:
            every = history(case, modes, own, at_coincident.points, coincident, *parameters)
            most, least = at_coincident.largest(every), at_coincident.smallest(every)
            other = xp.where(xp.abs(most) >= xp.abs(least), most, least)
        for sign, curve in ((-1.0, -points.smallest(values)), (1.0, points.largest(values))):
            new = _extremes(curve, times[block], own, other)
            found[sign] = _larger(found[sign], new) if sign in found else new
    (low, *of_low), (high, *of_high) = found[-1.0], found[1.0]
    others = (of_low.pop(), of_high.pop()) if coincident else (None, None)
    return RecordEnvelope(
        *(x, -low, *of_low, high, *of_high, quantity),
        smallest_coincident=others[0],
        largest_coincident=others[1],
        coincident=coincident,
    )


def _extremes(values, times, motion: Motion, other) -> tuple:
    """Largest of values (time, position), its time, and the positions of the loads then.

    Followed by another quantity (time, position) there and then, unless it is None.
    """
    index = xp.argmax(values, axis=0)
    found = (xp.take_along_axis(values, index[None], axis=0)[0], take(times, index))
    found += (take(motion.load_position, index),)
    return found if other is None else (*found, xp.take_along_axis(other, index[None], axis=0)[0])


def _larger(one: tuple, other: tuple) -> tuple:
    """The larger of two results of `_extremes`, at each position."""
    is_larger = other[0] > one[0]
    return tuple(
        xp.where(is_larger[:, None] if a.ndim == 2 else is_larger, b, a)
        for a, b in zip(one, other, strict=True)
    )
