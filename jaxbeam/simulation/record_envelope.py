"""Smallest and largest values of a quantity along the beam, with place of the loads and time."""

from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.display.views import TableViews
from jaxbeam.case.quantities import QUANTITIES
from jaxbeam.model.modes import Modes
from jaxbeam.model.static_correction import Motion
from jaxbeam.runtime.arrays import Array, take, xp
from jaxbeam.runtime.dataset import labelled_dataset
from jaxbeam.runtime.module import Module
from jaxbeam.simulation.section_forces import SIDES, history, shear_force

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX

MAX_ENTRIES = 4_000_000  # of the influence of all loads at all times on one part of the positions
DEFAULT_POSITIONS = 101


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
    """Envelope of a quantity at positions (m), by default equally spaced; see `Record.envelope`.

    Of shear forces on both sides of each position. Raises ValueError as `history` does.
    """
    if positions is None:
        positions = case.beam.length * np.linspace(0.0, 1.0, DEFAULT_POSITIONS)
    positions = xp.asarray(positions, float)
    size = max(1, times.shape[0] * len(case.loads))
    parts = -(-positions.shape[0] * size // MAX_ENTRIES)
    parameters = fibre_distance, section_modulus
    found: list[list] = []
    for part in np.array_split(np.arange(positions.shape[0]), parts):
        x = positions[part]

        def sides_of(name, x=x):
            """Histories (side, time, position) at the positions of this part."""
            if name == "shear":
                return xp.stack([shear_force(case, modes, motion, x, side) for side in SIDES])
            return history(case, modes, motion, x, name, *parameters)[None]

        sides, other = sides_of(quantity), None
        if coincident:
            every = sides_of(coincident)
            larger = xp.abs(every[0]) >= xp.abs(every[-1])
            other = xp.where(larger, every[0], every[-1])
        low, high = (_extremes(sign * sides, times, motion, other, sign) for sign in (-1.0, 1.0))
        found.append([*low[:3], *high[:3], *low[3:], *high[3:]])
    low, low_time, low_place, high, high_time, high_place, *others = map(
        xp.concatenate, zip(*found, strict=True)
    )
    with_low, with_high = others or (None, None)
    return RecordEnvelope(
        *(positions, low, low_time, low_place, high, high_time, high_place, quantity),
        smallest_coincident=with_low,
        largest_coincident=with_high,
        coincident=coincident,
    )


def _extremes(values, times, motion: Motion, other, sign: float):
    """Largest of values (side, time, position) with a sign, its time, and the loads then.

    Followed by another quantity (time, position) there and then, unless it is None.
    """
    highest = xp.max(values, axis=0)
    index = xp.argmax(highest, axis=0)
    value = xp.take_along_axis(highest, index[None], axis=0)[0]
    extremes = [sign * value, take(times, index), take(motion.load_position, index)]
    if other is not None:
        extremes.append(xp.take_along_axis(other, index[None], axis=0)[0])
    return extremes
