"""Impulses between beam and wheels where a wheel with mass passes a kink: steps of no length.

A passage changes velocities at once, not positions. With the mode shapes S at the wheels on the
beam, their masses m, and the change d = |v| ([w'] + [r']) of the velocity of the wheel that passes
at constant q', impulses p on the beam (N s, upwards) change the rates q' by S' p, and

    p = -m (d + S S' p):

no wheel leaves the surface. That is the contact law of a step in which d takes the place of the
acceleration of the surface under a wheel, and S S' that of the compliance. So a passage is a step
of no length with matrices of its own, and impulses are its contact forces at its first node.
"""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.integrator.kinks.passages import KinkSteps
from jaxbeam.integrator.step_matrices import StepMatrices
from jaxbeam.model.contact import ModalCompliance
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.runtime.arrays import Array, set_at, xp


def weights_with_impulses(
    kinks: KinkSteps,
    inertia: Float[Array, "step row batch"],
    weight: Float[Array, "step row batch"],
) -> Float[Array, "step row batch"]:
    """Weights (N) of the rows (wheel and node) of steps; m |v| [r'] (N s) in passages."""
    steps, loads = kinks.profile.shape
    others = xp.zeros((steps, loads, inertia.shape[1] // loads - 1))
    jumps = xp.concatenate([kinks.profile[..., None], others], axis=2).reshape(steps, -1, 1)
    return _in_passages(kinks, inertia * jumps, weight)


def with_impulses(
    kinks: KinkSteps,
    matrices: StepMatrices,
    shape: Float[Array, "step load node block mode"],
    model: ModalModel,
) -> StepMatrices:
    """Matrices of steps, with those of passages, from the mode shapes at the wheels."""
    steps, loads, nodes = shape.shape[:3]
    shapes = shape[:, :, 0].reshape(steps, loads, -1)

    def at_first_node(like, axes: tuple[int, ...], index, values):
        """Values at an index, where rows along some axes are split into wheel and node."""
        size: list[Any] = list(like.shape)
        for axis in sorted(axes, reverse=True):
            size[axis : axis + 1] = loads, nodes
        return _in_passages(kinks, set_at(xp.zeros(size), index, values).reshape(like.shape), like)

    index = np.s_[:, :, 0, model.coordinate_index]
    response = at_first_node(matrices.contact_response, (1,), index, kinks.slopes)
    compliance: Any = matrices.contact_compliance
    if isinstance(compliance, ModalCompliance):
        index = np.s_[:, :, 0, : shapes.shape[2]]
        factor = at_first_node(compliance.response, (1,), index, shapes)
        compliance = ModalCompliance(factor, compliance.shape_rows)
    else:
        mobility = shapes @ xp.swapaxes(shapes, 1, 2)
        compliance = at_first_node(compliance, (1, 2), np.s_[:, :, 0, :, 0], mobility)
    index = np.s_[:, model.rate_index, :, 0]
    forces = at_first_node(matrices.force_response, (2,), index, xp.swapaxes(shapes, 1, 2))

    def absent(matrices):
        """What has no effect in a passage: commands, and springs of wheels."""
        commands, springs = matrices.commands, matrices.springs
        parts = [] if commands is None else [commands.contact_response]
        if springs is not None:
            parts += [springs.response, springs.compliance]
            parts += [] if springs.commands is None else [springs.commands]
        return parts

    zero = [_in_passages(kinks, 0.0, part) for part in absent(matrices)]
    return eqx.tree_at(
        lambda m: [m.contact_response, m.contact_compliance, m.force_response, *absent(m)],
        matrices,
        [response, compliance, forces, *zero],
    )


def _in_passages(kinks: KinkSteps, values, others):
    """Values in passages, others in the other steps."""
    return xp.where(kinks.here.reshape(-1, *(1,) * (others.ndim - 1)), values, others)
