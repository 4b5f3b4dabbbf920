"""C code of laws that feed back readings: power laws, matrices of gains, compensators."""

import numpy as np

from jaxbeam.c_code.source import CSource, interpolation_operations, search_operations
from jaxbeam.c_code.writers import write_law, write_load_source
from jaxbeam.control.compensators import SampledCompensator
from jaxbeam.control.feedback import Feedback
from jaxbeam.control.optimal.h_infinity import HInfinityLaw
from jaxbeam.control.output_feedback import OutputFeedback
from jaxbeam.control.predictive.gpc import GPCLaw
from jaxbeam.control.scheduled_feedback import ScheduledFeedbackLaw


@write_law.register
def _(law: Feedback, code: CSource) -> None:
    rows = [law.gains, *([] if law.higher_gains is None else law.higher_gains)]
    actuators, terms = code.actuators, len(rows)
    gains = code.constant("gains", np.stack(rows))
    code.add(
        f"""
/* u = -(g_1 + g_2 y^2 + ...) y |y|^(p - 1) for the own sensor of each actuator */
for (i = 0; i < {actuators}; i++) {{
    const real y = {code.readings}[i];
    real gain = {gains}[{(terms - 1) * actuators} + i];
    for (j = {terms - 2}; j >= 0; j--) gain = {gains}[j * {actuators} + i] + gain * y * y;
    {code.output}[i] = -gain * power_law(y, {law.power});
}}""",
        actuators * (3 * (terms - 1) + law.power + 2),
    )


@write_law.register
def _(law: OutputFeedback, code: CSource) -> None:
    gains = code.constant("gains", law.gains)
    code.add("/* u = K y */")
    code.multiply(code.output, gains, code.readings, *np.shape(law.gains))


@write_law.register
def _(law: SampledCompensator, code: CSource) -> None:
    loops = law.sections.shape[-1]
    sections = code.constant("compensators", np.moveaxis(np.asarray(law.sections), -1, 0))
    states = code.state("compensator", np.zeros(2 * loops), "states of the compensators")
    code.add(
        f"""
/* Each actuator's own sensor through its compensator */
for (i = 0; i < {loops}; i++)
    {code.output}[i] =
        filter_sample({sections} + 6 * i, 1, {states} + 2 * i, {code.readings}[i]);""",
        9 * loops,
    )


@write_law.register
def _(law: GPCLaw, code: CSource) -> None:
    past, actuators, outputs = np.shape(law.reading_gains)
    powers = np.shape(law.command_gains)[0]
    code.add("/* u = r - H (past readings) - K (past commands), the latest ones first */")
    reference = code.constant("reference_command", law.reference_command)
    parts = (
        ("readings", law.reading_gains, code.readings, past, outputs),
        ("commands", law.command_gains, code.command, powers, actuators),
    )
    code.add(f"copy({code.output}, {reference}, {actuators});")
    for name, gains, latest, count, width in parts:
        size = count * width
        kept = code.state(f"past_{name}", np.zeros(size), f"last {name}, the latest first")
        gain = code.constant(f"{name}_gain", np.moveaxis(np.asarray(gains), 0, 1))
        code.add(
            f"for (i = {size - 1}; i >= {width}; i--) {kept}[i] = {kept}[i - {width}];\n"
            f"copy({kept}, {latest}, {width});"
        )
        code.multiply_add(code.output, gain, kept, actuators, size, -1)


@write_law.register
def _(law: HInfinityLaw, code: CSource) -> None:
    states, outputs = np.shape(law.G)
    actuators = code.actuators
    F = code.constant("state_matrix", law.F)
    G = code.constant("reading_matrix", law.G)
    B = code.constant("command_matrix", law.B)
    K = code.constant("state_gain", law.K)
    D = code.constant("reading_gain", law.D)
    state = code.state("predicted", np.zeros(states), "state, but for the last command")
    predicted = code.work("known", states, "state with the last command")
    code.add("/* u = K x + D y of the state x with the last command; then F x + G y */")
    code.add(f"copy({predicted}, {state}, {states});")
    code.multiply_add(predicted, B, code.command, states, actuators)
    code.multiply(code.output, K, predicted, actuators, states)
    code.multiply_add(code.output, D, code.readings, actuators, outputs)
    code.multiply(state, F, predicted, states, states)
    code.multiply_add(state, G, code.readings, states, outputs)


@write_law.register
def _(law: ScheduledFeedbackLaw, code: CSource) -> None:
    load = write_load_source(law.load_source, code)
    actuators, count = np.shape(law.gains)
    masses, gains = code.constant("masses", law.masses), code.constant("gains", law.gains)
    table = f"{gains} + {count} * i"
    gain = f"interpolate(mass, {masses}, {table}, {count})"
    operations = interpolation_operations(count)
    if not law.interpolated:
        gain = f"({table})[interval({masses}, {count}, mass)]"
        operations = search_operations(count)
    code.add(
        f"""
/* u = -k(m) y |y|^(p - 1), the lightest mass until the mass is identified */
{{
    const real mass = {load.mass_identified} ? {load.mass} : {masses}[0];
    for (i = 0; i < {actuators}; i++)
        {code.output}[i] = -{gain} * power_law({code.readings}[i], {law.power});
}}""",
        actuators * (operations + law.power + 2),
    )
