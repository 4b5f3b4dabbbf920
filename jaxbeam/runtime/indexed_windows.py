"""Gathers and scatters of XLA in NumPy, for the interpreter: windows of an array at given indices.

Each function takes the parameters of the primitive and the shapes of its arguments and result, and
returns the function of the arrays.
"""

from typing import Any

import numpy as np
from jax.lax import GatherScatterMode


class _Windows:
    """Where the windows of a gather or scatter lie in its operand.

    `full` are the axes that every window covers, `others` those that are indexed. `window_axes` are
    those of the gathered array, or of the updates, that run along the windows.
    """

    def __init__(self, params, operand, indices, sizes, window_axes, mode):
        numbers = params["dimension_numbers"]
        gathers = hasattr(numbers, "offset_dims")
        self.starts = numbers.start_index_map if gathers else numbers.scatter_dims_to_operand_dims
        collapsed = numbers.collapsed_slice_dims if gathers else numbers.inserted_window_dims
        own = numbers.operand_batching_dims
        theirs = (
            numbers.start_indices_batching_dims
            if gathers
            else numbers.scatter_indices_batching_dims
        )
        self.shape, self.sizes, self.mode = operand.shape, sizes, mode
        rank, self.batch = len(operand.shape), indices.shape[:-1]
        self.paired = dict(zip(own, theirs, strict=True))
        windows = [axis for axis in range(rank) if axis not in (*collapsed, *own)]
        self.full = [a for a in windows if a not in self.starts and sizes[a] == operand.shape[a]]
        self.others = [axis for axis in range(rank) if axis not in self.full]
        self.partial = [axis for axis in windows if axis not in self.full]
        self.to_front = (*self.others, *self.full)
        own_axis = dict(zip(windows, window_axes, strict=True))
        count = len(self.batch) + len(window_axes)
        outer = [axis for axis in range(count) if axis not in window_axes]
        # axes of the gathered array in the order batch, partial windows, full axes
        self.order = (*outer, *(own_axis[axis] for axis in (*self.partial, *self.full)))

    def index(self, starts) -> tuple[tuple, Any]:
        """Index along the `others`, and which windows are inside, None for all of them."""
        of_axis = dict(zip(self.starts, np.moveaxis(np.asarray(starts), -1, 0), strict=True))
        inside = None
        for axis, at in of_axis.items():
            last = self.shape[axis] - self.sizes[axis]
            if self.mode not in (GatherScatterMode.CLIP, GatherScatterMode.PROMISE_IN_BOUNDS):
                own = (at >= 0) & (at <= last)
                inside = own if inside is None else inside & own
            of_axis[axis] = np.clip(at, 0, last)
        index = []
        for axis in self.others:
            at = of_axis.get(axis, np.zeros((1,) * len(self.batch), int))
            if axis in self.paired:
                along = [1] * len(self.batch)
                along[self.paired[axis]] = -1
                at = np.arange(self.shape[axis]).reshape(along)
            at = np.reshape(at, at.shape + (1,) * len(self.partial))
            if axis in self.partial:
                along = [1] * len(self.partial)
                along[self.partial.index(axis)] = -1
                at = at + np.arange(self.sizes[axis]).reshape(along)
            index.append(at)
        if inside is not None and inside.all():
            inside = None
        return tuple(index), inside


def gather(params, operand, indices, out):
    """Function of operand and indices that returns what `lax.gather` with these params does."""
    numbers, mode = params["dimension_numbers"], params["mode"]
    windows = _Windows(params, operand, indices, params["slice_sizes"], numbers.offset_dims, mode)
    back = np.argsort(windows.order)
    outside = params["fill_value"]
    if outside is None and np.issubdtype(out.dtype, np.inexact):
        outside = np.nan
    elif outside is None:
        is_bool = out.dtype == bool
        outside = True if is_bool else getattr(np.iinfo(out.dtype), _LIMIT[out.dtype.kind])

    def gathered(value, starts):
        index, inside = windows.index(starts)
        found = np.transpose(value, windows.to_front)[index]
        full = [operand.shape[axis] for axis in windows.full]
        shape = (*windows.batch, *(windows.sizes[axis] for axis in windows.partial), *full)
        found = np.broadcast_to(found, shape)
        if inside is not None:
            inside = inside.reshape(*inside.shape, *(1,) * (found.ndim - inside.ndim))
            found = np.where(inside, found, np.asarray(outside, out.dtype))
        return np.transpose(found, back)

    return gathered


_LIMIT = {"i": "min", "u": "max"}


def scatter(combine):
    """Rule of a `lax.scatter` that combines entries and updates in place by `combine.at`."""

    def rule(params, operand, indices, updates, out):
        numbers = params["dimension_numbers"]
        axes = numbers.update_window_dims
        sizes = [1] * len(operand.shape)
        dropped = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
        windows = [axis for axis in range(len(operand.shape)) if axis not in dropped]
        for axis, own in zip(windows, axes, strict=True):
            sizes[axis] = updates.shape[own]
        places = _Windows(params, operand, indices, sizes, axes, params["mode"])
        back = np.argsort(places.to_front)

        def scattered(value, starts, parts):
            index, inside = places.index(starts)
            array = np.array(np.transpose(value, places.to_front))
            parts = np.transpose(parts, places.order)
            if inside is not None:
                inside, rank = np.broadcast_to(inside, places.batch), len(places.batch)
                index = tuple(
                    np.broadcast_to(at, (*places.batch, *at.shape[rank:]))[inside] for at in index
                )
                parts = parts[inside]
            if not index:
                index = (...,)
            if combine is None:
                array[index] = parts
            else:
                combine.at(array, index, parts)
            return np.transpose(array, back)

        return scattered

    return rule
