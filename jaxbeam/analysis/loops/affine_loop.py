"""Loops whose law is affine: their matrices from known numbers, without a compiler."""

import itertools
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.analysis.frozen_loop import LoopDynamics, LoopTiming
from jaxbeam.analysis.loops.affine import affine_jacobian, apply, is_affine, random_argument
from jaxbeam.case.controller import AbstractSampledLaw, ControlStep, Measurement
from jaxbeam.runtime.arrays import Array, ravel_pytree, xp


class LinearLaw(AbstractSampledLaw):
    """Deviations of an affine law: (commands, next state) = matrix @ (state, y, x, u).

    The state of the law, the readings y, the state x of the plant, and the last commands u, one
    after the other; columns of them for one matrix for each time (see `apply`).
    """

    matrix: Float[Array, "*time after before"]
    commands: int = eqx.field(static=True)

    def initial_state(self):
        return np.zeros(self.matrix.shape[-2] - self.commands)

    def step(self, state, measurement, t):
        measured = measurement.readings, measurement.state, measurement.command
        after = apply(self.matrix, xp.concatenate([state, *measured]))
        return ControlStep(after[: self.commands], after[self.commands :])


def linear_loop(loop: LoopDynamics, times: Float[np.ndarray, " time"]) -> LoopDynamics:
    """Deviations of a sampled loop of known numbers from any of its states, at several times (s).

    Raises NotAffineError for a law that is not affine, or that computes with JAX.
    """
    states, unpack = ravel_pytree(loop.law.initial_state())
    commands = len(loop.plant.case.actuators)
    plant_states = loop.plant.modal_model.state_count
    sizes = states.size, len(loop.plant.case.sensors), plant_states, commands
    ends = list(itertools.accumulate(sizes))
    nothing: Any = np.zeros(ends[-1])

    def step_at(t):
        def step(values):
            own, *measured = (values[slice(*both)] for both in itertools.pairwise([0, *ends]))
            command, after, _ = loop.law.step(unpack(own), Measurement(*measured), t)
            return xp.concatenate([command, ravel_pytree(after)[0]])

        return step

    argument, last = random_argument(ends[-1]), None
    matrices: list[Any] = []
    for t in times:
        step = step_at(t)
        value = step(argument)
        same = last is not None and (
            np.array_equal(value, last) or is_affine(step, matrices[-1], step(nothing))
        )
        matrices.append(matrices[-1] if same else affine_jacobian(step, nothing))
        last = value
    weight = loop.augmented_plant.loads.wheels.weight
    return eqx.tree_at(
        lambda x: (x.law, x.augmented_plant.loads.wheels.weight),
        loop,
        (LinearLaw(np.stack(matrices), commands), 0 * weight),
    )


def sampled_matrices(
    loop: LoopDynamics, timing: LoopTiming, times, transitions
) -> tuple[
    Float[np.ndarray, "time state state"],
    Float[np.ndarray, "time state actuator"],
    Float[np.ndarray, "time actuator state"],
]:
    """Matrices A, B and K of a `linear_loop` over periods from its times (s), open at the commands.

    `transitions` are those of its plant.
    """
    start, unpack = loop.rest_state(timing)
    size, commands = len(start), loop.law.commands
    columns = np.tile(np.eye(size + commands), len(times))
    after, command = loop.sampling_step(
        timing, unpack(columns[:size]), times, transitions, columns[size:]
    )
    rows = [leaf.reshape(-1, columns.shape[1]) for leaf in (*jax.tree.leaves(after), command)]
    both: Any = np.concatenate(rows).reshape(size + commands, len(times), size + commands)
    both = np.moveaxis(both, 1, 0)
    return both[:, :size, :size], both[:, :size, size:], both[:, size:, :size]
