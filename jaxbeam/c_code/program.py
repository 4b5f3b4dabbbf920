"""Program in C of the controller of a case: source, header, recorded samples, loop that checks."""

import dataclasses
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxbeam.c_code.recorded_loop import recorded_loop
from jaxbeam.c_code.sampled_program import (
    gate_times_of,
    sampled_program,
)
from jaxbeam.c_code.texts import (
    Member,
    ProgramText,
    check_text,
    header_text,
    samples_text,
    source_text,
    uses,
)
from jaxbeam.c_code.translation import (
    ProgramWriter,
    Word,
    functions_of,
    in_single_type,
    last_word,
    named_arrays,
    operations,
    with_numbers,
    without_unused,
)
from jaxbeam.case.case import Case
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.fields import concrete, kind_of
from jaxbeam.case.trajectory import NEVER
from jaxbeam.case.validation import check_case
from jaxbeam.control.state_controller import AbstractStateController
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.state_space import state_space
from jaxbeam.runtime.arrays import to_numpy
from jaxbeam.runtime.c_translation import renew
from jaxbeam.runtime.c_writer import (
    CArray,
    UntranslatedError,
    kind_of as kind_of_array,
    used_variables,
)
from jaxbeam.runtime.compiling import compiled_if_traced
from jaxbeam.runtime.module import Module
from jaxbeam.runtime.output_file import whole_file

MAX_SAMPLES = 2000  # recorded ones, of the start of the run


class CProgram(NamedTuple):
    """Texts of the files of a program by their names, and its cost in double precision.

    `operations` are those of a step at worst (see `jaxbeam.c_code.translation.operations`); the
    bytes are those of the state, work space included, and of the constants.
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
    body = in_single_type("\n".join(writer.lines))
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
        writer.stack_bytes,
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
