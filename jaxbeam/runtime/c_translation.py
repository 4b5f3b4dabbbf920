"""Programs of JAX as C: a jaxpr of static shapes becomes loops over arrays.

Where runs part, both branches are computed and each run chooses; a loop turns until none goes on.
Primitives that are not among the rules here raise `UntranslatedError`, which names them.
"""

from collections.abc import Callable
from typing import ClassVar

from jaxbeam.runtime.c_arrays import ARRAY_RULES
from jaxbeam.runtime.c_writer import CArray, Writer, select


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
    constants, carried = params["num_consts"], params["num_carry"]
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
        writer.line(f"const int64_t {at} = {f'{length} - 1 - {i}' if params['reverse'] else i};")
        here = [row._replace(name=f"({row.name} + {at} * {row.size})") for row in rows]
        found = writer.run(body, [*fixed, *carry, *here])
        for to, value in zip(stacked, found[carried:], strict=True):
            row = to._replace(shape=value.shape, name=f"({to.name} + {at} * {value.size})")
            writer.copy(row, value)
        _renew(writer, carry, found[:carried], None)
    return carry + stacked


def _renew(writer: Writer, carry: list[CArray], found: list[CArray], mask: str | None) -> None:
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
        _renew(writer, copies, writer.run(body, [*fixed, *copies]), mask)
    return copies


class Translation(Writer):
    """Lines of C of a program of JAX."""

    rules: ClassVar[dict[str, Callable]] = ARRAY_RULES | {
        "custom_linear_solve": _custom_solve,
        "cond": _cond,
        "scan": _scan,
        "while": _while,
    }
