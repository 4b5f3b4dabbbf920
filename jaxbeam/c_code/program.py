"""Program in C of the controller of a case: source, header, recorded samples, loop that checks."""

import dataclasses
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxbeam.c_code.compensation import Compensation
from jaxbeam.c_code.recorded_loop import (
    RecordedLoop,
    filters_in_program,
    recorded_loop,
)
from jaxbeam.c_code.source import CSource
from jaxbeam.c_code.texts import check_text, header_text, samples_text, source_text
from jaxbeam.c_code.writers import NoCCodeError, write_law
from jaxbeam.case.case import Case
from jaxbeam.case.controller import AbstractController, LawOfCommanded
from jaxbeam.case.fields import concrete, import_modules, kind_of
from jaxbeam.case.trajectory import NEVER
from jaxbeam.case.validation import check_case
from jaxbeam.control.state_controller import AbstractStateController, SampledStateLaw, TrueState
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.sensing.sensor_signals import (
    initial_filter_state,
    possible_readings,
    to_reading,
)
from jaxbeam.model.state_space import state_space
from jaxbeam.runtime.arrays import known
from jaxbeam.runtime.compiling import compiled_if_traced
from jaxbeam.runtime.output_file import whole_file
from jaxbeam.simulation.closed_loop import command_lag
from jaxbeam.simulation.commands import command_ranges

MAX_SAMPLES = 2000  # recorded ones, of the start of the run


class CProgram(NamedTuple):
    """Texts of the files of a program by their names, and its cost in double precision.

    `operations` are those of a step at worst, counted as in `jaxbeam.c_code.source`; the bytes are
    those of the state, work space included, and of the constants.
    """

    files: dict[str, str]
    operations: int
    state_bytes: int
    constant_bytes: int
    samples: int


def export_c(case: Case, name: str) -> CProgram:
    """Program in C99 of the controller of a case, with its estimator, filters, limits and delay.

    The law is designed, and its numbers are written as constants. `name` is that of the files and
    the prefix of the functions: `name_reset` and `name_step`, `name_gate` if gates trigger it. The
    samples to check by are those of a simulated run, MAX_SAMPLES at most.

    Raises ValueError for an invalid case, a name that is none in C, a case without a controller or
    with one without a period, a law that has no C code, and a loop that diverges.
    """
    if not (name.isidentifier() and name.isascii()):
        raise ValueError(f"{name!r} cannot be the name of functions in C: take letters, digits, _")
    check_case(case)
    controller = case.controller
    if controller is None:
        raise ValueError("controller is missing: there is nothing to export; add one to the case")
    if controller.period is None:
        raise ValueError("controller.period is missing: a real controller samples; give its period")
    import_modules("jaxbeam.c_code.laws")
    law = known(_designed(case, mesh_layout(case)))
    code = _source(case)
    try:
        write_law(law, code)
    except NoCCodeError as error:
        kind = kind_of(type(controller)) or type(controller).__name__
        raise ValueError(f"controller.kind {kind!r} cannot be exported as C: {error}") from None
    received = _write_limits(case, code)
    loop = recorded_loop(case, law, MAX_SAMPLES)
    given = _given_states(law, loop, code)
    gate_events = _gate_events(code, float(loop.times[-1]))
    title = _title(case, controller)
    files = {
        f"{name}.h": header_text(name, title, code),
        f"{name}.c": source_text(name, title, code),
        f"{name}_samples.h": samples_text(name, loop, given, gate_events),
        f"{name}_check.c": check_text(name, code, received),
    }
    return CProgram(files, code.operations, code.state_bytes, code.constant_bytes, len(loop.times))


def write_c(program: CProgram, folder: str | os.PathLike, overwrite: bool = False) -> list[Path]:
    """Write the files of a program to a folder; their paths.

    Raises FileExistsError, before anything is written, if one exists and `overwrite` is not set.
    """
    paths = [Path(folder) / name for name in program.files]
    for path in paths:
        if path.exists() and not overwrite:
            raise FileExistsError(f"{path} exists already; choose another name, or overwrite it")
    for path, text in zip(paths, program.files.values(), strict=True):
        with whole_file(path, overwrite) as beside:
            beside.write_text(text, encoding="utf-8")
    return paths


@compiled_if_traced
def _designed(case: Case, layout):
    """Law of the controller of a case."""
    return case.controller.law(state_space(case, layout=layout))


def _source(case: Case) -> CSource:
    """Code that begins with the readings, behind the digital filters of their sensors.

    One that is missing leaves the last in its place, and the filter as it is.
    """
    period, duration = (float(concrete(x)) for x in (case.controller.period, case.run.duration))
    samples = int(np.floor(duration / period * (1 + 1e-12))) + 1
    code = CSource(len(case.sensors), len(case.actuators), period, samples)
    at_rest = [to_reading(sensor, 0.0) for sensor in case.sensors]
    code.state("reading", at_rest, "last readings, behind the digital filters")
    code.work("present", len(case.sensors), "which of them are new: 1, or 0 for a missing one")
    commands = len(case.actuators)
    code.state("acting", np.zeros(commands), "commands that act at the sample", restarts=False)
    code.work("wanted", commands, "commands of the law, before the limits")
    filters = filters_in_program(case)
    if case.sensors:
        # A reading that comes filtered may be beyond the range of its samples.
        ranges = [
            possible_readings(
                dataclasses.replace(sensor, range=None)
                if sensor.has_digital_filter and sections is None
                else sensor
            )
            for sensor, sections in zip(case.sensors, filters, strict=True)
        ]
        lowest, highest = (
            code.constant(f"{name}_reading", ends)
            for name, ends in zip(("lowest", "highest"), np.transpose(ranges), strict=True)
        )
        arguments = f"{code.readings}, {code.present}, measurements, {lowest}, {highest}"
        code.add(f"receive({arguments}, {code.sensors});", 3 * code.sensors)
    for i, sections in enumerate(filters):
        if sections is None:
            continue
        count = len(sections)
        start = initial_filter_state(case.sensors[i], sections, 0.0)
        states = code.state(f"filter_{i}", start, f"states of the filter of sensor {i}")
        filter, reading = code.constant(f"filter_{i}", sections), f"{code.readings}[{i}]"
        code.add(
            f"if ({code.present}[{i}] > 0)\n"
            f"    {reading} = filter_sample({filter}, {count}, {states}, {reading});",
            9 * count + 1,
        )
    return code


def _write_limits(case: Case, code: CSource) -> tuple[str, ...]:
    """Resolution, limits and rate limits of the commands, and the delay until they act.

    The members of the state that are the last commands as the actuators received them; none where
    hysteresis or creep of the actuators is compensated, whose states follow from them. Where a
    number of the law is not finite, it starts again, and the last command of it stays.
    """
    actuators, lag = code.actuators, command_lag(case)
    low, high, rate = (np.asarray(part) for part in command_ranges(case))
    last = code.state("last_wanted", np.zeros(actuators), "last of these", restarts=False)
    numbers = sum(member.size for member in code.members.values() if member.restarts)
    code.add(
        f"""
/* A law with a number that is not finite starts again, and its last command stays */
if (!is_finite(s) || !all_finite({code.output}, {actuators})) {{
    restart(s);
    copy({code.output}, {last}, {actuators});
}}
copy({last}, {code.output}, {actuators});""",
        2 * (numbers + actuators),
    )
    zeros, meaning = np.zeros(actuators * lag), "last commands, the latest first"
    latest = code.state("sent", zeros, meaning, restarts=False)
    compensation = Compensation(case, code)
    compensation.write_inverse()
    code.add("/* Commands as the actuators receive them */")
    if case.controller.resolution is not None:
        step = f"(real){float(concrete(case.controller.resolution))!r}"
        code.add(
            f"for (i = 0; i < {actuators}; i++)\n"
            f"    {code.output}[i] = {step} * rint({code.output}[i] / {step});",
            3 * actuators,
        )
    for i in range(actuators):
        bounds = []
        if np.isfinite(low[i]):
            bounds.append((f"(real){float(low[i])!r}", f"(real){float(high[i])!r}", 2))
        if np.isfinite(rate[i]):
            change = f"(real){float(rate[i]) * code.period!r}"
            bounds.append((f"{latest}[{i}] - {change}", f"{latest}[{i}] + {change}", 4))
        for lower, upper, operations in bounds:
            code.add(
                f"{code.output}[{i}] = clamp({code.output}[{i}], {lower}, {upper});", operations
            )
    code.add(f"copy(commands, {code.output}, {actuators});")
    queues, known_queue = [(latest, code.output)], latest
    if compensation.operators:
        meaning = "what acts of them, the latest first"
        known_queue = code.state("known", zeros, meaning, restarts=False)
        acting = code.work("acts", actuators, "what acts of the commands")
        compensation.write_model(acting)
        queues.append((known_queue, acting))
    for queue, newest in queues:
        if lag > 1:
            code.add(
                f"for (i = {actuators * lag - 1}; i >= {actuators}; i--)"
                f" {queue}[i] = {queue}[i - {actuators}];"
            )
        code.add(f"copy({queue}, {newest}, {actuators});")
    code.add(f"copy({code.command}, {known_queue} + {actuators * (lag - 1)}, {actuators});")
    if compensation.operators:
        return ()
    return ("sent",) if lag > 1 else ("sent", "acting")


def _given_states(law, loop: RecordedLoop, code: CSource) -> np.ndarray:
    """States that the program is given at each sample, none for a law with an estimator."""
    if not code.given_states:
        return np.zeros((len(loop.times), 0))
    law = law.law if isinstance(law, LawOfCommanded) else law
    assert isinstance(law, SampledStateLaw)
    filter = law.filter
    while not isinstance(filter, TrueState):
        filter = filter.filter
    return loop.states @ np.asarray(filter.state_map).T


def _gate_events(code: CSource, end: float) -> list[tuple[float, int]]:
    """Times (s) up to the end of the run at which gates 0 and 1 are passed, in their order."""
    events = [(float(t), gate) for gate in (0, 1) for t in code.gate_times[:, gate]]
    return sorted(event for event in events if event[0] < min(NEVER, end))


def _title(case: Case, controller: AbstractController) -> list[str]:
    """Lines that say what the program is."""
    lines = [f'Controller of kind "{kind_of(type(controller))}"']
    estimator = controller.estimator if isinstance(controller, AbstractStateController) else None
    if estimator is not None:
        lines[0] += f', estimator "{kind_of(type(estimator))}"'
    if case.title:
        lines += [f"Case: {case.title}"]
    return lines
