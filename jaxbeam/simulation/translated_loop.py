"""Events of a sampled loop in C, for the C integrator: readings, law and commands of eight runs.

The same functions as in `sampled_loop`, traced and translated (`runtime/c_translation`). Numbers of
the loop are arguments, so that loops of one structure share the compiled code.
"""

import itertools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbeam.integrator.inputs import StepInfo
from jaxbeam.runtime.c_translation import Translation
from jaxbeam.runtime.c_writer import (
    HEADERS,
    CArray,
    UntranslatedError,
    Writer,
    kind_of,
    used_variables,
    without_unused,
)
from jaxbeam.simulation.sampled_loop import LoopMemory, SampledLoop

UNUSED = CArray("d", (), "", False)
HEAD = """
void process_event(const void *const *inputs, int64_t event, double time, Register *memory,
                   const Register *state, Register *commands) {
"""


class TranslatedLoop(NamedTuple):
    """C code of the events of a loop, its arguments, and its memory at the start of a run.

    `failures` is the place in the memory of the number of samples without a solution.
    """

    text: str
    inputs: tuple[np.ndarray, ...]
    memory: Float[np.ndarray, " memory"]
    failures: int


def translated_loop(loop: SampledLoop) -> TranslatedLoop:
    """Events of a loop in C.

    Raises UntranslatedError for a loop with a part that is not translated: accelerations, which
    follow from the contact forces, and a law with other functions than `c_translation` has.
    """
    if loop.measured_rows is not None:
        raise UntranslatedError("readings of accelerations")
    numbers, rest = eqx.partition(loop, _is_number)
    numbers, memory = (jax.tree.map(np.asarray, tree) for tree in (numbers, loop.start(1)))

    def process(numbers, event, time, memory, state):
        own = eqx.combine(numbers, rest)
        memory = own._process_event(memory, state, StepInfo(time, jnp.zeros(()), event))
        return own.path.acting(memory.commands), memory

    state = np.zeros((loop.model.state_count, 1))
    closed = jax.make_jaxpr(process)(numbers, np.int64(0), np.float64(0), memory, state)
    jaxpr = without_unused(closed.jaxpr)
    variables = [*jaxpr.constvars, *jaxpr.invars]
    used = used_variables(jaxpr)
    arrays = [*map(np.asarray, closed.consts), *jax.tree.leaves(numbers)]
    arrays = [a if v in used else None for a, v in zip(arrays, variables, strict=False)]
    leaves = jax.tree.leaves(memory)
    text = _text(jaxpr, arrays, leaves, state)
    place = sum(np.size(leaf) for leaf in leaves[:-1])  # failures are the last
    assert isinstance(memory, LoopMemory)
    start = np.concatenate([np.ravel(leaf).astype(float) for leaf in leaves])
    given = tuple(_as_argument(array) for array in arrays if array is not None)
    return TranslatedLoop(text, given, start, place)


def _is_number(leaf: Any) -> bool:
    """Whether a leaf is a number that another loop of the same structure may have otherwise."""
    return isinstance(leaf, np.ndarray | np.generic | float | jax.Array) and jnp.issubdtype(
        jnp.result_type(leaf), jnp.floating
    )


def _as_argument(array) -> np.ndarray:
    """An array as C takes it: of float64 or int64."""
    kind = float if np.issubdtype(np.asarray(array).dtype, np.floating) else np.int64
    return np.ascontiguousarray(array, kind)


def _text(jaxpr, arrays, leaves, state) -> str:
    """File of C of the program of an event."""
    writer = Translation()
    given: list[CArray] = []
    number = itertools.count()
    for array in arrays:
        if array is None:
            given.append(UNUSED)
            continue
        value = CArray(kind_of(array), np.shape(array), writer.new_name(), False)
        writer.line(f"const {value.type} *{value.name} = inputs[{next(number)}];")
        given.append(value)
    event, time = CArray("i", (), "&event", False), CArray("d", (), "&time", False)
    given += [event._replace(name="(&event)"), time._replace(name="(&time)")]
    place, kept = 0, []
    for leaf in leaves:
        stored = CArray("d", leaf.shape, f"(memory + {place})", True)
        kept.append(stored)
        given.append(_loaded(writer, stored, kind_of(leaf)))
        place += leaf.size
    given.append(CArray("d", state.shape, "state", True))
    commands, *after = writer.run(jaxpr, given)
    writer.copy(CArray("d", commands.shape, "commands", True), commands)
    for stored, value in zip(kept, after, strict=True):
        writer.copy(stored, writer.converted(value, "d"))
    return "\n".join([HEADERS + HEAD.rstrip("\n"), *writer.lines, "}", ""])


def _loaded(writer: Writer, stored: CArray, kind: str) -> CArray:
    """A part of the memory, which the program may change while it reads it."""
    texts = {"d": "{}", "i": "__builtin_convertvector({}, Mask)", "b": "{} != 0"}
    return writer.each(texts[kind], kind, stored.shape, [stored], True)
