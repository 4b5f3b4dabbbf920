"""Quantities along the beam: envelopes, amplification, section forces; corrections of records.

With an inner loop the amplifier of a shaker sets the voltage of its coil; without `limits` nothing
bounds it in the model, and here it can be compared with what the amplifier has.
"""

import dataclasses
import itertools
from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.actuators.electrodynamic import Electrodynamic, PortSignal
from jaxbeam.case.arguments import checks_classes
from jaxbeam.case.beam import END_CONDITIONS
from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.fields import (
    OUTSIDE,
    check_on_beam,
    concrete,
    real_numbers,
    refuse_traced,
    refuses_traced,
    suggestion,
)
from jaxbeam.case.sensors import QUANTITIES, Sensor, quantity_of
from jaxbeam.model.along_beam import (
    LEFT_DISTANCE,
    moving_positions,
    positions_along,
    refined,
    sections,
)
from jaxbeam.model.elements import held_positions
from jaxbeam.model.load_set import load_set
from jaxbeam.model.static_correction import bending_moment, corrected_history, shear_force
from jaxbeam.model.statics import REACTION, influence_line, static_peak, unit_of_effect
from jaxbeam.runtime.arrays import Array, Module, any_jax, xp
from jaxbeam.runtime.compiling import compiled, compiled_if_traced
from jaxbeam.runtime.printer import TableViews
from jaxbeam.simulation.integration_plan import TOLERANCE, integration_plan, sample_times
from jaxbeam.simulation.integrator.integrate import integrate_peaks
from jaxbeam.simulation.record import Record, envelope_headline, with_unit
from jaxbeam.simulation.simulate import integration_setup, run_integration


@checks_classes
def corrected_deflection(record: Record, x, derivative: int = 0) -> Float[Array, "time *position"]:
    """Statically corrected history of a record's deflection at x (m), in m.

    Sum of the modes, plus the residual of the modes under the forces of each instant (see
    `corrected_history`); `derivative` (up to 3) gives that x-derivative instead. Accurate where
    forces and commands change slowly compared with the first truncated mode.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> case = jb.Case(
    ...     beam, sensors=[jb.Sensor(0.3)], loads=[jb.MovingMass(mass=0.5, speed=2.0)]
    ... )
    >>> print(jb.sections.corrected_deflection(jb.simulate(case), 0.3).shape)
    (1001,)
    """
    x = real_numbers("x", x, "m", "positions")
    return corrected_history(record.case, record.modes, record.motion, x, derivative)


class CoilHistory(NamedTuple):
    """Current (A), voltage (V), and force on the beam (N) at times (s)."""

    times: Float[Array, " time"]
    current: Float[Array, " time"]
    voltage: Float[Array, " time"]
    force: Float[Array, " time"]


def coil_history(
    case: Case,
    actuator: int = 0,
    times: Float[Array, " time"] | None = None,
    tolerance: float = TOLERANCE,
) -> CoilHistory:
    """Current and voltage of the shaker with an index, and its force on the beam, over a run.

    At the sample times of the run, or at others (s), ascending; the run is simulated anew. Between
    samples of a controller the voltage may be larger: sample finely enough.

    Raises ValueError as `simulate` does, and if the actuator is no electrodynamic shaker.

    >>> import jaxbeam as jb
    >>> from jaxbeam.analysis.sections import coil_history
    >>> loop = jb.actuators.CurrentLoop(bandwidth=2e3)
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.2, modes=2),
    ...     actuators=[jb.Electrodynamic(0.3, 3.0, 1e-3, 8.0, inner_loop=loop)],
    ...     controller=jb.Prescribed(offsets=[0.5], period=0.01),
    ...     run=jb.Run(0.4, sample_rate=200.0),
    ... )
    >>> coil = coil_history(case)
    >>> print(f"{coil.current[-1]:.3f} A, {coil.voltage[-1]:.2f} V, {coil.force[-1]:.2f} N")
    0.500 A, 1.50 V, 4.00 N
    """
    device = case.actuators[actuator] if actuator < len(case.actuators) else None
    if not isinstance(device, Electrodynamic):
        raise ValueError(f"actuators.{actuator} is no electrodynamic shaker, and has no coil")
    times = sample_times(case) if times is None else real_numbers("times", times, "s")
    integration = run_integration(case, integration_plan(case, times, tolerance), times, None)
    motion, model, port = integration.outputs.motion, integration.model, device.coil_port()
    sizes = [one.attachment().state_matrix.shape[0] for one in case.actuators]
    first = 2 * model.mode_count + sum(sizes[:actuator])
    states = integration.sampled_states[:, first : first + sizes[actuator]]
    shape = model.modes.fields(device.position, (0,))[0]
    at_port = xp.stack(
        [part @ shape for part in (motion.coordinates, motion.rates, motion.accelerations)], axis=-1
    )

    def history(signal: PortSignal):
        return (
            states @ signal.states
            + signal.command * motion.command[:, actuator]
            + at_port @ signal.port
        )

    current = history(port.current)
    suspension = xp.stack([device.stiffness, device.damping, device.mass])
    force = device.force_constant * current - at_port @ suspension
    voltage = history(port.voltage)
    if device.limits is not None:
        voltage = xp.clip(voltage, *device.limits)
    return CoilHistory(times, current, voltage, force)


__all__ = [
    "Envelope",
    "amplification",
    "bending_moment",
    "characteristic_points",
    "corrected_deflection",
    "envelope",
    "shear_force",
]

BLOCK_ENTRIES = 2**22  # of the largest array for the points of an envelope that are taken at once,
LEAST_BLOCK = 8  # which are so many at least
AMPLIFIED = tuple(name for name, entry in QUANTITIES.items() if not entry.time_derivative)


class Envelope(TableViews, Module):
    """Lowest and highest value of a quantity at `positions` (m): at most zero, and at least zero.

    In the unit of the quantity, m for deflections. It unpacks as lowest and highest.

    >>> import jaxbeam as jb
    >>> case = jb.Case(jb.Beam(0.6, 12.0, 0.5), loads=[jb.MovingMass(mass=0.1, speed=1.0)])
    >>> found = jb.envelope(case, x=[0.15, 0.3])
    >>> print((1e3 * found.lowest).round(3), "mm")
    [-0.267 -0.38 ] mm
    """

    lowest: Float[Array, " position"]
    highest: Float[Array, " position"]
    positions: Float[Array, " position"]
    quantity: str = eqx.field(static=True, default="deflection")

    @property
    def headline(self) -> str:
        """The lowest and highest value of all, and where they are."""
        return envelope_headline(self.quantity, self.positions, self.lowest, self.highest)

    @property
    @refuses_traced("a table")
    def columns(self) -> dict[str, np.ndarray]:
        """Position (m), lowest and highest value, by head."""
        head = with_unit(self.quantity)
        return {
            "position (m)": np.asarray(self.positions),
            f"lowest {head}": np.asarray(self.lowest),
            f"highest {head}": np.asarray(self.highest),
        }

    def __iter__(self) -> Iterator[Float[Array, " position"]]:
        return iter((self.lowest, self.highest))


@checks_classes
def envelope(
    case: Case,
    x=None,
    tolerance: float = TOLERANCE,
    *,
    quantity: str = "deflection",
    fibre_distance=None,
    section_modulus=None,
) -> Envelope:
    """Lowest and highest value of a quantity at positions x (m) during a run, between samples too.

    Without x at the positions of `Record.envelope`: the special ones, a grid, and more around the
    extremes along the beam until they change by less than 1e-4. What jumps at a position, as shear
    forces at supports, is taken on both sides. By default the deflection in m; other quantities are
    those of sensors, in their units, moments and the like statically corrected. Free vibration and
    control are included; histories are not stored. The beam starts at rest, so zero is always among
    the values. `tolerance` is relative to the largest deflection. Strain needs `fibre_distance`
    (m), stress `section_modulus` (m^3).

    Raises ValueError for an invalid case, positions off the beam, an unknown quantity or one whose
    parameter is missing, RuntimeError if no time step meets the tolerance.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535),
    ...     loads=[jb.MovingMass(mass=0.5, speed=2.0)],
    ... )
    >>> low, high = jb.envelope(case, x=[0.3])
    >>> print(f"{1e3 * low[0]:.2f} mm")
    -2.00 mm
    """
    quantity_of(quantity, fibre_distance, section_modulus)
    plan = dataclasses.replace(integration_plan(case, tolerance=tolerance), error=0.0)
    calculate = _open_loop_envelope if case.controller is None else _closed_loop_envelope

    parameters = {"fibre_distance": fibre_distance, "section_modulus": section_modulus}

    def at(x):
        points = sections(case, x, quantity)
        found = []
        for own in _blocks(case, points.points, quantity):
            sensors = tuple(Sensor(point, quantity, **parameters) for point in own)
            found.append(calculate(case, plan, sample_times(case), sensors))
        count = points.points.shape[0]
        lowest, highest = (xp.concatenate(parts)[:count] for parts in zip(*found, strict=True))
        return Envelope(points.smallest(lowest), points.largest(highest), x, quantity)

    def curves(found):
        values = xp.stack([-found.lowest, found.highest], axis=-1)
        return values, xp.max(xp.abs(values)), [np.zeros((values.shape[0], 0))] * 2

    if x is None and not any_jax(case):
        return refined(case, at, curves)[1]
    if x is None:  # positions of the concrete case, where the extremes are differentiated
        arguments = concrete_case(case), None, tolerance
        found = envelope(*arguments, quantity=quantity, **jax.tree.map(concrete, parameters))
        own = np.asarray(found.positions)
        x, moving = moving_positions(case, own)
        if moving.any():  # apart: steps end where a load passes them, so that derivatives take long
            parts = at(xp.asarray(own[~moving])), at(x[moving])
            order = np.argsort(np.concatenate([own[~moving], own[moving]]), kind="stable")
            return jax.tree.map(lambda *both: xp.concatenate(both)[order], *parts)
    x = real_numbers("x", x, "m", "positions")
    check_on_beam("x", x, case.beam.length)
    return at(x)


def _blocks(case: Case, points: Float[Array, " point"], quantity: str) -> list:
    """The points in equal blocks, of which the last is filled up with its last point.

    Steps end where a wheel passes a point of what bends. Each step has a row for each point, so
    that the entries of all of these are as the square of the points that are computed at once.
    """
    count = points.shape[0]
    if not QUANTITIES[quantity].bends:
        return [points]
    of_two = 192 * case.beam.modes * max(1, load_set(case).inertia.shape[0])
    most = max(LEAST_BLOCK, int((BLOCK_ENTRIES / of_two) ** 0.5))
    blocks = -(-count // most)
    size = -(-count // max(1, blocks))
    index = np.minimum(np.arange(blocks * size), count - 1)
    return [points[own] for own in index.reshape(blocks, size)]


def _envelope(case, plan, times, sensors):
    discrete, loads, policy, *_ = integration_setup(case, plan, times, sensors)
    running_peaks, _ = integrate_peaks(
        discrete, loads, max_loads=plan.shapes.max_loads, policy=policy
    )
    highest, lowest = xp.split(running_peaks.refined_peak()[0][:, 0], 2)
    return -lowest, highest


_open_loop_envelope = compiled_if_traced(_envelope)
_closed_loop_envelope = compiled(_envelope)


@checks_classes
def amplification(
    case: Case,
    x,
    tolerance: float = TOLERANCE,
    *,
    quantity: str = "deflection",
    fibre_distance=None,
    section_modulus=None,
) -> Float[Array, " position"]:
    """Dynamic amplification at positions x (m): largest dynamic over largest static value.

    By default of the deflection; `quantity` may be rotation, slope, curvature, strain, moment,
    shear or stress, as in `envelope`. The static value is that of the same loads without inertia of
    beam and loads, exact (see `static_peak`). The dynamic deflection has the modes of the case
    only, so with few modes the ratio of a slow crossing is slightly below one; moments and the like
    are statically corrected. Raises as `envelope`, and ValueError for a beam that can move as a
    rigid body, or a quantity without a static value.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535),
    ...     loads=[jb.MovingMass(mass=0.5, speed=2.0)],
    ... )
    >>> print(f"{jb.sections.amplification(case, x=[0.3])[0]:.2f}")
    1.06
    >>> print(f"{jb.sections.amplification(case, x=[0.3], quantity='moment')[0]:.2f}")
    1.03
    """
    parameters = {"fibre_distance": fibre_distance, "section_modulus": section_modulus}
    if quantity not in AMPLIFIED:
        raise ValueError(f"no amplification of {quantity!r}; {suggestion(quantity, AMPLIFIED)}")
    quantity_of(quantity, **parameters)
    lowest, highest = envelope(case, x, tolerance, quantity=quantity, **parameters)
    return xp.maximum(-lowest, highest) / static_amplified(case, x, quantity, **parameters)


def static_amplified(case: Case, x, quantity: str, **parameters) -> Float[Array, " position"]:
    """Largest absolute static value at positions x (m), on both sides: see `amplification`."""
    points = sections(case, xp.asarray(x, float), quantity)
    return points.largest(static_peak(case, points.points, quantity=quantity, **parameters))


class CharacteristicPoint(NamedTuple):
    """Point of a beam by name, as "midspan 1", with its distance from the left end (m)."""

    name: str
    x: float


def spans(case: Case) -> list[tuple[float, float]]:
    """Ends (m) of the spans between held points, overhangs included, from left to right."""
    length = float(concrete(case.beam.length))
    marks = sorted({0.0, *held_positions(case).tolist(), length})
    return [(a, b) for a, b in itertools.pairwise(marks) if b - a > 1e-9 * length]


@refuses_traced("a list of points")
def characteristic_points(case: Case) -> list[CharacteristicPoint]:
    """Supports, quarter points and midspans of all spans, hinges and free ends, left to right.

    Spans and supports are counted from 1; of an overhang the points are those of a span. Raises
    ValueError for a case whose numbers are traced.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> print([point[0] for point in jb.sections.characteristic_points(jb.Case(beam))][:2])
    ['support 1', 'quarter 1']
    """
    length, held = float(concrete(case.beam.length)), set(held_positions(case).tolist())
    points = [CharacteristicPoint(f"support {i}", x) for i, x in enumerate(sorted(held), 1)]
    for i, (a, b) in enumerate(spans(case), 1):
        for name, fraction in (("quarter", 0.25), ("midspan", 0.5), ("three quarters", 0.75)):
            points.append(CharacteristicPoint(f"{name} {i}", a + fraction * (b - a)))
    hinges = sorted(float(concrete(hinge.position)) for hinge in case.beam.hinges)
    points += [CharacteristicPoint(f"hinge {i}", x) for i, x in enumerate(hinges, 1)]
    for name, x in (("left end", 0.0), ("right end", length)):
        if x not in held:
            points.append(CharacteristicPoint(name, x))
    return sorted(points, key=lambda point: point.x)


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


@refuses_traced("a table of influences")
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
        right_of_sections = [
            min(p + LEFT_DISTANCE * length, length)
            for q, _, p in lines
            if q in QUANTITIES and QUANTITIES[q].jumps
        ]
        start = positions_along(case, places=np.concatenate([own, right_of_sections]))
        found_at, found = refined(case, at, curves, start)
        positions = np.asarray(found_at)
    else:
        positions = np.asarray(real_numbers("load_positions", load_positions, "m", "positions"))
        found = at(positions)
    units = [unit_of_effect(q) for q, _, _ in lines]
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
        x = np.atleast_1d(real_numbers("x", x, "m", "positions")).tolist()
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


MAX_WHEELS = 400  # of a record with amplification, as its static peaks take about 2 ms a wheel
NEGLIGIBLE = 1e-6  # fraction of the largest static value of a quantity that counts as none


@np.errstate(all="ignore")  # of extreme numbers
def record_amplification(record: Record) -> list[float | None]:
    """Largest absolute over largest static value of the quantity of each sensor of a record.

    None at sensors of velocities and accelerations, where the static value vanishes, with a
    controller, for more wheels than MAX_WHEELS, and for beams without static deflections (see
    `static_peak`).
    """
    case = record.case
    refuse_traced("an amplification", OUTSIDE, case)
    wheels = load_set(case).wheel_count
    if case.controller is not None or not 0 < wheels <= MAX_WHEELS:
        return [None] * len(case.sensors)
    static = [_static(case, sensor) for sensor in case.sensors]
    largest: dict[str, float] = {}
    for sensor, value in zip(case.sensors, static, strict=True):
        largest[sensor.quantity] = max(largest.get(sensor.quantity, 0.0), value or 0.0)
    peaks = np.maximum(-np.asarray(record.smallest), np.asarray(record.largest))
    return [
        float(peak) / value if value and value > NEGLIGIBLE * largest[sensor.quantity] else None
        for sensor, peak, value in zip(case.sensors, peaks, static, strict=True)
    ]


def _static(case: Case, sensor: Sensor) -> float | None:
    """Largest static value at a sensor; None where `static_peak` has none."""
    if sensor.quantity not in AMPLIFIED:
        return None
    channel = {
        name: getattr(sensor, name) for name in ("quantity", "fibre_distance", "section_modulus")
    }
    channel["side"] = sensor.side or "right"
    try:
        value = float(static_peak(case, sensor.position, **channel))
    except ValueError:
        return None
    return value if np.isfinite(value) else None
