"""Prediction of a sampled plant: its free response, and its response to future moves.

Everywhere  x(k+1) = A_k x(k) + B_k u(k) + E_k W + w,  y(k) = C x(k),  with commands u held over a
period, weights W of the loads, and w the unexplained change of the state, assumed to persist.
Moves are the changes of the commands, u(k+i) = u(k-1) + du(k) + ... + du(k+i).
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.numerics.discretisation import c2d
from jaxbeam.runtime.arrays import Array, scan, xp


class SampledPlant(NamedTuple):
    """A plant over a period, or over several along a first axis; see the module.

    With a delay the previous commands are further states.
    """

    A: Float[Array, "*period state state"]
    B: Float[Array, "*period state actuator"]
    E: Float[Array, "*period state load"]


class Prediction(NamedTuple):
    """Future outputs Y = F initial + Phi variables, eq. (7.4), and the end of the horizon.

    `initial` are the initial conditions (x(k), w, u(k-1), 1), with a column of F for each; that of
    1 is the response to the loads. `end` and `end_phi` give x(k+N-1), x(k+N) and u(k+N-1), N the
    horizon. Of one sample, or of several along a first axis.
    """

    F: Float[Array, "*sample horizon output initial"]
    Phi: Float[Array, "*sample horizon output variable"]
    end: Float[Array, "*sample end initial"]
    end_phi: Float[Array, "*sample end variable"]

    def under(self, load_weights: Float[Array, " load"]) -> "Prediction":
        """Prediction under weights (N) from one whose last initial conditions are those weights."""

        def combined(columns):
            own = columns.shape[-1] - load_weights.shape[0]
            of_loads = columns[..., own:] @ load_weights
            return xp.concatenate([columns[..., :own], of_loads[..., None]], axis=-1)

        return self._replace(F=combined(self.F), end=combined(self.end))


def sampled_plant(
    A: Float[Array, "state state"],
    B: Float[Array, "state actuator"],
    B_f: Float[Array, "state load"],
    period: Float[Array, ""],
    delay: Float[Array, ""] | None = None,
) -> SampledPlant:
    """Plant z' = A z + B u + B_f W over a period (s) with held inputs. Exact.

    With a `delay` (s), at most the period, commands begin that much later.
    """
    actuators, loads = B.shape[1], B_f.shape[1]
    transition, input_matrix = c2d(A, xp.concatenate([B, B_f], axis=1), period)
    input_matrix, load_matrix = input_matrix[0, :, :actuators], input_matrix[0, :, actuators:]
    if delay is None:
        return SampledPlant(transition, input_matrix, load_matrix)
    late_input_matrix = c2d(A, B, period - delay)[1][0]
    no_state = xp.zeros((actuators, transition.shape[0]))
    return SampledPlant(
        A=xp.block(
            [
                [transition, input_matrix - late_input_matrix],
                [no_state, xp.zeros((actuators, actuators))],
            ]
        ),
        B=xp.concatenate([late_input_matrix, xp.eye(actuators)]),
        E=xp.concatenate([load_matrix, xp.zeros((actuators, loads))]),
    )


def incremental_model(
    A: Float[Array, "state state"],
    B: Float[Array, "state actuator"],
    C: Float[Array, "output state"],
) -> tuple[
    Float[Array, "augmented augmented"],
    Float[Array, "augmented actuator"],
    Float[Array, "output augmented"],
]:
    """A, B and C of eq. (7.1): the plant in the states (x(k) - x(k-1), y(k)), driven by moves."""
    states, outputs = A.shape[0], C.shape[0]
    transition = xp.block([[A, xp.zeros((states, outputs))], [C @ A, xp.eye(outputs)]])
    output_rows = xp.concatenate([xp.zeros((outputs, states)), xp.eye(outputs)], axis=1)
    return transition, xp.concatenate([B, C @ B]), output_rows


def move_basis(
    horizon: int, terms: int, pole: Float[Array, ""] | None = None
) -> Float[Array, "horizon term"]:
    """Basis of move sequences: unit moves in the first periods, or Laguerre functions.

    With a `pole` a (0 to 1) these are the orthonormal Laguerre functions in discrete time, of which
    a few span a long horizon (Wang, J. Process Control 14, 2004); at a = 0 they are unit moves.
    """
    if pole is None:
        return xp.eye(horizon, terms)
    pole_complement = 1 - pole**2
    first = xp.sqrt(pole_complement) * xp.cumprod(
        xp.concatenate([xp.ones(1), xp.full(terms - 1, -pole)])
    )
    column = xp.concatenate(
        [pole[None], pole_complement * first[: terms - 1] / xp.sqrt(pole_complement)]
    )
    step = xp.array(
        [[column[i - j] if i >= j else 0.0 for j in range(terms)] for i in range(terms)]
    )
    _, sequences = scan(lambda values, _: (step @ values, values), first, length=horizon)
    return sequences


def move_maps(basis: Float[Array, "horizon term"], actuators: int) -> Float[Array, "..."]:
    """Moves (horizon, actuator, variable) per variable, one for each basis term and actuator."""
    terms = basis[:, None, :, None] * np.eye(actuators)[:, None]
    return terms.reshape(basis.shape[0], actuators, -1)


def predict(
    plants: SampledPlant,
    C: Float[Array, "output state"],
    move_maps: Float[Array, "horizon actuator variable"],
    load_weights: Float[Array, "load *constant"],
) -> Prediction:
    """F and Phi of a plant given over each period of the horizon, eqs (7.5) and (7.10).

    `move_maps` map the variables to moves; `load_weights` are in N. For a time-invariant plant F
    initial equals F (x(k) - x(k-1), y(k)) of the thesis. Plants (horizon, sample) give predictions
    at several samples. With a matrix of `load_weights` further initial conditions take the place of
    the last, 1: the weights are the matrix times these.
    """
    states, actuators = plants.B.shape[-2:]
    if load_weights.ndim == 1:
        load_weights = load_weights[:, None]
    initial_count = 2 * states + actuators + load_weights.shape[1]
    columns = initial_count + move_maps.shape[2]
    previous_command = xp.eye(actuators, columns, k=2 * states)
    commands = previous_command + xp.pad(
        xp.cumsum(move_maps, axis=0), ((0, 0), (0, 0), (initial_count, 0))
    )
    unexplained = xp.eye(states, columns, k=states)

    samples = plants.A.shape[1:-2]
    others = [*[(0, 0)] * (len(samples) + 1), (2 * states + actuators, move_maps.shape[2])]

    def advance(state, period):
        plant, command = period
        of_loads = xp.pad(plant.E @ load_weights, others)
        next_state = plant.A @ state + plant.B @ command + unexplained + of_loads
        return next_state, next_state

    initial_state = xp.broadcast_to(xp.eye(states, columns), (*samples, states, columns))
    _, trajectory = scan(advance, initial_state, (plants, commands))
    outputs = C @ trajectory
    trajectory = xp.concatenate([initial_state[None], trajectory])
    last_command = xp.broadcast_to(commands[-1], (*samples, actuators, columns))
    end = xp.concatenate([trajectory[-2], trajectory[-1], last_command], axis=-2)
    outputs = xp.moveaxis(outputs, 0, -3)
    return Prediction(
        outputs[..., :initial_count],
        outputs[..., initial_count:],
        end[..., :initial_count],
        end[..., initial_count:],
    )


def repeat_plant(plant: SampledPlant, periods: int) -> SampledPlant:
    """The same plant over several periods."""
    return jax.tree.map(lambda part: xp.broadcast_to(part, (periods, *part.shape)), plant)
