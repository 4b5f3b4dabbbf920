"""Modal model: beam, supports and actuators as one linear system in modal coordinates.

    q'' + D q' + K q = shapes(x) . forces,   z' = A z + B u

The state z holds (q_1, q_1', q_2, q_2', ...) and then the actuators' own states. Where nothing
couples the modes, A consists of one 2 x 2 block a mode, otherwise of one full block; both have
the shape (block, side, side).
"""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.model.modes import Layout, Modes, mesh_layout, modes
from jaxbeam.model.track import SpreadShapes, spread_series
from jaxbeam.numerics.polynomials import piecewise_chebyshev
from jaxbeam.runtime.arrays import Array, Module, block_diag, set_at, solve_triangular, xp
from jaxbeam.runtime.compiling import compiled_if_traced


class ModalModel(Module):
    """Linear model of beam, supports and actuators, without loads and control.

    The coordinates q have the unit mass matrix. Where the moving mass of an actuator couples the
    `modes`, `mode_map` maps q to their amplitudes; else it is None. `displacement_map` maps q to
    the displacement (m, or rotation in rad) at each actuator. `spread` are the mode shapes under
    axles that a track spreads, or those of its rail; None without one.
    """

    modes: Modes
    mode_map: Float[Array, "mode mode"] | None
    state_matrix: Float[Array, "block side side"]
    command_matrix: Float[Array, "state actuator"]
    displacement_map: Float[Array, "actuator mode"]
    spread: SpreadShapes | None = None

    @property
    def state_count(self) -> int:
        """Number of states."""
        return self.state_matrix.shape[0] * self.state_matrix.shape[1]

    @property
    def mode_count(self) -> int:
        """Number of modes."""
        return self.modes.stiffness.shape[0]

    @property
    def coordinate_index(self) -> slice:
        """Index of the coordinates q among the states."""
        return slice(0, 2 * self.mode_count, 2)

    @property
    def rate_index(self) -> slice:
        """Index of the rates q' among the states."""
        return slice(1, 2 * self.mode_count, 2)

    @property
    def A(self) -> Float[Array, "state state"]:
        """State matrix in full, whether or not it consists of blocks."""
        return block_diag(*self.state_matrix)

    @property
    def modes_per_block(self) -> int:
        """Number of modal coordinates in each block of the state matrix."""
        return self.mode_count // self.state_matrix.shape[0]

    def shapes(self, x, derivatives: tuple[int, ...]) -> Float[Array, "order *position mode"]:
        """Rows from q to the deflection (m), or its x-derivatives, at positions x (m).

        Transposed, they map a force at x to generalised forces on q.
        """
        rows = self.modes.shape_derivatives(x, derivatives)
        return rows if self.mode_map is None else rows @ self.mode_map

    def load_shapes(
        self, x, derivatives: tuple[int, ...], eccentricity=None
    ) -> Float[Array, "order *position mode"]:
        """Rows from q to the deflection (m) under wheels at x (m), or its x-derivatives.

        Transposed, they map the force of a wheel to generalised forces on q. With an `eccentricity`
        (m), of a shape that x has, the deflection is w + e theta.
        """
        rows = piecewise_chebyshev(self.load_nodes, self.load_series, x, derivatives)
        if eccentricity is not None:
            twist = piecewise_chebyshev(self.load_nodes, self.load_twist, x, derivatives)
            rows = rows + xp.asarray(eccentricity)[..., None] * twist
        return rows if self.mode_map is None else rows @ self.mode_map

    @property
    def load_nodes(self) -> Float[Array, " node"]:
        """Positions of a wheel (m) between which its mode shapes are polynomials."""
        return self.modes.nodes if self.spread is None else self.spread.nodes

    @property
    def load_breaks(self) -> Float[Array, " break"]:
        """Positions of a wheel (m) at which its mode shapes are not smooth, of the `load_nodes`."""
        return self.load_nodes[1:-1] if self.modes.rail_series is None else xp.zeros(0)

    @property
    def load_series(self) -> Float[Array, "segment degree mode"]:
        """Chebyshev series of the modes under a wheel between the `load_nodes`."""
        return self.modes.series if self.spread is None else self.spread.series

    @property
    def load_twist(self) -> Float[Array, "segment degree mode"] | None:
        """Series of the twist (rad) under a wheel; None of a beam that does not twist."""
        return self.modes.twist_series if self.spread is None else self.spread.twist

    def load_places(self, places: Float[Array, " place"]) -> Float[Array, " wheel_place"]:
        """Positions of a wheel (m) at which its force, or a spread part of it, is at places (m)."""
        if self.spread is None:
            return places
        return (places[:, None] - self.spread.offsets).reshape(-1)

    def fields(self, x, orders: tuple[int, ...]) -> Float[Array, "order *position mode"]:
        """Rows from q to fields of the beam at positions x (m): see `Modes.fields`."""
        rows = self.modes.fields(x, orders)
        return rows if self.mode_map is None else rows @ self.mode_map

    def stiffness(self) -> Float[Array, "mode mode"]:
        """Stiffness matrix K of the coordinates q, suspensions included, in 1/s^2."""
        return -self.A[self.rate_index, self.coordinate_index]


def has_coupling(case: Case) -> bool:
    """Whether a part of the case couples the modes: an actuator, or a damper at a support.

    A damper of zero counts, for its derivatives; one of a rigid support does not act.
    """
    damped = any(s.damping is not None and s.stiffness is not None for s in case.supports)
    return damped or bool(case.actuators)


def modal_model(case: Case, layout: Layout | None = None, full_matrix: bool = True) -> ModalModel:
    """Modal model of a case, eqs (2.31) to (2.36) of the thesis in mass-normalised modes.

    Suspensions of actuators and support dampers couple the modes; non-classical damping is kept.
    Without `full_matrix` each mode is a block of its own: correct only where nothing couples the
    modes (see `has_coupling`) and none are repeated. `layout` (from `mesh_layout`) is needed
    inside `jit`, where the numbers that decide it are traced.
    """
    layout = mesh_layout(case) if layout is None else layout
    return assemble_modal_model(case, modes(case, layout), full_matrix)


_compiled = compiled_if_traced(modal_model)


def compiled_modal_model(case: Case, layout: Layout | None = None) -> ModalModel:
    """`modal_model`, compiled once for traced cases that differ only in their controllers."""
    layout = mesh_layout(case) if layout is None else layout
    uncontrolled_case = eqx.tree_at(
        lambda c: c.controller, case, None, is_leaf=lambda leaf: leaf is None
    )
    return _compiled(uncontrolled_case, layout)


@jax.named_scope("modal_model")
def assemble_modal_model(case: Case, modes: Modes, coupled: bool = True) -> ModalModel:
    """Modal model of a case from its modes; `coupled` is `full_matrix` of `modal_model`."""
    count = case.beam.modes
    if not coupled:
        zero, one = xp.zeros(count), xp.ones(count)
        blocks = xp.stack([zero, one, -modes.stiffness, -modes.damping], axis=-1)
        no_actuators = xp.zeros((2 * count, 0)), xp.zeros((0, count))
        blocks = blocks.reshape(count, 2, 2)
        return ModalModel(modes, None, blocks, *no_actuators, _spread_shapes(case, modes))
    stiffness = xp.diag(modes.stiffness) + modes.coupling
    damping = xp.diag(modes.damping) + modes.damping_coupling
    for support in case.supports:
        if support.damping is not None:
            shape = modes.shapes(support.position)
            damping = damping + support.damping * xp.outer(shape, shape)
    attachments = [actuator.attachment() for actuator in case.actuators]
    displacement_map = xp.zeros((len(attachments), count))
    mass = xp.eye(count)
    for i, (actuator, attachment) in enumerate(zip(case.actuators, attachments, strict=True)):
        terms = (
            factor * modes.fields(x, (order,))[0]
            for x, order, factor in actuator.displacement_map()
        )
        shape = sum(terms, xp.zeros(count))
        displacement_map = set_at(displacement_map, i, shape)
        stiffness = stiffness + attachment.stiffness * xp.outer(shape, shape)
        damping = damping + attachment.damping * xp.outer(shape, shape)
        if attachment.mass is not None:
            mass = mass + attachment.mass * xp.outer(shape, shape)
    transformation = None
    if any(device.mass is not None for device in attachments):
        cholesky_factor = xp.linalg.cholesky(mass)
        transformation = solve_triangular(cholesky_factor.T, xp.eye(count), lower=False)
        stiffness, damping = (
            transformation.T @ stiffness @ transformation,
            transformation.T @ damping @ transformation,
        )
        displacement_map = displacement_map @ transformation
    matrix, command = _state_space_matrices(stiffness, damping, displacement_map, attachments)
    parts = transformation, matrix[None], command, displacement_map
    return ModalModel(modes, *parts, _spread_shapes(case, modes))


def _spread_shapes(case: Case, modes: Modes) -> SpreadShapes | None:
    if case.track is None:
        return None
    if modes.rail_series is not None:
        return SpreadShapes(modes.rail_nodes, modes.rail_series, np.zeros(1))
    kernel, twist = case.track.kernel(), modes.twist_series
    if twist is not None:
        twist = spread_series(kernel, modes.nodes, twist)[1]
    return SpreadShapes(*spread_series(kernel, modes.nodes, modes.series), kernel.offsets, twist)


def _state_space_matrices(stiffness, damping, displacement_map, attachments):
    """State matrix and command matrix of the modes and the actuators' own states."""
    count = stiffness.shape[0]
    device_sizes = [device.state_matrix.shape[0] for device in attachments]
    total = 2 * count + sum(device_sizes)
    displacement, velocity_index = np.arange(0, 2 * count, 2), np.arange(1, 2 * count, 2)
    matrix = set_at(xp.zeros((total, total)), (displacement, velocity_index), 1.0)
    matrix = set_at(matrix, np.ix_(velocity_index, displacement), -stiffness)
    matrix = set_at(matrix, np.ix_(velocity_index, velocity_index), -damping)
    command = xp.zeros((total, len(attachments)))
    start = 2 * count
    for i, (device, size) in enumerate(zip(attachments, device_sizes, strict=True)):
        device_index = np.arange(start, start + size)
        start += size
        matrix = set_at(matrix, np.ix_(device_index, device_index), device.state_matrix)
        matrix = set_at(
            matrix,
            np.ix_(device_index, velocity_index),
            xp.outer(device.velocity_matrix, displacement_map[i]),
        )
        matrix = set_at(
            matrix,
            np.ix_(velocity_index, device_index),
            xp.outer(displacement_map[i], device.output_matrix),
        )
        command = set_at(command, (device_index, i), device.input_matrix)
        command = set_at(command, (velocity_index, i), device.feedthrough * displacement_map[i])
    return matrix, command
