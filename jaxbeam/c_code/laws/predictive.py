"""C code of predictive control and moving-horizon estimation.

The program of a sample is brought to its least-distance form (`jaxbeam.numerics.qp`)
beforehand: minimise |z| subject to G z <= h, all of which but h is constant, or known over time.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.c_code.laws.estimators import FilterModel, transition_matrices, write_filter_step
from jaxbeam.c_code.source import CSource
from jaxbeam.c_code.texts import at_samples
from jaxbeam.c_code.writers import EstimateCode, write_filter, write_law, write_state_law
from jaxbeam.case.estimator import Estimate
from jaxbeam.control.predictive.gpc import AdaptiveGPCLaw, probe_signs
from jaxbeam.control.predictive.mpc_law import MPCLaw
from jaxbeam.control.predictive.scenario_mpc import ScenarioLaw
from jaxbeam.estimation.crossing_filter import corrected
from jaxbeam.estimation.moving_horizon import BoundFactor, WindowFilter
from jaxbeam.estimation.observer import sensor_offsets
from jaxbeam.numerics.qp import MAX_STEPS, MAX_SWEEPS
from jaxbeam.runtime.arrays import vmap, xp


def write_solution(
    code: CSource,
    solver: str,
    h: str,
    G: str,
    minimiser: str,
    limits: int,
    variables: int,
    counter: tuple[str, str],
) -> None:
    """Write the point within G z <= h that is nearest to a `minimiser`, which it replaces.

    The rows of G have length one; `h` is work space, of which nothing is left. The C variable
    `solved` is whether there is such a point. A `counter`, its name and its meaning, counts the
    samples where there is none.
    """
    declared = "real scale", "int solved"
    code.variables += [each for each in declared if each not in code.variables]
    z = code.work("solution", variables, "solution of the least-distance form")
    if solver == "hildreth":
        work = code.work("qp_work", 2 * limits + variables)
        operations = MAX_SWEEPS * _sweep_operations(limits, variables)
        code.notes.append(f"Hildreth's procedure ends after {MAX_SWEEPS} sweeps at the latest.")
        steps = MAX_SWEEPS
    else:
        work = code.work("qp_work", variables * variables + 4 * variables + 10 * limits)
        operations = MAX_STEPS * _interior_operations(limits, variables)
        code.notes.append(f"The interior-point method ends after {MAX_STEPS} steps at the latest.")
        steps = MAX_STEPS
    failures = code.counter(*counter)
    method = "hildreth" if solver == "hildreth" else "interior_point"
    code.add(
        f"""
scale = least_distance({h}, {G}, {minimiser}, {limits}, {variables});
solved = scale <= 0 || {method}({z}, {G}, {h}, {limits}, {variables}, {steps}, {work});
if (!solved) {failures}++;
if (scale > 0)
    for (i = 0; i < {variables}; i++) {minimiser}[i] += scale * {z}[i];""",
        operations + limits * (2 * variables + 6) + 4 * variables + 4,
    )


def _interior_operations(R: int, V: int) -> int:
    """Operations of a step of the interior-point method for R limits and V variables, at most."""
    newton = 4 * R * V + 3 * V * V + 16 * R + 6 * V
    factor = (3 * R + 2) * V * (V + 1) // 2 + V * V * V + 3 * V * V + 4 * R
    return factor + 2 * newton + 10 * R * V + 58 * R + 12 * V + 32


def _sweep_operations(R: int, V: int) -> int:
    """Operations of a sweep of Hildreth's procedure, at most."""
    return 10 * R * V + 14 * R + 8 * V + 12


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


@write_filter.register
def _(filter: WindowFilter, code: CSource) -> EstimateCode:
    plant, states = filter.filter.filtered.plant, filter.rows.shape[1]

    def model(t):
        transition, C, D = filter.filter.model_at(t)
        _, *inputs = transition_matrices(transition)
        on_beam = xp.where(plant.loads.on_beam(t), 1.0, 0.0)
        return *filter.joint(transition, C), *inputs, D, on_beam

    A, noise, C, *inputs, D, on_beam = at_samples(model, code)
    previous, present = (np.pad(part, ((0, 0), (0, filter.earlier), (0, 0))) for part in inputs)
    gains, factors = [], []
    start, of_readings = filter.initial_state(), filter.filter.sensor_chain.noise_covariance
    covariance = np.asarray(start.covariance)
    for k in range(len(A)):
        covariance = A[k] @ covariance @ A[k].T + noise[k]
        gain, covariance = (np.asarray(part) for part in corrected(covariance, C[k], of_readings))
        gains.append(gain)
        factors.append(filter.factor(covariance))
    x = code.state("estimate", start.mean, "states of beam, loads and sensors; deflections before")
    model_at_samples = FilterModel(A, previous, present, C, D, np.stack(gains))
    write_filter_step(code, model_at_samples, sensor_offsets(plant), x)
    if filter.bounds()[0].shape[0]:
        x = _write_bounds(filter, factors, code, x)
    added, vehicles = plant.modal_model.state_count, plant.vehicle_states
    weights, wheels = None, filter.weight_rows.shape[0]
    if wheels:
        weights = code.work("weights", wheels, "estimated weights, zero off the beam (N)")
        mask = code.per_sample("on_beam", on_beam.reshape(len(A), -1))
        first = int(np.argmax(np.asarray(filter.weight_rows)[0]))
        code.add(
            f"for (i = 0; i < {wheels}; i++) {weights}[i] = {mask}[i] * {x}[{first} + i];", wheels
        )
    assert added + vehicles <= states
    return EstimateCode(
        x, filter.filter.plant_states, weights, wheels, f"{x} + {added}" if vehicles else None
    )


def _write_bounds(filter: WindowFilter, factors: list[BoundFactor], code: CSource, x: str) -> str:
    """Most probable states within the bounds; their C expression."""
    rows, lowest, highest = (np.asarray(part) for part in filter.bounds())
    states, (count, joint) = filter.rows.shape[1], rows.shape
    size, root, columns, certain = (
        np.stack([np.asarray(part) for part in parts]) for parts in zip(*factors, strict=True)
    )
    limits = np.concatenate([highest, -lowest])
    finite = np.isfinite(limits)
    limits, both = limits[finite], np.concatenate([rows, -rows])[finite]

    def of_both(part):
        return np.concatenate([part, part], axis=1)[:, finite]

    free, size = of_both(certain)[..., None], of_both(size)[..., None]
    G = np.where(free, 0.0, np.concatenate([root, -root], axis=1)[:, finite])
    norms = np.sqrt(np.sum(G**2, axis=2, keepdims=True))
    norms = np.where(norms > 0, norms, 1.0)
    sides = np.where(free, 1.0, limits[:, None] / size / norms)
    sides_by_states = np.where(free, 0.0, both / size / norms)
    h = code.work("bounds", len(limits), "right-hand sides of the bounds")
    z = code.work("correction", count, "independent numbers of the correction")
    within = code.work("within", states, "most probable states within the bounds")
    code.add("/* Most probable states within the bounds: minimise |z| subject to G z <= h */")
    code.add(
        f"copy({h}, {code.per_sample('bound', sides)}, {len(limits)});\n"
        f"for (i = 0; i < {count}; i++) {z}[i] = 0;"
    )
    matrix = code.per_sample("bound_rows", sides_by_states)
    code.multiply_add(h, matrix, x, len(limits), joint, -1)
    G = code.per_sample("bound_matrix", G / norms)
    counter = "bound_failures", "samples at which no states within the bounds were found"
    write_solution(code, "interior", h, G, z, len(limits), count, counter)
    columns = code.per_sample("correction_columns", columns[:, :states])
    code.add(f"copy({within}, {x}, {states});")
    code.add(
        f"if (solved) multiply_add({within}, 1, {columns}, {z}, {states}, {count});",
        2 * states * (count + 1),
    )
    return within


@write_law.register
def _(law: AdaptiveGPCLaw, code: CSource) -> None:
    powers, outputs, actuators = law.powers, law.outputs, code.actuators
    count, past, (first, horizon, moves) = np.size(law.start), law.powers + 1, law.horizons
    until, period = float(law.until), float(law.period)
    coefficients = code.state("coefficients", law.start, "a, then B by powers")
    root = code.state("root", law.start_root, "square root S of their covariance S S'")
    readings = code.state("past_readings", np.zeros(past * outputs), "the latest first")
    commands = code.state("past_commands", np.zeros(past * actuators), "the latest first")
    complete = code.state("complete", [past + 1.0], "samples with complete readings until now")
    code.missing.append("Identification pauses while one is missing or among the past readings.")
    changes = code.work("past_moves", powers * actuators, "changes of commands, the latest first")
    row = code.work("row", count, "what the coefficients multiply")
    spread = code.work("spread", 2 * count, "S' row, S S' row")
    n = moves * actuators
    size = horizon * outputs * (1 + actuators) + n * (n + 2)
    work = code.work("prediction", size, "predicted outputs, normal equations")
    move = code.work("move", actuators, "first move")
    start_trace = float(np.sum(np.asarray(law.start_root) ** 2))
    code.add(
        f"""
/* Past commands, and their changes */
for (i = {past * actuators - 1}; i >= {actuators}; i--) {commands}[i] = {commands}[i - {actuators}];
copy({commands}, {code.command}, {actuators});
for (i = 0; i < {powers * actuators}; i++)
    {changes}[i] = {commands}[i] - {commands}[i + {actuators}];
/* Recursive least squares with forgetting, from changes of readings and commands */
{complete}[0] = {complete}[0] < {past} ? {complete}[0] + 1 : {past + 1};
for (i = 0; i < {outputs}; i++)
    if (!({code.present}[i] > 0)) {complete}[0] = 0;
if ({"1" if np.isinf(until) else f"t <= (real){until!r}"} && t >= (real){period / 2!r}
    && {complete}[0] > {past}) {{
    real trace = 0;
    int k, o;
    for (i = 0; i < {count * count}; i++) {root}[i] /= (real){float(law.forgetting) ** 0.5!r};
    for (o = 0; o < {outputs}; o++) {{
        for (i = 0; i < {count}; i++) {row}[i] = 0;
        for (i = 0; i < {powers}; i++) {{
            {row}[i] = {readings}[(i + 1) * {outputs} + o] - {readings}[i * {outputs} + o];
            for (k = 0; k < {actuators}; k++)
                {row}[{powers} + (i * {outputs} + o) * {actuators} + k] =
                    {changes}[i * {actuators} + k];
        }}
        least_squares_step({coefficients}, {root}, {row}, {code.readings}[o] - {readings}[o],
                           (real){float(law.noise)!r}, {count}, {spread});
    }}
    for (i = 0; i < {count * count}; i++) trace += {root}[i] * {root}[i];
    if (trace > (real){start_trace!r})
        for (i = 0; i < {count * count}; i++) {root}[i] /= sqrt(trace / (real){start_trace!r});
}}
for (i = {past * outputs - 1}; i >= {outputs}; i--) {readings}[i] = {readings}[i - {outputs}];
copy({readings}, {code.readings}, {outputs});""",
        powers * actuators
        + 5
        + outputs
        + count * count
        + outputs * (powers + 6 + 6 * count * count + 7 * count)
        + 5 * count * count
        + 1,
    )
    weights = code.constant("output_weights", law.output_weights)
    move_weights = code.constant("move_weights", law.move_weights)
    reference = code.constant("reference", law.reference)
    code.add(
        f"""
/* First move by the identified model */
predictive_move({move}, {coefficients}, {coefficients} + {powers}, {readings}, {changes},
                {powers}, {outputs}, {actuators}, {first}, {horizon}, {moves}, {weights},
                {move_weights}, {reference}, {work});
for (i = 0; i < {actuators}; i++) {code.output}[i] = {code.command}[i] + {move}[i];""",
        _move_operations(law) + actuators,
    )
    if law.probes:
        signs, probe = probe_signs(), code.constant("probe", law.probe)
        sign, last = code.constant("probe_sign", signs), int(until / period) + 2
        code.add(
            f"""
/* Probe, before the loads come */
if (t < (real){until!r}) {{
    const int at = sample_number(t, (real){period!r}, {last}) % {len(signs)};
    for (i = 0; i < {actuators}; i++) {code.output}[i] = {probe}[i] * {sign}[at];
}}""",
            4 + actuators,
        )


def _move_operations(law: AdaptiveGPCLaw) -> int:
    """Operations of the helper `predictive_move`, at most."""
    powers, outputs, actuators = law.powers, law.outputs, np.size(law.probe)
    first, horizon, moves = law.horizons
    n, size = moves * actuators, outputs * actuators
    periods = range(1, horizon + 1)
    terms = [min(powers + 1, j - 1) for j in periods]
    later = [max(powers - j, 0) for j in periods]
    predictions = sum(
        outputs * (3 * (powers + 1) + 2 * actuators * late) + 3 * size * term
        for late, term in zip(later, terms, strict=True)
    )
    normal = sum(
        outputs * (4 + 2 * (i + 1))
        for i in range(n)
        for j in range(first, horizon + 1)
        if j - 1 >= i // actuators
    )
    factor = sum(2 * j + 1 for i in range(n) for j in range(i + 1)) + n * n + n
    return predictions + normal + factor + n * n + n
