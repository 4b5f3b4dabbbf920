"""C code of laws that follow loads, given or identified."""

import math

import numpy as np
from numpy.polynomial import chebyshev

from jaxbeam.c_code.source import CSource
from jaxbeam.c_code.writers import (
    EstimateCode,
    LoadCode,
    NoCCodeError,
    write_filter,
    write_load_source,
)
from jaxbeam.control.load_identification import (
    INFLUENCE_ROUNDING,
    MIN_EFFECTIVE_SAMPLES,
    MIN_TRAVEL_SPREAD,
    AbstractLoadIdentifier,
    DeflectionIdentifier,
    GateIdentifier,
    GivenLoad,
)
from jaxbeam.estimation.crossing_filter import NUMBERS, LoadFollowingFilter
from jaxbeam.estimation.extended_kalman import DIFFERENCE_STEP
from jaxbeam.estimation.observer import sensor_offsets
from jaxbeam.numerics.discretisation import DOUBLINGS, SERIES_TERMS


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


NODE = math.sqrt(3) / 6  # of a span, from its middle to a Gauss node


@write_filter.register
def _(filter: LoadFollowingFilter, code: CSource) -> EstimateCode:
    chain, plant = filter.sensor_chain, filter.filtered.plant
    if any(part is not None for part in (*chain.filter_sections, *chain.delays)):
        raise NoCCodeError(
            "there is no code for 'kalman-extended' with delays or digital filters of sensors"
        )
    modes, size = plant.modal_model.mode_count, np.size(filter.initial)
    loads, sensors, commands = np.size(filter.inertia_share), code.sensors, code.actuators
    numbers, first, joint = NUMBERS * loads, size - NUMBERS * loads, size + code.actuators
    variants = 1 + 2 * numbers
    x = code.state(
        "estimate", filter.initial, "states of the beam; loads: positions, speeds, masses"
    )
    P = code.state("covariance", filter.initial_covariance, "covariance of the estimate")
    last = code.state("filter_last", np.zeros(commands), "commands before")
    names = {
        "moved": numbers,
        "place": loads,
        "A": size * size,
        "B": size * commands,
        "system_work": loads * (4 * modes + loads + commands + size),
        "early": joint * joint,
        "late": joint * joint,
        "E": joint * joint,
        "G": joint * joint,
        "step_work": 4 * joint * joint,
        "predicted": variants * size,
        "next": size,
        "matrix": size * size,
        "noise": size * size,
        "product": size * size,
        "part": size * size,
        "rows": sensors * size,
        "values": variants * sensors,
        "innovation": sensors,
        "correction_work": sensors * (2 * size + sensors) + size * (3 * size + sensors),
    }
    gravity = float(plant.case.run.gravity)
    w = {name: code.work(f"filter_{name}", count) for name, count in names.items()}
    c = _constants(filter, code)
    system = (
        f"loaded_system({w['A']}, {w['B']}, {c['A']}, {c['B']}, {w['place']},\n"
        f"    {w['moved']} + {loads}, {w['moved']} + {2 * loads}, {c['share']}, {c['nodes']},"
        f" {c['series']},\n    {c['coordinate']}, {c['rate']}, {c['scale']}, (real){gravity!r},"
        f" {size}, {commands}, {modes}, {loads}, {c['segments']}, {c['degrees']},\n"
        f"    {w['system_work']});"
    )
    spans, starts, previous = _parts(chain.timing)
    span, start = code.constant("part_span", spans), code.constant("part_start", starts)
    acts = code.constant("previous_acts", previous)
    vary = f"""copy({w["moved"]}, {x} + {first}, {numbers});
    if (v > 0 && v <= {numbers}) {w["moved"]}[v - 1] += {c["steps"]}[v - 1];
    if (v > {numbers}) {w["moved"]}[v - 1 - {numbers}] -= {c["steps"]}[v - 1 - {numbers}];"""
    code.add(
        f"""
/* Prediction under loads as estimated, and with each of their numbers larger, then smaller */
{{
int v, k, l, node, part;
for (v = 0; v < {variants}; v++) {{
    real *own = {w["predicted"]} + v * {size};
    {vary}
    copy(own, {x}, {size});
    for (part = 0; part < {len(spans)}; part++) {{
        const real *acting = {acts}[part] ? {last} : {code.command};
        for (node = 0; node < 2; node++) {{
            real *M = node ? {w["late"]} : {w["early"]};
            const real elapsed =
                {start}[part] + {span}[part] * (node ? (real){0.5 + NODE!r} : (real){0.5 - NODE!r});
            for (l = 0; l < {loads}; l++)
                {w["place"]}[l] = {w["moved"]}[l] + {w["moved"]}[{loads} + l] * elapsed;
            {system}
            for (i = 0; i < {size}; i++) {{
                for (k = 0; k < {size}; k++)
                    M[i * {joint} + k] = {w["A"]}[i * {size} + k] * {c["size"]}[k] / {c["size"]}[i];
                for (k = 0; k < {commands}; k++)
                    M[i * {joint} + {size} + k] = {w["B"]}[i * {commands} + k] / {c["size"]}[i];
            }}
        }}
        magnus_step({w["E"]}, {w["G"]}, {w["early"]}, {w["late"]}, {c["intensity"]}, {span}[part],
                    v == 0, {joint}, {SERIES_TERMS}, {DOUBLINGS}, {w["step_work"]});
        for (i = 0; i < {size}; i++) {{
            {w["next"]}[i] = 0;
            for (k = 0; k < {size}; k++) {{
                {w["part"]}[i * {size} + k] =
                    {w["E"]}[i * {joint} + k] * {c["size"]}[i] / {c["size"]}[k];
                {w["next"]}[i] += {w["part"]}[i * {size} + k] * own[k];
            }}
            for (k = 0; k < {commands}; k++)
                {w["next"]}[i] += {w["E"]}[i * {joint} + {size} + k] * {c["size"]}[i] * acting[k];
        }}
        copy(own, {w["next"]}, {size});
        if (v > 0) continue;
        if (part == 0) {{
            copy({w["matrix"]}, {w["part"]}, {size * size});
            for (i = 0; i < {size * size}; i++) {w["noise"]}[i] = 0;
        }} else {{
            matrix_product({w["product"]}, {w["part"]}, {w["matrix"]}, {size}, {size}, {size});
            copy({w["matrix"]}, {w["product"]}, {size * size});
            matrix_product({w["product"]}, {w["part"]}, {w["noise"]}, {size}, {size}, {size});
            product_with_transposed({w["noise"]}, {w["product"]}, {w["part"]}, {size});
        }}
        for (i = 0; i < {size}; i++)
            for (k = 0; k < {size}; k++)
                {w["noise"]}[i * {size} + k] +=
                    {w["G"]}[i * {joint} + k] * {c["size"]}[i] * {c["size"]}[k];
    }}
}}
for (k = 0; k < {numbers}; k++)
    for (i = 0; i < {size}; i++)
        {w["matrix"]}[i * {size} + {first} + k] +=
            ({w["predicted"]}[(1 + k) * {size} + i]
             - {w["predicted"]}[({1 + numbers} + k) * {size} + i])
            / (2 * {c["steps"]}[k]);
matrix_product({w["product"]}, {w["matrix"]}, {P}, {size}, {size}, {size});
product_with_transposed({P}, {w["product"]}, {w["matrix"]}, {size});
for (i = 0; i < {size}; i++)
    for (k = 0; k <= i; k++)
        {P}[i * {size} + k] = {P}[k * {size} + i] =
            ({P}[i * {size} + k] + {w["noise"]}[i * {size} + k] + {P}[k * {size} + i] +
             {w["noise"]}[k * {size} + i]) / 2;
copy({x}, {w["predicted"]}, {size});
/* Readings, linearised about the predicted loads */
for (v = 0; v < {variants}; v++) {{
    {vary}
    copy({w["place"]}, {w["moved"]}, {loads});
    {system}
    for (i = 0; i < {sensors}; i++) {{
        real value = 0;
        for (k = 0; k < {size}; k++) {{
            real entry = {c["C"]}[i * {size} + k];
            for (l = 0; l < {modes}; l++)
                entry += {c["acceleration"]}[i * {modes} + l]
                         * {w["A"]}[{c["rate"]}[l] * {size} + k];
            if (v == 0) {w["rows"]}[i * {size} + k] = entry;
            value += entry * {x}[k];
        }}
        for (k = 0; k < {commands}; k++) {{
            real entry = {c["D"]}[i * {commands} + k];
            for (l = 0; l < {modes}; l++)
                entry += {c["acceleration"]}[i * {modes} + l]
                         * {w["B"]}[{c["rate"]}[l] * {commands} + k];
            value += entry * {code.command}[k];
        }}
        {w["values"]}[v * {sensors} + i] = value;
    }}
}}
for (i = 0; i < {sensors}; i++) {{
    for (k = 0; k < {numbers}; k++)
        {w["rows"]}[i * {size} + {first} + k] +=
            ({w["values"]}[(1 + k) * {sensors} + i]
             - {w["values"]}[({1 + numbers} + k) * {sensors} + i])
            / (2 * {c["steps"]}[k]);
    {w["innovation"]}[i] = {code.readings}[i] - {c["offset"]}[i] - {w["values"]}[i];
    if ({code.present}[i] > 0) continue;
    {w["innovation"]}[i] = 0;
    for (k = 0; k < {size}; k++) {w["rows"]}[i * {size} + k] = 0;
}}
kalman_correction({x}, {P}, {w["rows"]}, {c["variance"]}, {w["innovation"]}, {sensors}, {size},
                  {w["correction_work"]});
copy({last}, {code.command}, {commands});
}}""",
        _operations(size, joint, modes, loads, commands, sensors, len(spans), c),
    )
    code.missing.append("The estimate is predicted by the model, and not corrected by it.")
    weights = code.work("weights", loads, "estimated weights, zero off the beam (N)")
    length = float(plant.case.beam.length)
    code.add(
        f"for (i = 0; i < {loads}; i++)\n"
        f"    {weights}[i] = {x}[{first} + i] >= 0 && {x}[{first} + i] <= (real){length!r}\n"
        f"        ? (real){gravity!r} * {x}[{first + 2 * loads} + i] : 0;",
        3 * loads,
    )
    return EstimateCode(x, filter.plant_states, weights, loads, None, f"({x} + {first})")


def _parts(timing) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lengths and starts (s) of the parts of a period, and where the last command still acts."""
    period, delay = float(timing.period), timing.input_delay
    if delay is None:
        return np.array([period]), np.zeros(1), np.array([0])
    ends = np.sort([float(delay), period])
    starts = np.array([0.0, ends[0]])
    return ends - starts, starts, (ends <= float(delay)).astype(int)


def _constants(filter: LoadFollowingFilter, code: CSource) -> dict:
    """C expressions of the constants of the plant without loads, and of its mode shapes."""
    plant, model = filter.filtered.plant, filter.filtered.plant.modal_model
    modes, size, commands = model.mode_count, np.size(filter.initial), code.actuators
    loads = np.size(filter.inertia_share)
    unloaded = plant.with_contact(None, filter.output_rows)
    unloaded = filter.filtered.with_filtered_outputs(unloaded)
    states = np.shape(unloaded.A)[0]
    A = np.zeros((size, size))
    A[:states, :states] = unloaded.A
    A[states : states + loads, states + loads : states + 2 * loads] = np.eye(loads)
    B = np.zeros((size, commands))
    B[:states] = unloaded.B[:, :commands]
    scale = np.asarray(plant.coordinate_scale, float)
    filters = [sensor.filter for sensor in plant.case.sensors]
    analogue = np.array([f is not None and f.realisation == "analogue" for f in filters])
    accelerometers = np.asarray(filter.output_rows.has_feedthrough) & ~analogue
    acceleration = np.where(accelerometers[:, None], filter.output_rows.rows, 0.0) / scale
    C = np.zeros((code.sensors, size))
    C[:, :states] = np.where(accelerometers[:, None], 0.0, unloaded.C)
    D = np.where(accelerometers[:, None], 0.0, unloaded.D[:, :commands])
    nodes, series = np.asarray(model.modes.nodes), np.asarray(model.modes.series)
    if model.mode_map is not None:
        series = series @ np.asarray(model.mode_map)
    segments, degrees, _ = series.shape
    half = np.diff(nodes)[:, None, None] / 2
    tables = np.zeros((3, segments, degrees, modes))
    for order in range(3):
        derivative = chebyshev.chebder(np.moveaxis(series, 1, 0), order)
        tables[order, :, : len(derivative)] = np.moveaxis(derivative, 0, 1)
        tables[order] /= half**order
    size_of_states = np.asarray(filter.scale, float)
    intensity = np.zeros((size + commands,) * 2)
    intensity[:size, :size] = filter.noise_intensity / (size_of_states * size_of_states[:, None])
    values = {
        "A": A,
        "B": B,
        "C": C,
        "D": D,
        "acceleration": acceleration,
        "share": filter.inertia_share,
        "nodes": nodes,
        "series": tables,
        "coordinate": np.arange(modes),
        "rate": modes + np.arange(modes),
        "scale": scale,
        "size": size_of_states,
        "intensity": intensity,
        "steps": filter.steps,
        "offset": sensor_offsets(plant),
        "variance": np.diagonal(filter.sensor_chain.noise_covariance),
    }
    found = {name: code.constant(f"filter_{name}", value) for name, value in values.items()}
    code.difference_step = DIFFERENCE_STEP
    return found | {"segments": segments, "degrees": degrees}


def _operations(size, joint, modes, loads, commands, sensors, parts, c) -> int:
    """Operations of a sample, at most."""
    variants = 1 + 2 * NUMBERS * loads
    system = loads * (
        3 * modes * (4 * c["degrees"] + 2)
        + c["segments"]
        + 10
        + size * (3 * modes + 1)
        + 12 * modes
        + 4 * commands * modes
        + loads * (2 * modes + 4)
        + loads * (1 + 2 * loads + 2 * modes)
        + modes * (4 + 2 * size + 2 * commands)
    )
    cube, square = 2 * joint**3, joint * joint
    step = DOUBLINGS + 2 + 2 * cube + 8 * square
    step += SERIES_TERMS * (cube + 2 * square) + DOUBLINGS * cube
    with_noise = (
        cube + 7 * square + SERIES_TERMS * (cube + 4 * square) + DOUBLINGS * (2 * cube + square)
    )
    assembled = 2 * (4 + 2 * loads + system + 2 * size * size + size * commands)
    advanced = 4 * size * size + 3 * size * commands
    covariance = parts * (6 * size**3 + 3 * size * size) + 4 * size**3 + 5 * size * size
    reading = system + sensors * (size + commands) * (2 * modes + 2)
    numbers = NUMBERS * loads
    correction = 2 * sensors * size * size + sensors * sensors * (2 * size + sensors + 2)
    correction += size * sensors * (2 * sensors + 2) + 2 * size * size * sensors + size * size
    correction += 4 * size**3 + size * size * (3 * sensors + 2) + 2 * size * (sensors + 1)
    return (
        variants * (parts * (assembled + step + advanced) + reading + 2)
        + parts * with_noise
        + covariance
        + numbers * 3 * (size + sensors)
        + 3 * sensors
        + correction
    )
