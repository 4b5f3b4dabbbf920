"""C code of internal-model control: static lift behind the sensors' filters, notches, table."""

import numpy as np

from jaxbeam.c_code.source import CSource, interpolation_operations
from jaxbeam.c_code.writers import write_law
from jaxbeam.control.internal_model import InternalModelLaw


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
