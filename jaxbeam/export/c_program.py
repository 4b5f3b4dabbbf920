"""Program in C of the controller of a case: source, header, recorded samples, loop that checks.

Texts of the C files of a program: header, source, recorded samples and check.
"""

import dataclasses
import math
import os
import re
import textwrap
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Num

from jaxbeam.case.arguments import checks_classes
from jaxbeam.case.case import Case
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.fields import concrete, kind_of
from jaxbeam.case.trajectory import NEVER, SAME_TIME
from jaxbeam.case.validation import check_case
from jaxbeam.control.state_controller import AbstractStateController
from jaxbeam.export.c_sampled_program import (
    RecordedLoop,
    gate_times_of,
    recorded_loop,
    sampled_program,
)
from jaxbeam.export.c_steps import (
    ProgramWriter,
    Word,
    functions_of,
    in_single_type,
    last_word,
    named_arrays,
    operations,
    sharing_memory,
    with_numbers,
    without_unused,
)
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.state_space import state_space
from jaxbeam.runtime.arrays import Module, to_numpy
from jaxbeam.runtime.c_translation import renew
from jaxbeam.runtime.c_writer import (
    CArray,
    UntranslatedError,
    kind_of as kind_of_array,
    number_text,
    used_variables,
)
from jaxbeam.runtime.compiling import compiled_if_traced
from jaxbeam.runtime.output_file import whole_file

REAL_BYTES, INT_BYTES = 8, 4  # in double precision


class Member(NamedTuple):
    """Member of the state: kind of its numbers as in `CArray`, values after a reset, address."""

    kind: str
    start: np.ndarray
    address: str


class ProgramText(NamedTuple):
    """Step of a program in C with its functions, state and constants, and facts for comments.

    `given_states` is the number of states of the plant that follow the readings among the
    measurements; `received` are members of the state that have the last commands. Where a law
    takes derivatives by finite differences, commands agree to rounding over `difference_step`.
    """

    body: str
    functions: list[str]
    members: dict[str, Member]
    constants: dict[str, np.ndarray]
    sensors: int
    actuators: int
    period: float
    given_states: int
    gate_loads: int
    received: list[str]
    operations: int
    stack_bytes: int
    notes: list[str]
    missing: list[str]
    difference_step: float

    @property
    def state_bytes(self) -> int:
        """Bytes of the state in double precision."""
        reals, ints = self._sizes([part.start for part in self.members.values()])
        ints += 2 * (self.gate_loads > 0)
        size = REAL_BYTES * reals + INT_BYTES * ints
        return -(-size // REAL_BYTES) * REAL_BYTES if reals else size

    @property
    def constant_bytes(self) -> int:
        """Bytes of the constants in double precision."""
        reals, ints = self._sizes(self.constants.values())
        return REAL_BYTES * reals + INT_BYTES * ints

    @staticmethod
    def _sizes(arrays) -> tuple[int, int]:
        """Counts of real entries and of whole-number entries."""
        sizes = [(array.size, array.dtype.kind == "f") for array in arrays]
        return sum(n for n, real in sizes if real), sum(n for n, real in sizes if not real)


BY_PRECISION = """
#define BY_PRECISION(single, twice) (sizeof(real) < 8 ? (single) : (twice))
"""

# Of commands, relative to the largest, in double and single precision. Rounding makes ROUNDING and
# less; filters that invert their sensors and programs with many limits may magnify it.
ROUNDING, TOLERANCE, FLOAT_TOLERANCE = 1e-12, 1e-10, 1e-2


def header_text(name: str, title: list[str], code: ProgramText) -> str:
    """Text of the header: sizes, state, functions, cost."""
    big = name.upper()
    members = [
        f"    {f'{name}_real' if part.kind == 'd' else 'int'} {member}[{part.start.size}];"
        f" /* {_meaning(part)} */"
        for part_kind in (True, False)
        for member, part in code.members.items()
        if (part.kind == "d") == part_kind
    ]
    if code.gate_loads:
        members.append("    int passages[2]; /* loads that have passed each gate */")
    return f"""{_comment([*title, *_cost_lines(code), *code.notes])}
#ifndef {big}_H
#define {big}_H

/* Define {big}_REAL as float for single precision. */
#ifndef {big}_REAL
#define {big}_REAL double
#endif
typedef {big}_REAL {name}_real;

#define {big}_PERIOD {code.period!r} /* s, between samples */
enum {{
    {big}_SENSORS = {code.sensors},
    {big}_GIVEN_STATES = {code.given_states},
    {big}_COMMANDS = {code.actuators},
    {big}_GATES = {2 if code.gate_loads else 0}
}};

typedef struct {{
{_lines(members)}
}} {name}_state;

/* Start of a run, at rest: states, delays and filters. */
void {name}_reset({name}_state *s);
{_gate_prototype(name, code)}
/* One sample: commands from the measurements at a time t (s from the start of the run).
   {_measurements(code)}
   Commands are rounded and limited: send them to the actuators as they are.
{_missing_lines(code)} */
void {name}_step({name}_state *s, const {name}_real *measurements, {name}_real t,
     {" " * len(name)}      {name}_real *commands);

#endif
"""


def source_text(name: str, title: list[str], code: ProgramText) -> str:
    """Text of the source: constants, helper functions, reset, gate and step."""
    constants = [
        _wrapped(f"static const {_type(values)} {constant}[] = {{{real_text(values)}}};")
        for constant, values in code.constants.items()
    ]
    unused = [f"    (void){word};" for word in ("measurements", "t") if not uses(code.body, word)]
    return f"""{_comment(title)}
#include "{name}.h"

#include <limits.h>
#include <stdlib.h>
#include <string.h>
#include <tgmath.h>

#ifdef __FAST_MATH__
#error "missing readings are NaN, which -ffast-math takes for numbers: compile without it"
#endif

typedef {name}_real real;
{BY_PRECISION if uses(code.body, "BY_PRECISION") else ""}
{_lines(constants)}

{(chr(10) * 2).join(code.functions)}

void {name}_reset({name}_state *s)
{{
{_lines(_reset_lines(code))}
}}
{_gate_function(name, code)}
void {name}_step({name}_state *s, const real *measurements, real t, real *commands)
{{
{_lines([*unused, code.body])}
}}
"""


def samples_text(
    name: str, loop: RecordedLoop, given: np.ndarray, gate_events: list[tuple[float, int]]
) -> str:
    """Text of the recorded samples: times, measurements, expected commands, gate passages."""
    measurements = np.concatenate([loop.readings, given], axis=1)
    events = [number for event in gate_events for number in event]
    arrays = {
        "sample_time": loop.times,
        "sample_measurements": np.ravel(measurements),
        "sample_commands": np.ravel(loop.commands),
        "gate_event": np.asarray(events, float),
    }
    texts = [
        _wrapped(f"static const double {key}[] = {{{array_text(values) or '0'}}};")
        for key, values in arrays.items()
    ]
    return f"""/* Samples of a simulated run of {name}: inputs and expected commands. */
enum {{ SAMPLES = {len(loop.times)}, GATE_EVENTS = {len(gate_events)} }};
{_lines(texts)}
"""


def check_text(name: str, code: ProgramText) -> str:
    """Text of the check: a loop over the recorded samples that compares commands with expected.

    The last commands in the state are then replaced by the recorded ones: a law may be unstable by
    itself, where only the loop is stable, and would amplify the rounding of its own commands.
    """
    big = name.upper()
    receive = "".join(
        f"\n            state.{member}[i] += ({name}_real)(expected - (double)commands[i]);"
        for member in code.received
    )
    if receive:
        receive = (
            "\n            /* The actuators received the recorded command: without the loop a"
            f"\n               law may be unstable, and multiply its own rounding. */{receive}"
        )
    gates, tolerance = "", max(TOLERANCE, ROUNDING / code.difference_step)
    if code.gate_loads:
        gates = f"""
        while (event < GATE_EVENTS
               && gate_event[2 * event] * (1 - {SAME_TIME:g}) <= sample_time[k]) {{
            {name}_gate(&state, (int)gate_event[2 * event + 1], ({name}_real)gate_event[2 * event]);
            event++;
        }}"""
    return f"""/* Loop of the controller {name} over the recorded samples of a simulated run.

   cc -std=c99 {name}.c {name}_check.c -lm && ./a.out

   In a real loop a timer of period {big}_PERIOD takes the place of the samples: read the sensors,
   call {name}_step, write the commands to the actuators. */
#include <math.h>
#include <stdio.h>

#include "{name}.h"
#include "{name}_samples.h"

enum {{ INPUTS = {big}_SENSORS + {big}_GIVEN_STATES }};

int main(void)
{{
    const int is_single = sizeof({name}_real) < sizeof(double);
    const double tolerance = is_single ? {FLOAT_TOLERANCE!r} : {tolerance!r};
    static {name}_state state;
    {name}_real measurements[INPUTS + 1] = {{0}}, commands[{big}_COMMANDS];
    double largest = 0, error = 0;
    int i, k{", event = 0" if code.gate_loads else ""};
    {name}_reset(&state);
    for (k = 0; k < SAMPLES; k++) {{{gates}
        for (i = 0; i < INPUTS; i++)
            measurements[i] = ({name}_real)sample_measurements[k * INPUTS + i];
        {name}_step(&state, measurements, ({name}_real)sample_time[k], commands);
        for (i = 0; i < {big}_COMMANDS; i++) {{
            const double expected = sample_commands[k * {big}_COMMANDS + i];
            const double difference = fabs((double)commands[i] - expected);
            if (!(difference <= error)) error = difference;
            if (fabs(expected) > largest) largest = fabs(expected);{receive}
        }}
    }}
    printf("%d samples, largest command %.6g, largest error %.3g of it, %d bytes of state\\n",
           SAMPLES, largest, largest > 0 ? error / largest : error, (int)sizeof(state));
    return error <= tolerance * largest ? 0 : 1;
}}
"""


def _cost_lines(code: ProgramText) -> list[str]:
    return [
        f"Written by jaxbeam {version('jaxbeam')}; C99, fixed memory, no library but that of math.",
        f"Cost of a step at worst: {code.operations} additions, multiplications, divisions,",
        "comparisons and functions of math.h.",
        f"Memory in double precision: {code.state_bytes} bytes of state,"
        f" {code.constant_bytes} bytes of constants,",
        f"{code.stack_bytes} bytes of intermediate results on the stack at most.",
    ]


def _measurements(code: ProgramText) -> str:
    """Sentence on the meaning of the measurements."""
    text = f"Measurements are the readings of the sensors ({code.sensors}), in SI units"
    if code.given_states:
        text += (
            f",\n   then the {code.given_states} states of the model that the law is designed for"
        )
    return text + "."


def _gate_prototype(name: str, code: ProgramText) -> str:
    if not code.gate_loads:
        return ""
    return f"""
/* A load passes a gate, 0 or 1, at a time t (s); call it before the step of the next sample. */
void {name}_gate({name}_state *s, int gate, {name}_real t);
"""


def _gate_function(name: str, code: ProgramText) -> str:
    """C function that stores the passage of a gate; a new load replaces the oldest one."""
    if not code.gate_loads:
        return ""
    return f"""
void {name}_gate({name}_state *s, int gate, real t)
{{
    int load;
    if (!(t - t == 0)) return;
    load = s->passages[gate]++ % {code.gate_loads};
    s->gate_times[2 * load + gate] = t;
    if (!gate) s->gate_times[2 * load + 1] = (real)1e30;
}}
"""


def _missing_lines(code: ProgramText) -> str:
    """Lines of a comment on what a step does where a reading is missing."""
    sentences = [
        "A reading that is no number, or outside the range of its sensor, is missing: give NAN for"
        " one that did not come in time, and call the step once a period even if none came; one"
        " that comes late counts in the next step. The last reading stays in the place of a missing"
        " one, filters wait, and commands stay within their limits.",
        *dict.fromkeys(code.missing),
        "If a number of the law is not finite, it starts again and its last command stays.",
    ]
    return textwrap.fill(" ".join(sentences), 97, initial_indent="   ", subsequent_indent="   ")


def _reset_lines(code: ProgramText) -> list[str]:
    """C statements that set the state to its initial values."""
    lines, loops = [], False
    for name, part in code.members.items():
        values = real_text(part.start).split(", ")
        if len(values) > 2 and len(set(values)) == 1:
            loops = True
            lines.append(f"    for (i = 0; i < {len(values)}; i++) s->{name}[i] = {values[0]};")
        else:
            lines += [f"    s->{name}[{i}] = {value};" for i, value in enumerate(values)]
    if code.gate_loads:
        lines.append("    s->passages[0] = s->passages[1] = 0;")
    return ["    int i;", *lines] if loops else lines or ["    (void)s;"]


def _type(values: np.ndarray) -> str:
    return "real" if values.dtype.kind == "f" else "int"


def _meaning(part: Member) -> str:
    """Meaning of a member of the state, from its address in the state of the program."""
    if part.address.startswith("settings."):
        return f"{part.address.removeprefix('settings.')}; settable"
    return part.address


def array_text(values: Num[np.ndarray, "*entry"] | Bool[np.ndarray, "*entry"]) -> str:
    """Numbers of an array in C, separated by commas; exact in double precision."""
    kind = int if values.dtype.kind in "iub" else float
    return ", ".join(map(number_text, np.ravel(values).astype(kind).tolist()))


def real_text(values: Num[np.ndarray, "*entry"] | Bool[np.ndarray, "*entry"]) -> str:
    """Numbers of an array in C, in the precision of the program, separated by commas."""
    return in_single_type(array_text(values))


def _comment(lines: list[str]) -> str:
    safe = [line.replace("*/", "* /").replace("/*", "/ *") for line in lines]
    return "/* " + "\n   ".join(safe) + " */"


def _lines(lines) -> str:
    return "\n".join(lines)


def uses(body: str, word: str) -> bool:
    """Whether statements use a variable."""
    return re.search(rf"\b{word}\b", body) is not None


def _wrapped(text: str) -> str:
    """Text of an array, wrapped to lines of 100 characters."""
    return "\n    ".join(textwrap.wrap(text, 96, break_long_words=False))


MAX_SAMPLES = 2000  # recorded ones, of the start of the run


class CProgram(NamedTuple):
    """Texts of the files of a program by their names, and its cost in double precision.

    `operations` are those of a step at worst (see `jaxbeam.export.c_steps.operations`); the
    bytes are those of the state, work space included, and of the constants.
    """

    files: dict[str, str]
    operations: int
    state_bytes: int
    constant_bytes: int
    samples: int


@checks_classes
def export_c(case: Case, name: str) -> CProgram:
    """Program in C99 of the controller of a case, with its estimator, filters, limits and delay.

    The law is designed, and its numbers are written as constants. `name` is that of the files and
    the prefix of the functions: `name_reset` and `name_step`, `name_gate` if gates trigger it. The
    samples to check by are those of a simulated run, MAX_SAMPLES at most.

    Raises ValueError for an invalid case, a name that is none in C, a case without a controller or
    with one without a period, a law that has no C code, and a loop that diverges.
    """
    if not (name.isidentifier() and name.isascii()):
        raise ValueError(
            f"{name!r} cannot be the name of functions in C: take a letter, then"
            " letters, digits or _"
        )
    check_case(case)
    controller = case.controller
    if controller is None:
        raise ValueError("controller is missing: there is nothing to export; add one to the case")
    if controller.period is None:
        raise ValueError("controller.period is missing: a real controller samples; give its period")
    law = to_numpy(_designed(case, mesh_layout(case)))
    loop = recorded_loop(case, law, MAX_SAMPLES)
    period, duration = (float(concrete(x)) for x in (controller.period, case.run.duration))
    samples = math.floor(duration / period * (1 + 1e-12)) + 1
    try:
        text = _translated(case, law, samples, loop.states.shape[1])
    except (UntranslatedError, jax.errors.JAXTypeError) as error:
        kind = kind_of(type(controller)) or type(controller).__name__
        reason = (
            f"there is no C for {error}"
            if isinstance(error, UntranslatedError)
            else "take jaxbeam.runtime.arrays.xp in its step, not numpy"
        )
        raise ValueError(f"controller.kind {kind!r} cannot be exported as C: {reason}") from None
    given = loop.states if text.given_states else np.zeros((len(loop.times), 0))
    gate_events = _gate_events(gate_times_of(law), float(loop.times[-1]))
    title = _title(case, controller)
    files = {
        f"{name}.h": header_text(name, title, text),
        f"{name}.c": source_text(name, title, text),
        f"{name}_samples.h": samples_text(name, loop, given, gate_events),
        f"{name}_check.c": check_text(name, text),
    }
    return CProgram(files, text.operations, text.state_bytes, text.constant_bytes, len(loop.times))


@checks_classes
def write_c(program: CProgram, folder: str | os.PathLike, overwrite: bool = False) -> list[Path]:
    """Paths of the files of a program, written to a folder.

    Raises FileExistsError, before anything is written, if one exists and `overwrite` is not set.
    """
    paths = [Path(folder) / name for name in program.files]
    for path in paths:
        if path.exists() and not overwrite:
            raise FileExistsError(f"{path} exists already; choose another name, or overwrite it")
    for path, text in zip(paths, program.files.values(), strict=True):
        with whole_file(path, overwrite) as partial:
            partial.write_text(text, encoding="utf-8")
    return paths


@compiled_if_traced
def _designed(case: Case, layout):
    """Law of the controller of a case."""
    return case.controller.law(state_space(case, layout=layout))


def _translated(case: Case, law, samples: int, states: int) -> ProgramText:
    """Step of a program in C, translated, with the facts for its comments."""
    program = sampled_program(case, law, samples)
    start = jax.tree.map(np.asarray, program.start())
    sensors, actuators = len(program.ranges), len(start.wanted)
    arguments = start, np.zeros(sensors), np.zeros(states), np.float64(0)
    closed = without_unused(jax.make_jaxpr(program.step)(*arguments))
    with_paths, _ = jax.tree_util.tree_flatten_with_path(start)
    names = with_numbers({path: last_word(path) for path, _ in with_paths})
    writer = ProgramWriter(named_arrays(jax.tree_util.tree_leaves_with_path(program)))
    members, given = {}, []
    for path, leaf in with_paths:
        kind, place = kind_of_array(leaf), jax.tree_util.keystr(path, simple=True, separator=".")
        given.append(CArray(kind, leaf.shape, f"s->{names[path]}", False))
        if leaf.size:
            members[names[path]] = Member(kind, np.ravel(leaf), place)
    kept = list(given)
    given.append(CArray("d", (sensors,), "measurements", False))
    given.append(CArray("d", (states,), f"(measurements + {sensors})", False))
    given.append(Word("d", (), "t", False))
    sent, *after = writer.run(closed, given)
    writer.line("/* State for the next sample */")
    renew(writer, kept, after, None)
    writer.line("/* Commands */")
    writer.copy(CArray("d", (actuators,), "commands", False), sent)
    lines, stack_bytes = sharing_memory(writer.lines)
    body = "\n".join(lines)
    notes = []
    if jax.tree.structure(program.law.law) != jax.tree.structure(law):
        notes = [f"Tables over time end after {samples} samples; then their last entries hold."]
    # The last commands as the actuators received them; with compensations the states of these
    # follow from them.
    queue, acting = (
        next(names[path] for path, leaf in with_paths if leaf is part)
        for part in (start.commands.queue, start.commands.command)
    )
    received = [queue] if program.begun else [queue, acting]
    received = [] if start.commands.assumed is not None else received
    return ProgramText(
        body,
        functions_of(body),
        members,
        {key: part for key, part in writer.constants.items() if uses(body, key)},
        sensors,
        actuators,
        float(concrete(case.controller.period)),
        states if closed.jaxpr.invars[-2] in used_variables(closed.jaxpr) else 0,
        len(gate_times_of(law)),
        received,
        operations(closed.jaxpr),
        stack_bytes,
        notes,
        [part.without_reading for part in _parts(law) if hasattr(part, "without_reading")],
        min(getattr(part, "difference_step", 1.0) for part in _parts(law)),
    )


def _parts(law: Any) -> Iterator[Module]:
    """All modules in a law, itself first: filters, sources of the load, laws within it."""
    if isinstance(law, Module):
        yield law
        law = [getattr(law, field.name) for field in dataclasses.fields(law)]
    if isinstance(law, list | tuple):
        for part in law:
            yield from _parts(part)


def _gate_events(gate_times: np.ndarray, end: float) -> list[tuple[float, int]]:
    """Times (s) up to the end of the run at which gates 0 and 1 are passed, in their order."""
    events = [(float(t), gate) for gate in (0, 1) for t in gate_times[:, gate]]
    return sorted(event for event in events if event[0] < min(NEVER, end))


def _title(case: Case, controller: AbstractController) -> list[str]:
    """Lines of a title: the controller and its case."""
    lines = [f'Controller of kind "{kind_of(type(controller))}"']
    estimator = controller.estimator if isinstance(controller, AbstractStateController) else None
    if estimator is not None:
        lines[0] += f', estimator "{kind_of(type(estimator))}"'
    if case.title:
        lines += [f"Case: {case.title}"]
    return lines
