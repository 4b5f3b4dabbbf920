"""Envelopes along the beam, and dynamic amplification over static loading, of any quantity."""

import dataclasses
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.declared_checks import check_on_beam, suggestion
from jaxbeam.case.quantities import QUANTITIES, quantity_of
from jaxbeam.case.sensors import Sensor
from jaxbeam.integrator.integrate import integrate_peaks
from jaxbeam.model.along_beam import refined, sections
from jaxbeam.model.influence import static_peak
from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.runtime.compiling import compiled, compiled_if_traced
from jaxbeam.runtime.module import Module
from jaxbeam.simulation.integration_plan import TOLERANCE, integration_plan, sample_times
from jaxbeam.simulation.simulate import integration_setup

AMPLIFIED = tuple(name for name, entry in QUANTITIES.items() if not entry.time_derivative)


class Envelope(Module):
    """Lowest and highest value of a quantity at `positions` (m): at most zero, and at least zero.

    In m for deflections. It unpacks as lowest and highest.

    >>> import jaxbeam as jb
    >>> case = jb.Case(jb.Beam(0.6, 12.0, 0.5), loads=[jb.MovingMass(mass=0.1, speed=1.0)])
    >>> found = jb.envelope(case, x=[0.15, 0.3])
    >>> print((1e3 * found.lowest).round(3), "mm")
    [-0.267 -0.38 ] mm
    """

    lowest: Float[Array, " position"]
    highest: Float[Array, " position"]
    positions: Float[Array, " position"]

    def __iter__(self) -> Iterator[Float[Array, " position"]]:
        return iter((self.lowest, self.highest))


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
        sensors = tuple(Sensor(point, quantity, **parameters) for point in points.points)
        lowest, highest = calculate(case, plan, sample_times(case), sensors)
        return Envelope(points.smallest(lowest), points.largest(highest), x)

    def curves(found):
        values = xp.stack([-found.lowest, found.highest], axis=-1)
        return values, xp.max(xp.abs(values)), [np.zeros((values.shape[0], 0))] * 2

    if x is None:
        return refined(case, at, curves)[1]
    x = xp.asarray(x, float)
    check_on_beam("x", x, case.beam.length)
    return at(x)


def _envelope(case, plan, times, sensors):
    discrete, loads, policy, *_ = integration_setup(case, plan, times, sensors)
    running_peaks, _ = integrate_peaks(
        discrete, loads, max_loads=plan.shapes.max_loads, policy=policy
    )
    highest, lowest = xp.split(running_peaks.refined_peak()[0][:, 0], 2)
    return -lowest, highest


_open_loop_envelope = compiled_if_traced(_envelope)
_closed_loop_envelope = compiled(_envelope)


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
    >>> print(f"{jb.amplification(case, x=[0.3])[0]:.2f}")
    1.06
    >>> print(f"{jb.amplification(case, x=[0.3], quantity='moment')[0]:.2f}")
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
