"""Exact static solutions without modes: deflections, influence lines, static gains of actuators,
and peaks of a slow crossing (see `flexibility`).

Static influence of forces over their position: Chebyshev series.
"""

import dataclasses
from collections.abc import Callable, Sequence

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxbeam.case.arguments import checks_classes
from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.fields import check_on_beam, concrete, is_concrete, real_numbers
from jaxbeam.case.sensors import TWIST, TWIST_RATE
from jaxbeam.case.track import Kernel
from jaxbeam.case.trajectory import NEVER
from jaxbeam.case.validation import check_case
from jaxbeam.model.elements import is_uniform
from jaxbeam.model.flexibility import Flexibility, check_supported, flexibility
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.modes import Layout, Modes, mesh_layout
from jaxbeam.model.torsion import TwistFlexibility, twist_flexibility
from jaxbeam.model.track import spread_series, to_series
from jaxbeam.model.transfer_matrices import SectionFlexibility
from jaxbeam.numerics.polynomials import (
    chebyshev_polynomials,
    estimate_peak,
    piecewise_chebyshev,
    refine_peak,
)
from jaxbeam.runtime.arrays import Array, Module, add_at, is_numpy, set_at, solve, take, xp
from jaxbeam.runtime.compiling import compiled_if_traced

# Positions on an interval between events that determine the deflection exactly there: eleven for a
# cubic (flexibility) of a cubic (trajectory) times a table of forces, a polynomial of degree ten.
# Half a period of a sine is interpolated to 1e-7 of its amplitude.
PEAK_POSITIONS = tuple(float(fraction) for fraction in np.linspace(0, 1, 11))
BLOCK = 4_000_000  # values of lines under all wheels at a time
END_FRACTION = 1e-5  # of an interval: width left out at each of its ends
# Of the span of all times: shorter intervals, between a place and the section next to it, are left
# out.
SHORTEST = 1e-9
# Samples are taken at the positions WITHIN, from the middle of the interval, and extrapolated to
# PEAK_POSITIONS by the matrix TO_ENDS: two terms of the Taylor series of their polynomial.
WITHIN = (1 - 2 * END_FRACTION) * (np.array(PEAK_POSITIONS) - 0.5)


def _to_ends() -> Float[np.ndarray, "point point"]:
    x = 2 * np.array(PEAK_POSITIONS) - 1
    powers = np.arange(x.size)
    slopes = powers * x[:, None] ** np.maximum(powers - 1, 0)
    derivative = slopes @ np.linalg.inv(x[:, None] ** powers)
    step = (2 * END_FRACTION * x)[:, None]
    return step * derivative + step**2 / 2 * (derivative @ derivative)


TO_ENDS = _to_ends()


Greens = Flexibility | SectionFlexibility | TwistFlexibility


def influence_functions(case: Case, layout: Layout, x: Float[Array, " position"], order: int):
    """Influence functions of a field of an order (see `Modes.fields`) at x (m), in beam units.

    Per unit of force; per unit of torque for TWIST and TWIST_RATE.
    """
    if order in (TWIST, TWIST_RATE):
        return twist_flexibility(case, layout, x, order)
    return flexibility(case, layout, x, order)


@compiled_if_traced
def unchecked_influence_line(case: Case, layout: Layout, x, load_positions, derivative: int):
    """`influence_line` without checks of the case and of the positions (arrays).

    For the orders TWIST and TWIST_RATE the force of 1 N acts 1 m left of the axis.
    """
    greens = influence_functions(case, layout, x.reshape(-1), derivative)
    length = case.beam.length
    order = abs(derivative)  # that of the slope is 1, too
    line = -greens(load_positions / length) * length ** (3 - order) / case.beam.bending_stiffness
    return line.reshape((*load_positions.shape, *x.shape))


def influence_line(
    case: Case, x, load_positions, derivative: int = 0, layout: Layout | None = None
) -> Float[Array, "..."]:
    """Influence line: static deflection at x under 1 N downwards at each load position, in m/N.

    Exact for E I w'''' = p with the case's supports, bonded patches and suspensions; commands are
    zero. `x` and `load_positions` (m from the left end) may have any shapes; the result has the
    shape (load position..., x...). `derivative` (up to 3) gives that x-derivative instead, in
    m^(1-derivative)/N. By reciprocity the line is also the deflected shape under 1 N at x.
    Differentiable in every number. Inside `jit`, pass the `layout` found outside by
    `model.modes.mesh_layout(case)`.

    Raises ValueError for an invalid case, a position off the beam, or a beam that can move as a
    rigid body.

    >>> import jaxbeam as jb
    >>> beam = jb.Case(jb.Beam(length=2.0, flexural_rigidity=6.0, mass_per_length=1.0))
    >>> print(f"{jb.influence_line(beam, x=1.0, load_positions=1.0):.6f}")  # -L^3 / (48 E I)
    -0.027778
    """
    x = real_numbers("x", x, "m", "positions")
    load_positions = real_numbers("load_positions", load_positions, "m", "positions")
    layout = validated_layout(case, layout, x=x, positions=load_positions)
    return unchecked_influence_line(case, layout, x, load_positions, derivative)


@checks_classes
def static_deflection(
    case: Case,
    x,
    load_positions,
    forces=None,
    derivative: int = 0,
    layout: Layout | None = None,
) -> Float[Array, "*position"]:
    """Static deflection at x (m) under stationary forces, in m, positive upwards.

    `forces` (load,) are in N, positive downwards, at `load_positions` (load,) in m; by default the
    static loads of the wheels of the case. `derivative` and `layout` are those of `influence_line`.

    Raises ValueError as `influence_line` does, and where forces and positions differ in number.

    >>> import jaxbeam as jb
    >>> beam = jb.Case(jb.Beam(length=2.0, flexural_rigidity=6.0, mass_per_length=1.0))
    >>> print(f"{jb.statics.static_deflection(beam, 1.0, load_positions=[1.0], forces=[18.0]):.3f}")
    -0.500
    """
    positions = xp.atleast_1d(real_numbers("load_positions", load_positions, "m", "positions"))
    if forces is None:
        forces = load_set(case).weight[:, 0]
        described = "wheels of the case"
    else:
        forces = xp.atleast_1d(real_numbers("forces", forces, "N"))
        described = "forces"
    if forces.shape != positions.shape or forces.ndim != 1:
        raise ValueError(
            f"load_positions must be one for each of the {forces.size} {described};"
            f" their shape is {positions.shape}"
        )
    return xp.tensordot(forces, influence_line(case, x, positions, derivative, layout), axes=1)


def static_deflection_per_command(
    case: Case, x, derivative: int = 0, layout: Layout | None = None
) -> Float[Array, "actuator *position"]:
    """Static deflection at x (m) per unit of each actuator's steady command, in m/V or m/N.

    Exact, without the loads of the case. `derivative` (up to 3) gives that x-derivative instead; at
    a discontinuity, such as that of the curvature at the end of a patch, its value to the right.
    Inside `jit`, pass the `layout`. Raises ValueError as `influence_line` does.
    """
    per_force = static_deflection_per_port_force(case, x, derivative, layout)
    gains = xp.array([a.attachment().static_gain for a in case.actuators]).reshape(-1)
    return gains.reshape(-1, *(1,) * (per_force.ndim - 1)) * per_force


def static_deflection_per_port_force(
    case: Case, x, derivative: int = 0, layout: Layout | None = None
) -> Float[Array, "actuator *position"]:
    """Static deflection at x (m) per unit of each actuator's generalised force on the beam.

    In m/N for a force, 1/N for a couple; otherwise as `static_deflection_per_command`.
    """
    x = real_numbers("x", x, "m", "positions")
    layout = validated_layout(case, layout, x=x)
    return _deflection_per_port_force(case, layout, x, derivative)


@compiled_if_traced
def _deflection_per_port_force(case: Case, layout: Layout, x, derivative: int):
    length = case.beam.length
    greens = flexibility(case, layout, x.reshape(-1), derivative)  # by reciprocity: forces at x
    gains = xp.zeros((len(case.actuators), x.size))
    for i, actuator in enumerate(case.actuators):
        terms = actuator.displacement_map()
        displacement = sum(f / length**d * greens(position / length, d) for position, d, f in terms)
        gains = set_at(gains, i, displacement)
    return (gains * length ** (3 - derivative) / case.beam.bending_stiffness).reshape(-1, *x.shape)


def peak_under_loads(
    case: Case,
    line: Callable[[Float[Array, "*position"]], Float[Array, "*position x"]],
    breaks: Float[Array, " break"],
    wave_intervals: int = 0,
    of_torque: bool = False,
) -> Float[Array, " x"]:
    """Largest absolute value of the sums F_l(t) line(y_l(t)) over the loads l and all times.

    `line` is that of a quantity per newton over the position y (m) of a force, a cubic between the
    `breaks` (m). Between events the sum is a polynomial in time, of degree POINTS - 1 at most;
    under waves it is interpolated in `wave_intervals` more (see `intervals_of_waves`). With
    `of_torque` the line is one per unit of torque, and the forces have their eccentricities.
    """
    loads, low, high = load_set(case), 0.0, case.beam.length
    arms = loads.eccentricity
    if case.track is not None:
        first, last = case.track.ends()
        low, high = low - last, high - first
    windows, times = _intervals(case, loads, breaks, wave_intervals)
    starts, ends = times[:-1], times[1:]
    count = line(xp.zeros(0)).shape[-1]
    size = starts.shape[0] * len(PEAK_POSITIONS) * loads.wheel_count * max(1, count)
    samples, estimates = [], []
    for part in np.array_split(np.arange(starts.shape[0]), -(-size // BLOCK)):
        middle = (starts[part] + ends[part]) / 2
        # At a break, where the line of a shear force jumps, the side on which the wheel is.
        within = middle + (ends[part] - starts[part]) * WITHIN[:, None]
        position = xp.clip(loads.kinematics(within)[0], low, high)
        forces = loads.varying_weight(within)[..., 0]
        active = (windows[:, :1] < middle) & (middle < windows[:, 1:])
        active = active & (ends[part] - starts[part] > SHORTEST * (times[-1] - times[0]))
        if is_numpy(active):
            wheel, at = np.nonzero(active)
        else:
            wheel, at = np.divmod(np.arange(loads.wheel_count * part.size), part.size)
        force = (forces[:, at, wheel] * active[wheel, at])[..., None]
        if of_torque:
            force = force * (0.0 if arms is None else arms[wheel][:, None])
        total = xp.zeros((len(PEAK_POSITIONS), part.size, count))
        total = add_at(total, np.s_[:, at], force * line(position[wheel, :, at].T))
        total = total + xp.tensordot(TO_ENDS, total, axes=1)
        estimate = estimate_peak(total, PEAK_POSITIONS)
        best = xp.argmax(estimate, axis=0)[None]
        estimates.append(xp.take_along_axis(estimate, best, axis=0)[0])
        samples.append(xp.take_along_axis(total, best[None], axis=1)[:, 0])
    best = xp.argmax(xp.stack(estimates), axis=0)[None, None]
    chosen = xp.take_along_axis(xp.stack(samples, axis=1), best, axis=1)[:, 0]
    return refine_peak(chosen, PEAK_POSITIONS)[0]


def _intervals(case: Case, loads: LoadSet, breaks, wave_intervals: int):
    """Entry and exit of each wheel, and times (s) between which forces and motions are smooth.

    The last interval is that after all events, in which loads that stay still press.
    """
    windows, events = loads.events(breaks)
    happens = events < NEVER
    happening = xp.any(happens)
    first = xp.where(happening, xp.min(xp.where(happens, events, NEVER)), 0.0)
    last = xp.where(happening, xp.max(xp.where(happens, events, -NEVER)), 0.0)
    end = xp.maximum(last, case.run.duration) if wave_intervals else last + 1.0
    grid = first + (end - first) * np.linspace(0.0, 1.0, wave_intervals + 2)
    times = xp.concatenate([xp.where(happens, events, first), grid])
    return windows, np.unique(times) if is_numpy(times) else xp.sort(times)


def intervals_of_waves(case: Case) -> int:
    """Number of half periods of the fastest force wave of a case; 0 without waves.

    Counted from the first event.

    Waves last until the end of the run, or the last event if that is later. Raises ValueError where
    there is a wave and a number of the loads or the run is traced.
    """
    histories = load_set(case).wheels.histories.values()
    frequencies = [history.frequencies for history in histories if history.frequencies.size]
    if not frequencies:
        return 0
    if not all(map(is_concrete, jax.tree.leaves((case.loads, case.run, case.beam.length)))):
        raise ValueError(
            "the static peak under a force with waves needs concrete numbers of loads, run and"
            " length: leave them out of what jax.jit or jax.grad traces"
        )
    case = concrete_case(case)
    _, times = _intervals(case, load_set(case), np.zeros(0), 1)
    fastest = max(float(np.max(np.abs(concrete(one)))) for one in frequencies)
    return int(np.ceil(2 * fastest * float(times[-1] - times[0]))) + 1


def validated_layout(case: Case, layout: Layout | None, **positions) -> Layout:
    """Layout of a case, after checks of its concrete numbers, positions and supports.

    Raises ValueError as `influence_line` does.
    """
    check_case(case)
    for name, position in positions.items():
        check_on_beam(name, position, case.beam.length)
    layout = mesh_layout(case) if layout is None else layout
    unloaded_case = Case(case.beam, case.supports, case.actuators)
    if all(is_concrete(leaf) for leaf in jax.tree.leaves(unloaded_case)):
        check_supported(concrete_case(unloaded_case), layout)
    return layout


SIDE_SHIFT = 0.01  # towards a position nearby, by which the side of a break is found,
LARGEST_SHIFT = 0.1  # over the length of the beam and the root of the rounding error, at most
PARTS, PART_TERMS = 8, 24  # in which influence functions that are no cubics are interpolated


class LoadInfluence(Module):
    """Influence line of the modes left out: static outputs per newton over the force's position.

    The static influence of a force less that of the modes kept.

    Chebyshev `series` of the outputs per newton upwards between the `breaks` (m): nodes of the
    beam, and the outputs, at which moments have kinks and shear forces jump. `twist` is the series
    per unit of torque, where the beam twists.
    """

    breaks: Float[Array, " break"]
    series: Float[Array, "piece term output"]
    twist: Float[Array, "piece term output"] | None = None

    def of_forces_at(
        self,
        x: Float[Array, "*position"],
        near: Float[Array, "*position"],
        output: Int[Array, "*position"] | None = None,
        eccentricity: Float[Array, "..."] | None = None,
    ) -> Float[Array, "..."]:
        """Outputs (*position, output) per newton upwards at positions x (m).

        At an `eccentricity` (m), which is broadcast to the positions, or on the axis.

        Off the beam as at its nearer end. At a break the limit on the side of it on which `near`
        (m) is. Only one `output` at each position, if its number is given: (*position,).
        """
        # Further breaks may lie between a position and one nearby.
        largest = LARGEST_SHIFT * np.finfo(x.dtype).eps ** 0.5 * self.breaks[-1]
        toward = x + xp.clip(SIDE_SHIFT * (near - x), -largest, largest)
        piece = xp.sum(toward[..., None] >= self.breaks[1:-1], axis=-1)
        left, right = take(self.breaks, piece), take(self.breaks, piece + 1)
        width = xp.where(right > left, right - left, 1.0)
        local = xp.clip((2 * x - left - right) / width, -1.0, 1.0)
        table = chebyshev_polynomials(local, self.series.shape[1])
        if output is not None:
            return xp.sum(table * self.series[piece, :, output], axis=-1)
        influence = xp.einsum("...k,...ko->...o", table, take(self.series, piece))
        if eccentricity is not None and self.twist is not None:
            of_torque = xp.einsum("...k,...ko->...o", table, take(self.twist, piece))
            influence = influence + xp.asarray(eccentricity)[..., None] * of_torque
        return influence

    def spread(self, kernel: Kernel) -> "LoadInfluence":
        """Influence per newton of an axle, whose force the track's `kernel` spreads."""
        nodes, series = spread_series(kernel, self.breaks, self.series)
        twist = self.twist
        if twist is not None:
            twist = spread_series(kernel, self.breaks, twist)[1]
        return LoadInfluence(nodes, series, twist)

    def plus(self, other: "LoadInfluence") -> "LoadInfluence":
        """Sum with another, whose breaks are among those of this one."""

        breaks, terms = self.breaks, self.series.shape[1]
        series, twist = (
            None
            if own is None
            else own + to_series(breaks, terms, lambda x, one=one: one.of_forces_at(x, x))
            for own, one in ((self.series, other), (self.twist, other.of_torques()))
        )
        return dataclasses.replace(self, series=series, twist=twist)

    def of_torques(self) -> "LoadInfluence | None":
        """Influence per unit of torque; None where the beam does not twist."""
        if self.twist is None:
            return None
        return dataclasses.replace(self, series=self.twist, twist=None)

    def on_line(self, eccentricity) -> "LoadInfluence":
        """Influence per newton of forces at one eccentricity (m): bending plus twist."""
        series = self.series if self.twist is None else self.series + eccentricity * self.twist
        return dataclasses.replace(self, series=series, twist=None)


def load_influence(
    case: Case,
    modes: Modes,
    on_modes: Float[Array, "mode output"],
    greens: Sequence[tuple[Greens, Float[Array, " _"], Sequence[int]]],
) -> LoadInfluence:
    """Influence line of the modes left out, from exact influence functions of the outputs.

    `greens` are influence functions, factors from them to the quantities, and the indices of their
    outputs; the amplitudes of the modes have the influence `on_modes`. Between the breaks both are
    polynomials on a uniform beam; on others, smooth functions, interpolated in parts.
    """
    uniform, terms = is_uniform(case), max(4, modes.series.shape[1])
    breakpoints = [modes.nodes / case.beam.length, *(one.breakpoints for one, _, _ in greens)]
    if not uniform:
        breakpoints.append(np.linspace(0.0, 1.0, PARTS + 1))
    breaks = case.beam.length * xp.sort(xp.clip(xp.concatenate(breakpoints), 0.0, 1.0))
    terms = terms if uniform else max(terms, PART_TERMS)

    def influence(x, series, of_torque=False):
        values = -piecewise_chebyshev(modes.nodes, series @ on_modes, x, (0,))[0]
        for one, factor, index in greens:
            if of_torque != isinstance(one, TwistFlexibility):
                continue
            at = np.s_[..., np.array(index, int)]
            values = set_at(values, at, values[at] + factor * one(x / case.beam.length))
        return values

    twist = modes.twist_series
    if twist is not None:
        twist = to_series(breaks, terms, lambda x: influence(x, modes.twist_series, True))
    series = to_series(breaks, terms, lambda x: influence(x, modes.series))
    return LoadInfluence(breaks, series, twist=twist)


def residual_influence(case: Case, model: ModalModel, x, order: int) -> LoadInfluence:
    """Influence of loads on an x-derivative of the deflection at x (m), less that of the modes.

    The derivative is of this `order`; forces are spread by the track of the case.
    """
    rows = model.fields(x.reshape(-1), (order,))[0]
    on_modes = solve(model.stiffness(), rows.T)
    if model.mode_map is not None:
        on_modes = model.mode_map @ on_modes
    greens = influence_functions(case, model.modes.layout, x.reshape(-1), order)
    factor = case.beam.length ** (3 - abs(order)) / case.beam.bending_stiffness * xp.ones(x.size)
    found = load_influence(case, model.modes, on_modes, [(greens, factor, range(x.size))])
    return found if case.track is None else found.spread(case.track.kernel())


def spread_line(
    case: Case, line: Callable, breaks: Float[Array, " break"]
) -> tuple[Callable, Float[Array, " _"]]:
    """Influence line of an axle whose force the track spreads, and its breaks (m).

    `line` is that of a point force over its position, (*position) -> (*position, x), smooth between
    its `breaks`; without a track both are returned as they are.
    """
    if case.track is None:
        return line, breaks
    length, terms = case.beam.length, 4
    if not is_uniform(case):
        breaks, terms = xp.append(breaks, length * np.linspace(0.0, 1.0, PARTS + 1)), PART_TERMS
    breaks = xp.sort(xp.clip(xp.concatenate([breaks, xp.stack([0 * length, length])]), 0.0, length))
    found = LoadInfluence(breaks, to_series(breaks, terms, line)).spread(case.track.kernel())
    return (lambda y: found.of_forces_at(y, y)), found.breaks
