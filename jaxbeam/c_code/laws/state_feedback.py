"""C code of laws that feed back an estimate of the state: gains, constant or over the crossing."""

from textwrap import indent

import numpy as np

from jaxbeam.c_code.source import CSource, search_operations
from jaxbeam.c_code.tables import at_samples
from jaxbeam.c_code.writers import (
    EstimateCode,
    NoCCodeError,
    write_filter,
    write_law,
    write_load_source,
    write_state_law,
)
from jaxbeam.control.optimal.gain_schedules import GainSchedule
from jaxbeam.control.optimal.position_lqr import PositionGainLaw
from jaxbeam.control.optimal.scheduled_lqr import ScheduledGainLaw
from jaxbeam.control.sliding_mode import SlidingModeLaw
from jaxbeam.control.state_law import GainLaw, SampledStateLaw


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
    if estimate.followed_loads:
        raise NoCCodeError(
            "there is no code for 'lqr-position' at the positions of 'kalman-extended'"
        )
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


def _command_text(code, schedule: GainSchedule, x: str, columns: int, design: str) -> str:
    """Statement that adds the command of one design of a table, times a `weight`."""
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
if (t >= start && t < end)
    add_scheduled_command({code.output}, weight, {breakpoints},
                          {polynomials}, {intervals}, {powers},
                          (t - start) / (end - start), {x}, {code.actuators}, {columns});
else if (t >= end)
    multiply_add({code.output}, -weight * decay, {final_gain}, {x}, {code.actuators}, {columns});
""".strip()


def _command_operations(code: CSource, schedule: GainSchedule, columns: int) -> int:
    """Operations of the command of one design."""
    intervals, powers = schedule.table.coefficients.shape[-4:-2]
    entries = code.actuators * columns
    return 14 + search_operations(intervals + 1) + entries * (2 * powers + 1) + 2 * code.actuators


def _decay(schedule: GainSchedule) -> str:
    """Factor of the final gain."""
    if schedule.fade_time is None:
        return "1"
    fade = float(np.ravel(schedule.fade_time)[0])
    return f"t > end ? exp((end - t) / (real){fade!r}) : 1"


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
    times = code.state("crossing", [law.start, law.end], "s, start and end; settable")
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
