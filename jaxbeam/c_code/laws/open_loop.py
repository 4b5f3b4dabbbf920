"""C code of laws without feedback: prescribed commands, feedforward by position."""

import numpy as np

from jaxbeam.c_code.source import CSource, interpolation_operations
from jaxbeam.c_code.writers import write_law
from jaxbeam.control.feedforward import (
    CONFIRMATION_SHARE,
    ConfirmedFeedforwardLaw,
    FeedforwardLaw,
)
from jaxbeam.control.prescribed import Prescribed


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
