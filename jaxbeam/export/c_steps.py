"""Translation of a JAX program to C99 for one run: named constants, no vectors, worst-case cost.

`jaxbeam.runtime.c_translation` has the rules; this module adds what programs for real-time systems
need beyond them.
"""

import functools
import math
import re
import sysconfig
import textwrap
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jax.interpreters.partial_eval import dce_jaxpr

from jaxbeam.numerics.qp import SINGLE_PRECISION
from jaxbeam.runtime.c_translation import Translation
from jaxbeam.runtime.c_writer import (
    CArray,
    UntranslatedError,
    elementwise,
    kind_of,
    number_text,
)
from jaxbeam.runtime.interpreter import called_program
from jaxbeam.runtime.native_library import C_FOLDER

WIDTH = 100  # of the lines of C
NUMBERS = re.compile(r"(?<![\w.])(?:\d+\.\d*(?:e[+-]?\d+)?|\d+e[+-]?\d+|NAN\b|INFINITY\b)")
INDEX = "#"  # placeholder of the index in the text of an `Expression`
QUADRATIC_PROGRAMS = "numerics/qp"  # whose tolerances depend on the precision
PACKAGE = str(Path(__file__).parents[1])
MACHINERY = str(Path(__file__).parents[1] / "runtime")
BY_POINTER = {
    "cholesky",
    "triangular_solve",
    "lu",
    "scan",
    "unstack",
}  # primitives whose rules take addresses of inputs
BY_PLACE = {"gather", "dynamic_slice"}  # primitives that read their first input at computed indices
FREE = {  # primitives that cost no operation: they move numbers, or act on booleans and indices
    *("broadcast_in_dim", "reshape", "squeeze", "expand_dims", "transpose", "slice", "rev"),
    *("concatenate", "stack", "tile", "pad", "split", "unstack", "iota", "gather", "dynamic_slice"),
    *("dynamic_update_slice", "scatter", "convert_element_type", "copy", "stop_gradient"),
    *("platform_index", "select_n", "and", "or", "not", "xor", "reduce_or", "reduce_and"),
}
STANDARD_LIBRARY = sysconfig.get_path("stdlib")
TAKEN = re.compile(  # names of the writer, words of C, of math.h, and of the step of a program
    r"[a-z]\d*"
    "|auto|break|case|char|const|continue|default|do|double|else|enum|extern|float|for|goto|if"
    "|inline|int|long|register|restrict|return|short|signed|sizeof|static|struct|switch|typedef"
    "|union|unsigned|void|volatile|while"
    "|sqrt|cbrt|exp|expm1|log|log1p|sin|cos|tan|sinh|cosh|tanh|asin|acos|atan|atan2|pow|fmod"
    "|floor|ceil|rint|round|fabs|gamma|abs|labs|llabs"
    "|real|commands|measurements"
)


class Word(CArray):
    """Array with one value in all entries, whose name is the C text of the value."""

    def at(self, index: Any, varying: bool | None = None) -> str:
        """C text of the value, whatever the index."""
        return self.name


class Number(Word):
    """Array with one constant in all entries."""


class Expression(CArray):
    """Array that is used once: its entries are computed there, without storage.

    Its name is the C text of an entry, with INDEX in place of the index.
    """

    def at(self, index: Any, varying: bool | None = None) -> str:
        """C text of the entry at an index."""
        return self.name.replace(INDEX, str(index))


class ProgramWriter(Translation):
    """Writer of the C lines of a program, with its constants in a separate table.

    An elementwise operation that is used once, by another one, is written in the same line.
    """

    def __init__(self, names: dict[tuple, str]):
        super().__init__()
        self.names = names
        self.constants: dict[str, np.ndarray] = {}
        self.last_place: str | None = None
        self.used_once: set = set()

    def line(self, text: str) -> None:
        """Write a line, or several of at most WIDTH characters, with the types of a program."""
        indent = "    " * self.depth
        self.lines += textwrap.wrap(
            in_single_type(text),
            WIDTH,
            initial_indent=indent,
            subsequent_indent=f"{indent}    ",
            break_long_words=False,
            break_on_hyphens=False,
        )

    def constant(self, array: np.ndarray) -> CArray:
        """Constant array of some numbers; arrays of equal numbers are stored once."""
        kind = kind_of(array)
        if array.size == 1:
            text = number_text(array.ravel().tolist()[0])
            return Number(kind, array.shape, f"({text})" if text.startswith("-") else text, False)
        if array.size == 0:
            return CArray(kind, array.shape, "none", False)
        key = fingerprint(array)
        name = self.names.setdefault(key, f"constant_{len(self.constants) + 1}")
        self.constants[name] = array
        return CArray(kind, array.shape, name, False)

    def run(self, closed, inputs: Sequence[CArray]) -> list[CArray]:
        """Outputs of a jaxpr as stored arrays, after its equations are written."""
        jaxpr = getattr(closed, "jaxpr", closed)
        uses = Counter(atom for atom in jaxpr.outvars if not hasattr(atom, "val"))
        single = {}
        for equation in jaxpr.eqns:
            for atom in equation.invars:
                if not hasattr(atom, "val"):
                    uses[atom] += 1
                    single[atom] = _joins(atom, equation)
        uses.update(atom for atom in jaxpr.outvars if not hasattr(atom, "val"))
        self.used_once |= {atom for atom, n in uses.items() if n == 1 and single.get(atom)}
        return [self._stored(value) for value in super().run(closed, inputs)]

    def equation(self, equation, values: list[CArray]) -> list[CArray]:
        """Outputs of an equation, written below a comment with the function that it is from."""
        name = equation.primitive.name
        if called_program(equation) is not None:
            return super().equation(equation, values)
        place = _place(equation)
        if self.depth == 1 and place not in (None, self.last_place):
            self.last_place = place
            self.line(f"/* {place} */")
        if place is not None and place.startswith(QUADRATIC_PROGRAMS):
            values = [_by_precision(value) for value in values]
        out = equation.outvars[0].aval
        if name == "broadcast_in_dim" and isinstance(values[0], Word):
            return [values[0]._replace(shape=out.shape)]
        text = _form(equation, values)
        if text is not None and out.size == 1 and all(isinstance(one, Number) for one in values):
            found = equation.primitive.bind(*map(_array, values), **equation.params)
            return [self.constant(np.asarray(found, out.dtype))]
        if text is None or any(text.count(f"{{{i}}}") > 1 for i in range(len(values))):
            values = [
                self._stored(value, name in BY_POINTER or (name in BY_PLACE and i == 0))
                for i, value in enumerate(values)
            ]
        if text is None or equation.outvars[0] not in self.used_once:
            return super().equation(equation, values)
        entries = [value.at("0" if value.size == 1 else INDEX) for value in values]
        return [Expression(kind_of(out), out.shape, f"({text.format(*entries)})", False)]

    def varies(self, closed, inputs: Sequence[CArray]) -> list[bool]:
        """False for each output: there is one run, so that nothing differs between runs."""
        return [False] * len(getattr(closed, "jaxpr", closed).outvars)

    def converted(self, value: CArray, kind: str) -> CArray:
        """Array converted to another kind; numbers beyond the range of integers are clipped."""
        if value.kind + kind == "di":
            return self.each("whole({})", "i", value.shape, [value], False)
        return super().converted(value, kind)

    def _stored(self, value: CArray, also_words: bool = False) -> CArray:
        """Stored array with the entries of an `Expression`, or of a `Word` if asked for."""
        if isinstance(value, Expression) or (also_words and isinstance(value, Word)):
            return self.each("{}", value.kind, value.shape, [value], False)
        return value


def _array(number: Number) -> np.ndarray:
    """Array of a number."""
    words = {"NAN": math.nan, "INFINITY": math.inf, "-INFINITY": -math.inf}
    text = number.name.strip("()")
    kinds = {"d": float, "i": int, "b": lambda text: bool(int(text))}
    return np.full(number.shape, words[text] if text in words else kinds[number.kind](text))


def _by_precision(value: CArray) -> CArray:
    """Value that depends on the precision of the program, for tolerances of quadratic programs."""
    if isinstance(value, Number) and value.kind == "d":
        number = float(_array(value).flat[0])
        if number in SINGLE_PRECISION:
            text = f"BY_PRECISION({SINGLE_PRECISION[number]!r}, {value.name})"
            return Word("d", value.shape, text, False)
    return value


def _form(equation, values: list[CArray]) -> str | None:
    """Format of the C text of an elementwise operation on arrays or numbers; else None."""
    name = equation.primitive.name
    rule = None if name in Translation.rules else elementwise(name, equation.params)
    size = equation.outvars[0].aval.size
    if rule is None or name == "pow" or any(value.size not in (1, size) for value in values):
        return None
    form = rule(values[-1].kind if name == "select_n" else values[0].kind, False)
    for i in range(form.count("{}")):
        form = form.replace("{}", f"{{{i}}}", 1)
    return form


def _joins(atom, equation) -> bool:
    """Whether an equation is an elementwise operation on an atom of its own size."""
    return (
        equation.primitive.name not in Translation.rules
        and elementwise(equation.primitive.name, equation.params) is not None
        and equation.outvars[0].aval.size == atom.aval.size
    )


def without_unused(closed):
    """JAX program without the equations that no output depends on, also within its loops."""
    jaxpr, _ = dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars), instantiate=True)
    return closed.replace(jaxpr=jaxpr)


def fingerprint(array) -> tuple:
    """Hashable key of the kind, size and numbers of an array."""
    array = np.asarray(array)
    return array.dtype.kind, array.size, array.tobytes()


DECLARATION = re.compile(r"^( *)(real|int) (v\d+)\[(\d+)\];$")
OWN_PLACE = 16  # entries: up to so many an array is one of its own, which may be in registers
BYTES = {"real": 8, "int": 4}


def sharing_memory(lines: Sequence[str]) -> tuple[list[str], int]:
    """Lines of a function whose large arrays share memory where no two are used at a time.

    Also the bytes of all arrays in double precision. An array is used from its declaration to the
    last line with its name, or to the end of the block within the block of its declaration that
    this line is in or opens, as the block may be a loop.
    """
    last_use: dict[str, int] = {}
    opened: list[int] = []  # lines that open the blocks around the present one
    closed: dict[int, int] = {}  # line that closes a block, by the line that opens it
    around: list[tuple[int, ...]] = []
    for number, line in enumerate(lines):
        outer = tuple(opened)
        for sign in re.findall(r"[{}]", line):
            if sign == "{":
                opened.append(number)
            else:
                closed[opened.pop()] = number
        around.append(max(outer, tuple(opened), key=len))
        last_use |= dict.fromkeys(re.findall(r"\bv\d+\b", line), number)
    declared, sizes = [], {"real": 0, "int": 0}
    for number, line in enumerate(lines):
        if found := DECLARATION.match(line):
            indent, kind, name, size = *found.groups()[:3], int(found[4])
            end, depth = last_use[name], len(around[number])
            if len(around[end]) > depth:
                end = closed[around[end][depth]]
            declared.append((number, end, indent, kind, name, size))
    lines, own, placed = list(lines), 0, []
    for number, end, indent, kind, name, size in declared:
        if size <= OWN_PLACE:
            own += size * BYTES[kind]
            continue
        present = [one for one in placed if one[0] == kind and one[1] >= number]
        starts = sorted([0, *(start + length for _, _, start, length in present)])
        free = next(
            start
            for start in starts
            if all(start >= a + n or start + size <= a for _, _, a, n in present)
        )
        placed.append((kind, end, free, size))
        sizes[kind] = max(sizes[kind], free + size)
        lines[number] = f"{indent}{kind} *const {name} = {kind}_memory + {free};"
    memory = [f"    {kind} {kind}_memory[{size}];" for kind, size in sizes.items() if size]
    return memory + lines, own + sum(BYTES[kind] * size for kind, size in sizes.items())


def _place(equation) -> str | None:
    """Name of the function, of jaxbeam or a user, that an equation is from; None if unknown."""
    frames = getattr(getattr(equation.source_info, "traceback", None), "frames", ())
    for frame in frames:
        file = frame.file_name
        if file.startswith(PACKAGE) and not file.startswith(MACHINERY):
            module = file.removeprefix(PACKAGE).strip("/\\").removesuffix(".py")
            return f"{module.replace(chr(92), '/')}: {_plain(frame.function_name)}"
        if not file.startswith((PACKAGE, STANDARD_LIBRARY)) and "site-packages" not in file:
            return _plain(frame.function_name)
    return None


def _plain(function: str) -> str:
    """Name of the outermost function around a local one."""
    return function.split(".<locals>")[0]


def in_single_type(text: str) -> str:
    """Text of translated lines with the types of a program, `real` and `int`, also of numbers."""
    text = NUMBERS.sub(r"(real)\g<0>", text)  # which are float or double in C
    for word, own in (("double", "real"), ("int64_t", "int"), ("INT64_", "INT_")):
        text = re.sub(rf"\b{word}\b" if word != "INT64_" else word, own, text)
    return text


def functions_of(text: str) -> list[str]:
    """Texts of the functions that a text calls, each after those that it calls itself."""
    texts = {re.search(r"(\w+)\(", one)[1]: one for one in _functions()}  # type: ignore[index]
    found: dict[str, str] = {}

    def add(part: str) -> None:
        for name, own in texts.items():
            if name not in found and re.search(rf"\b{name}\(", part):
                add(own.split("{", 1)[1])
                found[name] = own

    add(text)
    return list(found.values())


def _functions() -> list[str]:
    """Texts of the functions of translated programs, for numbers of type `real`."""
    texts = [(C_FOLDER / name).read_text(encoding="utf-8") for name in ("algebra.h", "decompose.h")]
    text = "\n".join(texts)
    words = {"NUMBER": "real", "SQUARE_ROOT": "sqrt", "ZERO": "0", "ONE": "1"}
    words |= {"Lane": "real", "Place": "int", "static inline": "static"}
    text = re.sub(r"NAMED\((\w+)\)", r"\1", text)
    for word, own in words.items():
        text = re.sub(rf"\b{word}\b", own, text)
    starts = [match.start() for match in re.finditer(r"^static", text, re.M)]
    parts = [text[a:b] for a, b in zip(starts, [*starts[1:], len(text)], strict=True)]
    return [*SMALL, *(part[: part.rindex("\n}") + 2] for part in parts)]


@functools.cache
def _names_in_functions() -> frozenset[str]:
    """Names of these functions, and of all that is declared in them, which would be shadowed."""
    return frozenset(re.findall(r"\w+", "\n".join(_functions())))


SMALL = [
    "static real larger(real a, real b)\n{\n    return a > b || !(a == a) ? a : b;\n}",
    "static real smaller(real a, real b)\n{\n    return a < b || !(a == a) ? a : b;\n}",
    "static int within(int index, int most)\n{\n"
    "    return index < 0 ? 0 : index > most ? most : index;\n}",
    "static int whole(real x)\n{\n"
    "    return x >= (real)2e9 ? 2000000000 : x > -(real)2e9 ? (int)x : -2000000000;\n}",
]


def operations(jaxpr) -> int:
    """Worst-case number of operations of a program: arithmetic, comparisons, functions of math.h.

    Raises UntranslatedError for a loop without a largest number of turns.
    """
    return sum(map(_operations, jaxpr.eqns))


def _operations(equation) -> int:
    name, params = equation.primitive.name, equation.params
    program = called_program(equation)
    if program is not None:
        return operations(_open(program))
    if name == "custom_linear_solve":
        return operations(_open(params["jaxprs"].solve))
    if name == "scan":
        return params["length"] * operations(_open(params["jaxpr"]))
    if name == "cond":
        return max(operations(_open(branch)) for branch in params["branches"])
    if name == "while":
        condition, body = _open(params["cond_jaxpr"]), _open(params["body_jaxpr"])
        turns = _most_turns(condition)
        return turns * operations(body) + (turns + 1) * operations(condition)
    if name == "convert_element_type" and equation.invars[0].aval.dtype.kind == "f":
        return 2 * equation.outvars[0].aval.size  # comparisons with the ends of whole numbers
    read, made = equation.invars[0].aval if equation.invars else None, equation.outvars[0].aval
    if read is None or name in FREE:
        return 0
    if name == "lu":
        size = read.shape[-1]
        return read.size // size**2 * size**3
    if read.dtype.kind != "f":
        return 0
    if name == "dot_general":
        (contracted, _), _ = params["dimension_numbers"]
        return 2 * made.size * int(np.prod([read.shape[axis] for axis in contracted], dtype=int))
    if name.startswith(("reduce", "arg", "cum")):
        return read.size
    if name in ("scatter-add", "scatter-sub", "scatter-mul"):
        return equation.invars[2].aval.size
    if name == "sort":
        size = read.shape[params["dimension"]]
        return 3 * read.size * size // 2
    if name == "cholesky":
        return read.size // read.shape[-1] ** 2 * (read.shape[-1] ** 3 // 3 + read.shape[-1] ** 2)
    if name == "triangular_solve":
        return made.size * read.shape[-1]
    if name == "polynomial":
        return 2 * made.size * (len(equation.invars) - 2)
    if name == "integer_pow":
        return made.size * (2 * abs(params["y"]).bit_length() + 1)
    return made.size * {
        "max": 2,
        "min": 2,
        "clamp": 4,
        "sign": 4,
        "is_finite": 2,
        "lt_to": 3,
        "le_to": 2,
        "one_minus_square": 3,
    }.get(name, 1)


def _open(closed):
    return getattr(closed, "jaxpr", closed)


def _most_turns(condition) -> int:
    """Largest number of turns of a loop: the number that its condition compares with."""
    for equation in condition.eqns:
        if equation.primitive.name == "lt" and hasattr(most := equation.invars[1], "val"):
            return int(most.val)
    raise UntranslatedError("a loop without a largest number of turns")


def named_arrays(leaves: Sequence[tuple[Any, Any]]) -> dict[tuple, str]:
    """Names of arrays and of their rows by `fingerprint`, made from their addresses."""
    found: dict[tuple, str] = {}
    for path, leaf in leaves:
        if not hasattr(leaf, "dtype") or np.asarray(leaf).dtype.kind not in "fiub":
            continue
        array, name = np.asarray(leaf), last_word(path)
        found.setdefault(fingerprint(array), name)
        for i, row in enumerate(array if array.ndim > 1 else ()):
            found.setdefault(fingerprint(row), f"{name}_{i}")
    return with_numbers(found)


def last_word(path) -> str:
    """Last name in the address of a leaf, with the numbers behind it."""
    words = [
        str(getattr(key, "name", getattr(key, "key", getattr(key, "idx", "")))) for key in path
    ]
    place = max((i for i, word in enumerate(words) if not word.isdecimal()), default=0)
    word = re.sub(r"\W", "", "_".join(words[place:])).strip("_") or "value"
    return f"{word}_" if TAKEN.fullmatch(word) or word in _names_in_functions() else word


def with_numbers(names: dict[Any, str]) -> dict[Any, str]:
    """The same names, each but the first of several equal ones with a number."""
    taken: dict[str, int] = {}
    found = {}
    for key, name in names.items():
        taken[name] = taken.get(name, 0) + 1
        found[key] = name if taken[name] == 1 else f"{name}_{taken[name]}"
    return found
