"""C code of laws of readings or of time: feedback, tables, internal models."""

import numpy as np

from jaxbeam.c_code.source import CSource, interpolation_operations, search_operations
from jaxbeam.c_code.writers import write_law, write_load_source
from jaxbeam.control.compensators import SampledCompensator
from jaxbeam.control.feedback import Feedback, OutputFeedback, ScheduledFeedbackLaw
from jaxbeam.control.feedforward import (
    CONFIRMATION_SHARE,
    ConfirmedFeedforwardLaw,
    FeedforwardLaw,
    Prescribed,
)
from jaxbeam.control.internal_model import InternalModelLaw, ScheduledInternalModelLaw
from jaxbeam.control.optimal.h_infinity import HInfinityLaw
from jaxbeam.control.predictive.gpc import GPCLaw


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


@write_law.register
def _(law: Prescribed, code: CSource) -> None:
    actuators = code.actuators
    code.missing.append("No reading is used.")
    offsets = code.constant("offsets", law.offsets)
    code.add(f"/* Prescribed commands */\ncopy({code.output}, {offsets}, {actuators});")
    if law.amplitudes is not None and law.frequencies is not None:
        sines = law.frequencies.shape[0]
        phases = np.zeros_like(law.amplitudes) if law.phases is None else law.phases
        amplitudes = code.constant("amplitudes", law.amplitudes)
        rates = code.constant("angular_frequencies", 2 * np.pi * np.asarray(law.frequencies))
        phases = code.constant("phases", phases)
        code.add(
            f"""
for (i = 0; i < {actuators}; i++) {{
    real sum = 0;
    for (j = 0; j < {sines}; j++)
        sum += {amplitudes}[{sines} * i + j] * sin({rates}[j] * t + {phases}[{sines} * i + j]);
    {code.output}[i] += sum;
}}""",
            actuators * (5 * sines + 1),
        )
    if law.times is not None and law.values is not None:
        points = law.times.shape[0]
        times, values = code.constant("times", law.times), code.constant("values", law.values)
        table = f"{times}, {values} + {points} * i, {points}"
        code.add(
            f"for (i = 0; i < {actuators}; i++)\n"
            f"    {code.output}[i] += interpolate_inside(t, {table});",
            actuators * (interpolation_operations(points) + 1),
        )


@write_law.register
def _(law: FeedforwardLaw, code: CSource) -> None:
    code.missing.append("No reading is used.")
    _write_feedforward(law, code)


@write_law.register
def _(law: ConfirmedFeedforwardLaw, code: CSource) -> None:
    never = np.full(len(law.gate_times), -1e30)
    states = code.state("confirmed", never, "second gate's times (s) of loads that a sensor showed")
    shown = " || ".join(
        f"({code.present}[{i}] > 0 && {code.readings}[{i}] <= (real)-{float(law.confirmation)!r})"
        for i in law.sensors
    )
    code.missing.append("It shows no load.")
    limit = CONFIRMATION_SHARE * float(law.length)
    _write_feedforward(
        law,
        code,
        f"""
    if (({shown})
        && {{distance}} + (t - second) * fabs(speed) <= (real){limit!r})
        {states}[j] = second;
    if ({states}[j] < second) continue;""",
        2 * len(law.sensors) + 7,
    )


def _write_feedforward(
    law: FeedforwardLaw, code: CSource, check: str = "", operations: int = 0
) -> None:
    """Commands over the position of each load; `check`, of some operations, may leave one out."""
    actuators, points = np.shape(law.values)
    shares, values = code.constant("shares", law.shares), code.constant("values", law.values)
    near, far = (float(position) for position in law.gates)
    times = code.gates(np.asarray(law.gate_times))
    loads, length = code.gate_loads, float(law.length)
    table = f"{shares}, {values} + {points} * i, {points}"
    distance = f"(speed < 0 ? (real){length - far!r} : (real){far!r})"
    check = check.replace("{distance}", distance)
    code.add(
        f"""
/* Commands over the position of each load, which keeps its speed between the gates */
for (i = 0; i < {actuators}; i++) {code.output}[i] = 0;
for (j = 0; j < {loads}; j++) {{
    const real first = {times}[2 * j], second = {times}[2 * j + 1];
    real speed, share;
    if (t < second) continue;
    speed = (real){far - near!r} / (second - first);{check}
    share = ({distance}
             + (t + (real){float(law.lead)!r} - second) * fabs(speed)) / (real){length!r};
    for (i = 0; i < {actuators}; i++)
        {code.output}[i] += interpolate_inside(share, {table});
}}""",
        loads * (10 + operations + actuators * (interpolation_operations(points) + 1)),
    )


@write_law.register
def _(law: InternalModelLaw, code: CSource) -> None:
    actuators, points = np.shape(law.values)
    readings, values = code.constant("table", law.readings), code.constant("values", law.values)
    lift = code.work("lift", actuators, "deflections due to the commands (m)")
    code.add("/* Deflection due to the commands, as the sensors show it */")
    code.multiply(
        lift, code.constant("static_lift", law.static_lift), code.command, actuators, actuators
    )
    for i, sections in enumerate(law.sensor_filters):
        if sections is not None:
            count = len(sections)
            states = code.state(f"lift_filter_{i}", np.zeros(2 * count), "states of a filter")
            filter = code.constant(f"lift_filter_{i}", sections)
            code.add(
                f"{lift}[{i}] = filter_sample({filter}, {count}, {states}, {lift}[{i}]);",
                9 * count,
            )
    notch = ""
    if law.notch_sections is not None and len(law.notch_sections):
        count = len(law.notch_sections)
        sections = code.constant("notches", law.notch_sections)
        states = code.state("notch", np.zeros(2 * count * actuators), "states of the notches")
        notch = f"\n    y = filter_sample({sections}, {count}, {states} + {2 * count} * i, y);"
        code.operations += 9 * count * actuators
    code.add(
        f"""
/* The rest is due to the load: the table turns it into commands */
for (i = 0; i < {actuators}; i++) {{
    real y = {code.readings}[i] - (real){float(law.compensation)!r} * {lift}[i];{notch}
    {code.output}[i] = interpolate(y, {readings}, {values} + {points} * i, {points});
}}""",
        actuators * (2 + interpolation_operations(points)),
    )


@write_law.register
def _(law: ScheduledInternalModelLaw, code: CSource) -> None:
    sensors, actuators = np.shape(law.static_lift)
    count, points, commands = len(law.reference), len(law.shares), code.command
    if max(law.late):
        held = actuators * (max(law.late) + 1)
        commands = code.state("acting", np.zeros(held), "acting commands, the latest first")
        code.add(
            f"""
/* Readings come late: keep the commands that they show */
for (i = {held - 1}; i >= {actuators}; i--) {commands}[i] = {commands}[i - {actuators}];
for (i = 0; i < {actuators}; i++) {commands}[i] = {code.command}[i];""",
            held,
        )
    lift = code.work("lift", sensors, "deflections due to the commands (m)")
    rows = code.constant("static_lift", law.static_lift)
    late = code.constant("late", np.asarray(law.late) * actuators)
    reference = code.constant("reference", law.reference)
    equalisers = code.constant("equalisers", np.stack(law.equalisers))
    states = code.state("filters", np.zeros(4 * count * sensors), "states of the filters")
    shares, values = code.constant("shares", law.shares), code.constant("values", law.values)
    limits = [
        code.constant(name, numbers)
        for name, numbers in (("full", law.full), ("opposite", law.opposite))
    ]
    own_lift, offsets = (
        code.constant("own_lift", law.own_lift),
        code.constant("offset", law.offsets),
    )
    code.add(
        f"""
/* Lift and readings behind the reference filter: the table turns their difference into commands */
for (i = 0; i < {sensors}; i++) {{
    real *lift_states = {states} + {4 * count} * i, *reading_states = lift_states + {2 * count};
    real y = {code.readings}[i] - {offsets}[i];
    multiply({lift} + i, {rows} + {actuators} * i, {commands} + {late}[i], 1, {actuators});
    {lift}[i] = filter_sample({reference}, {count}, lift_states, {lift}[i]);
    y = filter_sample({equalisers} + {6 * count} * i, {count}, reading_states, y);
    y = interpolate(({lift}[i] - y) / {own_lift}[i], {shares}, {values}, {points});
    {code.output}[i] = y > 0 ? y * {limits[0]}[i] : -y * {limits[1]}[i];
}}""",
        sensors * (2 * actuators + 18 * count + 6 + interpolation_operations(points)),
    )
