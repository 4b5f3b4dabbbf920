"""Texts of C: numbers, tables and loops."""

import re
import textwrap
from collections.abc import Callable, Sequence
from importlib.metadata import version

import jax
import numpy as np

from jaxbeam.c_code.recorded_loop import RecordedLoop
from jaxbeam.c_code.source import CSource, array_text

MIN_COMPILED = 300  # samples from which compilation pays


def at_samples(function: Callable, code: CSource, varies: bool = True) -> tuple[np.ndarray, ...]:
    """Arrays that a function gives at each sample time (s), stacked along a first axis.

    A function that does not vary is evaluated once.
    """
    times = code.period * np.arange(code.samples if varies else 1)
    if len(times) >= MIN_COMPILED:
        return tuple(np.asarray(part) for part in jax.jit(jax.vmap(function))(times))
    rows = [function(t) for t in times]
    return tuple(
        np.stack([np.asarray(part) for part in column]) for column in zip(*rows, strict=True)
    )


# Of commands, relative to the largest, in double and single precision. Rounding makes ROUNDING and
# less; filters that invert their sensors and programs with many limits may magnify it.
ROUNDING, TOLERANCE, FLOAT_TOLERANCE = 1e-12, 1e-10, 1e-2


def header_text(name: str, title: list[str], code: CSource) -> str:
    """Header: sizes, state, functions, cost."""
    big = name.upper()
    members = [
        f"    {name}_real {member}[{max(part.size, 1)}]; /* {part.comment} */"
        for member, part in code.members.items()
    ]
    members += [f"    int {counter}; /* {comment} */" for counter, comment in code.counters.items()]
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


def source_text(name: str, title: list[str], code: CSource) -> str:
    """Source: constants, helpers, reset, gate and step."""
    constants = []
    for constant, values in code.constants.items():
        kind = "int" if values.dtype.kind == "i" else "real"
        constants.append(
            _wrapped(f"static const {kind} {constant}[] = {{{array_text(values) or '0'}}};")
        )
    body = "\n".join(code.lines)
    indices = [i for i in ("i", "j", "sample") if _uses(body, i)]
    declared = [f"    int {', '.join(indices)};"] if indices else []
    declared += [f"    {variable};" for variable in code.variables]
    unused = [f"    (void){word};" for word in ("measurements", "t") if not _uses(body, word)]
    return f"""{_comment(title)}
#include "{name}.h"

#include <math.h>

#ifdef __FAST_MATH__
#error "missing readings are NaN, which -ffast-math takes for numbers: compile without it"
#endif

typedef {name}_real real;

{_lines(constants)}

{(chr(10) * 2).join(code.helper_texts())}

{_restart_functions(name, code)}
void {name}_reset({name}_state *s)
{{
{_lines(_reset_lines(code, False))}
    restart(s);
}}
{_gate_function(name, code)}
void {name}_step({name}_state *s, const real *measurements, real t, real *commands)
{{
{_lines([*declared, *unused, body])}
}}
"""


def samples_text(
    name: str, loop: RecordedLoop, given: np.ndarray, gate_events: list[tuple[float, int]]
) -> str:
    """Recorded samples: times, measurements, expected commands, passages of gates."""
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


def check_text(name: str, code: CSource, received: Sequence[str]) -> str:
    """Loop over the recorded samples, which compares the commands with those expected.

    Members `received` of the state have the commands that the actuators received last. They become
    the recorded ones: a law may be unstable by itself, where only the loop is stable, and would
    multiply the rounding of its own commands from sample to sample.
    """
    big = name.upper()
    receive = "".join(
        f"\n            state.{member}[i] += ({name}_real)(expected - (double)commands[i]);"
        for member in received
    )
    if receive:
        receive = (
            "\n            /* The actuators received the recorded command: without the loop a"
            f"\n               law may be unstable, and multiply its own rounding. */{receive}"
        )
    gates, tolerance = "", max(TOLERANCE, ROUNDING / code.difference_step)
    if code.gate_loads:
        gates = f"""
        while (event < GATE_EVENTS && gate_event[2 * event] <= sample_time[k]) {{
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


def _cost_lines(code: CSource) -> list[str]:
    return [
        f"Written by jaxbeam {version('jaxbeam')}; C99, fixed memory, no library but math.h.",
        f"Cost of a step at worst: {code.operations} additions, multiplications, divisions,",
        "comparisons and functions of math.h.",
        f"Memory in double precision: {code.state_bytes} bytes of state,"
        f" {code.constant_bytes} bytes of constants.",
    ]


def _measurements(code: CSource) -> str:
    """What the measurements are, as a sentence."""
    text = f"Measurements are the readings of the sensors ({code.sensors}), in SI units"
    if code.given_states:
        text += (
            f",\n   then the {code.given_states} states of the model that the law is designed for"
        )
    return text + "."


def _gate_prototype(name: str, code: CSource) -> str:
    if not code.gate_loads:
        return ""
    return f"""
/* A load passes a gate, 0 or 1, at a time t (s); call it before the step of the next sample. */
void {name}_gate({name}_state *s, int gate, {name}_real t);
"""


def _gate_function(name: str, code: CSource) -> str:
    """Function that notes the passage of a gate; the oldest load makes room for a new one."""
    if not code.gate_loads:
        return ""
    return f"""
void {name}_gate({name}_state *s, int gate, real t)
{{
    int load;
    if (!all_finite(&t, 1)) return;
    load = (gate ? s->passages_2++ : s->passages_1++) % {code.gate_loads};
    s->gate_times[2 * load + gate] = t;
    if (gate) return;
    {" ".join(["s->gate_times[2 * load + 1] = (real)1e30;", *code.first_gate_lines])}
}}
"""


def _restart_functions(name: str, code: CSource) -> str:
    """Functions that set the law to its start, and say whether all its numbers are finite."""
    restarting = [
        f"all_finite(s->{key}, {part.size})"
        for key, part in code.members.items()
        if part.restarts and part.size
    ]
    separator, unused = "\n        && ", [] if restarting else ["    (void)s;"]
    return f"""/* Start of the law: what is set from outside, and commands on their way, stay. */
static void restart({name}_state *s)
{{
{_lines([*unused, *_reset_lines(code, True)])}
}}

static int is_finite(const {name}_state *s)
{{
{_lines([*unused, f"    return {separator.join(restarting or ['1'])};"])}
}}
"""


def _missing_lines(code: CSource) -> str:
    """What a step does where a reading is missing, as lines of a comment."""
    sentences = [
        "A reading that is no number, or outside the range of its sensor, is missing: give NAN for"
        " one that did not come in time, and call the step once a period even if none came; one"
        " that comes late counts in the next step. The last reading stays in the place of a missing"
        " one, filters wait, and commands stay within their limits.",
        *dict.fromkeys(code.missing),
        "If a number of the law is not finite, it starts again and its last command stays.",
    ]
    return textwrap.fill(" ".join(sentences), 97, initial_indent="   ", subsequent_indent="   ")


def _reset_lines(code: CSource, restarts: bool) -> list[str]:
    """Statements that set the state to its start: what restarts, or all else."""
    lines, loops = [], False
    members = {key: part for key, part in code.members.items() if part.restarts == restarts}
    for name, part in members.items():
        start = np.zeros(part.size) if part.start is None else part.start
        if part.size and np.all(start == start[0]) and part.size > 2:
            loops = True
            value = array_text(start[:1])
            lines.append(f"    for (i = 0; i < {part.size}; i++) s->{name}[i] = {value};")
        else:
            lines += [
                f"    s->{name}[{i}] = {array_text(start[i : i + 1])};" for i in range(part.size)
            ]
    lines += [] if restarts else [f"    s->{name} = 0;" for name in code.counters]
    return ["    int i;", *lines] if loops else lines


def _comment(lines: list[str]) -> str:
    safe = [line.replace("*/", "* /").replace("/*", "/ *") for line in lines]
    return "/* " + "\n   ".join(safe) + " */"


def _lines(lines) -> str:
    return "\n".join(lines)


def _uses(body: str, word: str) -> bool:
    """Whether statements use a variable."""
    return re.search(rf"\b{word}\b", body) is not None


def _wrapped(text: str, width: int = 100) -> str:
    """An array in lines of a width."""
    return "\n    ".join(textwrap.wrap(text, width - 4, break_long_words=False))
