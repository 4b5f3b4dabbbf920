"""Array functions for NumPy and JAX: concrete numbers are computed, traced ones are recorded.

`xp` has the functions that `numpy` and `jax.numpy` share. A function of `xp` is that of JAX if one
of its arguments is an array of JAX (in `jit`, `grad` or `vmap` a tracer), else that of NumPy, which
needs no compiler: the same lines serve the first answer and the compiled, differentiated program.
The other functions here serve where the two libraries differ: indexed updates, loops, branches.
"""

import functools
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.runtime import lapack, vectorised
from jaxbeam.runtime.vectorised import VectorisedArray


class Module(eqx.Module):
    """`equinox.Module` whose methods are those of Python, found in a hundredth of the time.

    Those of Equinox are trees of arrays themselves, so that `jax.jit` may be given one; with them
    a run of two loads takes 5 % longer.
    """

    if not TYPE_CHECKING:  # a checker of types takes it for attributes of any name
        __getattribute__ = object.__getattribute__


_NOT_JAX = {np.ndarray, VectorisedArray, np.float64, np.int64, np.bool_, float, int, bool, str}
_NOT_JAX |= {type(None), slice}
MAX_TRIANGLE_ROWS = 64  # largest triangular system that is solved as a general one


def is_jax(value: Any) -> bool:
    """Whether a value, or any in a nested list or tuple, is an array of JAX."""
    if type(value) in _NOT_JAX:
        return False
    if isinstance(value, (list, tuple)):  # a union of types would be made anew in each call
        return any(map(is_jax, value))
    return isinstance(value, jax.Array)


def is_numpy(value: Any) -> bool:
    """Whether an array is one of NumPy: neither of JAX nor a `VectorisedArray`."""
    return not is_jax(value) and not isinstance(value, VectorisedArray)


def any_jax(*trees: Any) -> bool:
    """Whether any leaf of some trees is an array of JAX."""
    return any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(trees))


def any_traced(*trees: Any) -> bool:
    """Whether any leaf of some trees is traced by JAX."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


class _Product(NamedTuple):
    """Subscripts of `einsum` for two arrays as a product of matrices.

    `first` and `second` are orders of the axes: axes of both that are in the result (`batch` in
    number), axes of one array only (`left` of the first), and axes that are summed. `output` is the
    order of the axes of the result.
    """

    first: tuple[int, ...]
    second: tuple[int, ...]
    batch: int
    left: int
    output: tuple[int, ...]


@functools.cache
def _product(subscripts: str) -> _Product | None:
    """Product of matrices for subscripts of `einsum`; None for others than such products."""
    inputs, _, output = subscripts.partition("->")
    first, comma, second = inputs.partition(",")
    if not comma or "," in second or "." in subscripts or not output:
        return None
    shared = [label for label in first if label in second]
    batch = [label for label in shared if label in output]
    summed = [label for label in shared if label not in output]
    left = [label for label in first if label not in second]
    right = [label for label in second if label not in first]
    if set(left + right) - set(output):
        return None
    found = batch + left + right
    return _Product(
        tuple(map(first.index, batch + left + summed)),
        tuple(map(second.index, batch + summed + right)),
        len(batch),
        len(left),
        tuple(map(found.index, output)),
    )


def _einsum(subscripts: str, *operands: np.ndarray) -> np.ndarray | np.generic:
    """`numpy.einsum`; of two operands as products of matrices, several times as fast."""
    product = _product(subscripts)
    if product is None:
        return np.einsum(subscripts, *operands)
    a, b = operands[0].transpose(product.first), operands[1].transpose(product.second)
    i, j = product.batch, product.batch + product.left
    k = i + a.ndim - j  # of the first axis of `b` that is not summed
    batch, left, right = a.shape[:i], a.shape[i:j], b.shape[k:]
    summed = math.prod(a.shape[j:])
    rows = a.reshape(*batch, math.prod(left), summed)
    columns = b.reshape(*batch, summed, math.prod(right))
    return (rows @ columns).reshape(batch + left + right).transpose(product.output)


def _asarray(value: Any, dtype: Any = None) -> Any:
    """`numpy.asarray` that also takes a `VectorisedArray`."""
    if isinstance(value, VectorisedArray):
        return value if dtype is None else value.astype(dtype)
    return np.asarray(value, dtype)


def _array(value: Any, *args: Any, **kwargs: Any) -> Any:
    """`numpy.array` that also takes a list of `VectorisedArray`s."""
    if isinstance(value, list) and any(isinstance(part, VectorisedArray) for part in value):
        return np.stack(value)
    return np.array(value, *args, **kwargs)


class _Namespace:
    """Namespace of functions that call NumPy or JAX, by the type of their arguments."""

    def __init__(self, concrete, traced):
        self._concrete, self._traced = concrete, traced

    def __getattr__(self, name):
        concrete = getattr(self._concrete, name)
        traced: Any = lapack if name == "linalg" else getattr(self._traced, name)
        concrete = {"einsum": _einsum, "array": _array, "asarray": _asarray}.get(name, concrete)
        if name in ("linalg", "fft"):
            attribute: Any = _Namespace(concrete, traced)
        elif isinstance(concrete, type) or not callable(concrete):
            attribute = concrete
        else:

            @functools.wraps(concrete)
            def call(*args, **kwargs):
                for value in args:
                    if type(value) not in _NOT_JAX and is_jax(value):
                        return traced(*args, **kwargs)
                if kwargs and any(map(is_jax, kwargs.values())):
                    return traced(*args, **kwargs)
                return concrete(*args, **kwargs)

            attribute = call

        setattr(self, name, attribute)  # found without this method from now on
        return attribute


if TYPE_CHECKING:
    xp = jnp
    Array = jax.Array
    # A number of a case: an array when read, and given as whatever its converter takes, which a
    # checker of types cannot see (mypy knows no converters).
    Number = jax.Array | Any
else:
    xp = _Namespace(np, jnp)

    class _OfEitherLibrary(type):
        def __instancecheck__(cls, value) -> bool:
            return isinstance(value, (jax.Array, np.ndarray, np.generic, VectorisedArray))

    class Array(metaclass=_OfEitherLibrary):
        """An array of JAX or NumPy. One class, as a union of three takes jaxtyping longer."""

    Number = Array


def array_namespace(*values: Any) -> Any:
    """`jax.numpy` or `numpy`, as `xp` chooses for some values; for loops of many small calls."""
    return jnp if any(map(is_jax, values)) else np


def take(array, index) -> Any:
    """Entries at an index along the first axis; the index may be traced in an array of NumPy."""
    if isinstance(index, VectorisedArray) and not isinstance(array, VectorisedArray):
        return vectorised.take(array, index)
    return jnp.asarray(array)[index] if is_jax(index) else array[index]


def set_at(array, index, value) -> Any:
    """Copy of an array with the entries at an index replaced."""
    if is_jax(array) or is_jax(index) or is_jax(value):
        return jnp.asarray(array, jnp.result_type(array, value)).at[index].set(value)
    if isinstance(array, VectorisedArray) or isinstance(value, VectorisedArray):
        return vectorised.set_at(array, index, value)
    array = np.array(array, np.result_type(array, value))
    array[index] = value
    return array


def add_at(array, index, value) -> Any:
    """Copy of an array with a value added at an index; values at repeated indices accumulate."""
    if is_jax(array) or is_jax(index) or is_jax(value):
        return jnp.asarray(array, jnp.result_type(array, value)).at[index].add(value)
    array = np.array(array, np.result_type(array, value))
    parts = index if isinstance(index, tuple) else (index,)
    if all(isinstance(part, slice | int) or part is Ellipsis for part in parts):
        array[index] += value  # no index is repeated; ten times as fast
    else:
        np.add.at(array, index, value)
    return array


def with_blocks(shape: tuple[int, ...], blocks) -> Any:
    """Array of zeros of a shape, with some blocks (pairs of index and values) set."""
    blocks = list(blocks)
    array: Any = zeros(shape, [values for _, values in blocks])
    for index, values in blocks:
        if is_jax(array):
            array = array.at[index].set(values)
        else:
            array[index] = values
    return array


def put(array, index, values) -> Any:
    """Copy of an array with the rows at some indices replaced; indices beyond the end are left out.

    One index at most may lie within the array more than once.
    """
    if is_jax(array) or is_jax(index) or is_jax(values):
        return jnp.asarray(array).at[index].set(values, mode="drop")
    array, inside = np.array(array), np.asarray(index) < len(array)
    array[np.asarray(index)[inside]] = np.asarray(values)[inside]
    return array


def checkpoint(function: Callable, policy: Callable) -> Callable:
    """`jax.checkpoint` of a function; a call without arrays of JAX is direct."""
    checkpointed = jax.checkpoint(function, policy=policy)

    def call(*args):
        return checkpointed(*args) if any_jax(args) else function(*args)

    return call


def to_numpy(tree) -> Any:
    """Tree with its concrete arrays of JAX converted to NumPy; traced ones are unchanged."""

    def converted(leaf):
        is_concrete = isinstance(leaf, jax.Array) and not isinstance(leaf, jax.core.Tracer)
        return np.asarray(leaf) if is_concrete else leaf

    return jax.tree.map(converted, tree)


def stop_gradient(tree) -> Any:
    """Tree of the same numbers with zero derivatives."""
    return jax.lax.stop_gradient(tree) if any_jax(tree) else tree


def zeros(shape: tuple[int, ...], like: Any) -> Any:
    """Array of zeros, of JAX if any leaf of `like` is; to start a loop over such numbers."""
    return (jnp if any_jax(like) else np).zeros(shape)


def scan(step: Callable, carry, inputs=None, length: int | None = None) -> Any:
    """`jax.lax.scan`: final carry and stacked outputs of a loop over the first axis of inputs.

    Concrete numbers are looped over in Python, unless `step` closes over arrays of JAX.
    """
    if any_jax(carry, inputs):
        return jax.lax.scan(step, carry, inputs, length)
    leaves, structure = jax.tree.flatten(inputs)
    start, outputs = carry, []
    for i in range(len(leaves[0]) if leaves else length):
        carry, output = step(carry, structure.unflatten([leaf[i] for leaf in leaves]))
        if i == 0 and any_jax(carry, output):
            return jax.lax.scan(step, start, inputs, length)
        outputs.append(output)
    return carry, jax.tree.map(lambda *parts: np.stack(parts), *outputs)


def map_elements(function: Callable, inputs) -> Any:
    """`jax.lax.map`: stacked results of a function for each element along the first axis."""
    return scan(lambda _, element: (None, function(element)), None, inputs)[1]


def while_loop(condition: Callable, step: Callable, carry) -> Any:
    """`jax.lax.while_loop`; concrete numbers are looped over in Python."""
    start, count = carry, 0
    # Numbers that are concrete at the start and after one step stay concrete.
    while count > 1 or not any_jax(carry):
        if is_jax(going_on := condition(carry)):
            break
        if not going_on:
            return carry
        carry, count = step(carry), count + 1
    return jax.lax.while_loop(condition, step, start)


def cond(predicate, if_true: Callable, if_false: Callable, *operands) -> Any:
    """`jax.lax.cond`; with a concrete predicate only its branch is called."""
    if is_jax(predicate):
        return jax.lax.cond(predicate, if_true, if_false, *operands)
    return if_true(*operands) if predicate else if_false(*operands)


class custom_jvp:
    """`jax.custom_jvp` of a function; concrete numbers call the function itself."""

    def __init__(self, function: Callable):
        self.function, self.traced = function, jax.custom_jvp(function)
        functools.update_wrapper(self, function)

    def __call__(self, *args) -> Any:
        return self.traced(*args) if any_jax(args) else self.function(*args)

    def defjvp(self, rule: Callable) -> Callable:
        """Set the rule of derivatives; see `jax.custom_jvp`."""
        return self.traced.defjvp(rule)


def not_differentiated(value: Any, reason: str) -> Any:
    """Value that raises ValueError, with a reason, where it is differentiated."""
    if not is_jax(value):
        return value

    @jax.custom_jvp
    def itself(value):
        return value

    @itself.defjvp
    def _(primals, tangents):
        raise ValueError(reason)

    # Batched numbers may hold an array of NumPy, which `custom_jvp` refuses; a sum is one of JAX.
    return itself(value + 0)


@functools.cache
def _refused_change():
    """Primitive for the change of what has no derivative: NaN, and ValueError in reverse."""
    from jax.interpreters import ad, batching, mlir  # late: not part of JAX in a browser

    def _refuse(cotangent, *_, reason):
        raise ValueError(reason)

    def unknown(change, reason):
        return change * jnp.nan

    primitive = jax.extend.core.Primitive("refused_change")
    primitive.def_impl(unknown)
    primitive.def_abstract_eval(lambda change, reason: change)
    mlir.register_lowering(primitive, mlir.lower_fun(unknown, multiple_results=False))
    ad.deflinear2(primitive, _refuse)
    batching.defvectorized(primitive)
    return primitive


def without_derivative(value: Any, numbers: Any, reason: str) -> Any:
    """A value that depends on a tree of numbers in steps or at random, so that none is its slope.

    Its derivatives by them are NaN in forward mode, where it may stand beside others that have one;
    in reverse they raise ValueError, with a reason.
    """
    numbers = [leaf for leaf in jax.tree.leaves(numbers) if isinstance(leaf, jax.core.Tracer)]

    @jax.custom_jvp
    def itself(value, numbers):
        return value

    @itself.defjvp
    def _(primals, tangents):
        parts = [jnp.sum(part) for part in tangents[1] if part.dtype != jax.dtypes.float0]
        change = _refused_change().bind(sum(parts, jnp.zeros(())), reason=reason)
        return primals[0], jnp.broadcast_to(change, primals[0].shape)

    return itself(jnp.asarray(value), numbers) if numbers else value


def fori_loop(start: int, end: int, step: Callable, carry) -> Any:
    """`jax.lax.fori_loop`; concrete numbers are looped over in Python."""
    return scan(lambda carry, i: (step(i, carry), None), carry, np.arange(start, end))[0]


def vmap(function: Callable, in_axes: Any = 0, out_axes: int = 0) -> Callable:
    """`jax.vmap`; concrete arguments are looped over in Python (for many see `vectorised`)."""

    def mapped(*args):
        leaves, structure = jax.tree.flatten(args)
        if any(map(is_jax, leaves)):
            return jax.vmap(function, in_axes, out_axes)(*args)
        if any(isinstance(leaf, VectorisedArray) for leaf in leaves):
            return vectorised.vectorised(function, out_axes)(*args)
        if isinstance(in_axes, tuple):
            pairs = zip(args, in_axes, strict=True)
            axes = [axis for arg, axis in pairs for _ in jax.tree.leaves(arg)]
        else:
            axes = [in_axes] * len(leaves)
        leaves = list(zip(leaves, axes, strict=True))
        size = next(leaf.shape[axis] for leaf, axis in leaves if axis is not None)
        if size == 0:
            shapes = jax.eval_shape(jax.vmap(function, in_axes, out_axes), *args)
            return jax.tree.map(lambda part: np.zeros(part.shape, part.dtype), shapes)
        results = []
        for i in range(size):
            element = structure.unflatten([_at(leaf, axis, i) for leaf, axis in leaves])
            result, result_structure = jax.tree.flatten(function(*element))
            if i == 0 and any(map(is_jax, result)):  # `function` closes over arrays of JAX
                return jax.vmap(function, in_axes, out_axes)(*args)
            results.append(result)
        parts = zip(*results, strict=True)
        return result_structure.unflatten([_stack(part, out_axes) for part in parts])

    return mapped


def _at(leaf, axis, i):
    """Entry of a leaf at an index along an axis; the whole leaf if the axis is None."""
    if axis is None:
        return leaf
    return leaf[..., i] if axis == -1 else np.take(leaf, i, axis)


def _stack(parts, axis):
    """`numpy.stack`, with an index for a single part, which is ten times as fast."""
    if len(parts) == 1 and axis == -1:
        return np.asarray(parts[0])[..., None]
    return np.stack(parts, axis)


def optimization_barrier(tree) -> Any:
    """`jax.lax.optimization_barrier`: values that XLA does not compute twice."""
    return jax.lax.optimization_barrier(tree) if any_jax(tree) else tree


def solve(matrix, right) -> Any:
    """Solutions of linear systems (..., row, column); not finite where the matrix is singular."""
    if is_jax(matrix) or is_jax(right):
        return lapack.solve(matrix, right)
    try:
        return np.linalg.solve(matrix, right)
    except np.linalg.LinAlgError:  # of any matrix of a stack
        singular = np.linalg.matrix_rank(matrix) < matrix.shape[-1]
        regular = np.where(singular[..., None, None], np.eye(matrix.shape[-1]), matrix)
        solution = np.linalg.solve(regular, right)
        return np.where(singular[..., None, None] if right.ndim > 1 else singular, np.nan, solution)


def solve_conditioned(matrix, right) -> Any:
    """`solve` of many well-conditioned systems; by their inverses where any number is traced."""
    if is_jax(matrix):
        return lapack.inverses(matrix) @ right
    if is_jax(right):
        return solve(matrix, np.eye(matrix.shape[-1])) @ right
    return solve(matrix, right)


def solve_triangular(matrix, right, lower: bool, transposed: bool = False) -> Any:
    """Solution of a triangular system, or with `transposed` of that with the transposed matrix."""
    if is_jax(matrix) or is_jax(right):
        return lapack.solve_triangular(matrix, right, lower, transposed)
    if not right.size:
        return np.zeros_like(right)
    if right.ndim > 1:  # without scipy, which takes 0.1 s to import
        matrix, lower = (matrix.T, not lower) if transposed else (matrix, lower)
        return _solve_by_halves(matrix, right, lower)
    from scipy.linalg import lapack as scipy_lapack

    # LAPACK itself: the function of scipy takes ten times as long as a small system. In the order
    # of Fortran its matrix is the transposed one.
    solution, singular = scipy_lapack.dtrtrs(matrix.T, right, not lower, not transposed)
    return np.full_like(solution, np.nan) if singular else solution


def _solve_by_halves(matrix, right, lower: bool):
    """`solve_triangular` in NumPy: 528 rows take half the time of a general system."""
    rows = len(matrix)
    if rows <= MAX_TRIANGLE_ROWS:
        # Reversed, a lower triangle is an upper one, of which elimination changes nothing.
        return solve(matrix[::-1, ::-1], right[::-1])[::-1] if lower else solve(matrix, right)
    halves = [slice(rows // 2), slice(rows // 2, rows)]
    first, last = halves if lower else halves[::-1]
    solution = np.empty(right.shape, np.result_type(matrix, right))
    solution[first] = _solve_by_halves(matrix[first, first], right[first], lower)
    left = right[last] - matrix[last, first] @ solution[first]
    solution[last] = _solve_by_halves(matrix[last, last], left, lower)
    return solution


def solve_tridiagonal(lower, diagonal, upper, right) -> Any:
    """Solution of a tridiagonal system (n,), with n - 1 entries below and above the diagonal."""
    if is_jax((lower, diagonal, upper, right)):
        return lapack.solve_tridiagonal(lower, diagonal, upper, right)
    import scipy.linalg

    bands = np.stack([np.append(0.0, upper), diagonal, np.append(lower, 0.0)])
    return scipy.linalg.solve_banded((1, 1), bands, right)


def cholesky(matrix) -> Any:
    """Lower triangular factor of a matrix; nan where it is not positive definite."""
    if is_jax(matrix):
        return lapack.cholesky(matrix)
    try:
        return np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return np.tril(np.full_like(matrix, np.nan))


def ravel_pytree(tree) -> tuple[Any, Callable]:
    """`jax.flatten_util.ravel_pytree`: a tree as one vector, and the function that unpacks it.

    The function also unpacks columns (entry, column), as leaves with a last axis.
    """
    leaves, structure = jax.tree.flatten(tree)
    leaves = [leaf if is_jax(leaf) else np.asarray(leaf) for leaf in leaves]
    ends = np.cumsum([leaf.size for leaf in leaves])

    def unpack(vector):
        parts = zip(leaves, ends, strict=True)
        return structure.unflatten(
            vector[end - leaf.size : end]
            .reshape((*leaf.shape, *vector.shape[1:]))
            .astype(leaf.dtype)
            for leaf, end in parts
        )

    return xp.concatenate([xp.zeros(0), *(xp.ravel(leaf) for leaf in leaves)]), unpack


def block_diag(*blocks) -> Any:
    """Block-diagonal matrix."""
    if any(map(is_jax, blocks)):
        return jax.scipy.linalg.block_diag(*blocks)
    sizes = np.array([block.shape for block in blocks])
    matrix = np.zeros(sizes.sum(axis=0))
    for block, (row, column) in zip(blocks, np.cumsum(sizes, axis=0) - sizes, strict=True):
        matrix[row : row + block.shape[0], column : column + block.shape[1]] = block
    return matrix


def slice_in_dim(array, start: int | None, end: int | None, axis: int) -> Any:
    """Slice along one axis, which XLA compiles several times as fast as an index of JAX."""
    if isinstance(array, jax.Array):
        return jax.lax.slice_in_dim(array, start, end, axis=axis)
    return array[(slice(None),) * (axis % array.ndim) + (slice(start, end),)]


def index_in_dim(array, index, axis: int = 0, keepdims: bool = True) -> Any:
    """Entry at an index along one axis."""
    if is_jax(array) or is_jax(index):
        return jax.lax.dynamic_index_in_dim(array, index, axis, keepdims)
    index = slice(index, index + 1) if keepdims else index
    return array[(slice(None),) * axis + (index,)]


def collapse(array, start: int, end: int) -> Any:
    """Array with the axes from `start` to before `end` merged into one."""
    shape = array.shape
    return array.reshape(*shape[:start], math.prod(shape[start:end]), *shape[end:])


def searchsorted(ascending, values) -> Any:
    """Number of ascending entries less than or equal to each value; for few entries."""
    if is_jax(ascending) or is_jax(values):
        return jnp.searchsorted(ascending, values, side="right", method="compare_all")
    return np.searchsorted(ascending, values, side="right")
