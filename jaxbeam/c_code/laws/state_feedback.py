"""C code of laws that feed back an estimate of the state: gains, constant or over the crossing."""

from textwrap import indent

import numpy as np

from jaxbeam.c_code.source import CSource, search_operations
from jaxbeam.c_code.texts import at_samples
from jaxbeam.c_code.writers import (
    EstimateCode,
    write_filter,
    write_law,
    write_load_source,
    write_state_law,
)
from jaxbeam.control.optimal.crossing_gains import GainSchedule
from jaxbeam.control.optimal.load_tables import PositionGainLaw, ScheduledGainLaw
from jaxbeam.control.sliding_mode import SlidingModeLaw
from jaxbeam.control.state_controller import GainLaw, SampledStateLaw


@write_law.register
def _(law: SampledStateLaw, code: CSource) -> None:
    write_state_law(law.law, code, write_filter(law.filter, code))


@write_state_law.register
def _(law: GainLaw, code: CSource, estimate: EstimateCode) -> None:
    gain = np.asarray(law.gain)
    actuators, states = gain.shape[0], estimate.states
    code.add(f"/* u = -K x */\nfor (i = 0; i < {actuators}; i++) {code.output}[i] = 0;")
    matrix = code.constant("gain", gain[:, :states])
    code.multiply_add(code.output, matrix, estimate.state, actuators, states, -1)
    if law.feeds_back_command:
        matrix = code.constant("command_gain", gain[:, states:])
        code.multiply_add(code.output, matrix, code.command, actuators, actuators, -1)


@write_state_law.register
def _(law: SlidingModeLaw, code: CSource, estimate: EstimateCode) -> None:
    outputs, states = np.shape(law.surface)
    s = code.work("surface", outputs, "distance from each surface, in layers")
    code.add("/* u = -(equivalent control) - gain sat(s) */")
    code.multiply(s, code.constant("surface", law.surface), estimate.state, outputs, states)
    code.add(
        f"for (i = 0; i < {outputs}; i++) {s}[i] = clamp({s}[i], -1, 1);\n"
        f"for (i = 0; i < {code.actuators}; i++) {code.output}[i] = 0;",
        2 * outputs,
    )
    gain = code.constant("equivalent_gain", law.equivalent_gain)
    code.multiply_add(code.output, gain, estimate.state, code.actuators, states, -1)
    gain = code.constant("reaching_gain", law.reaching_gain)
    code.multiply_add(code.output, gain, s, code.actuators, outputs, -1)


@write_state_law.register
def _(law: PositionGainLaw, code: CSource, estimate: EstimateCode) -> None:
    if estimate.loads is not None:
        _write_followed(law, code, estimate)
        return
    known = at_samples(lambda t: law.combined(law.loads_at(t)), code)
    gains, forward = (np.asarray(part) for part in known)
    code.add("/* u = f - K x, with K and f along the known ways of the loads */")
    code.add(f"copy({code.output}, {code.per_sample('forward', forward)}, {code.actuators});")
    gain = code.per_sample("gain", gains)
    code.multiply_add(code.output, gain, estimate.state, code.actuators, gains.shape[2], -1)


def _fed_back(code: CSource, schedule: GainSchedule, estimate: EstimateCode, weights: int) -> str:
    """What a schedule feeds back: states, those of vehicles, weights, which are left to be set."""
    vehicles = schedule.vehicle_states
    x = code.work("fed_back", estimate.states + vehicles + weights, "states and weights fed back")
    code.add(f"copy({x}, {estimate.state}, {estimate.states});")
    if vehicles:
        code.add(f"copy({x} + {estimate.states}, {estimate.vehicles}, {vehicles});")
    return x


def _command_text(
    code, schedule: GainSchedule, x: str, columns: int, design: str, time: str = "t"
) -> str:
    """Statement that adds the command of one design of a table at a time, times a `weight`."""
    intervals, powers = schedule.table.coefficients.shape[-4:-2]
    size = code.actuators * columns
    breakpoints = code.constant("breakpoints", schedule.table.breakpoints)
    polynomials = code.constant("polynomials", schedule.table.coefficients)
    final_gain = code.constant("final_gain", schedule.final_gain)
    if design:
        breakpoints += f" + {intervals + 1} * {design}"
        polynomials += f" + {intervals * powers * size} * {design}"
        final_gain += f" + {size} * {design}"
    return f"""
if ({time} >= start && {time} < end)
    add_scheduled_command({code.output}, weight, {breakpoints},
                          {polynomials}, {intervals}, {powers},
                          ({time} - start) / (end - start), {x}, {code.actuators}, {columns});
else if ({time} >= end)
    multiply_add({code.output}, -weight * decay, {final_gain}, {x}, {code.actuators}, {columns});
""".strip()


def _command_operations(code: CSource, schedule: GainSchedule, columns: int) -> int:
    """Operations of the command of one design."""
    intervals, powers = schedule.table.coefficients.shape[-4:-2]
    entries = code.actuators * columns
    return 14 + search_operations(intervals + 1) + entries * (2 * powers + 1) + 2 * code.actuators


def _decay(schedule: GainSchedule, time: str = "t") -> str:
    """Factor of the final gain at a time."""
    if schedule.fade_time is None:
        return "1"
    fade = float(np.ravel(schedule.fade_time)[0])
    return f"{time} > end ? exp((end - {time}) / (real){fade!r}) : 1"


@write_state_law.register
def _(law: GainSchedule, code: CSource, estimate: EstimateCode) -> None:
    known = np.asarray(law.load_weights)
    weights = len(known)
    columns = np.shape(law.final_gain)[1]
    x = _fed_back(code, law, estimate, weights)
    place = f"{x} + {columns - weights}"
    if weights:
        code.add(f"copy({place}, {code.constant('load_weights', known)}, {weights});")
    if law.load_feedforward and estimate.weights is not None:
        code.add(f"copy({place}, {estimate.weights}, {estimate.wheels});")
    numbers, meaning = [law.start, law.end], "s, start and end; settable"
    times = code.state("crossing", numbers, meaning, restarts=False)
    code.add(
        f"""
/* u = -K(t) x, from the first entry to the last exit by the table */
for (i = 0; i < {code.actuators}; i++) {code.output}[i] = 0;
{{
    const real start = {times}[0], end = {times}[1], weight = 1;
    const real decay = {_decay(law)};
{indent(_command_text(code, law, x, columns, ""), "    ")}
}}""",
        _command_operations(code, law, columns) + 5,
    )


@write_state_law.register
def _(law: ScheduledGainLaw, code: CSource, estimate: EstimateCode) -> None:
    load = write_load_source(law.load_source, code)
    schedules, masses, speeds = law.schedules, len(law.masses), len(law.speeds)
    lightest = np.asarray(schedules.load_weights)[0, 0]
    columns, weights = np.shape(schedules.final_gain)[-1], len(lightest)
    x = _fed_back(code, schedules, estimate, weights)
    grids = code.constant("masses", law.masses), code.constant("speeds", law.speeds)
    nearest = int(law.nearest)
    mass_ends = f"(real){float(law.masses[0])!r}, (real){float(law.masses[-1])!r}"
    weight_line = ""
    if weights:
        place, known = f"{x} + {columns - weights}", code.constant("load_weights", lightest)
        code.add(f"copy({place}, {known}, {weights});")
        own = f"for (i = 0; i < {law.weight_count}; i++)\n        ({place})[i]"
        weight_line = f"\n    {own} *= clamp(mass, {mass_ends}) / {grids[0]}[0];"
        if schedules.load_feedforward and estimate.weights is not None:
            weight_line = f"\n    copy({place}, {estimate.weights}, {estimate.wheels});"
    command = _command_text(code, schedules, x, columns, "design")
    code.add(
        f"""
/* u = -K(mass, speed, share) x, interpolated between the designs of a grid */
for (i = 0; i < {code.actuators}; i++) {code.output}[i] = 0;
if ({load.speed_identified}) {{
    const real mass = {load.mass_identified} ? {load.mass} : {grids[0]}[0];
    const real speed = fabs({load.speed}), start = {load.entry_time};
    const real end = start + (real){float(law.length)!r} / speed;
    const real decay = {_decay(schedules)};
    int mass_index[2], speed_index[2];
    real mass_weight[2], speed_weight[2];
    grid_weights({grids[0]}, {masses}, mass, {nearest}, mass_index, mass_weight);
    grid_weights({grids[1]}, {speeds}, speed, {nearest}, speed_index, speed_weight);{weight_line}
    for (i = 0; i < 4; i++) {{
        const real weight = mass_weight[i / 2] * speed_weight[i % 2];
        const int design = {speeds} * mass_index[i / 2] + speed_index[i % 2];
        if (!(weight > 0)) continue;
{indent(command, "        ")}
    }}
}}""",
        30
        + 6 * (masses + speeds)
        + 4 * weights
        + 4 * (_command_operations(code, schedules, columns) + 2),
    )


def _write_followed(law: PositionGainLaw, code: CSource, estimate: EstimateCode) -> None:
    """Command of the tables that followed loads read at their positions."""
    schedules, path = law.schedules, law.load_set.trajectories[0]
    masses, speeds, loads = len(law.masses), len(law.speeds), np.size(law.load_masses)
    columns, states = np.shape(schedules.final_gain)[-1], estimate.states
    grids = code.constant("masses", law.masses), code.constant("speeds", law.speeds)
    per_mass = np.asarray(law.load_weights) / np.asarray(law.load_masses)
    gravity = code.constant("weight_of_mass", per_mass)
    x = code.work("fed_back", columns, "share of the state, and weight, that a load feeds back")
    clock = code.work("clock", loads, "share travelled, then 1 + s since the exit; -1 before")
    share = code.work("load_share", loads, "share of each load in the gain of the state")
    length, backward = float(path.length), bool(np.asarray(path.direction()) < 0)
    travelled = f"1 - {estimate.loads}[l] / (real){length!r}" if backward else ""
    travelled = travelled or f"{estimate.loads}[l] / (real){length!r}"
    weight = f"on_beam ? {gravity}[l] * mass : 0" if schedules.load_feedforward else "0"
    command = _command_text(code, schedules, x, columns, "design", "at")
    code.add(
        f"""
/* u = f - K x: the gains that the loads read at their positions, with their masses as weights */
for (i = 0; i < {code.actuators}; i++) {code.output}[i] = 0;
{{
    real total = 0;
    int l, any = 0;
    for (l = 0; l < {loads}; l++) {{
        const real along = {travelled}, speed = fabs({estimate.loads}[{loads} + l]);
        const real after = along > 1 && speed > 0 ? (along - 1) * (real){length!r} / speed : 0;
        {clock}[l] = along < 0 ? -1 : (along < 1 ? along : 1) + after;
        if (along >= 0 && along < 1) any = 1;
    }}
    for (l = 0; l < {loads}; l++) {{
        const int counts = any ? {clock}[l] >= 0 && {clock}[l] < 1 : {clock}[l] >= 1;
        {share}[l] = counts ? {estimate.loads}[{2 * loads} + l] : 0;
        total += {share}[l];
    }}
    for (l = 0; l < {loads}; l++) {{
        const real at = {clock}[l], start = 0, end = 1, decay = {_decay(schedules, "at")};
        const real speed = fabs({estimate.loads}[{loads} + l]);
        const real mass = {estimate.loads}[{2 * loads} + l];
        const int on_beam = at >= 0 && at < 1;
        int mass_index[2], speed_index[2];
        real mass_weight[2], speed_weight[2];
        for (i = 0; i < {states}; i++)
            {x}[i] = {share}[l] / (total > 0 ? total : 1) * {estimate.state}[i];
        for (i = {states}; i < {columns}; i++) {x}[i] = 0;
        if ({int(columns > states)}) {x}[{min(states, columns - 1)}] = {weight};
        grid_weights({grids[0]}, {masses}, mass, 0, mass_index, mass_weight);
        grid_weights({grids[1]}, {speeds}, speed, 0, speed_index, speed_weight);
        for (i = 0; i < 4; i++) {{
            const real weight = mass_weight[i / 2] * speed_weight[i % 2];
            const int design = {speeds} * mass_index[i / 2] + speed_index[i % 2];
            if (!(weight > 0)) continue;
{indent(command, "            ")}
        }}
    }}
}}""",
        loads
        * (
            40
            + 3 * states
            + 6 * (masses + speeds)
            + 4 * (_command_operations(code, schedules, columns) + 2)
        ),
    )
