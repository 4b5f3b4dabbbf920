"""Exact static solutions: deflections, influence lines, and peaks while loads travel slowly.

No modes here. Between the nodes of the layout the beam is uniform, so Hermite cubics are exact:
a unit force at y acts on the nodes through their values at y (consistent nodal loads), and the
segment it stands on bends in addition like a beam clamped at both ends. Suspensions of actuators
are springs anywhere on the beam, solved for together with the nodes.
"""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case import Case, known_case
from jaxbeam.checks import ROUNDING, check
from jaxbeam.fields import is_known, known
from jaxbeam.loads import motion
from jaxbeam.modes import Layout, assemble, lay_out, piecewise, section, supported
from jaxbeam.motion import NEVER
from jaxbeam.peaks import refine

SOFTEST = 1e-10  # stiffness against rigid-body motion in E I / L^3: less is an unstable beam
POINTS = 10  # on a stretch of a crossing: a cubic of a cubic is known exactly by so many


class Points(eqx.Module):
    """Unit forces, or x-derivatives of them: positions (in L), each with its own derivative."""

    places: Float[Array, " point"]
    derivatives: tuple[int, ...] = eqx.field(static=True)

    def groups(self) -> list[tuple[int, np.ndarray]]:
        """Derivatives that occur, each with the indices of its points."""
        orders = np.array(self.derivatives, int)
        return [(int(order), np.flatnonzero(orders == order)) for order in np.unique(orders)]


class Compliance(eqx.Module):
    """Deflections of the beam under given sources, prepared for any y.

    All in beam units: lengths in L, stiffness in E I / L^3. `series` are the cubics between the
    nodes, one column a source; `points` those at which segments bend between their nodes, and
    `amounts` how much of each point a source brings.
    """

    nodes: Float[Array, " node"]
    rigidity: Float[Array, " segment"]
    series: Float[Array, "segment degree source"]
    points: Points
    amounts: Float[Array, "point source"]

    def __call__(self, y: Float[Array, "*place"]) -> Float[Array, "*place source"]:
        """Deflection at positions y under each source."""
        between = _bending(self.nodes, self.rigidity, y, 0, self.points)
        return piecewise(self.nodes, self.series, y, (0,))[0] + between @ self.amounts


def _power(x, exponent: int):
    """<x>^n / n! of Macaulay's method, zero for negative n."""
    if exponent < 0:
        return jnp.zeros_like(x)
    return jnp.where(x > 0, x**exponent / math.factorial(exponent), 0.0)


def _clamped(nodes, rigidity, x, order: int, y, derivative: int):
    """Bending between clamped nodes: order-th x- and derivative-th y-derivative.

    Green's function of a clamped segment, E I w'''' = delta(x - y): Macaulay's cubic, less the
    two Hermite cubics that take out its deflection and slope at the right node.
    """
    inner = nodes[1:-1]
    at_x, at_y = (jnp.sum(place[..., None] >= inner, axis=-1) for place in (x, y))
    left, right = nodes[at_y], nodes[at_y + 1]
    size, s, beyond = right - left, x - left, right - y
    z = s / size
    deflection = (z**2 * (3 - 2 * z), 6 * z * (1 - z), 6 - 12 * z, -12 + 0 * z)[order]
    slope = (z**2 * (z - 1), z * (3 * z - 2), 6 * z - 2, 6 + 0 * z)[order]
    bend = (
        _power(x - y, 3 - order - derivative)
        - deflection / size**order * _power(beyond, 3 - derivative)
        - slope * size / size**order * _power(beyond, 2 - derivative)
    )
    return jnp.where(at_x == at_y, (-1) ** derivative * bend / rigidity[at_y], 0.0)


def _bending(nodes, rigidity, x, order: int, points: Points) -> Float[Array, "*place point"]:
    """What each point bends its own segment at positions x, or an x-derivative of it."""
    total = jnp.zeros((*x.shape, len(points.derivatives)))
    for derivative, index in points.groups():
        part = _clamped(nodes, rigidity, x[..., None], order, points.places[index], derivative)
        total = total.at[..., index].set(part)
    return total


def _compliance(case: Case, layout: Layout, x: Float[Array, " place"], order: int) -> Compliance:
    """Prepare unit forces at positions x (m); with an order, its derivatives by x.

    With K the stiffness of nodes, f the forces of suspensions of stiffness k and B their rows:
    K u - B' f = load,  f = -k (B u + (what the segment under the stroke bends)).
    """
    length = case.beam.length
    nodes, stiffness, _, expand = assemble(case, _cubics(layout))
    rigidity = jnp.stack([section(case, layout, i)[0] for i in range(len(layout.degrees))])

    def nodal(points):
        """Rows (point, unknown) of nodal forces."""
        rows = jnp.zeros((len(points.derivatives), stiffness.shape[0]))
        for derivative, index in points.groups():
            there = piecewise(nodes, expand, points.places[index], (derivative,))[0]
            rows = rows.at[index].set(there)
        return rows

    def between(at, points):
        """Matrix (point, point) of bending within segments, at some points due to others."""
        matrix = jnp.zeros((len(at.derivatives), len(points.derivatives)))
        for derivative, index in at.groups():
            there = _bending(nodes, rigidity, at.places[index], derivative, points)
            matrix = matrix.at[index].set(there)
        return matrix

    sources = Points(x / length, (order,) * x.shape[0])
    held, factors, springs = _suspensions(case)
    rows = factors @ nodal(held)
    own = factors @ between(held, held) @ factors.T
    bent = factors @ between(held, sources)
    system = jnp.block(
        [[stiffness, -rows.T], [springs * rows, jnp.eye(rows.shape[0]) + springs * own]]
    )
    found = jnp.linalg.solve(system, jnp.concatenate([nodal(sources).T, -springs * bent]))
    motions, forces = jnp.split(found, [stiffness.shape[0]])
    return Compliance(
        nodes,
        rigidity,
        jnp.einsum("std,dx->stx", expand, motions),
        Points(
            jnp.concatenate([sources.places, held.places]),
            sources.derivatives + held.derivatives,
        ),
        jnp.concatenate([jnp.eye(x.shape[0]), factors.T @ forces]),
    )


def _suspensions(case: Case):
    """Where actuators hold the beam: points, their factors (actuator, point), and stiffness.

    In beam units, in which a stroke of derivative d counts L^-d deflections.
    """
    length = case.beam.length
    strokes = [actuator.stroke() for actuator in case.actuators]
    terms = [(i, *term) for i, stroke in enumerate(strokes) for term in stroke]
    points = Points(
        jnp.array([place for _, place, _, _ in terms]).reshape(-1) / length,
        tuple(derivative for _, _, derivative, _ in terms),
    )
    factors = jnp.zeros((len(strokes), len(terms)))
    for column, (i, _, derivative, factor) in enumerate(terms):
        factors = factors.at[i, column].set(factor / length**derivative)
    springs = jnp.array([actuator.attachment().stiffness for actuator in case.actuators])
    return points, factors, springs.reshape(-1, 1) * length**3 / case.beam.rigidity


def _cubics(layout: Layout) -> Layout:
    return dataclasses.replace(layout, degrees=(3,) * len(layout.degrees))


@eqx.filter_jit
def _influence(case: Case, layout: Layout, x, positions, order: int):
    compliance = _compliance(case, layout, x.reshape(-1), order)
    length = case.beam.length
    line = -compliance(positions / length) * length ** (3 - order) / case.beam.rigidity
    return line.reshape(*positions.shape, *x.shape)


def influence_line(
    case: Case, x, positions, derivative: int = 0, layout: Layout | None = None
) -> Float[Array, "..."]:
    """Static deflection at x per newton that presses at each position, in m/N.

    Exact for E I w'''' = p with the case's supports, bonded patches and suspensions, commands
    zero. `x` and `positions` are in m from the left end and may have any shapes; the result is
    (position..., place...). `derivative` (up to 3)
    gives that x-derivative instead, in m^(1-derivative)/N. By reciprocity the line of deflections
    is also the deflected shape under 1 N at x. Differentiable in every number. Inside `jit`, give
    the `layout` found outside by `modes.lay_out(case)`.

    Raises ValueError for a faulty case, a place off the beam, or a beam that can move as a rigid
    body.
    """
    x, positions = jnp.asarray(x, float), jnp.asarray(positions, float)
    layout = _checked(case, layout, x=x, positions=positions)
    return _influence(case, layout, x, positions, derivative)


def static_deflection(
    case: Case,
    x,
    load_positions,
    forces=None,
    derivative: int = 0,
    layout: Layout | None = None,
) -> Float[Array, "*place"]:
    """Static deflection at x (m) under forces that stand on the beam, in m, positive upwards.

    `forces` (load,) are in N, positive downwards, at `load_positions` (load,) in m; without them,
    each load of the case presses with its weight. The rest is as for `influence_line`.

    Raises ValueError as `influence_line` does, and where forces and positions differ in number.
    """
    positions = jnp.atleast_1d(jnp.asarray(load_positions, float))
    if forces is None:
        forces = jnp.array([load.weight(case.run.gravity) for load in case.loads]).reshape(-1)
        whose = "loads of the case"
    else:
        forces = jnp.atleast_1d(jnp.asarray(forces, float))
        whose = "forces"
    if forces.shape != positions.shape or forces.ndim != 1:
        raise ValueError(
            f"load_positions must be one for each of the {forces.size} {whose};"
            f" their shape is {positions.shape}"
        )
    return jnp.tensordot(forces, influence_line(case, x, positions, derivative, layout), axes=1)


def static_peak(case: Case, x, layout: Layout | None = None) -> Float[Array, "*place"]:
    """Largest absolute static deflection at x (m) while the case's loads travel, in m.

    At every instant the loads press with their weights where their motions put them, as if the
    beam followed without inertia: loads of equal speed keep their distances, so with one load or
    a stream of equal speed this is the limit of slow travel. All the way counts, from the first
    entry to the last exit (or stop), however long the run. What dynamic amplification divides by.

    The maximum is exact: between the events of a crossing the deflection is a polynomial in time.
    Differentiable in every number where one instant is the highest. Raises ValueError as
    `influence_line` does.
    """
    x = jnp.asarray(x, float)
    layout = _checked(case, layout, x=x)
    if not case.loads:
        return jnp.zeros(x.shape)
    return _peak(case, layout, x)


@eqx.filter_jit
def _peak(case: Case, layout: Layout, x):
    length = case.beam.length
    compliance = _compliance(case, layout, x.reshape(-1), 0)
    motions = [motion(load, length) for load in case.loads]
    windows = jnp.stack([jnp.stack(path.window()) for path in motions])
    corners = jnp.concatenate([compliance.nodes, compliance.points.places])
    tables = [load.times for load in case.loads if load.times is not None]
    events = [windows.ravel(), *(path.arrivals(corners * length) for path in motions), *tables]
    events = jnp.concatenate(events)
    edges = jnp.sort(jnp.where(events < NEVER, events, windows[0, 0]))
    low, high = edges[:-1], edges[1:]
    middle = (low + high) / 2
    times = low + (high - low) * np.linspace(0, 1, POINTS)[:, None]
    total = jnp.zeros((*times.shape, x.size))
    for load, path, window in zip(case.loads, motions, windows, strict=True):
        active = (window[0] < middle) & (middle < window[1])
        place = jnp.clip(path.travel(times)[0] / length, 0.0, 1.0)
        pressed = load.weight(case.run.gravity) * active[:, None] * compliance(place)
        total = total + pressed
    highest = jnp.max(refine(total)[0], axis=0)
    return (highest * length**3 / case.beam.rigidity).reshape(x.shape)


def _checked(case: Case, layout: Layout | None, **places) -> Layout:
    """The layout of a case that is fit for statics, as far as its numbers are known."""
    check(case)
    for name, place in places.items():
        if is_known(place) and is_known(case.beam.length):
            _check_on_beam(name, known(place), float(known(case.beam.length)))
    layout = lay_out(case) if layout is None else layout
    resting = Case(case.beam, case.supports, case.actuators)
    if all(is_known(leaf) for leaf in jax.tree.leaves(resting)):
        _check_stable(known_case(resting), layout)
    return layout


def _check_on_beam(name: str, place: np.ndarray, length: float) -> None:
    off = ~((place >= -ROUNDING * length) & (place <= (1 + ROUNDING) * length))
    if off.any():
        raise ValueError(
            f"{name} must lie on the beam, between 0 and {length:g} m;"
            f" found {place[off].flat[0]:g} m"
        )


def _check_stable(case: Case, layout: Layout) -> None:
    """A beam can move rigidly, w = a + b x, unless something resists both of the two motions."""
    length, unit = case.beam.length, case.beam.length**3 / case.beam.rigidity
    nodes, *_ = assemble(case, _cubics(layout))
    shift, turn = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    held = [
        (shift + x * turn, 1.0) for x, (fixed, _) in zip(nodes, layout.held, strict=True) if fixed
    ]
    held += [(turn, 1.0) for _, turned in layout.held if turned]
    for support, node in supported(case, layout):
        if support.stiffness is not None:
            held.append((shift + nodes[node] * turn, support.stiffness * unit))
        held.append((turn, support.rotational_stiffness * unit / length**2))
    points, factors, springs = _suspensions(case)
    moved = [
        (shift + x * turn, turn, 0 * turn, 0 * turn)[derivative]
        for x, derivative in zip(points.places, points.derivatives, strict=True)
    ]
    held += zip(factors @ np.array(moved).reshape(-1, 2), springs[:, 0], strict=True)
    resistance = sum((min(1.0, float(k)) * np.outer(row, row) for row, k in held), np.zeros((2, 2)))
    if np.linalg.eigvalsh(resistance)[0] < SOFTEST:
        raise ValueError(
            f"the beam ({case.beam.ends}) can move as a rigid body, so it has no static"
            " deflection; hold its ends or add supports"
        )
