"""C code of model predictive control: prediction and quadratic program as data of the law.

The program of a sample is brought to its least-distance form (`jaxbeam.numerics.optimisation.qp`)
beforehand: minimise |z| subject to G z <= h, all of which but h is constant, or known over time.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.c_code.source import CSource
from jaxbeam.c_code.tables import at_samples
from jaxbeam.c_code.writers import EstimateCode, write_state_law
from jaxbeam.case.estimator import Estimate
from jaxbeam.control.predictive.mpc_law import MPCLaw
from jaxbeam.numerics.optimisation.qp import MAX_STEPS, MAX_SWEEPS
from jaxbeam.runtime.arrays import vmap, xp

Rows = Float[np.ndarray, "sample row column"]


class _Program(NamedTuple):
    """Numbers of the law at each sample; columns are those of the initial conditions.

    `past` predicts the present state from the last one, the command and the known inputs, 1;
    `minimiser` gives the unconstrained one, `limits` the right-hand sides, over the lengths of the
    rows of M L'^-1, which are `rows`; `move` the first move from z.
    """

    past: Rows
    minimiser: Rows
    limits: Rows
    rows: Rows
    move: Rows


@write_state_law.register
def _(law: MPCLaw, code: CSource, estimate: EstimateCode) -> None:
    wheels = estimate.wheels if law.known_weights else 0
    program = _program(law, code, wheels)
    states, actuators = np.shape(law.C)[1], code.actuators
    limits, variables = program.rows.shape[1:]
    columns = 2 * states + actuators + 1 + wheels
    last = code.state("last_state", np.zeros(states), "state at the last sample")
    initial = code.work("initial", columns, "initial conditions of the prediction")
    predicted = code.work("predicted_state", states, "state that the last sample predicts")
    minimiser = code.work("minimiser", variables, "unconstrained minimiser, then solution")
    unexplained, command = f"{initial} + {states}", f"{initial} + {2 * states}"
    code.add("/* Initial conditions: state, its unexplained change, last command, 1 */")
    _copy_state(law, code, estimate, initial)
    code.add(
        f"copy({command}, {code.command}, {actuators});\n{initial}[{columns - wheels - 1}] = 1;\n"
        f"copy({unexplained}, {last}, {states});"
    )
    if wheels:
        code.add(f"copy({initial} + {columns - wheels}, {estimate.weights}, {wheels});")
    past = code.per_sample("past", program.past)
    code.multiply(predicted, past, unexplained, states, columns - states)
    code.add(
        f"for (i = 0; i < {states}; i++)"
        f" {initial}[{states} + i] = {initial}[i] - {predicted}[i];\n"
        f"copy({last}, {initial}, {states});\n"
        "/* Quadratic program: minimise |z| subject to G z <= h */",
        states,
    )
    matrix = code.per_sample("minimiser", program.minimiser)
    code.multiply(minimiser, matrix, initial, variables, columns)
    solved = "1"
    if limits:
        _write_quadratic_program(law, code, program, minimiser, initial)
        solved = "solved"
    move = code.per_sample("first_move", program.move)
    move_work = code.work("move", actuators, "first move")
    code.multiply(move_work, move, minimiser, actuators, variables)
    code.add(
        f"for (i = 0; i < {actuators}; i++)\n"
        f"    {code.output}[i] = {code.command}[i] + ({solved} ? {move_work}[i] : 0);",
        actuators,
    )


def _copy_state(law: MPCLaw, code: CSource, estimate: EstimateCode, initial: str) -> None:
    """Estimated states of beam and vehicles and, with a delay, the last command."""
    place = estimate.states
    code.add(f"copy({initial}, {estimate.state}, {place});")
    if law.vehicle_states:
        code.add(f"copy({initial} + {place}, {estimate.vehicles}, {law.vehicle_states});")
        place += law.vehicle_states
    if law.delayed:
        code.add(f"copy({initial} + {place}, {code.command}, {code.actuators});")


def _write_quadratic_program(law, code: CSource, program: _Program, minimiser, initial) -> None:
    """The solution replaces the unconstrained minimiser; `solved` is whether there is one."""
    code.variables += ["real scale", "int solved"]
    limits, variables = program.rows.shape[1:]
    h = code.work("limits", limits, "right-hand sides h")
    z = code.work("solution", variables, "solution of the least-distance form")
    G = code.per_sample("rows", program.rows)
    code.multiply(
        h, code.per_sample("limit_rows", program.limits), initial, limits, initial_size(program)
    )
    if law.solver == "hildreth":
        work = code.work("qp_work", 2 * limits + variables)
        operations = MAX_SWEEPS * _sweep_operations(limits, variables)
        code.notes.append(f"Hildreth's procedure ends after {MAX_SWEEPS} sweeps at the latest.")
        steps = MAX_SWEEPS
    else:
        work = code.work("qp_work", variables * variables + 4 * variables + 10 * limits)
        operations = MAX_STEPS * _interior_operations(limits, variables)
        code.notes.append(f"The interior-point method ends after {MAX_STEPS} steps at the latest.")
        steps = MAX_STEPS
    failures = code.counter("failures", "samples without a solution, at which the command stayed")
    method = "hildreth" if law.solver == "hildreth" else "interior_point"
    code.add(
        f"""
scale = least_distance({h}, {G}, {minimiser}, {limits}, {variables});
solved = scale <= 0 || {method}({z}, {G}, {h}, {limits}, {variables}, {steps}, {work});
if (!solved) {failures}++;
if (scale > 0)
    for (i = 0; i < {variables}; i++) {minimiser}[i] += scale * {z}[i];""",
        operations + limits * (2 * variables + 6) + 4 * variables + 4,
    )


def initial_size(program: _Program) -> int:
    """Number of initial conditions."""
    return program.minimiser.shape[2]


def _interior_operations(R: int, V: int) -> int:
    """Operations of a step of the interior-point method for R limits and V variables, at most."""
    newton = 4 * R * V + 3 * V * V + 16 * R + 6 * V
    factor = (3 * R + 2) * V * (V + 1) // 2 + V * V * V + 3 * V * V + 4 * R
    return factor + 2 * newton + 10 * R * V + 58 * R + 12 * V + 32


def _sweep_operations(R: int, V: int) -> int:
    """Operations of a sweep of Hildreth's procedure, at most."""
    return 10 * R * V + 14 * R + 8 * V + 12


def _program(law: MPCLaw, code: CSource, wheels: int) -> _Program:
    """Numbers of the law at all samples; at one if they do not change.

    The last of the initial conditions are estimated weights of a number of `wheels`.
    """
    states, actuators = np.shape(law.C)[1], code.actuators
    columns = 2 * states + actuators + 1
    unit, commands = np.eye(columns), np.zeros((columns, actuators))
    commands[2 * states : 2 * states + actuators] = np.eye(actuators)

    def numbers(t):
        def prediction_for(weights):
            return law._predict(t, Estimate(xp.zeros(states), weights if wheels else None))

        past, prediction, weights = prediction_for(xp.zeros(wheels))
        known = past.E @ weights if weights.shape[0] else xp.zeros(states)
        past = xp.concatenate([past.A, past.B, known[:, None], past.E[:, :wheels]], axis=1)
        start = law.quadratic_program(prediction, xp.zeros(columns), xp.zeros(actuators))
        programs = vmap(lambda *at: law.quadratic_program(prediction, *at)[1::2])(unit, commands)
        f, limits = programs[0], programs[1] - start.gamma
        constant = limits[-1] + start.gamma
        # A weight changes the response to the condition 1.
        for weight in np.eye(wheels):
            _, loaded, _ = prediction_for(weight)
            program = law.quadratic_program(loaded, unit[-1], commands[-1])
            f = xp.concatenate([f, (program.f - f[columns - 1])[None]])
            limits = xp.concatenate([limits, (program.gamma - constant)[None]])
        return past, start.H, f.T, start.M, limits.T, start.gamma

    past, H, f, M, limit_columns, gamma = at_samples(numbers, code, varies=law.preview is not None)
    inverse_factor = np.linalg.inv(np.linalg.cholesky(H))
    to_one = np.eye(limit_columns.shape[-1])[columns - 1]
    limit_columns = limit_columns + gamma[..., None] * to_one
    transposed = np.swapaxes(inverse_factor, -1, -2)
    rows = M @ transposed
    norms = np.sqrt(np.sum(rows**2, axis=-1, keepdims=True))
    norms = np.where(norms > 0, norms, 1.0)
    moved = np.shape(law.move_maps)[2]
    move = np.asarray(law.move_maps)[0] @ transposed[:, :moved]
    return _Program(past, -inverse_factor @ f, limit_columns / norms, rows / norms, move)
