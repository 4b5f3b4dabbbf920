"""Loops whose law is affine: their matrices from known numbers, without a compiler."""

from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.analysis.frozen_loop import LoopDynamics, LoopTiming
from jaxbeam.analysis.loops.affine import affine_jacobian, is_affine
from jaxbeam.case.controller import AbstractSampledLaw, ControlStep, Measurement
from jaxbeam.runtime.arrays import Array, ravel_pytree, xp


class LinearLaw(AbstractSampledLaw):
    """Deviations of an affine law at one time: (commands, next state) = matrix @ (state, y, x, u).

    The state of the law, the readings y, the state x of the plant, and the last commands u, one
    after the other, or columns of them.
    """

    matrix: Float[Array, "after before"]
    commands: int = eqx.field(static=True)

    def initial_state(self):
        return np.zeros(self.matrix.shape[0] - self.commands)

    def step(self, state, measurement, t):
        after = self.matrix @ xp.concatenate([state, *measurement])
        return ControlStep(after[: self.commands], after[self.commands :])


def linear_loop(loop: LoopDynamics, t: float, earlier: LoopDynamics | None = None) -> LoopDynamics:
    """Deviations of a sampled loop of known numbers from any of its states, at t (s).

    The `earlier` one, of another time, if the law is the same. Raises NotAffineError for a law that
    is not affine, or that computes with JAX.
    """
    states, unpack = ravel_pytree(loop.law.initial_state())
    commands = len(loop.plant.case.actuators)
    plant_states = loop.plant.modal_model.state_count
    sizes = states.size, len(loop.plant.case.sensors), plant_states, commands
    ends = np.cumsum(sizes)

    def step(values):
        own, *measured = np.split(values, ends[:-1])
        command, after, _ = loop.law.step(unpack(own), Measurement(*measured), t)
        return xp.concatenate([command, ravel_pytree(after)[0]])

    if earlier is not None and is_affine(step, earlier.law.matrix, step(np.zeros(ends[-1]))):
        return earlier
    law = LinearLaw(affine_jacobian(step, np.zeros(ends[-1])), commands)
    if earlier is not None:
        return eqx.tree_at(lambda x: x.law, earlier, law)
    weight = loop.augmented_plant.loads.wheels.weight
    return eqx.tree_at(
        lambda x: (x.law, x.augmented_plant.loads.wheels.weight), loop, (law, 0 * weight)
    )


def sampled_matrices(
    loop: LoopDynamics, timing: LoopTiming, t, transitions
) -> tuple[
    Float[Array, "state state"], Float[Array, "state actuator"], Float[Array, "actuator state"]
]:
    """Matrices A, B and K of a `linear_loop` over the period from t (s), opened at the commands.

    `transitions` are those of its plant.
    """
    start, unpack = loop.rest_state(timing)
    size, commands = len(start), loop.law.commands
    columns = np.eye(size + commands)
    after, command = loop.sampling_step(
        timing, unpack(columns[:size]), t, transitions, columns[size:]
    )
    change = ravel_columns(after)
    return change[:, :size], change[:, size:], command[:, :size]


def ravel_columns(tree) -> Any:
    """Leaves (..., column) of known numbers as one matrix; see `ravel_pytree`."""
    leaves = jax.tree.leaves(tree)
    return np.concatenate([leaf.reshape(-1, leaf.shape[-1]) for leaf in leaves])
