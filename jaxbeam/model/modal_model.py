"""The rig: beam, supports and actuators as one linear system in modal coordinates.

    q'' + D q' + K q = shapes(x) . forces,   z' = A z + B u

The state z holds (q_1, q_1', q_2, q_2', ...) and then the actuators' own states. Where nothing
couples the modes, A is kept as one 2 x 2 block a mode; otherwise it is a single full block. All
that follows works on blocks and does not ask which of the two it has.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag, solve_triangular
from jaxtyping import Array, Float

from jaxbeam.case.case import Case
from jaxbeam.model.modes import Layout, Modes, lay_out, modes
from jaxbeam.runtime.compiling import compiled


class Rig(eqx.Module):
    """Linear model of beam, supports and actuators, without loads and control.

    Its coordinates q are modal amplitudes with unit mass matrix; `mixing` (if any) maps them to
    the amplitudes of `modes` where the moving mass of an actuator couples those. `strokes` are
    the rows that take q to the stroke of each actuator.
    """

    modes: Modes
    mixing: Float[Array, "mode mode"] | None
    state_matrix: Float[Array, "block side side"]
    command_matrix: Float[Array, "state actuator"]
    strokes: Float[Array, "actuator mode"]

    @property
    def states(self) -> int:
        """Number of states."""
        return self.state_matrix.shape[0] * self.state_matrix.shape[1]

    @property
    def modes_per_block(self) -> int:
        """Number of modal coordinates in each block of the state matrix."""
        return self.modes.stiffness.shape[0] // self.state_matrix.shape[0]

    def shapes(self, x, derivatives: tuple[int, ...]) -> Float[Array, "order *place mode"]:
        """Rows that take q to the deflection (or its x-derivatives) at positions x (m).

        Transposed, they take a force at x to forces on q.
        """
        rows = self.modes.shapes_together(x, derivatives)
        return rows if self.mixing is None else rows @ self.mixing

    def stiffness(self) -> Float[Array, "mode mode"]:
        """Stiffness matrix of the coordinates q, suspensions included, in 1/s^2."""
        full = -block_diag(*self.state_matrix)
        size = 2 * self.modes.stiffness.shape[0]
        return full[1:size:2, 0:size:2]


def couples(case: Case) -> bool:
    """Tell whether any part of the case couples the modes: an actuator, a damper at a support."""
    return bool(case.actuators) or any(support.damping is not None for support in case.supports)


def rig(case: Case, layout: Layout | None = None, coupled: bool = True) -> Rig:
    """Assemble the rig of a case, eqs (2.31) to (2.36) of the thesis in mass-normalised modes.

    Actuators' suspensions and support dampers act on the modes, coupled and exact; non-classical
    damping is not dropped. Without `coupled` the modes stay single blocks, which is right only
    where nothing couples them (see `couples`) and none are repeated. `layout` (from `lay_out`) is
    needed inside `jit`, where the numbers that decide it are not known.
    """
    layout = lay_out(case) if layout is None else layout
    return assemble(case, modes(case, layout), coupled)


_in_one = compiled(rig)


def rig_in_one(case: Case, layout: Layout | None = None) -> Rig:
    """The same rig by one program: step by step, the many small ones take seconds to compile.

    Cases that differ in their controllers share it.
    """
    layout = lay_out(case) if layout is None else layout
    bare = eqx.tree_at(lambda c: c.controller, case, None, is_leaf=lambda leaf: leaf is None)
    return _in_one(bare, layout)


@jax.named_scope("rig")
def assemble(case: Case, found: Modes, coupled: bool = True) -> Rig:
    """The rig of a case whose modes are known already; see `rig`."""
    count = case.beam.modes
    if not coupled:
        zero, one = jnp.zeros(count), jnp.ones(count)
        blocks = jnp.stack([zero, one, -found.stiffness, -found.damping], axis=-1)
        nothing = jnp.zeros((2 * count, 0)), jnp.zeros((0, count))
        return Rig(found, None, blocks.reshape(count, 2, 2), *nothing)
    stiffness = jnp.diag(found.stiffness) + found.coupling
    damping = jnp.diag(found.damping) + found.damping_coupling
    for support in case.supports:
        if support.damping is not None:
            shape = found.shapes(support.position)
            damping = damping + support.damping * jnp.outer(shape, shape)
    attached = [actuator.attachment() for actuator in case.actuators]
    strokes = jnp.zeros((len(attached), count))
    mass = jnp.eye(count)
    for i, (actuator, device) in enumerate(zip(case.actuators, attached, strict=True)):
        terms = (factor * found.shapes(x, order) for x, order, factor in actuator.stroke())
        shape = sum(terms, jnp.zeros(count))
        strokes = strokes.at[i].set(shape)
        stiffness = stiffness + device.stiffness * jnp.outer(shape, shape)
        damping = damping + device.damping * jnp.outer(shape, shape)
        if device.mass is not None:
            mass = mass + device.mass * jnp.outer(shape, shape)
    mixing = None
    if any(device.mass is not None for device in attached):
        half = jnp.linalg.cholesky(mass)
        mixing = solve_triangular(half.T, jnp.eye(count), lower=False)
        stiffness, damping = mixing.T @ stiffness @ mixing, mixing.T @ damping @ mixing
        strokes = strokes @ mixing
    matrix, command = _state_space(stiffness, damping, strokes, attached)
    return Rig(found, mixing, matrix[None], command, strokes)


def _state_space(stiffness, damping, strokes, attached):
    """State and command matrices of the modes and the actuators' own states together."""
    count = stiffness.shape[0]
    sizes = [device.state_matrix.shape[0] for device in attached]
    total = 2 * count + sum(sizes)
    place, rate = np.arange(0, 2 * count, 2), np.arange(1, 2 * count, 2)
    matrix = jnp.zeros((total, total)).at[place, rate].set(1.0)
    matrix = matrix.at[np.ix_(rate, place)].set(-stiffness)
    matrix = matrix.at[np.ix_(rate, rate)].set(-damping)
    command = jnp.zeros((total, len(attached)))
    start = 2 * count
    for i, (device, size) in enumerate(zip(attached, sizes, strict=True)):
        own = np.arange(start, start + size)
        start += size
        matrix = matrix.at[np.ix_(own, own)].set(device.state_matrix)
        matrix = matrix.at[np.ix_(own, rate)].set(jnp.outer(device.stroke_matrix, strokes[i]))
        matrix = matrix.at[np.ix_(rate, own)].set(jnp.outer(strokes[i], device.output_matrix))
        command = command.at[own, i].set(device.input_matrix)
        command = command.at[rate, i].set(device.feedthrough * strokes[i])
    return matrix, command
