"""Envelopes of the load models of road bridges: a vehicle at its worst place, and a lane load.

Models are those of `jaxbeam/case/library/load_models.toml`; a new one is a table there.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.analysis.sections import Envelope, envelope
from jaxbeam.case.case import Case
from jaxbeam.case.fields import check_on_beam, concrete, refuses_traced, suggestion
from jaxbeam.case.library.published import LoadModel, ModelVehicle, load_models, trains
from jaxbeam.case.loads.axles import Axles
from jaxbeam.case.sensors import quantity_of
from jaxbeam.case.toml_file import number_in_si
from jaxbeam.case.track import Kernel
from jaxbeam.model.along_beam import positions_along, sections
from jaxbeam.model.elements import held_positions
from jaxbeam.model.modes import modes
from jaxbeam.model.statics import REACTION, influence_line

POSITIONS = 41  # along the beam by default, in addition to the special ones
LINE_POINTS = 2001  # along the beam, between which influence lines are linear
COARSE = 20  # points of a line between those at which an axle is tried first
REFINED = 4  # of the places found so, those whose neighbours are tried at all points


def load_model(name: str) -> LoadModel:
    """Load model of a name, or one of a train of the library without a lane load.

    Raises ValueError for an unknown name, and for a train without forces.
    """
    if name in load_models():
        return load_models()[name]
    train = trains().get(name)
    if train is not None and train.forces is None:
        raise ValueError(f"{name} has masses of its axles, not forces; take another train")
    if train is None:
        names = [
            *load_models(),
            *(one for one, train in trains().items() if train.forces is not None),
        ]
        raise ValueError(f"there is no load model {name!r}; {suggestion(name, names)}")
    spacings = np.diff(train.offsets)
    return LoadModel((ModelVehicle(name, spacings, train.forces, 0.0, None, None, ()),), 0.0)


class WorstPlace(NamedTuple):
    """Worst place of a vehicle: name, offsets (m) of axles behind the first, x (m) of the first.

    Offsets are negative for a vehicle that goes to the left. Without a `vehicle` there is none.
    """

    vehicle: str
    offsets: Float[np.ndarray, " axle"]
    first_axle: float

    def __str__(self) -> str:
        if not self.vehicle:
            return "unloaded"
        last, first = sorted((self.first_axle, self.first_axle - self.offsets[-1]))
        return f"{self.vehicle} {last:.4g}-{first:.4g} m"


@dataclasses.dataclass(frozen=True)
class LoadModelEnvelope:
    """Lowest and highest static value of a quantity at `positions` (m), in SI units.

    At most zero and at least zero. Axles count with the allowance, the lane load without.
    `at_lowest` and `at_highest` are the places of the vehicles.
    """

    positions: Float[np.ndarray, " position"]
    lowest: Float[np.ndarray, " position"]
    highest: Float[np.ndarray, " position"]
    at_lowest: tuple[WorstPlace, ...]
    at_highest: tuple[WorstPlace, ...]


def check_quantity(quantity: str) -> None:
    """Check that a quantity has an influence line of loads that are on the axis of the beam.

    Raises ValueError for unknown ones, and for those of the twist.
    """
    if quantity != REACTION and quantity_of(quantity).of_twist:
        raise ValueError(
            f"{quantity} depends on the eccentricity of the loads, which load models do not have:"
            " give a case loads with an eccentricity, and take their envelope"
        )


@refuses_traced("an envelope of a load model")
def load_model_envelope(
    case: Case,
    model: str | LoadModel,
    x=None,
    *,
    quantity: str = "moment",
    lane: float | str | None = None,
    allowance: float | str | None = None,
) -> LoadModelEnvelope:
    """Static envelope of a load model of a code at positions x (m), by default along the beam.

    One vehicle of the `model`, a name of `load_models` or a train of the library, stands wherever
    it is worst, in either direction, in part on the beam; its varied spacing has the worst of its
    values. All axles on the beam count, those that relieve too. The `lane` load (N/m, or "9 kN/m")
    lies on all parts where it is unfavourable. `allowance` is added to effects of axles. Both are
    by default those of the model. Quantities are those of `influence_line`; of what jumps at a
    position both sides count. The case's own loads do not.

    Raises ValueError as `influence_line`, for an unknown model, and for a lane load or an allowance
    below 0.

    >>> import jaxbeam as jb
    >>> from jaxbeam.analysis.load_models import load_model_envelope
    >>> case = jb.Case(jb.Beam(length=20.0, flexural_rigidity=6e9, mass_per_length=9e3))
    >>> found = load_model_envelope(case, "LM1", x=[10.0])  # 2 * 300 kN * 4.7 m + 27 kN/m L^2 / 8
    >>> print(f"{found.highest[0]:.4g} N m")
    4.17e+06 N m
    """
    chosen = load_model(model) if isinstance(model, str) else model
    lane = None if lane is None else number_in_si(lane, "N/m", "lane")
    allowance = chosen.allowance if allowance is None else number_in_si(allowance, "1", "allowance")
    for name, value in (("lane", lane or 0.0), ("allowance", allowance)):
        if not 0 <= value < np.inf:
            raise ValueError(f"{name} must be 0 or more, not {value:g}")
    if x is None:
        x = held_positions(case) if quantity == REACTION else positions_along(case, POSITIONS)
    x = np.atleast_1d(np.asarray(concrete(x, "x"), float))
    check_on_beam("x", x, case.beam.length)
    points, left_of = x, np.zeros(0, int)
    check_quantity(quantity)
    if quantity != REACTION:
        points, left_of = map(np.asarray, sections(case, x, quantity))
    found = [
        _extremes(influence_at(case, float(point), quantity), chosen, lane, 1 + allowance)
        for point in points
    ]
    lowest, highest = ([one[i] for one in found[: x.size]] for i in (0, 1))
    for position, (low, high) in zip(left_of, found[x.size :], strict=True):
        lowest[position] = min(lowest[position], low, key=lambda one: one[0])
        highest[position] = max(highest[position], high, key=lambda one: one[0])
    return LoadModelEnvelope(
        x,
        np.array([value for value, _ in lowest]),
        np.array([value for value, _ in highest]),
        tuple(place for _, place in lowest),
        tuple(place for _, place in highest),
    )


@refuses_traced("an envelope of a load model")
def crossing_envelope(
    case: Case, model: str | LoadModel, speed: float | str, x, *, quantity: str = "moment"
) -> Envelope:
    """Dynamic envelope at positions x (m) of the vehicles of a load model, one after another.

    Each crosses from the left at a `speed` (m/s, or "80 km/h") with the least of its varied
    spacing, as moving forces without allowance and lane load, and the run goes on for one period of
    the lowest mode.
    Raises as `envelope`, and ValueError for an unknown model or a speed that is not above 0.
    """
    speed = number_in_si(speed, "m/s", "speed")
    if not 0 < speed < np.inf:
        raise ValueError(f"the speed of a crossing must be above 0 m/s, not {speed:g}")
    chosen = load_model(model) if isinstance(model, str) else model
    free = dataclasses.replace(case, loads=(), controller=None)
    length, period = float(concrete(case.beam.length)), 1 / float(modes(free).frequencies[0])
    found = []
    for vehicle in chosen.vehicles:
        offsets = vehicle.with_spacing(None)
        axles = Axles(offsets=offsets, forces=vehicle.axle_forces, speed=speed)
        run = dataclasses.replace(case.run, duration=(length + offsets[-1]) / speed + period)
        crossing = dataclasses.replace(free, loads=(axles,), run=run)
        found.append(envelope(crossing, x, quantity=quantity))
    lowest = np.min([one.lowest for one in found], axis=0)
    return Envelope(lowest, np.max([one.highest for one in found], axis=0), found[0].positions)


class TabulatedLine(NamedTuple):
    """Influence line (per newton) at load positions (m); zero off the beam.

    It is linear between positions, among which are its `kinks` (m).
    """

    positions: Float[np.ndarray, " position"]
    values: Float[np.ndarray, " position"]
    kinks: Float[np.ndarray, " kink"]

    def at(self, x: Float[np.ndarray, "*place"]) -> Float[np.ndarray, "*place"]:
        """Values at positions x (m)."""
        return np.interp(x, self.positions, self.values, left=0.0, right=0.0)

    def spread(self, kernel: Kernel) -> "TabulatedLine":
        """Influence line of axles that a track spreads; off the beam, of the part of them on it.

        Between positions, of which an even spread has a curve, it is linear.
        """
        places = np.unique((self.positions[:, None] - concrete(kernel.offsets)).reshape(-1))
        values = self.values
        steps = np.diff(self.positions) * (values[1:] + values[:-1]) / 2
        integral = np.append(0.0, np.cumsum(steps))
        total = np.zeros(places.size)
        for offset, weight in zip(*map(concrete, kernel[:2]), strict=True):
            x = places + offset
            total += weight * (
                np.interp(x, self.positions, integral) if kernel.integrated else self.at(x)
            )
        kinks = (self.kinks[:, None] - concrete(kernel.offsets)).reshape(-1)
        return TabulatedLine(places, total, kinks)

    @property
    def positive_area(self) -> float:
        """Integral of the positive values over the positions (m)."""
        a, b = self.values[:-1], self.values[1:]
        # Of an interval in which the line crosses zero a triangle counts.
        highest, lowest = np.maximum(a, b), np.minimum(a, b)
        crosses = (highest > 0) & (lowest < 0)
        fraction = np.where(crosses, highest / np.where(crosses, highest - lowest, 1.0), 1.0)
        heights = np.where(crosses, highest, np.maximum(a, 0.0) + np.maximum(b, 0.0))
        return float(np.sum(np.diff(self.positions) * fraction * heights / 2))


@refuses_traced("a table of influences")
def influence_at(
    case: Case, x: float, quantity: str, side: str = "right", points: int = LINE_POINTS
) -> TabulatedLine:
    """Influence line of a quantity at x (m), for loads at equally spaced `points` and its kinks."""
    length = float(concrete(case.beam.length))
    places = np.linspace(0.0, length, points)
    # Shear forces jump at the section: a point on both sides of it.
    around = x + 1e-9 * length * np.array([-1.0, 0.0, 1.0])
    hinges = [float(concrete(hinge.position)) for hinge in case.beam.hinges]
    kinks = np.concatenate([np.clip(around, 0.0, length), held_positions(case), hinges])
    places = np.union1d(places, kinks)
    line = influence_line(case, x, places, quantity=quantity, side=side)
    return TabulatedLine(places, np.asarray(line), kinks)


def _extremes(line: TabulatedLine, model: LoadModel, lane: float | None, factor: float):
    """Lowest and highest value with the places of the vehicles, each at most and at least zero."""
    found = []
    for sign in (-1.0, 1.0):
        signed = line._replace(values=sign * line.values)
        area = signed.positive_area
        best = 0.0, WorstPlace("", np.zeros(0), np.nan)
        for vehicle in model.vehicles:
            uniform = (vehicle.lane if lane is None else lane) * area
            value, place = _worst_place(signed, vehicle)
            if factor * value + uniform > best[0]:
                best = factor * value + uniform, place
        found.append((sign * best[0] + 0.0, best[1]))  # no -0.0
    return found


def _worst_place(line: TabulatedLine, vehicle: ModelVehicle) -> tuple[float, WorstPlace]:
    """Largest sum of the axle forces times the line (N times its unit), and the vehicle's place."""
    if vehicle.between is None:
        return _worst_rigid_place(line, vehicle, vehicle.choices or (None,))
    low, high = vehicle.between
    between = low, high or max(low, float(line.positions[-1]))
    found = _worst_rigid_place(line, vehicle, between), _worst_apart(line, vehicle, *between)
    return max(found, key=lambda one: one[0])


def _worst_rigid_place(line: TabulatedLine, vehicle: ModelVehicle, spacings):
    """The same for some values of the varied spacing (m), None for the vehicle's own."""
    coarse = np.concatenate([line.positions[::COARSE], line.kinks])

    def best(places, behind) -> tuple[float, WorstPlace]:
        """The best with an axle at one of the places, of axles at distances behind the first."""
        fronts = (places[:, None] + behind).ravel()
        total = line.at(fronts[:, None] - behind) @ vehicle.axle_forces
        i = int(np.argmax(total))
        return float(total[i]), WorstPlace(vehicle.name, behind, float(fronts[i]))

    found = []
    for spacing in spacings:
        offsets = vehicle.with_spacing(spacing)
        found += [best(coarse, offsets), best(coarse, -offsets)]
    # The line is linear between its points, so that an axle is at one of them at the worst place.
    step = COARSE * line.positions[-1] / line.positions.size
    for _, place in sorted(found, key=lambda one: -one[0])[:REFINED]:
        near = np.abs(line.positions[:, None] - place.first_axle + place.offsets)
        points = line.positions[near.min(axis=1) <= 2 * step]
        if points.size:
            found.append(best(points, place.offsets))
    return max(found, key=lambda one: one[0])


def _worst_apart(line: TabulatedLine, vehicle: ModelVehicle, low: float, high: float):
    """The same where the varied spacing is free between two values (m).

    The axles before and behind it are then each at a best place of their own: one of them is at a
    point of the line, or next to the beam.
    """
    length, offsets = line.positions[-1], vehicle.with_spacing(0.0)
    split = 1 + (vehicle.varied or 0)
    points = np.concatenate([[-1e-9 * length], line.positions, [(1 + 1e-9) * length]])
    best = 0.0, WorstPlace("", np.zeros(0), np.nan)
    for way in (1.0, -1.0):
        groups = []
        for part in (slice(None, split), slice(split, None)):
            behind = way * (offsets[part] - offsets[part][0])
            fronts = np.unique(points[:, None] + behind)
            groups.append((fronts, line.at(fronts[:, None] - behind) @ vehicle.axle_forces[part]))
        (front, ahead), (rear, after) = groups
        last = front - way * offsets[split - 1]
        ends = np.sort(last[:, None] - way * np.array([low, high]), axis=1)
        start, stop = np.searchsorted(rear, ends[:, 0]), np.searchsorted(rear, ends[:, 1], "right")
        chosen = _largest_between(after, start, stop)
        total = np.where(start < stop, ahead + after[chosen], -np.inf)
        i = int(np.argmax(total))
        if total[i] > best[0]:
            spacing = way * float(last[i] - rear[chosen[i]])
            behind = way * vehicle.with_spacing(spacing)
            best = float(total[i]), WorstPlace(vehicle.name, behind, float(front[i]))
    return best


def _largest_between(values, start, stop) -> np.ndarray:
    """Indices of the largest of values[start:stop] for many pairs, 0 where there is none."""
    found, size, largest = np.zeros(start.size, int), 1, np.arange(values.size)
    counts = stop - start
    while largest.size:  # `largest` has those of all ranges of the size
        at = (size <= counts) & (counts < 2 * size)
        first, second = largest[start[at]], largest[stop[at] - size]
        found[at] = np.where(values[first] >= values[second], first, second)
        first, second = largest[:-size], largest[size:]
        largest = np.where(values[first] >= values[second], first, second)
        size *= 2
    return found
