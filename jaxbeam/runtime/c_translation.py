"""Programs of JAX as C: a jaxpr of static shapes becomes loops over arrays.

Where runs part, both branches are computed and each run chooses; a loop turns until none goes on.
Primitives that are not among the rules here raise `UntranslatedError`, which names them. A rule
takes a writer, the parameters, the inputs, and kind and shape of each result.
"""

import math
from collections.abc import Callable
from typing import ClassVar

import numpy as np
from jax.lax import GatherScatterMode

from jaxbeam.runtime.c_writer import (
    ELEMENTWISE,
    PROMOTED,
    TYPES,
    CArray,
    UntranslatedError,
    Writer,
    clipped,
    elementwise,
    filled,
    flat_index,
    select,
    strides_of,
)
from jaxbeam.runtime.interpreter import scan_counts


def _convert(writer: Writer, params, values, outs):
    return writer.converted(values[0], outs[0][0])


def _reshape(writer, params, values, outs):
    return values[0]._replace(shape=outs[0][1])


def _broadcast(writer: Writer, params, values, outs):
    value, (_, shape) = values[0], outs[0]
    if value.size == math.prod(shape):
        return value._replace(shape=shape)
    strides = [0] * len(shape)
    own = zip(params["broadcast_dimensions"], value.shape, strides_of(value.shape), strict=True)
    for axis, size, stride in own:
        strides[axis] = stride if size > 1 else 0
    return writer.strided(value, shape, strides)


def _transpose(writer: Writer, params, values, outs):
    strides = [strides_of(values[0].shape)[axis] for axis in params["permutation"]]
    return writer.strided(values[0], outs[0][1], strides)


def _slice(writer: Writer, params, values, outs):
    own, steps = strides_of(values[0].shape), params["strides"] or (1,) * len(values[0].shape)
    first = sum(s * start for s, start in zip(own, params["start_indices"], strict=True))
    strides = [s * step for s, step in zip(own, steps, strict=True)]
    return writer.strided(values[0], outs[0][1], strides, first)


def _reverse(writer: Writer, params, values, outs):
    value, strides, first = values[0], strides_of(values[0].shape), 0
    for axis in params["dimensions"]:
        first += strides[axis] * (value.shape[axis] - 1)
        strides[axis] = -strides[axis]
    return writer.strided(value, value.shape, strides, first)


def _place(writer: Writer, found: CArray, part: CArray, strides, first) -> None:
    """Copy an array to a part of another."""
    with writer.loops(part.shape) as index:
        to = found.at(flat_index(index, strides, first))
        entry = part.at(flat_index(index, strides_of(part.shape)), found.varying)
        writer.line(f"{to} = {entry};")


def _concatenate(writer: Writer, params, values, outs):
    kind, shape = outs[0]
    axis, first = params["dimension"], 0
    found = writer.declare(kind, shape, any(value.varying for value in values))
    strides = strides_of(shape)
    for value in values:
        _place(writer, found, value, strides, first)
        first += value.shape[axis] * strides[axis]
    return found


def _stack(writer: Writer, params, values, outs):
    axis = params.get("axis", params.get("dimension", 0))
    parts = []
    for value in values:
        shape = (*value.shape[:axis], 1, *value.shape[axis:])
        parts.append(value._replace(shape=shape))
    return _concatenate(writer, {"dimension": axis}, parts, outs)


def _tile(writer: Writer, params, values, outs):
    value, (_, shape) = values[0], outs[0]
    repeats = params["reps"]
    wide = [n for pair in zip(repeats, value.shape, strict=True) for n in pair]
    strides = [n for stride in strides_of(value.shape) for n in (0, stride)]
    return writer.strided(value, wide, strides)._replace(shape=shape)


def _pad(writer: Writer, params, values, outs):
    value, padding = values
    kind, shape = outs[0]
    config, strides, first = params["padding_config"], strides_of(shape), 0
    if any(low < 0 or high < 0 for low, high, _ in config):
        raise UntranslatedError("pad by less than nothing")
    found = writer.each("{}", kind, shape, [padding], value.varying or padding.varying)
    for (low, _, gap), axis in zip(config, range(len(shape)), strict=True):
        first += low * strides[axis]
        strides[axis] *= gap + 1
    _place(writer, found, value, strides, first)
    return found


def _split(writer: Writer, params, values, outs):
    value, axis, first, found = values[0], params["axis"], 0, []
    strides = strides_of(value.shape)
    for _, shape in outs:
        found.append(writer.strided(value, shape, strides, first))
        first += shape[axis] * strides[axis]
    return found


def _unstack(writer: Writer, params, values, outs):
    value, axis, shape = values[0], params["axis"], outs[0][1]
    strides = strides_of(value.shape)
    step, own = strides[axis], [*strides[:axis], *strides[axis + 1 :]]
    if axis == 0:  # parts of the array itself
        return [
            value._replace(shape=shape, name=f"({value.name} + {i * step})")
            for i in range(len(outs))
        ]
    return [writer.strided(value, shape, own, i * step) for i in range(len(outs))]


def _polynomial(writer: Writer, params, values, outs):
    x, *coefficients = values
    text = f"{{{len(coefficients)}}}"
    for power in range(len(coefficients) - 1, 0, -1):
        text = f"({text} * {{0}} + {{{power}}})"
    (kind, shape), varying = outs[0], any(value.varying for value in values)
    return writer.each(text, kind, shape, [x, *coefficients], varying)


def _iota(writer: Writer, params, values, outs):
    kind, shape = outs[0]
    found = writer.declare(kind, shape, False)
    with writer.loops(shape) as index:
        at = flat_index(index, strides_of(shape))
        writer.line(f"{found.at(at)} = {index[params['dimension']]};")
    return found


def _reduce(name: str, start: str):
    """Reduction along axes by an operation on two numbers, from a first one."""

    def rule(writer: Writer, params, values, outs):
        value, (kind, shape) = values[0], outs[0]
        axes, own = params["axes"], strides_of(value.shape)
        kept = [axis for axis in range(len(own)) if axis not in axes]
        found, text = writer.declare(kind, shape, value.varying), elementwise(name, params)
        assert text is not None
        own_start = start.replace("INFINITY", "INT64_MAX") if kind == "i" else start
        first = PROMOTED[kind].format(own_start) if value.varying else own_start
        with writer.loops([value.shape[axis] for axis in kept]) as index:
            at = found.at(flat_index(index, strides_of(shape)))
            writer.line(f"{at} = {first};")
            with writer.loops([value.shape[axis] for axis in axes]) as along:
                place = flat_index([*index, *along], [own[axis] for axis in (*kept, *axes)])
                combined = text(kind, value.varying).format(at, value.at(place))
                writer.line(f"{at} = {combined};")
        return found

    return rule


def _position(sign: str):
    """First place of the largest or smallest along an axis."""

    def rule(writer: Writer, params, values, outs):
        value, (kind, shape), (axis,) = values[0], outs[0], params["axes"]
        found, own = writer.declare(kind, shape, value.varying), strides_of(value.shape)
        kept = [one for one in range(len(own)) if one != axis]
        best = writer.declare(value.kind, (), value.varying)
        with writer.loops([value.shape[one] for one in kept]) as index:
            at = found.at(flat_index(index, strides_of(shape)))
            first = flat_index(index, [own[one] for one in kept])
            writer.line(f"{at} = {PROMOTED['i'].format(0) if value.varying else 0};")
            writer.line(f"{best.at(0)} = {value.at(first)};")
            i = writer.new_name("i")
            with writer.block(f"for (int64_t {i} = 1; {i} < {value.shape[axis]}; {i}++)"):
                entry = value.at(f"{first} + {i} * {own[axis]}")
                better = f"{entry} {sign} {best.at(0)}"
                if value.varying:
                    choose = "choose" if value.kind == "d" else "either"
                    writer.line(f"{at} = either({better}, whole({i}), {at});")
                    writer.line(f"{best.at(0)} = {choose}({better}, {entry}, {best.at(0)});")
                else:
                    writer.line(f"if ({better}) {at} = {i}, {best.at(0)} = {entry};")
        return found

    return rule


def _dot(writer: Writer, params, values, outs):
    (a, b), (kind, shape) = values, outs[0]
    if kind != "d":
        raise UntranslatedError("dot_general of whole numbers")
    (left, right), (batch_a, batch_b) = params["dimension_numbers"]
    free_a = [axis for axis in range(len(a.shape)) if axis not in (*left, *batch_a)]
    free_b = [axis for axis in range(len(b.shape)) if axis not in (*right, *batch_b)]
    own_a, own_b = strides_of(a.shape), strides_of(b.shape)
    found = writer.declare(kind, shape, a.varying or b.varying)
    outer = [*(a.shape[i] for i in batch_a), *(a.shape[i] for i in free_a)]
    outer += [b.shape[i] for i in free_b]
    zero = PROMOTED["d"].format("0.0") if found.varying else "0"
    with writer.loops(outer) as index:
        of_batch, rest = index[: len(batch_a)], index[len(batch_a) :]
        of_a, of_b = rest[: len(free_a)], rest[len(free_a) :]
        total = writer.new_name("s")
        writer.line(f"{found.type} {total} = {zero};")
        with writer.loops([a.shape[i] for i in left]) as along:
            first = [*of_batch, *of_a, *along], [own_a[i] for i in (*batch_a, *free_a, *left)]
            second = [*of_batch, *of_b, *along], [own_b[i] for i in (*batch_b, *free_b, *right)]
            writer.line(f"{total} += {a.at(flat_index(*first))} * {b.at(flat_index(*second))};")
        writer.line(f"{found.at(flat_index(index, strides_of(shape)))} = {total};")
    return found


def _dynamic_slice(writer: Writer, params, values, outs):
    value, starts = values[0], values[1:]
    kind, shape = outs[0]
    parted = any(start.varying for start in starts)
    found, own = writer.declare(kind, shape, parted or value.varying), strides_of(value.shape)
    with writer.lanes(parted) as (lane,):
        terms = ["0"]
        for start, full, size, stride in zip(starts, value.shape, shape, own, strict=True):
            if full > size:
                entry = start.at(0) + (f"[{lane}]" if start.varying else "")
                terms.append(f"{clipped(entry, full - size)} * {stride}")
        first = writer.new_name("a")
        writer.line(f"const int64_t {first} = {' + '.join(terms)};")
        with writer.loops(shape) as index:
            to = found.at(flat_index(index, strides_of(shape)))
            entry = value.at(flat_index(index, own, first))
            entry = _lane(entry, parted and value.varying, lane)
            writer.line(f"{_lane(to, parted, lane)} = {entry};")
    return found


def _lane(entry: str, parted: bool, lane: str) -> str:
    return f"{entry}[{lane}]" if parted else entry


def _dynamic_update(writer: Writer, params, values, outs):
    value, part, starts = values[0], values[1], values[2:]
    parted = any(start.varying for start in starts)
    found = writer.declare(value.kind, value.shape, parted or value.varying or part.varying)
    writer.copy(found, value)
    own = strides_of(value.shape)
    with writer.lanes(parted) as (lane,):
        terms = ["0"]
        for start, full, size, stride in zip(starts, value.shape, part.shape, own, strict=True):
            if full > size:
                entry = _lane(start.at(0), start.varying, lane)
                terms.append(f"{clipped(entry, full - size)} * {stride}")
        first = writer.new_name("a")
        writer.line(f"const int64_t {first} = {' + '.join(terms)};")
        with writer.loops(part.shape) as index:
            to = _lane(found.at(flat_index(index, own, first)), parted, lane)
            at = flat_index(index, strides_of(part.shape))
            entry = part.at(at, found.varying and not parted)
            writer.line(f"{to} = {_lane(entry, parted and part.varying, lane)};")
    return found


def _gather(writer: Writer, params, values, outs):
    value, places = values
    kind, shape = outs[0]
    numbers, sizes = params["dimension_numbers"], params["slice_sizes"]
    parted, own = places.varying, strides_of(value.shape)
    fills = params["mode"] == GatherScatterMode.FILL_OR_DROP
    found = writer.declare(kind, shape, value.varying or parted)
    dropped = {*numbers.collapsed_slice_dims, *numbers.operand_batching_dims}
    kept = [axis for axis in range(len(own)) if axis not in dropped]
    of_batch = [axis for axis in range(len(shape)) if axis not in numbers.offset_dims]
    with writer.loops(shape) as index, writer.lanes(parted) as (lane,):
        batch = [index[axis] for axis in of_batch]
        first, inside = _start(writer, places, batch, numbers.start_index_map, value, sizes, lane)
        for axis, of_places in zip(
            numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True
        ):
            first += f" + {batch[of_places]} * {own[axis]}"
        offsets = [index[axis] for axis in numbers.offset_dims]
        at = flat_index(offsets, [own[axis] for axis in kept], first)
        entry = _lane(value.at(at), parted and value.varying, lane)
        if fills:
            missing = "NAN" if kind == "d" else "INT64_MIN" if kind == "i" else "1"
            other = filled(missing, kind, value.varying and not parted)
            entry = f"({inside}) ? {entry} : {other}"
        to = _lane(found.at(flat_index(index, strides_of(shape))), parted, lane)
        writer.line(f"{to} = {entry};")
    return found


def _start(writer: Writer, places: CArray, batch, axes, value: CArray, sizes, lane: str):
    """First place of a slice of an array, kept within it, and whether it was within it."""
    own, strides = strides_of(value.shape), strides_of(places.shape)
    first, inside = "0", ["1"]
    for k, axis in enumerate(axes):
        at = flat_index([*batch, str(k) if k else "0"], [*strides[:-1], 1])
        start, most = _lane(places.at(at), places.varying, lane), value.shape[axis] - sizes[axis]
        first += f" + {clipped(start, most)} * {own[axis]}"
        inside.append(f"({start} >= 0) & ({start} <= {most})")
    return first, " & ".join(inside)


def _scatter(assign: str):
    """Entries of an array that an assignment of C changes; places outside of it are left out."""

    def rule(writer: Writer, params, values, outs):
        value, places, parts = values
        numbers = params["dimension_numbers"]
        parted, own = places.varying, strides_of(value.shape)
        found = writer.declare(value.kind, value.shape, any(v.varying for v in values))
        writer.copy(found, value)
        dropped = {*numbers.inserted_window_dims, *numbers.operand_batching_dims}
        kept = [axis for axis in range(len(own)) if axis not in dropped]
        of_batch = [a for a in range(len(parts.shape)) if a not in numbers.update_window_dims]
        sizes = [1] * len(own)
        for axis, window in zip(kept, numbers.update_window_dims, strict=True):
            sizes[axis] = parts.shape[window]
        axes = numbers.scatter_dims_to_operand_dims
        with writer.loops(parts.shape) as index, writer.lanes(parted) as (lane,):
            batch = [index[axis] for axis in of_batch]
            first, inside = _start(writer, places, batch, axes, value, sizes, lane)
            for axis, of_places in zip(
                numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, strict=True
            ):
                first += f" + {batch[of_places]} * {own[axis]}"
            offsets = [index[axis] for axis in numbers.update_window_dims]
            at = flat_index(offsets, [own[axis] for axis in kept], first)
            to = _lane(found.at(at), parted, lane)
            entry = parts.at(
                flat_index(index, strides_of(parts.shape)), found.varying and not parted
            )
            entry = _lane(entry, parted and parts.varying, lane)
            writer.line(f"if ({inside}) {to} {assign} {entry};")
        return found

    return rule


def _cumulative(name: str):
    """Sums along an axis, or their like, up to each place."""

    def rule(writer: Writer, params, values, outs):
        value, axis = values[0], params["axis"]
        found, text = (
            writer.declare(outs[0][0], outs[0][1], value.varying),
            elementwise(name, params),
        )
        assert text is not None
        writer.copy(found, value)
        own, length = strides_of(value.shape), value.shape[axis]
        others = [1 if i == axis else size for i, size in enumerate(value.shape)]
        with writer.loops(others) as index:
            i = writer.new_name("i")
            with writer.block(f"for (int64_t {i} = 1; {i} < {length}; {i}++)"):
                place, before = f"{i} * {own[axis]}", f"({i} - 1) * {own[axis]}"
                if params["reverse"]:
                    place = f"({length} - 1 - {i}) * {own[axis]}"
                    before = f"({length} - {i}) * {own[axis]}"
                here, last = (flat_index(index, own, at) for at in (place, before))
                combined = text(found.kind, found.varying).format(found.at(last), found.at(here))
                writer.line(f"{found.at(here)} = {combined};")
        return found

    return rule


def _sort(writer: Writer, params, values, outs):
    if params["num_keys"] != 1:
        raise UntranslatedError("sort by several keys")
    axis, varying = params["dimension"], any(value.varying for value in values)
    found = [writer.declare(value.kind, value.shape, varying) for value in values]
    for to, value in zip(found, values, strict=True):
        writer.copy(to, value)
    shape, own = found[0].shape, strides_of(found[0].shape)
    others = [1 if i == axis else size for i, size in enumerate(shape)]
    less = ELEMENTWISE["lt_to"](found[0].kind, varying)
    with writer.loops(others) as index:
        i, j = writer.new_name("i"), writer.new_name("i")
        with (
            writer.block(f"for (int64_t {i} = {shape[axis]} - 1; {i} > 0; {i}--)"),
            writer.block(f"for (int64_t {j} = 0; {j} < {i}; {j}++)"),
        ):
            here = flat_index(index, own, f"{j} * {own[axis]}")
            after = flat_index(index, own, f"({j} + 1) * {own[axis]}")
            wrong, kind = writer.new_name("b"), TYPES[varying].get("b", "int64_t")
            order = less.format(found[0].at(after), found[0].at(here))
            writer.line(f"const {kind} {wrong} = {order};")
            for to in found:
                first, second = writer.new_name("x"), writer.new_name("x")
                writer.line(f"const {to.type} {first} = {to.at(here)}, {second} = {to.at(after)};")
                text = select(to.kind, varying)
                writer.line(f"{to.at(here)} = {text.format(wrong, first, second)};")
                writer.line(f"{to.at(after)} = {text.format(wrong, second, first)};")
    return found


def _cholesky(writer: Writer, params, values, outs):
    value, (_, shape) = values[0], outs[0]
    found, size = writer.declare("d", shape, value.varying), shape[-1]
    for first in range(0, found.size, size * size):
        name = "factors" if value.varying else "factor"
        writer.line(f"{name}({found.name} + {first}, {value.name} + {first}, {size});")
    return found


def _triangular(writer: Writer, params, values, outs):
    (matrix, right), (_, shape) = values, outs[0]
    varying = matrix.varying or right.varying
    found, size = writer.declare("d", shape, varying), matrix.shape[-1]
    writer.copy(found, right)
    if matrix.varying != varying:
        matrix = writer.each("{}", "d", matrix.shape, [matrix], varying)
    rows, columns = shape[-2:]
    left, transposed = params["left_side"], params["transpose_a"]
    name = "eliminates" if varying else "eliminate"
    # X A = B is A' X' = B'.
    transposed, lower = transposed != (not left), params["lower"]
    unit = params["unit_diagonal"]
    steps = (columns, 1, columns) if left else (1, columns, rows)
    for batch in range(found.size // (rows * columns)):
        arguments = f"{found.name} + {batch * rows * columns}, {steps[0]}, {steps[1]}, {steps[2]}"
        own = f"{matrix.name} + {batch * size * size}, {size}"
        writer.line(f"{name}({arguments}, {own}, {int(lower)}, {int(transposed)}, {int(unit)});")
    return found


def _lu(writer: Writer, params, values, outs):
    """Triangular factors, rows that were swapped, and the order of the rows, run by run."""
    value, size = values[0], outs[0][1][-1]
    found = writer.declare("d", outs[0][1], value.varying)
    swapped, order = (writer.declare("i", shape, value.varying) for _, shape in outs[1:])
    writer.copy(found, value)
    with writer.lanes(value.varying) as (lane,):
        for matrix in range(found.size // size**2):
            parts = (found, "Lane", size**2), (order, "Place", size), (swapped, "Place", size)
            rows = [f"{one.name} + {matrix * step}" for one, _, step in parts]
            if value.varying:
                kinds = [kind for _, kind, _ in parts]
                rows = [f"({k} *)({r}) + {lane}" for k, r in zip(kinds, rows, strict=True)]
            step = "REGISTER_WIDTH" if value.varying else "1"
            writer.line(f"decompose({', '.join(rows)}, {size}, {step});")
    return [found, swapped, order]


def _platform(writer: Writer, params, values, outs):
    names = params["platforms"]
    own = next(i for i, group in enumerate(names) if group is None or "cpu" in group)
    return writer.constant(np.asarray(own))


ARRAY_RULES: dict[str, Callable] = {
    "convert_element_type": _convert,
    **{name: _reshape for name in ("reshape", "squeeze", "expand_dims")},
    "broadcast_in_dim": _broadcast,
    "transpose": _transpose,
    "slice": _slice,
    "rev": _reverse,
    "concatenate": _concatenate,
    "stack": _stack,
    "tile": _tile,
    "pad": _pad,
    "split": _split,
    "unstack": _unstack,
    "polynomial": _polynomial,
    "iota": _iota,
    "reduce_sum": _reduce("add", "0"),
    "reduce_prod": _reduce("mul", "1"),
    "reduce_max": _reduce("max", "-INFINITY"),
    "reduce_min": _reduce("min", "INFINITY"),
    "reduce_or": _reduce("or", "0"),
    "reduce_and": _reduce("and", "1"),
    "argmax": _position(">"),
    "argmin": _position("<"),
    "cumsum": _cumulative("add"),
    "cumprod": _cumulative("mul"),
    "cummax": _cumulative("max"),
    "cummin": _cumulative("min"),
    "dot_general": _dot,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update,
    "gather": _gather,
    "scatter": _scatter("="),
    "scatter-add": _scatter("+="),
    "scatter-sub": _scatter("-="),
    "scatter-mul": _scatter("*="),
    "sort": _sort,
    "cholesky": _cholesky,
    "triangular_solve": _triangular,
    "lu": _lu,
    "platform_index": _platform,
}


def _custom_solve(writer: Writer, params, values, outs):
    lengths, solve = params["const_lengths"], params["jaxprs"].solve
    first = lengths.matvec + lengths.vecmat
    constants = values[first : first + lengths.solve]
    return writer.run(solve, [*constants, *values[sum(lengths) :]])


def _cond(writer: Writer, params, values, outs):
    index, inputs, branches = values[0], values[1:], params["branches"]
    flags = [
        index.varying or any(flags)
        for flags in zip(*(writer.varies(branch, inputs) for branch in branches), strict=True)
    ]
    found = [writer.declare(out[0], out[1], flag) for out, flag in zip(outs, flags, strict=True)]
    for to in found if index.varying else []:
        writer.line(f"memset({to.name}, 0, sizeof {to.name});")
    last = len(branches) - 1
    for number, branch in enumerate(branches):
        here = index.at(0)
        if index.kind == "b":
            here = here if number else f"{'~' if index.varying else '!'}{here}"
        else:
            sign = "<=" if number == 0 else ">=" if number == last else "=="
            here = f"{here} {sign} {number}"
        if not index.varying:
            first = "else " * (number > 0)
            with writer.block(first if number == last else f"{first}if ({here})"):
                for to, value in zip(found, writer.run(branch, inputs), strict=True):
                    writer.copy(to, value)
            continue
        mask = writer.new_name("b")
        writer.line(f"const Mask {mask} = {here};")
        with writer.block(f"if (any({mask}))"):
            for to, value in zip(found, writer.run(branch, inputs), strict=True):
                _copy_where(writer, mask, to, value)
    return found


def _copy_where(writer: Writer, mask: str, to: CArray, value: CArray) -> None:
    """Copy an array in those runs that a mask marks."""
    with writer.loops([to.size]) as (i,):
        text = select(to.kind, True).format(mask, to.at(i), value.at(i, True))
        writer.line(f"{to.at(i)} = {text};")


def _carried(writer: Writer, body, carry: list[CArray], before, after, least: bool):
    """Copies of what a loop carries; runs differ where a turn of the loop makes them differ."""
    flags = [value.varying or least for value in carry]
    while True:
        given = [value._replace(varying=flag) for value, flag in zip(carry, flags, strict=True)]
        found = writer.varies(body, [*before, *given, *after])[: len(carry)]
        wider = [one or other for one, other in zip(flags, found, strict=True)]
        if wider == flags:
            break
        flags = wider
    copies = [writer.declare(v.kind, v.shape, flag) for v, flag in zip(carry, flags, strict=True)]
    for to, value in zip(copies, carry, strict=True):
        writer.copy(to, value)
    return copies


def _scan(writer: Writer, params, values, outs):
    constants, carried = scan_counts(params)
    body, length = params["jaxpr"], params["length"]
    fixed, inputs = values[:constants], values[constants + carried :]
    rows = [v._replace(shape=v.shape[1:]) for v in inputs]
    carry = _carried(writer, body, values[constants : constants + carried], fixed, rows, False)
    flags = writer.varies(body, [*fixed, *carry, *rows])[carried:]
    stacked = [
        writer.declare(o[0], o[1], flag) for o, flag in zip(outs[carried:], flags, strict=True)
    ]
    i, at = writer.new_name("i"), writer.new_name("a")
    with writer.block(f"for (int64_t {i} = 0; {i} < {length}; {i}++)"):
        if inputs or stacked:
            place = f"{length} - 1 - {i}" if params["reverse"] else i
            writer.line(f"const int64_t {at} = {place};")
        here = [row._replace(name=f"({row.name} + {at} * {row.size})") for row in rows]
        found = writer.run(body, [*fixed, *carry, *here])
        for to, value in zip(stacked, found[carried:], strict=True):
            row = to._replace(shape=value.shape, name=f"({to.name} + {at} * {value.size})")
            writer.copy(row, value)
        renew(writer, carry, found[:carried], None)
    return carry + stacked


def renew(writer: Writer, carry: list[CArray], found: list[CArray], mask: str | None) -> None:
    """Copy what a turn of a loop has found to what the loop carries, in runs that go on."""
    kept = {value.name for value in carry}
    # One that is only handed on may be overwritten before it is copied.
    found = [
        writer.each("{}", value.kind, value.shape, [value], value.varying)
        if value.name in kept and value.name != to.name
        else value
        for to, value in zip(carry, found, strict=True)
    ]
    for to, value in zip(carry, found, strict=True):
        if value.name == to.name:
            continue
        if mask is None:
            writer.copy(to, value)
        else:
            _copy_where(writer, mask, to, value)


def _while(writer: Writer, params, values, outs):
    of_condition, of_body = params["cond_nconsts"], params["body_nconsts"]
    asked, fixed = values[:of_condition], values[of_condition : of_condition + of_body]
    carry, body = values[of_condition + of_body :], params["body_jaxpr"]
    condition = params["cond_jaxpr"]
    lines, writer.lines = writer.lines, []
    copies = _carried(writer, body, carry, fixed, [], False)
    writer.lines = lines
    parted = writer.varies(condition, [*asked, *copies])[0]
    # Runs that part differ in all that is carried.
    copies = _carried(writer, body, carry, fixed, [], parted)
    with writer.block("for (;;)"):
        (goes_on,) = writer.run(condition, [*asked, *copies])
        writer.line(f"if (!{f'any({goes_on.at(0)})' if parted else goes_on.at(0)}) break;")
        mask = goes_on.at(0) if parted else None
        renew(writer, copies, writer.run(body, [*fixed, *copies]), mask)
    return copies


class Translation(Writer):
    """Lines of C of a program of JAX."""

    rules: ClassVar[dict[str, Callable]] = ARRAY_RULES | {
        "custom_linear_solve": _custom_solve,
        "cond": _cond,
        "scan": _scan,
        "while": _while,
    }
