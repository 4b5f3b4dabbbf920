"""Writing of programs of JAX as C: arrays, loops over them, and elementwise operations.

A program is that of one run; its C computes as many runs at once as a vector register holds. What
differs between these runs is a `Register` or `Mask` of `native/registers.h` for each number, all
else a single number, so that branches and loops that all runs share stay branches and loops.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar, NamedTuple

import numpy as np

from jaxbeam.runtime.interpreter import called_program

KINDS = {"f": "d", "i": "i", "u": "i", "b": "b"}  # by numpy's kinds: number, whole number, truth
TYPES = {True: {"d": "Register", "i": "Mask", "b": "Mask"}, False: {"d": "double"}}
PROMOTED = {"d": "broadcast({})", "i": "whole({})", "b": "whole(-({}))"}
HEADERS = '#include <math.h>\n\n#include "registers.h"\n#include "translated.h"\n'


class UntranslatedError(NotImplementedError):
    """A program has a part that is not written in C."""


class CArray(NamedTuple):
    """An array in C: its kind ("d", "i" or "b"), shape, name, and whether runs differ in it."""

    kind: str
    shape: tuple[int, ...]
    name: str
    varying: bool

    @property
    def size(self) -> int:
        """Number of entries."""
        return math.prod(self.shape)

    @property
    def type(self) -> str:
        """Type of an entry in C."""
        return TYPES[self.varying].get(self.kind, "int64_t")

    def at(self, index: Any, varying: bool | None = None) -> str:
        """An entry, promoted to one that differs between runs if that is `varying`."""
        entry = f"{self.name}[{index}]"
        return PROMOTED[self.kind].format(entry) if varying and not self.varying else entry


class Writer:
    """Lines of C of a program; `rules` are those of primitives that do not act on each entry.

    A rule takes the writer, the parameters, the inputs, and kind and shape of each result.
    """

    rules: ClassVar[dict[str, Callable]] = {}

    def __init__(self):
        self.lines: list[str] = []
        self.count = itertools.count()
        self.depth = 1

    def line(self, text: str) -> None:
        """Write a line."""
        self.lines.append("    " * self.depth + text)

    def new_name(self, letter: str = "v") -> str:
        """A name that no other part has."""
        return f"{letter}{next(self.count)}"

    @contextmanager
    def block(self, head: str) -> Iterator[None]:
        """Lines in braces."""
        self.line(f"{head} {{")
        self.depth += 1
        yield
        self.depth -= 1
        self.line("}")

    @contextmanager
    def loops(self, shape: Sequence[Any]) -> Iterator[list[str]]:
        """Loops over all indices of a shape, whose names are given; 0 along an axis of length 1.

        Nothing is written where there are no indices.
        """
        lines = self.lines
        if 0 in shape:
            self.lines = []
            yield ["0"] * len(shape)
            self.lines = lines
            return
        names = [self.new_name("i") if size != 1 else "0" for size in shape]
        used = [(name, size) for name, size in zip(names, shape, strict=True) if name != "0"]
        for name, size in used:
            self.line(f"for (int64_t {name} = 0; {name} < {size}; {name}++) {{")
            self.depth += 1
        yield names
        for _ in used:
            self.depth -= 1
            self.line("}")

    def declare(self, kind: str, shape: Sequence[int], varying: bool) -> CArray:
        """A new array."""
        value = CArray(kind, tuple(shape), self.new_name(), varying)
        if value.size:
            self.line(f"{value.type} {value.name}[{value.size}];")
        return value

    def copy(self, to: CArray, source: CArray) -> None:
        """Copy an array of the same kind and size."""
        with self.loops([to.size]) as (i,):
            self.line(f"{to.at(i)} = {source.at(i, to.varying)};")

    def strided(
        self, value: CArray, shape: Sequence[int], strides: Sequence[int], first=0
    ) -> CArray:
        """A new array of entries of another at constant strides along its axes."""
        found = self.declare(value.kind, shape, value.varying)
        with self.loops(shape) as index:
            source = flat_index(index, strides, first)
            self.line(f"{found.at(flat_index(index, strides_of(shape)))} = {value.at(source)};")
        return found

    def run(self, closed, inputs: Sequence[CArray]) -> list[CArray]:
        """Write the equations of a jaxpr; its outputs."""
        constants = map(self.constant, map(np.asarray, getattr(closed, "consts", ())))
        return self.run_open(getattr(closed, "jaxpr", closed), list(constants), inputs)

    def run_open(
        self, jaxpr, constants: Sequence[CArray], inputs: Sequence[CArray]
    ) -> list[CArray]:
        """Write the equations of a jaxpr with arrays of C for its constants; its outputs."""
        given = [*constants, *inputs]
        variables = [*jaxpr.constvars, *jaxpr.invars]
        values: dict[Any, CArray] = dict(zip(variables, given, strict=True))

        def value_of(atom) -> CArray:
            if hasattr(atom, "val"):
                return self.constant(np.asarray(atom.val, atom.aval.dtype))
            return values[atom]

        for equation in jaxpr.eqns:
            found = self.equation(equation, [value_of(atom) for atom in equation.invars])
            values |= zip(equation.outvars, found, strict=True)
        return [value_of(atom) for atom in jaxpr.outvars]

    def constant(self, array: np.ndarray) -> CArray:
        """Array of constant numbers."""
        value = CArray(kind_of(array), array.shape, self.new_name(), False)
        numbers = ", ".join(map(number_text, array.ravel().tolist())) or "0"
        self.line(f"static const {value.type} {value.name}[] = {{{numbers}}};")
        return value

    def equation(self, equation, values: list[CArray]) -> list[CArray]:
        """Write an equation; its results. Raises UntranslatedError for one without a rule."""
        name, params = equation.primitive.name, equation.params
        program = called_program(equation)
        if program is not None:
            return self.run(program, values)
        if name in SAME:
            return values
        if name in self.rules:
            outs = [(kind_of(out.aval), out.aval.shape) for out in equation.outvars]
            found = self.rules[name](self, params, values, outs)
            return found if isinstance(found, list) else [found]
        if name == "pow":  # whose exponent may be whole
            values = [self.converted(value, "d") for value in values]
        expression = elementwise(name, params)
        if expression is None:
            raise UntranslatedError(name)
        out = equation.outvars[0].aval
        varying = any(value.varying for value in values)
        text = expression(values[-1].kind if name == "select_n" else values[0].kind, varying)
        return [self.each(text, kind_of(out), out.shape, values, varying)]

    def each(self, text: str, kind: str, shape, values: list[CArray], varying: bool) -> CArray:
        """An array by an expression of the entries of others."""
        found = self.declare(kind, shape, varying)
        if all(value.size in (1, found.size) for value in values):
            shape = (found.size,)
            values = [value._replace(shape=(value.size,)) for value in values]
        with self.loops(shape) as index:
            entries = []
            for value in values:  # along axes of length 1 all entries are the same
                own = zip(value.shape, strides_of(value.shape), strict=True)
                strides = [0 if size == 1 else stride for size, stride in own]
                entries.append(value.at(flat_index(index, strides or [0] * len(index)), varying))
            to = found.at(flat_index(index, strides_of(shape)))
            self.line(f"{to} = {text.format(*entries)};")
        return found

    def converted(self, value: CArray, kind: str) -> CArray:
        """An array of another kind of numbers."""
        varying = value.varying
        texts = {
            "di": "__builtin_convertvector({}, Mask)" if varying else "(int64_t){}",
            "id": "__builtin_convertvector({}, Register)" if varying else "(double){}",
            "bd": "(Register)({} & (Mask)broadcast(1))" if varying else "(double){}",
            "bi": "-{}" if varying else "{}",
            "ib": "{} != 0",
            "db": "{} != 0",
        }
        if value.kind == kind:
            return value
        return self.each(texts[value.kind + kind], kind, value.shape, [value], varying)

    def varies(self, closed, inputs: Sequence[CArray]) -> list[bool]:
        """Whether runs differ in each of the outputs of a jaxpr."""
        lines, self.lines = self.lines, []
        found = self.run(closed, inputs)
        self.lines = lines
        return [value.varying for value in found]

    def lanes(self, varying: bool):
        """Loop over the runs of a register where indices differ between them."""
        return self.loops(["REGISTER_WIDTH"] if varying else [1])


def without_unused(jaxpr):
    """A jaxpr without the equations of which no output makes use."""
    needed = {atom for atom in jaxpr.outvars if not hasattr(atom, "val")}
    kept = []
    for equation in reversed(jaxpr.eqns):
        if needed.intersection(equation.outvars):
            kept.append(equation)
            needed |= {atom for atom in equation.invars if not hasattr(atom, "val")}
    return jaxpr.replace(eqns=kept[::-1])


def used_variables(jaxpr) -> set:
    """Variables that the equations of a jaxpr, or its outputs, make use of."""
    atoms = [*jaxpr.outvars, *(atom for equation in jaxpr.eqns for atom in equation.invars)]
    return {atom for atom in atoms if not hasattr(atom, "val")}


def kind_of(array) -> str:
    """Kind of the entries of an array or its description; raises UntranslatedError for others."""
    kind = KINDS.get(getattr(array.dtype, "kind", ""))
    if kind is None or array.dtype == np.float32:
        raise UntranslatedError(f"numbers of type {array.dtype}")
    return kind


def number_text(number: Any) -> str:
    """A number in C, to the last bit."""
    if not isinstance(number, float):
        return str(int(number))
    if not math.isfinite(number):
        return "NAN" if math.isnan(number) else "INFINITY" if number > 0 else "-INFINITY"
    return repr(number)


def strides_of(shape: Sequence[int]) -> list[int]:
    """Strides of an array in the order of C."""
    return [math.prod(shape[axis + 1 :]) for axis in range(len(shape))]


def flat_index(index: Sequence[str], strides: Sequence[int], first: Any = 0) -> str:
    """Expression of a place in memory from that along each axis."""
    terms = [] if first == 0 else [str(first)]
    for name, stride in zip(index, strides, strict=True):
        if name != "0" and stride != 0:
            terms.append(name if stride == 1 else f"{name} * {stride}")
    return " + ".join(terms) or "0"


# --- One entry after the other. A rule is an expression for (kind, whether runs differ).


def clipped(start: str, most: int) -> str:
    """An index within 0 and the `most`, as XLA clips it."""
    return f"within({start}, {most})"


def filled(number: str, kind: str, varying: bool) -> str:
    """A number of one run, for all runs of a register where they vary."""
    return PROMOTED[kind].format(number) if varying else number


def _both(text: str) -> Callable[[str, bool], str]:
    return lambda kind, varying: text


def _function(name: str) -> Callable[[str, bool], str]:
    """A function of `math.h`."""
    return lambda kind, varying: f"each_{name}({{}})" if varying else f"{name}({{}})"


def _of_two(name: str) -> Callable[[str, bool], str]:
    return lambda kind, varying: f"each_{name}({{}}, {{}})" if varying else f"{name}({{}}, {{}})"


def _extreme(name: str, sign: str) -> Callable[[str, bool], str]:
    """The larger or smaller of two; NaN if one is."""

    def rule(kind, varying):
        if kind != "d":
            chosen = f"({{0}} {sign} {{1}})"
            return f"either({chosen}, {{0}}, {{1}})" if varying else f"{chosen} ? {{0}} : {{1}}"
        return f"{name}s({{}}, {{}})" if varying else f"{name}({{}}, {{}})"

    return rule


def select(kind: str, varying: bool) -> str:
    """Choice between two by a truth."""
    if not varying:
        return "{0} ? {2} : {1}"
    return "choose({0}, {2}, {1})" if kind == "d" else "either({0}, {2}, {1})"


def _not(kind, varying):
    return "!{}" if kind == "b" and not varying else "~{}"


def _absolute(kind, varying):
    if kind == "d":
        return "absolute({})" if varying else "fabs({})"
    return "either({0} < 0, -{0}, {0})" if varying else "llabs({})"


def _sign(kind, varying):
    if varying:
        return "signs({})" if kind == "d" else "({0} < 0) - ({0} > 0)"
    return "({0} > 0) - ({0} < 0) + 0 * {0}"


def _remainder(kind, varying):
    return _of_two("fmod")(kind, varying) if kind == "d" else "{} % {}"


def _clamp(kind, varying):
    if kind == "d":
        s = "s" if varying else ""
        return f"smaller{s}(larger{s}({{1}}, {{0}}), {{2}})"
    if not varying:
        return "{1} < {0} ? {0} : {1} > {2} ? {2} : {1}"
    return "either({1} < {0}, {0}, either({1} > {2}, {2}, {1}))"


ELEMENTWISE: dict[str, Callable[[str, bool], str]] = {
    **{name: _both("{} + {}") for name in ("add", "add_any")},
    **{"sub": _both("{} - {}"), "mul": _both("{} * {}"), "div": _both("{} / {}")},
    **{"and": _both("{} & {}"), "or": _both("{} | {}"), "xor": _both("{} ^ {}"), "not": _not},
    **{"eq": _both("{} == {}"), "ne": _both("{} != {}"), "lt": _both("{} < {}")},
    **{"le": _both("{} <= {}"), "gt": _both("{} > {}"), "ge": _both("{} >= {}")},
    # In the order of sorts, in which NaN is last.
    "lt_to": _both("({0} < {1}) | (({1} != {1}) & ({0} == {0}))"),
    "le_to": _both("({0} <= {1}) | ({1} != {1})"),
    "neg": _both("-{}"),
    "square": _both("{0} * {0}"),
    "one_minus_square": _both("(1 + {0}) * (1 - {0})"),
    "max": _extreme("larger", ">"),
    "min": _extreme("smaller", "<"),
    "is_finite": _both("0 * {} == 0"),
    "abs": _absolute,
    "sign": _sign,
    "rem": _remainder,
    "clamp": _clamp,
    "select_n": select,
    "pow": _of_two("pow"),
    "atan2": _of_two("atan2"),
    "rsqrt": lambda kind, varying: f"1 / {_function('sqrt')(kind, varying)}",
    **{
        name: _function(name)
        for name in ("sqrt", "cbrt", "exp", "expm1", "log", "log1p", "sin", "cos", "tan", "tanh")
    },
    **{name: _function(name) for name in ("sinh", "cosh", "floor", "ceil")},
    **{name: _function(name) for name in ("asin", "acos", "atan")},
}
SAME = {"stop_gradient", "copy", "copy_p", "optimization_barrier"}


def elementwise(name: str, params) -> Callable[[str, bool], str] | None:
    """Rule of a primitive that acts on each entry, None for another."""
    if name == "integer_pow":
        return lambda kind, varying: f"power{'s' if varying else ''}({{}}, {params['y']})"
    if name == "round":
        return _function("rint" if int(params["rounding_method"]) else "round")
    return ELEMENTWISE.get(name)
