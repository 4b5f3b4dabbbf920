"""Propagators of vehicles: exact response of their states to the motion of the surface.

Within a step, the forces q = k y + c y' that the surface exerts on the springs of the wheels are
polynomials through their values at the Gauss nodes, as the contact forces are. The states of a
vehicle follow exactly (`propagators`), and the springs press on the surface at the nodes with

    s = S q - O z

where z are its states at the start of the step.
"""

import math

import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.integrator.propagators import (
    GAUSS_NODES,
    NODE_COUNT,
    force_weights,
    phi_functions_of,
)
from jaxbeam.model.load_set import LoadSet, VehicleGroup
from jaxbeam.runtime.arrays import Array, cond, is_jax, map_elements, stop_gradient, xp
from jaxbeam.runtime.module import Module


class VehiclePropagators(Module):
    """Matrices of the vehicles of one load over steps of some lengths.

    `transition` and `input` map states and q at the nodes to the states at the end;
    `spring_states` is O and `spring_surface` is S. Rows are (wheel, node).
    """

    transition: Float[Array, "*length state state batch"]
    input: Float[Array, "*length state row batch"]
    spring_states: Float[Array, "*length row state batch"]
    spring_surface: Float[Array, "*length row row batch"]


def vehicle_state_norm(loads: LoadSet) -> Float[Array, ""]:
    """Largest norm of the scaled state matrices of the vehicles, in 1/s; zero without any."""
    norms = [
        xp.max(xp.sum(xp.abs(_scaled_systems(group)[0]), axis=1)) for group in loads.wheels.vehicles
    ]
    return stop_gradient(xp.max(xp.stack(norms))) if norms else xp.zeros(())


def _scaled_systems(group: VehicleGroup):
    """State, input and output matrices with displacements scaled to the size of rates."""
    dofs = group.A.shape[0] // 2
    frequency = xp.sqrt(1.0 + xp.max(xp.sum(xp.abs(group.A[dofs:, :dofs]), axis=1), axis=0))
    shape = (dofs, *frequency.shape)
    scale = stop_gradient(xp.concatenate([xp.broadcast_to(frequency, shape), np.ones(shape)]))
    return group.A * scale[:, None] / scale, group.B * scale[:, None], group.H / scale, scale


@jax.named_scope("vehicles")
def vehicle_propagators(
    group: VehicleGroup, lengths: Float[Array, " length"]
) -> VehiclePropagators:
    """Propagators of the vehicles of a load over steps of the given lengths (s)."""
    if not is_jax(lengths):
        return _propagators(group, lengths)

    def of_length(length):
        """Most panels of a compiled program are empty."""
        parts = cond(
            length > 0, lambda t: _propagators(group, t), lambda t: _at_once(group, t), length[None]
        )
        return jax.tree.map(lambda part: part[0], parts)

    return map_elements(of_length, lengths)


def _at_once(group: VehicleGroup, lengths: Float[Array, " length"]) -> VehiclePropagators:
    """Propagators over steps of no length (s), to first order: events at one time may part."""
    A, B, H = (xp.asarray(part, lengths.dtype) for part in (group.A, group.B, group.H))
    states, wheels, batch_size = B.shape
    rows = wheels * NODE_COUNT
    fractions = np.append(GAUSS_NODES, 1.0)
    # Integrals of the polynomials of the nodes, up to each fraction of a step.
    divisors = [math.factorial(power) for power in range(1, NODE_COUNT + 1)]
    integrals = fractions[:, None] * (force_weights() / divisors).sum(axis=-1)
    to_end = xp.einsum("f,swb->swfb", integrals[-1], B)
    speeds = xp.einsum("c,wsb,stb->wctb", GAUSS_NODES, H, A)
    response = xp.einsum("cf,wsb,svb->wcvfb", integrals[:NODE_COUNT], H, B)

    def first_order(start, slope, columns):
        shape = -1, columns, batch_size
        start, slope = xp.asarray(start, lengths.dtype), slope.reshape(shape)
        return xp.broadcast_to(start, slope.shape) + lengths[:, None, None, None] * slope

    return VehiclePropagators(
        first_order(np.eye(states)[..., None], A, states),
        first_order(xp.zeros((states, rows, 1)), to_end, rows),
        first_order(xp.repeat(H, NODE_COUNT, axis=0), speeds, states),
        first_order(np.eye(rows)[..., None], -response, rows),
    )


def _propagators(group: VehicleGroup, lengths: Float[Array, " length"]) -> VehiclePropagators:
    A, B, H, scale = _scaled_systems(group)
    durations = lengths[:, None] * np.append(GAUSS_NODES, 1.0)
    transition, phi_functions = phi_functions_of(A, B, durations, few_doublings=True)
    inputs = xp.einsum("cfp,pswblc->lcfswb", force_weights(), phi_functions)
    transition = xp.einsum("stblc->lcstb", transition)
    nodes = slice(0, NODE_COUNT)
    spring_states = xp.einsum("wsb,lcstb->lwctb", H, transition[:, nodes]) * scale
    response = xp.einsum("wsb,lcfsvb->lwcvfb", H, inputs[:, nodes])
    to_end = xp.einsum("lfswb->lswfb", inputs[:, -1])
    count, rows, states, batch_size = lengths.shape[0], H.shape[0] * NODE_COUNT, *scale.shape
    return VehiclePropagators(
        transition=transition[:, -1] / scale[:, None] * scale,
        input=to_end.reshape(count, states, rows, batch_size) / scale[:, None],
        spring_states=spring_states.reshape(count, rows, states, batch_size),
        spring_surface=np.eye(rows)[..., None] - response.reshape(count, rows, rows, batch_size),
    )
