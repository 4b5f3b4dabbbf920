"""C code of internal-model control, with its own filters or those of the plant: lift, table."""

import numpy as np

from jaxbeam.c_code.source import CSource, interpolation_operations
from jaxbeam.c_code.writers import write_law
from jaxbeam.control.internal_model.scheduled import ScheduledInternalModelLaw
from jaxbeam.control.internal_model.table import InternalModelLaw


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
