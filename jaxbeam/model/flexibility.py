"""Flexibility of the beam on its supports and suspensions, exact: no modes here.

Between the nodes of the layout the beam is uniform, so Hermite cubics are exact: a unit force at
y acts on the nodes through their values at y (consistent nodal loads), and the segment it stands
on bends in addition like a beam clamped at both ends. Suspensions of actuators are springs
anywhere on the beam, solved for together with the nodes.
"""

import dataclasses
import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.case import Case
from jaxbeam.model.modes import Layout, assemble, section, supported
from jaxbeam.numerics.piecewise import piecewise_chebyshev
from jaxbeam.runtime.compiling import compiled

SOFTEST = 1e-10  # stiffness against rigid-body motion in E I / L^3: less is an unstable beam


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

    def __call__(
        self, y: Float[Array, "*place"], derivative: int = 0
    ) -> Float[Array, "*place source"]:
        """Deflection at positions y under each source, or its derivative by y."""
        between = _bending(self.nodes, self.rigidity, y, derivative, self.points)
        of_nodes = piecewise_chebyshev(self.nodes, self.series, y, (derivative,))[0]
        return of_nodes + between @ self.amounts


def _power(x, exponent: int):
    """x^n / n!, and zero for negative n."""
    return jnp.zeros_like(x) if exponent < 0 else x**exponent / math.factorial(exponent)


def _bracket(x, exponent: int):
    """<x>^n / n! of Macaulay's method: nothing up to x = 0."""
    return jnp.where(x > 0, _power(x, exponent), 0.0)


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
        _bracket(x - y, 3 - order - derivative)
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


def compliance(case: Case, layout: Layout, x: Float[Array, " place"], order: int) -> Compliance:
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
            there = piecewise_chebyshev(nodes, expand, points.places[index], (derivative,))[0]
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


@compiled  # step by step, the many small programs take seconds to compile
def _hold(case: Case, layout: Layout):
    """Nodes, and what `_suspensions` returns."""
    return assemble(case, _cubics(layout))[0], *_suspensions(case)


def check_held(case: Case, layout: Layout) -> None:
    """Refuse a beam that can move rigidly, w = a + b x, because nothing resists the motion.

    Raises ValueError.
    """
    length, unit = case.beam.length, case.beam.length**3 / case.beam.rigidity
    nodes, points, factors, springs = _hold(case, layout)
    shift, turn = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    held = [
        (shift + x * turn, 1.0) for x, (fixed, _) in zip(nodes, layout.held, strict=True) if fixed
    ]
    held += [(turn, 1.0) for _, turned in layout.held if turned]
    for support, node in supported(case, layout):
        if support.stiffness is not None:
            held.append((shift + nodes[node] * turn, support.stiffness * unit))
        held.append((turn, support.rotational_stiffness * unit / length**2))
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
