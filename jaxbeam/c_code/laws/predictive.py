"""C code of model predictive control: prediction and quadratic program as data of the law.

The program of a sample is brought to its least-distance form (`jaxbeam.numerics.optimisation.qp`)
beforehand: minimise |z| subject to G z <= h, all of which but h is constant, or known over time.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.c_code.quadratic_programs import write_solution
from jaxbeam.c_code.source import CSource
from jaxbeam.c_code.tables import at_samples
from jaxbeam.c_code.writers import EstimateCode, write_state_law
from jaxbeam.case.estimator import Estimate
from jaxbeam.control.predictive.mpc_law import MPCLaw
from jaxbeam.control.predictive.scenario_mpc import ScenarioLaw
from jaxbeam.runtime.arrays import vmap, xp

Rows = Float[np.ndarray, "sample row column"]


class _Program(NamedTuple):
    """Numbers of the law at each sample; columns are those of the initial conditions.

    `past` predicts the present state, in each scenario, from the last one, the command and 1;
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
    _write_predictive_law(ScenarioLaw((law,), np.ones(1), False), code, estimate)


@write_state_law.register
def _(law: ScenarioLaw, code: CSource, estimate: EstimateCode) -> None:
    _write_predictive_law(law, code, estimate)


def _write_predictive_law(scenarios: ScenarioLaw, code: CSource, estimate: EstimateCode) -> None:
    """Step of a law of several scenarios; of one, it is that of model predictive control."""
    law = scenarios.laws[0]
    wheels = estimate.wheels if law.known_weights else 0
    program = _program(scenarios, code, wheels)
    states, actuators = np.shape(law.C)[1], code.actuators
    unexplained_states = states * len(scenarios.laws)
    limits, variables = program.rows.shape[1:]
    columns = states + unexplained_states + actuators + 1 + wheels
    last = code.state("last_state", np.zeros(states), "state at the last sample")
    initial = code.work("initial", columns, "initial conditions of the prediction")
    # State and command of the last sample, 1 and weights: what the present state is predicted from.
    before = code.work("before", columns - unexplained_states, "what the state is predicted from")
    predicted = code.work("predicted_state", unexplained_states, "state predicted, by scenario")
    minimiser = code.work("minimiser", variables, "unconstrained minimiser, then solution")
    unexplained, command = f"{initial} + {states}", f"{initial} + {states + unexplained_states}"
    code.add("/* Initial conditions: state, its unexplained change, last command, 1 */")
    _copy_state(law, code, estimate, initial)
    code.add(
        f"copy({command}, {code.command}, {actuators});\n{initial}[{columns - wheels - 1}] = 1;"
    )
    if wheels:
        code.add(f"copy({initial} + {columns - wheels}, {estimate.weights}, {wheels});")
    code.add(
        f"copy({before}, {last}, {states});\n"
        f"copy({before} + {states}, {command}, {columns - states - unexplained_states});"
    )
    past = code.per_sample("past", program.past)
    code.multiply(predicted, past, before, unexplained_states, columns - unexplained_states)
    code.add(
        f"for (i = 0; i < {unexplained_states}; i++)"
        f" ({unexplained})[i] = {initial}[i % {states}] - {predicted}[i];\n"
        f"copy({last}, {initial}, {states});\n"
        "/* Quadratic program: minimise |z| subject to G z <= h */",
        unexplained_states,
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
    limits, variables = program.rows.shape[1:]
    h = code.work("limits", limits, "right-hand sides h")
    columns = program.minimiser.shape[2]
    code.multiply(h, code.per_sample("limit_rows", program.limits), initial, limits, columns)
    G = code.per_sample("rows", program.rows)
    counter = "failures", "samples without a solution, at which the command stayed"
    write_solution(code, law.solver, h, G, minimiser, limits, variables, counter)


def _program(scenarios: ScenarioLaw, code: CSource, wheels: int) -> _Program:
    """Numbers of the law at all samples; at one if they do not change.

    The last of the initial conditions are estimated weights of a number of `wheels`.
    """
    law, factors = scenarios.laws[0], np.asarray(scenarios.mass_factors)
    states, actuators = np.shape(law.C)[1], code.actuators
    count = len(scenarios.laws)
    first_command = states * (1 + count)
    columns = first_command + actuators + 1
    unit, commands = np.eye(columns), np.zeros((columns, actuators))
    commands[first_command : first_command + actuators] = np.eye(actuators)

    def numbers(t):
        def predictions_for(weights):
            found = []
            for each, factor in zip(scenarios.laws, factors, strict=True):
                known = weights * factor if wheels else None
                found.append(each._predict(t, Estimate(xp.zeros(states), known)))
            return found

        def program(predictions, initial, command):
            parts = []
            for i, (each, (_, prediction, _)) in enumerate(
                zip(scenarios.laws, predictions, strict=True)
            ):
                own = states * (1 + i)
                change = initial[own : own + states]
                conditions = xp.concatenate([initial[:states], change, initial[first_command:]])
                parts.append((each, prediction, conditions))
            return scenarios.quadratic_program(parts, command)

        known = predictions_for(xp.zeros(wheels))
        pasts = []
        for factor, (past, _, weights) in zip(factors, known, strict=True):
            forces = past.E @ weights if weights.shape[0] else xp.zeros(states)
            of_wheels = factor * past.E[:, :wheels]
            pasts.append(xp.concatenate([past.A, past.B, forces[:, None], of_wheels], axis=1))
        start = program(known, xp.zeros(columns), xp.zeros(actuators))
        programs = vmap(lambda *at: program(known, *at)[1::2])(unit, commands)
        f, limits = programs[0], programs[1] - start.gamma
        constant = limits[-1] + start.gamma
        # A weight changes the response to the condition 1.
        for weight in np.eye(wheels):
            loaded = program(predictions_for(weight), unit[-1], commands[-1])
            f = xp.concatenate([f, (loaded.f - f[columns - 1])[None]])
            limits = xp.concatenate([limits, (loaded.gamma - constant)[None]])
        return xp.concatenate(pasts), start.H, f.T, start.M, limits.T, start.gamma

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
