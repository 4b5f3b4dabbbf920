"""Programs of JAX computed by NumPy, equation by equation, without a compiler.

XLA takes a millisecond or more to compile an equation, NumPy some microseconds to compute it: a
program that runs a few times only is done sooner so. Primitives without a rule here are called as
they are, which compiles each of them alone.
"""

import contextlib
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.runtime.indexed_windows import gather, scatter

CALL_COST = 2e3  # ns, of an equation in NumPy
ENTRY_COST = 1.0  # ns, of an entry of its result, or of what it reduces
PRODUCT_COST = 0.25  # ns, of a product of two entries in `dot_general`
COMPILE_COST = 1.2e6  # ns, of an equation in XLA
WHILE_TRIPS = 10  # assumed of a loop whose length is not known
OPENED = {  # calls of other programs, and the parameters that these are
    "jit": "jaxpr",
    "remat2": "jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "custom_vmap_call": "call",
}
LOOPS = {"scan", "while", "cond", "custom_linear_solve"}


class InterpretedProgram:
    """Function of arrays by the equations of a jaxpr.

    Results are arrays of NumPy, or those of JAX where a primitive is called as it is.
    """

    def __init__(self, closed):
        jaxpr, constants = getattr(closed, "jaxpr", closed), getattr(closed, "consts", ())
        places: dict[Any, int] = {}
        self.values: list[Any] = []

        def place_of(atom) -> int:
            if hasattr(atom, "val"):  # a literal
                self.values.append(np.asarray(atom.val, atom.aval.dtype))
                return len(self.values) - 1
            if atom not in places:
                places[atom] = len(self.values)
                self.values.append(None)
            return places[atom]

        self.inputs = [place_of(variable) for variable in jaxpr.invars]
        for variable, value in zip(jaxpr.constvars, constants, strict=True):
            self.values[place_of(variable)] = value
        self.calls: list[tuple[Callable, list[int], list[int], bool]] = []
        for equation in jaxpr.eqns:
            sources = [place_of(atom) for atom in equation.invars]
            results = [place_of(variable) for variable in equation.outvars]
            several = equation.primitive.multiple_results
            self.calls.append((_rule(equation), sources, results, several))
        self.outputs = [place_of(atom) for atom in jaxpr.outvars]
        self._free(set(self.outputs))

    def _free(self, kept: set[int]) -> None:
        """Note after which call each value is needed no more."""
        self.last: list[list[int]] = [[] for _ in self.calls]
        given = {place for place, value in enumerate(self.values) if value is not None}
        seen = kept | given
        for i in reversed(range(len(self.calls))):
            _, sources, results, _ = self.calls[i]
            for place in (*sources, *results):
                if place not in seen:
                    seen.add(place)
                    self.last[i].append(place)

    @np.errstate(all="ignore")  # as compiled code, which yields inf and nan
    def __call__(self, *arrays) -> list:
        values = list(self.values)
        for place, array in zip(self.inputs, arrays, strict=True):
            values[place] = array
        for (function, sources, results, several), last in zip(self.calls, self.last, strict=True):
            found = function(*[values[place] for place in sources])
            if several:
                for place, value in zip(results, found, strict=True):
                    values[place] = value
            else:
                values[results[0]] = found
            for place in last:
                values[place] = None
        return [values[place] for place in self.outputs]


def called_program(equation):
    """Jaxpr of the program that an equation calls, None for an operation."""
    name, params = equation.primitive.name, equation.params
    if name in OPENED:
        return params[OPENED[name]]
    if name == "call_hi_primitive":  # an operation of JAX 0.12 in terms of others
        avals = [atom.aval for atom in equation.invars]
        call = functools.partial(equation.primitive.to_lojax, **params)
        return jax.make_jaxpr(call)(*avals)
    return None


def run_cost(jaxpr) -> float:
    """Estimated time (ns) that NumPy takes for a program."""
    return sum(map(_cost, jaxpr.eqns))


def compile_cost(jaxpr) -> float:
    """Estimated time (ns) that XLA takes to compile a program."""
    inner = (part for equation in jaxpr.eqns for part in _programs_of(equation))
    return COMPILE_COST * len(jaxpr.eqns) + sum(map(compile_cost, inner))


def _programs_of(equation) -> list:
    """Jaxprs among the parameters of an equation."""
    parts = jax.tree.leaves(list(equation.params.values()), is_leaf=lambda p: hasattr(p, "eqns"))
    jaxprs = (getattr(part, "jaxpr", part) for part in parts)
    return [part for part in jaxprs if hasattr(part, "eqns")]


def _cost(equation) -> float:
    name, params = equation.primitive.name, equation.params
    program = called_program(equation)
    if program is not None:
        return run_cost(getattr(program, "jaxpr", program))
    if name == "scan":
        return params["length"] * run_cost(params["jaxpr"].jaxpr)
    if name in LOOPS:
        return (WHILE_TRIPS if name == "while" else 1) * sum(map(run_cost, _programs_of(equation)))
    size = sum(out.aval.size for out in equation.outvars)
    if name.startswith(("reduce", "arg")):
        size = equation.invars[0].aval.size
    if name == "dot_general":
        (contracted, _), _ = params["dimension_numbers"]
        shape = equation.invars[0].aval.shape
        size += PRODUCT_COST * size * math.prod(shape[axis] for axis in contracted)
    return CALL_COST + ENTRY_COST * size


def _rule(equation) -> Callable:
    """Function of the arrays that an equation takes."""
    name, params = equation.primitive.name, equation.params
    avals = [atom.aval for atom in (*equation.invars, *equation.outvars)]
    if any(jnp.issubdtype(aval.dtype, jax.dtypes.extended) for aval in avals):
        return _as_it_is(equation)
    program = called_program(equation)
    if program is not None:
        return InterpretedProgram(program)
    if name in ELEMENTWISE:
        return ELEMENTWISE[name]
    if name in WITH_PARAMETERS:
        with contextlib.suppress(NotImplementedError):  # of rare parameters
            return WITH_PARAMETERS[name](params, *avals)
    return _as_it_is(equation)


def _as_it_is(equation) -> Callable:
    primitive, params = equation.primitive, equation.params

    def call(*arrays):
        found = primitive.bind(*map(jax.numpy.asarray, arrays), **params)
        return jax.tree.map(_to_numpy, found)

    return call


def _to_numpy(value):
    """Array of NumPy, except of a type that NumPy lacks, as a key of random numbers."""
    return value if jnp.issubdtype(value.dtype, jax.dtypes.extended) else np.asarray(value)


def _divide(a, b):
    a = np.asarray(a)  # of JAX where a derivative began outside
    if np.issubdtype(a.dtype, np.inexact):
        return a / b
    return (np.sign(a) * np.sign(b) * (np.abs(a) // np.abs(b))).astype(a.dtype)


def _select(which, *cases):
    if len(cases) == 2:
        return np.where(which, cases[1], cases[0])
    return np.choose(which, cases)


def _same(*values):
    return values[0]


ELEMENTWISE: dict[str, Callable] = {
    "add": np.add,
    "add_any": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": _divide,
    "rem": np.fmod,
    "neg": np.negative,
    "sign": np.sign,
    "abs": np.abs,
    "max": np.maximum,
    "min": np.minimum,
    "sqrt": np.sqrt,
    "rsqrt": lambda x: 1 / np.sqrt(x),
    "cbrt": np.cbrt,
    "square": np.square,
    "one_minus_square": lambda x: (1 + x) * (1 - x),
    "exp": np.exp,
    "exp2": np.exp2,
    "expm1": np.expm1,
    "log": np.log,
    "log1p": np.log1p,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "atan2": np.arctan2,
    "sinh": np.sinh,
    "cosh": np.cosh,
    "tanh": np.tanh,
    "asinh": np.arcsinh,
    "acosh": np.arccosh,
    "atanh": np.arctanh,
    "floor": np.floor,
    "ceil": np.ceil,
    "is_finite": np.isfinite,
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "xor": np.bitwise_xor,
    "not": np.invert,
    "real": np.real,
    "imag": np.imag,
    "conj": np.conj,
    "complex": lambda real, imag: real + 1j * imag,
    "clamp": lambda low, x, high: np.minimum(np.maximum(x, low), high),
    "select_n": _select,
    "stop_gradient": _same,
    "copy": _same,
}


def _reshape(params, x, out):
    return lambda value: np.reshape(value, out.shape)


def _broadcast(params, x, out):
    shape = [1] * len(out.shape)
    for axis, size in zip(params["broadcast_dimensions"], x.shape, strict=True):
        shape[axis] = size
    return lambda value: np.broadcast_to(np.reshape(value, shape), out.shape)


def _convert(params, x, out):
    drops = np.issubdtype(x.dtype, np.complexfloating) and not np.issubdtype(
        out.dtype, np.complexfloating
    )
    return lambda value: np.asarray(np.real(value) if drops else value).astype(out.dtype)


def _power(params, x, *rest):
    if "y" not in params:
        return lambda base, exponent: np.power(base, exponent).astype(rest[-1].dtype)
    exponent = params["y"]
    if exponent < 0 and not np.issubdtype(x.dtype, np.inexact):
        return lambda base: base.astype(float) ** exponent
    return {2: np.square, 1: _same}.get(exponent, lambda base: base**exponent)


def _slice(params, x, out):
    strides = params["strides"] or (1,) * len(x.shape)
    bounds = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    index = tuple(slice(*bound) for bound in bounds)
    return lambda value: value[index]


def _split(params, *_):
    ends = np.cumsum(params["sizes"])[:-1]
    return lambda value: np.split(value, ends, params["axis"])


def _unstack(params, *_):
    return lambda value: list(np.moveaxis(value, params["axis"], 0))


def _polynomial(params, *avals):
    def value(x, *coefficients):
        found = coefficients[-1]
        for coefficient in coefficients[-2::-1]:
            found = found * x + coefficient
        return np.broadcast_to(found, avals[-1].shape)

    return value


def _pad(params, x, padding, out):
    config, inner, cut, wide = params["padding_config"], [], [], []
    for (low, high, gap), size in zip(config, x.shape, strict=True):
        first, spread = max(low, 0), size + max(size - 1, 0) * gap
        wide.append(first + spread + max(high, 0))
        inner.append(slice(first, first + spread, gap + 1))
        cut.append(slice(max(-low, 0), wide[-1] - max(-high, 0)))

    def padded(value, with_):
        array = np.full(wide, with_, out.dtype)
        array[tuple(inner)] = value
        return array[tuple(cut)]

    return padded


def _iota(params, *_):
    shape, axis = params["shape"], params["dimension"]
    along = np.arange(shape[axis], dtype=params["dtype"])
    along = along.reshape([-1 if i == axis else 1 for i in range(len(shape))])
    values = np.broadcast_to(along, shape)
    return lambda: values


def _dot(params, a, b, out):
    (left, right), (batch_a, batch_b) = params["dimension_numbers"]
    free_a = [i for i in range(len(a.shape)) if i not in (*left, *batch_a)]
    free_b = [i for i in range(len(b.shape)) if i not in (*right, *batch_b)]
    batch = [a.shape[i] for i in batch_a]
    summed = math.prod(a.shape[i] for i in left)
    of_a, of_b = (*batch_a, *free_a, *left), (*batch_b, *right, *free_b)

    def product(first, second):
        first = np.transpose(first, of_a).reshape(*batch, -1, summed)
        second = np.transpose(second, of_b).reshape(*batch, summed, -1)
        return (first @ second).astype(out.dtype, copy=False).reshape(out.shape)

    if not (out.size and summed):
        return lambda *_: np.zeros(out.shape, out.dtype)
    return product


def _reduce(function):
    def rule(params, x, out):
        axes = tuple(params["axes"])
        if function in (np.sum, np.prod):
            return lambda value: function(value, axis=axes, dtype=out.dtype)
        return lambda value: function(value, axis=axes)

    return rule


def _position(function):
    def rule(params, x, out):
        (axis,) = params["axes"]
        return lambda value: function(value, axis).astype(out.dtype)

    return rule


def _accumulate(function):
    def rule(params, x, out):
        axis = params["axis"]

        def one_way(value):
            return function(value, axis, dtype=out.dtype)

        if not params["reverse"]:
            return one_way
        return lambda value: np.flip(one_way(np.flip(value, axis)), axis)

    return rule


def _sort(params, *avals):
    axis, keys = params["dimension"], params["num_keys"]

    def sorted_(*values):
        order = np.lexsort(values[:keys][::-1], axis=axis)
        return [np.take_along_axis(value, order, axis) for value in values]

    return sorted_


def _clipped_starts(starts, shape, sizes):
    pairs = zip(starts, shape, sizes, strict=True)
    return tuple(
        slice(at := int(min(max(start, 0), full - size)), at + size) for start, full, size in pairs
    )


def _dynamic_slice(params, x, *_):
    sizes = params["slice_sizes"]
    return lambda value, *starts: value[_clipped_starts(starts, x.shape, sizes)]


def _dynamic_update(params, x, update, *_):
    def updated(value, part, *starts):
        value = np.array(value)
        value[_clipped_starts(starts, x.shape, update.shape)] = part
        return value

    return updated


def _cholesky(params, *_):
    def factor(matrix):
        try:
            return np.linalg.cholesky(matrix)
        except np.linalg.LinAlgError:
            if matrix.ndim == 2:
                return np.full_like(matrix, np.nan)
            flat = [factor(one) for one in matrix.reshape(-1, *matrix.shape[-2:])]
            return np.stack(flat).reshape(matrix.shape)

    return factor


def _triangular(params, a, *_):
    def solved(matrix, right):
        matrix = np.tril(matrix) if params["lower"] else np.triu(matrix)
        if params["unit_diagonal"]:
            size = matrix.shape[-1]
            matrix = np.where(np.eye(size, dtype=bool), 1.0, matrix)
        if params["conjugate_a"]:
            matrix = np.conj(matrix)
        if params["transpose_a"]:
            matrix = matrix.mT
        if params["left_side"]:
            return _solution(matrix, right)
        return _solution(matrix.mT, right.mT).mT

    return solved


def _solution(matrix, right):
    try:
        return np.linalg.solve(matrix, right)
    except np.linalg.LinAlgError:
        return np.full_like(right, np.nan)


def _eigh(params, *_):
    if params["subset_by_index"] is not None or not params["sort_eigenvalues"]:
        raise NotImplementedError("of some eigenvalues, or in any order")

    def decomposed(matrix):
        values, vectors = np.linalg.eigh(matrix, "L" if params["lower"] else "U")
        return vectors, values

    return decomposed


def scan_counts(params) -> tuple[int, int]:
    """Number of constants of a `scan`, and number of arrays that it carries, from its parameters.

    JAX 0.12 replaced the numbers by a tree of all inputs.
    """
    if "ft_in" in params:
        constants, carried, _ = params["ft_in"].unpack()
        return len(list(constants)), len(list(carried))
    return params["num_consts"], params["num_carry"]


def _scan(params, *avals):
    body, length = InterpretedProgram(params["jaxpr"]), params["length"]
    constants, carried = scan_counts(params)
    order = range(length)[::-1] if params["reverse"] else range(length)
    stacked = params["jaxpr"].out_avals[carried:]

    def loop(*arrays):
        fixed, inputs = arrays[:constants], arrays[constants + carried :]
        carry = arrays[constants : constants + carried]
        outputs = [np.empty((length, *aval.shape), aval.dtype) for aval in stacked]
        for i in order:
            found = body(*fixed, *carry, *[part[i] for part in inputs])
            carry = found[:carried]
            for output, value in zip(outputs, found[carried:], strict=True):
                output[i] = value
        return [*carry, *outputs]

    return loop


def _along_first(mask, array):
    """A mask over the first axes of an array, to be broadcast along the others."""
    return np.reshape(mask, (*np.shape(mask), *[1] * (np.ndim(array) - np.ndim(mask))))


def _while(params, *_):
    condition, body = (
        InterpretedProgram(params["cond_jaxpr"]),
        InterpretedProgram(params["body_jaxpr"]),
    )
    of_condition, of_body = params["cond_nconsts"], params["body_nconsts"]

    def loop(*arrays):
        first, rest = arrays[:of_condition], arrays[of_condition:]
        second, carry = rest[:of_body], rest[of_body:]
        while np.any(go_on := condition(*first, *carry)[0]):
            found = body(*second, *carry)
            if np.ndim(go_on):  # a batch of loops, each of which ends by itself
                pairs = zip(found, carry, strict=True)
                found = [np.where(_along_first(go_on, new), new, old) for new, old in pairs]
            carry = found
        return list(carry)

    return loop


def _cond(params, *_):
    branches = [InterpretedProgram(branch) for branch in params["branches"]]
    last = len(branches) - 1
    return lambda which, *arrays: branches[min(max(int(which), 0), last)](*arrays)


def _platform_index(params, *_):
    platforms = params["platforms"]
    own = jax.default_backend()
    found = [i for i, names in enumerate(platforms) if names and own in names]
    index = np.int32(found[0] if found else platforms.index(None))
    return lambda: index


def _linear_solve(params, *_):
    lengths, solve = params["const_lengths"], InterpretedProgram(params["jaxprs"].solve)
    first = lengths.matvec + lengths.vecmat
    last = first + lengths.solve + lengths.transpose_solve

    def solution(*arrays):
        return solve(*arrays[first : first + lengths.solve], *arrays[last:])

    return solution


WITH_PARAMETERS: dict[str, Callable] = {
    "reshape": _reshape,
    "squeeze": _reshape,
    "broadcast_in_dim": _broadcast,
    "convert_element_type": _convert,
    "pow": _power,
    "integer_pow": _power,
    "transpose": lambda params, *_: lambda value: np.transpose(value, params["permutation"]),
    "rev": lambda params, *_: lambda value: np.flip(value, params["dimensions"]),
    "slice": _slice,
    "concatenate": lambda params, *_: lambda *parts: np.concatenate(parts, params["dimension"]),
    "stack": lambda params, *_: lambda *parts: np.stack(parts, params["axis"]),
    "tile": lambda params, *_: lambda value: np.tile(value, params["reps"]),
    "split": _split,
    "unstack": _unstack,
    "polynomial": _polynomial,
    "pad": _pad,
    "iota": _iota,
    "dot_general": _dot,
    "reduce_sum": _reduce(np.sum),
    "reduce_prod": _reduce(np.prod),
    "reduce_max": _reduce(np.max),
    "reduce_min": _reduce(np.min),
    "reduce_and": _reduce(np.all),
    "reduce_or": _reduce(np.any),
    "argmax": _position(np.argmax),
    "argmin": _position(np.argmin),
    "cumsum": _accumulate(np.add.accumulate),
    "cumprod": _accumulate(np.multiply.accumulate),
    "cummax": _accumulate(np.maximum.accumulate),
    "cummin": _accumulate(np.minimum.accumulate),
    "sort": _sort,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update,
    "gather": gather,
    "scatter": scatter(None),
    "scatter-add": scatter(np.add),
    "scatter-sub": scatter(np.subtract),
    "scatter-mul": scatter(np.multiply),
    "scatter-max": scatter(np.maximum),
    "scatter-min": scatter(np.minimum),
    "cholesky": _cholesky,
    "triangular_solve": _triangular,
    "eigh": _eigh,
    "scan": _scan,
    "while": _while,
    "cond": _cond,
    "platform_index": _platform_index,
    "custom_linear_solve": _linear_solve,
    "optimization_barrier": lambda *_: lambda *values: list(values),
}
