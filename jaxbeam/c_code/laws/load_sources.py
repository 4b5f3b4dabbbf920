"""C code of mass, speed and entry time of the load: given, or identified from deflections."""

import numpy as np

from jaxbeam.c_code.source import CSource
from jaxbeam.c_code.writers import LoadCode, write_load_source
from jaxbeam.control.load_identifiers import (
    INFLUENCE_ROUNDING,
    MIN_EFFECTIVE_SAMPLES,
    MIN_TRAVEL_SPREAD,
    AbstractLoadIdentifier,
    DeflectionIdentifier,
    GateIdentifier,
    GivenLoad,
)


@write_load_source.register
def _(source: GivenLoad, code: CSource) -> LoadCode:
    numbers = np.nan_to_num([source.mass, source.speed, source.entry_time])  # NaN: not used
    meaning = "mass (kg), speed (m/s), entry (s) of the load; settable"
    load = code.state("load", numbers, meaning, restarts=False)
    return LoadCode(f"{load}[0]", f"{load}[1]", f"{load}[2]", "1", "1")


def _deflections(source: AbstractLoadIdentifier, code: CSource) -> str:
    """Deflections due to the load alone: readings less offset and static lift."""
    sensors, actuators = np.shape(source.static_lift)
    deflection = code.work("deflection", sensors, "deflections due to the load (m)")
    code.missing.append("Samples at which a deflection is missing do not identify the load.")
    offset = code.constant("reading_offset", source.offset)
    indices = code.constant("deflection_sensor", np.array(source.sensor_indices))
    lift = code.constant("static_lift", source.static_lift)
    code.add(
        "/* Identification of the load from its deflections */\n"
        f"for (i = 0; i < {sensors}; i++)\n"
        f"    {deflection}[i] = {code.readings}[{indices}[i]] - {offset}[i];",
        sensors,
    )
    code.multiply_add(deflection, lift, code.command, sensors, actuators, -1)
    code.variables += [each for each in ("int complete",) if each not in code.variables]
    code.add(
        f"complete = 1;\nfor (i = 0; i < {sensors}; i++)\n"
        f"    if (!({code.present}[{indices}[i]] > 0)) complete = 0;",
        sensors,
    )
    return deflection


@write_load_source.register
def _(source: GateIdentifier, code: CSource) -> LoadCode:
    deflection = _deflections(source, code)
    sensors, positions = np.shape(source.influence_lines)
    times = code.gates(np.asarray(source.gate_times)[None])
    sums = code.state("sums", np.zeros(2), "sums of a y and of a a over the samples")
    load = code.work("load", 5, "mass, speed, entry time; whether speed and mass are identified")
    lines = code.constant("influence_lines", source.influence_lines)
    near, far = (float(position) for position in source.gates)
    length, gravity = (f"(real){float(x)!r}" for x in (source.length, source.gravity))
    code.first_gate_lines = [f"{sums}[0] = {sums}[1] = 0;"]
    code.add(
        f"""
{load}[3] = t >= {times}[1];
{load}[4] = 0;
if (t >= {times}[1]) {{
    const real speed = (real){far - near!r} / ({times}[1] - {times}[0]);
    const real entry = {times}[1] + ((speed < 0 ? {length} : 0) - (real){far!r}) / speed;
    const real share = (t - entry) * fabs(speed) / {length};
    if (share >= (real){float(source.until)!r}) {load}[4] = 1;
    else if (share > 0 && complete) {{
        const real place = (speed < 0 ? 1 - share : share) * {positions - 1};
        const int left = place < {positions - 2} ? (int)place : {positions - 2};
        for (i = 0; i < {sensors}; i++) {{
            const real *line = {lines} + {positions} * i + left;
            const real influence = line[0] + (place - left) * (line[1] - line[0]);
            {sums}[0] += influence * {deflection}[i];
            {sums}[1] += influence * influence;
        }}
    }}
    {load}[1] = speed;
    {load}[2] = entry;
}}
{load}[0] = ({sums}[1] > 0 ? {sums}[0] / {sums}[1] : 0) / {gravity};""",
        26 + 8 * sensors,
    )
    return LoadCode(f"{load}[0]", f"{load}[1]", f"{load}[2]", f"{load}[3] > 0", f"{load}[4] > 0")


@write_load_source.register
def _(source: DeflectionIdentifier, code: CSource) -> LoadCode:
    deflection = _deflections(source, code)
    sensors, positions = np.shape(source.influence_lines)
    lines = np.asarray(source.influence_lines)
    squares = np.sum(lines**2, axis=0)
    observable = squares > INFLUENCE_ROUNDING * np.max(squares)
    by_position = code.constant("influence_lines", lines.T)
    squares = code.constant("squared_influence", np.where(observable, squares, 0.0))
    sums = code.state("sums", np.zeros(8), "sums of w, w t, w t t, w x, w t x, a y, a a; largest w")
    load = code.work("load", 5, "mass, speed, entry time; whether speed and mass are identified")
    fit = code.work("explained", positions, "deflection that a load at each position explains")
    length, gravity = (f"(real){float(x)!r}" for x in (source.length, source.gravity))
    travel = float(MIN_TRAVEL_SPREAD * source.until * source.length)
    until, settings = float(source.until * source.length), f"{length}, (real){travel!r}"
    settings += f", {MIN_EFFECTIVE_SAMPLES}, (real){until!r}, {gravity}"
    arguments = f"{by_position}, {squares}, {sensors}, {positions}, {deflection}, {fit}"
    code.add(
        f"""
load_from_sums({load}, {sums}, t, {settings});
if (complete && {load}[4] <= 0) {{
    add_deflections({sums}, {arguments}, t, {length}, (real){float(source.threshold)!r});
    load_from_sums({load}, {sums}, t, {settings});
}}""",
        2 * 40 + 50 + 4 * sensors + positions * (2 * sensors + 5),
    )
    return LoadCode(f"{load}[0]", f"{load}[1]", f"{load}[2]", f"{load}[3] > 0", f"{load}[4] > 0")
