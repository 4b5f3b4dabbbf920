"""C code of a control law while it is written: constants, state, statements of a step, cost.

The statements use the C functions of the folder `helpers`, each of which is in a file of its name.
A cost is a number of additions, multiplications, divisions, comparisons and functions of math.h.
"""

import itertools
import re
from collections.abc import Container, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Num

HELPERS = Path(__file__).parent / "helpers"
REAL_BYTES, INT_BYTES = 8, 4  # in double precision


class Member(NamedTuple):
    """Member of the state in C: number of entries, values after a reset (None: none), meaning.

    With `restarts` it is set to its start, too, if a number of the law is not finite.
    """

    size: int
    start: Float[np.ndarray, " entry"] | None
    comment: str
    restarts: bool = False


class CSource:
    """C code of a law while it is written.

    `readings`, `command`, `time` and `output` are the C expressions of the readings of the sensors,
    of the command that acts at the sample, of the time (s), and of the command that the law has to
    write. `present` is positive for each sensor whose reading came; else the last one is in its
    place, and a sentence in `missing` says what else the law does. `given_states` is the number of
    states that follow the readings among the measurements: a law that takes any sets it.
    """

    readings, present = "s->reading", "s->present"
    command, time, output = "s->acting", "t", "s->wanted"

    def __init__(self, sensors: int, actuators: int, period: float, samples: int):
        self.sensors, self.actuators = sensors, actuators
        self.period, self.samples = period, samples
        self.given_states = 0
        self.gate_loads = 0
        self.gate_times = np.zeros((0, 2))
        self.first_gate_lines: list[str] = []
        self.constants: dict[str, np.ndarray] = {}
        self.members: dict[str, Member] = {}
        self.counters: dict[str, str] = {}
        self.variables: list[str] = []
        self.lines: list[str] = []
        self.notes: list[str] = []
        self.missing: list[str] = []
        self.operations = 0
        self.difference_step = 1.0  # relative; derivatives by differences divide rounding by it

    def constant(self, name: str, values) -> str:
        """Constant array of numbers; its name in C, which is unique. Of one number its value."""
        array = np.asarray(values)
        kind = int if array.dtype.kind in "iub" else float
        name = _unique(name, self.constants)
        self.constants[name] = np.ravel(array).astype(kind)
        return name if array.ndim else f"{name}[0]"

    def per_sample(self, name: str, values: Num[np.ndarray, "sample *entry"]) -> str:
        """Constant arrays, one for each sample; the C expression of that of the present sample.

        Equal neighbours are stored once. After the last sample the last array holds.
        """
        rows = np.reshape(values, (len(values), -1))
        scale = np.max(np.abs(rows), initial=0.0) * 1e-15
        new = np.concatenate([[True], np.any(np.abs(np.diff(rows, axis=0)) > scale, axis=1)])
        if new.sum() == 1:
            return self.constant(name, rows[0])
        self._number_samples(len(rows))
        name = self.constant(name, rows[new])
        index = self.constant(f"{name}_index", np.cumsum(new) - 1)
        return f"({name} + {rows.shape[1]} * {index}[sample])"

    def _number_samples(self, count: int) -> None:
        """Statements that number the samples, once."""
        line = f"    sample = sample_number(t, (real){self.period!r}, {count});"
        if line not in self.lines:
            self.notes.append(
                f"Tables over time end after {count} samples; then their last entries hold."
            )
            self.lines[:0] = [line]
            self.operations += 4

    def state(self, name: str, start, comment: str, restarts: bool = True) -> str:
        """Array in the state that keeps its values between samples; its C expression.

        It goes back to its start if a number of the law is not finite, unless it `restarts` never.
        """
        values = np.ravel(np.asarray(start, float))
        name = _unique(name, self.members)
        self.members[name] = Member(values.size, values, comment, restarts)
        return f"s->{name}" if np.ndim(start) else f"s->{name}[0]"

    def work(self, name: str, size: int, comment: str = "work space") -> str:
        """Array in the state for intermediate results; its C expression."""
        name = _unique(name, self.members)
        self.members[name] = Member(size, None, comment)
        return f"s->{name}"

    def counter(self, name: str, comment: str) -> str:
        """Whole number in the state, zero after a reset; its C expression."""
        self.counters[name] = comment
        return f"s->{name}"

    def gates(self, gate_times: Float[np.ndarray, "load 2"]) -> str:
        """Times (s) at which loads pass two gates; the C expression of them, two for each load.

        A gate that has not been passed has the time NEVER. `gate_times` are those of the case.
        """
        self.gate_loads, self.gate_times = len(gate_times), np.asarray(gate_times, float)
        self.counter("passages_1", "loads that have passed the first gate")
        self.counter("passages_2", "loads that have passed the second gate")
        never = np.full(2 * len(gate_times), 1e30)
        return self.state("gate_times", never, "s, NEVER before", restarts=False)

    def add(self, text: str, operations: int = 0) -> None:
        """Add statements of a step, which take at most a number of operations."""
        self.lines += [f"    {line}" if line else "" for line in text.strip("\n").split("\n")]
        self.operations += operations

    def multiply(self, result: str, matrix: str, vector: str, rows: int, columns: int) -> None:
        """result = matrix x vector"""
        self.add(f"multiply({result}, {matrix}, {vector}, {rows}, {columns});", 2 * rows * columns)

    def multiply_add(
        self, result: str, matrix: str, vector: str, rows: int, columns: int, sign: int = 1
    ) -> None:
        """result += sign x matrix x vector"""
        arguments = f"{result}, {sign}, {matrix}, {vector}, {rows}, {columns}"
        self.add(f"multiply_add({arguments});", 2 * rows * (columns + 1))

    @property
    def constant_bytes(self) -> int:
        """Bytes of the constants in double precision."""
        sizes = (INT_BYTES if a.dtype.kind == "i" else REAL_BYTES for a in self.constants.values())
        return sum(
            size * array.size for size, array in zip(sizes, self.constants.values(), strict=True)
        )

    @property
    def state_bytes(self) -> int:
        """Bytes of the state in double precision, work space included."""
        reals = sum(member.size for member in self.members.values())
        size = REAL_BYTES * reals + INT_BYTES * len(self.counters)
        return -(-size // REAL_BYTES) * REAL_BYTES

    def helper_texts(self) -> list[str]:
        """Texts of the helpers that the statements use, in an order that C accepts."""
        return helpers_of("\n".join([*self.lines, *self.first_gate_lines]))


def _unique(name: str, taken: Container[str]) -> str:
    """A name, with a number if it is taken already."""
    names = itertools.chain([name], (f"{name}_{i}" for i in itertools.count(2)))
    return next(each for each in names if each not in taken)


class _Helper(NamedTuple):
    name: str
    text: str


@cache
def _helpers() -> dict[str, _Helper]:
    files = sorted(HELPERS.glob("*.h"))
    return {f.stem: _Helper(f.stem, f.read_text(encoding="utf-8").strip()) for f in files}


def helpers_of(text: str) -> list[str]:
    """Texts of the helpers that a text in C calls, in an order that C accepts."""
    return [helper.text for helper in _closure(text)]


def _closure(text: str) -> Sequence[_Helper]:
    """Helpers that a text calls, each after those that it calls itself."""
    found: dict[str, _Helper] = {}
    for name, helper in _helpers().items():
        if re.search(rf"\b{name}\(", text):
            body = helper.text.split("{", 1)[1]
            found |= {inner.name: inner for inner in _closure(body)}
            found[name] = helper
    return list(found.values())


def search_operations(points: int) -> int:
    """Comparisons of the helper `interval` in a grid with a number of points."""
    return int(np.ceil(np.log2(max(points, 1))))


def interpolation_operations(points: int) -> int:
    """Operations of the helpers `interpolate` and `interpolate_inside`."""
    return search_operations(points) + 9


def array_text(values: Float[np.ndarray, " entry"] | Int[np.ndarray, " entry"]) -> str:
    """Numbers of an array in C, separated by commas; exact in double precision."""
    names = {"nan": "NAN", "inf": "INFINITY", "-inf": "-INFINITY"}  # of math.h
    return ", ".join(names.get(repr(value), repr(value)) for value in values.tolist())
