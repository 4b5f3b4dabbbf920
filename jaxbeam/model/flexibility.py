"""Static Green's function of the beam on its supports and suspensions, exact and without modes.

Between the nodes of the layout the beam is uniform, so Hermite cubics are exact: a unit force at
y acts on the nodes through the cubics' values at y (consistent nodal loads), and its segment bends
in addition like a beam clamped at both ends. Suspensions of actuators are springs anywhere on the
beam, solved for together with the nodes.
"""

import dataclasses
import math

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.model.elements import Layout, is_uniform
from jaxbeam.model.modes import assemble_matrices, section_properties, supported_matrices
from jaxbeam.model.transfer_matrices import SectionFlexibility, is_held, section_flexibility
from jaxbeam.numerics.polynomials import piecewise_chebyshev
from jaxbeam.runtime.arrays import Array, Module, set_at, take, xp
from jaxbeam.runtime.compiling import compiled_if_traced

# Least stiffness against rigid-body motion of a statically supported beam, in E I / L^3.
MIN_RIGID_BODY_STIFFNESS = 1e-10


class FlexibilityPoints(Module):
    """Points of unit forces (derivative 0) or unit couples (1) on the beam; positions in L.

    A derivative d stands for the d-th x-derivative of a unit force, up to 3.
    """

    positions: Float[Array, " point"]
    derivatives: tuple[int, ...] = eqx.field(static=True)

    def by_derivative(self) -> list[tuple[int, np.ndarray]]:
        """Pairs of a derivative that occurs and the indices of its points."""
        orders = np.array(self.derivatives, int)
        return [(int(order), np.flatnonzero(orders == order)) for order in np.unique(orders)]


class Flexibility(Module):
    """Deflections of the beam under unit sources, to be evaluated at any position y.

    In beam units: lengths in L, stiffness in E I / L^3. `series` holds the cubics between the
    nodes, one column a source; `sources` the points (unit sources, then suspensions) that bend
    their segments between the nodes, and `source_weights` the force at each point per source.
    """

    nodes: Float[Array, " node"]
    rigidity: Float[Array, " segment"]
    series: Float[Array, "segment degree source"]
    sources: FlexibilityPoints
    source_weights: Float[Array, "point source"]

    @property
    def breakpoints(self) -> Float[Array, " breakpoint"]:
        """Positions (in L) between which the deflection is a cubic."""
        return xp.concatenate([self.nodes, self.sources.positions])

    def __call__(
        self, y: Float[Array, "*position"], derivative: int = 0
    ) -> Float[Array, "*position source"]:
        """Deflection at positions y (in L) under each source, or a derivative of it by y."""
        segment_bending = _segment_bending(self.nodes, self.rigidity, y, derivative, self.sources)
        nodal = piecewise_chebyshev(self.nodes, self.series, y, (derivative,))[0]
        return nodal + segment_bending @ self.source_weights


def _factorial_power(x, exponent: int):
    """x^n / n!, and zero for negative n."""
    return xp.zeros_like(x) if exponent < 0 else x**exponent / math.factorial(exponent)


def _macaulay(x, exponent: int):
    """<x>^n / n! of Macaulay's method: zero up to x = 0."""
    return xp.where(x > 0, _factorial_power(x, exponent), 0.0)


def _clamped_segment_bending(nodes, rigidity, x, x_derivative: int, y, y_derivative: int):
    """Green's function of a segment clamped at both nodes, or derivatives of it by x and y.

    Solution of E I w'''' = delta(x - y): Macaulay's cubic less the two Hermite cubics with its
    deflection and slope at the right node; zero where x and y are in different segments.
    """
    inner_nodes = nodes[1:-1]
    segment_of_x, segment_of_y = (
        xp.sum(position[..., None] >= inner_nodes, axis=-1) for position in (x, y)
    )
    left, right = take(nodes, segment_of_y), take(nodes, segment_of_y + 1)
    length, s, y_to_right = right - left, x - left, right - y
    z = s / length
    deflection = (z**2 * (3 - 2 * z), 6 * z * (1 - z), 6 - 12 * z, -12 + 0 * z)[x_derivative]
    slope = (z**2 * (z - 1), z * (3 * z - 2), 6 * z - 2, 6 + 0 * z)[x_derivative]
    bending = (
        _macaulay(x - y, 3 - x_derivative - y_derivative)
        - deflection / length**x_derivative * _factorial_power(y_to_right, 3 - y_derivative)
        - slope * length / length**x_derivative * _factorial_power(y_to_right, 2 - y_derivative)
    )
    bending = (-1) ** y_derivative * bending / take(rigidity, segment_of_y)
    return xp.where(segment_of_x == segment_of_y, bending, 0.0)


def _segment_bending(
    nodes, rigidity, x, x_derivative: int, sources: FlexibilityPoints
) -> Float[Array, "*position point"]:
    """Bending of the segment of each point at positions x, or its x-derivative."""
    total = xp.zeros((*x.shape, len(sources.derivatives)))
    for derivative, index in sources.by_derivative():
        part = _clamped_segment_bending(
            nodes, rigidity, x[..., None], x_derivative, sources.positions[index], derivative
        )
        total = set_at(total, np.s_[..., index], part)
    return total


def flexibility(
    case: Case, layout: Layout, x: Float[Array, " position"], x_derivative: int
) -> Flexibility | SectionFlexibility:
    """Flexibility for unit forces at positions x (m), or for their x-derivatives.

    Of a beam that is not uniform see `model.transfer_matrices`; of others, with nodal stiffness K,
    forces f of suspensions of stiffness k and their rows B:

    K u - B' f = load,  f = -k (B u + bending of the segment under the suspension).
    """
    if not is_uniform(case):
        return section_flexibility(case, layout, x, x_derivative)
    length = case.beam.length
    nodes, stiffness, _, to_series = assemble_matrices(case, _cubic_layout(layout))
    rigidity = xp.stack(
        [section_properties(case, layout, i)[0] for i in range(len(layout.degrees))]
    )

    def nodal_forces(sources):
        """Consistent nodal forces (point, unknown) of unit sources."""
        rows = xp.zeros((len(sources.derivatives), stiffness.shape[0]))
        for derivative, index in sources.by_derivative():
            shape_values = piecewise_chebyshev(
                nodes, to_series, sources.positions[index], (derivative,)
            )[0]
            rows = set_at(rows, index, shape_values)
        return rows

    def bending_between(observed, sources):
        """Bending within segments (point, point) at observed points due to sources."""
        matrix = xp.zeros((len(observed.derivatives), len(sources.derivatives)))
        for derivative, index in observed.by_derivative():
            there = _segment_bending(
                nodes, rigidity, observed.positions[index], derivative, sources
            )
            matrix = set_at(matrix, index, there)
        return matrix

    unit_sources = FlexibilityPoints(x / length, (x_derivative,) * x.shape[0])
    suspension_points, factors, suspension_stiffness = _suspensions(case)
    suspension_rows = factors @ nodal_forces(suspension_points)
    suspension_bending = factors @ bending_between(suspension_points, suspension_points) @ factors.T
    source_bending = factors @ bending_between(suspension_points, unit_sources)
    system = xp.block(
        [
            [stiffness, -suspension_rows.T],
            [
                suspension_stiffness * suspension_rows,
                xp.eye(suspension_rows.shape[0]) + suspension_stiffness * suspension_bending,
            ],
        ]
    )
    solution = xp.linalg.solve(
        system,
        xp.concatenate([nodal_forces(unit_sources).T, -suspension_stiffness * source_bending]),
    )
    nodal_displacements, suspension_forces = xp.split(solution, [stiffness.shape[0]])
    return Flexibility(
        nodes,
        rigidity,
        xp.einsum("std,dx->stx", to_series, nodal_displacements),
        FlexibilityPoints(
            xp.concatenate([unit_sources.positions, suspension_points.positions]),
            unit_sources.derivatives + suspension_points.derivatives,
        ),
        xp.concatenate([xp.eye(x.shape[0]), factors.T @ suspension_forces]),
    )


def _suspensions(case: Case):
    """Points of the actuators' suspensions, factors (actuator, point), and stiffness (actuator, 1).

    In beam units; a term of derivative d of a displacement map has the factor L^-d.
    """
    length = case.beam.length
    displacements = [actuator.displacement_map() for actuator in case.actuators]
    terms = [(i, *term) for i, stroke in enumerate(displacements) for term in stroke]
    points = FlexibilityPoints(
        xp.array([position for _, position, _, _ in terms]).reshape(-1) / length,
        tuple(derivative for _, _, derivative, _ in terms),
    )
    factors = xp.zeros((len(displacements), len(terms)))
    for column, (i, _, derivative, factor) in enumerate(terms):
        factors = set_at(factors, (i, column), factor / length**derivative)
    stiffness = xp.array([actuator.attachment().stiffness for actuator in case.actuators])
    return points, factors, stiffness.reshape(-1, 1) * length**3 / case.beam.bending_stiffness


def _cubic_layout(layout: Layout) -> Layout:
    return dataclasses.replace(layout, degrees=(3,) * len(layout.degrees))


@compiled_if_traced
def _support_conditions(case: Case, layout: Layout):
    """Node positions (in L), and points, factors and stiffness of the suspensions."""
    return assemble_matrices(case, _cubic_layout(layout))[0], *_suspensions(case)


def check_supported(case: Case, layout: Layout) -> None:
    """Check that supports, ends or suspensions resist every rigid-body motion w = a + b x.

    Raises ValueError for a beam that can move as a rigid body.
    """
    if not is_uniform(case):
        if not is_held(case, layout):
            raise ValueError(_unsupported(case))
        return
    length, unit = case.beam.length, case.beam.length**3 / case.beam.bending_stiffness
    nodes, suspension_points, factors, suspension_stiffness = _support_conditions(case, layout)
    translation, rotation = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    restraints = [
        (translation + x * rotation, 1.0)
        for x, (fixed, _) in zip(nodes, layout.constrained, strict=True)
        if fixed
    ]
    restraints += [(rotation, 1.0) for _, rotation_fixed in layout.constrained if rotation_fixed]
    for support, node in supported_matrices(case, layout):
        if support.stiffness is not None:
            restraints.append((translation + nodes[node] * rotation, support.stiffness * unit))
        restraints.append((rotation, support.rotational_stiffness * unit / length**2))
    suspension_motions = [
        (translation + x * rotation, rotation, 0 * rotation, 0 * rotation)[derivative]
        for x, derivative in zip(
            suspension_points.positions, suspension_points.derivatives, strict=True
        )
    ]
    restraints += zip(
        factors @ np.array(suspension_motions).reshape(-1, 2),
        suspension_stiffness[:, 0],
        strict=True,
    )
    resistance = sum(
        (min(1.0, float(k)) * np.outer(row, row) for row, k in restraints), np.zeros((2, 2))
    )
    if np.linalg.eigvalsh(resistance)[0] < MIN_RIGID_BODY_STIFFNESS:
        raise ValueError(_unsupported(case))


def _unsupported(case: Case) -> str:
    return (
        f"the beam ({case.beam.ends}) can move as a rigid body, so it has no static deflection;"
        " hold its ends or add supports"
    )
