"""C code of generalised predictive control of a plant that is identified while it runs."""

import numpy as np

from jaxbeam.c_code.source import CSource
from jaxbeam.c_code.writers import write_law
from jaxbeam.control.predictive.adaptive_gpc import AdaptiveGPCLaw, probe_signs


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
