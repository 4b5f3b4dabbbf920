"""Static influence of forces over their position: Chebyshev series."""

from collections.abc import Callable, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from jaxbeam.case.case import Case
from jaxbeam.case.track import Kernel
from jaxbeam.model.flexibility import Flexibility, flexibility
from jaxbeam.model.layout import is_uniform
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.modes import Modes
from jaxbeam.model.spread import spread_series, to_series
from jaxbeam.model.theory.statics import SectionFlexibility
from jaxbeam.numerics.polynomials import chebyshev_polynomials, piecewise_chebyshev
from jaxbeam.runtime.arrays import Array, set_at, solve, take, xp
from jaxbeam.runtime.module import Module

SIDE_SHIFT = 0.01  # towards a position nearby, by which the side of a break is found,
LARGEST_SHIFT = 0.1  # over the length of the beam and the root of the rounding error, at most
PARTS, PART_TERMS = 8, 24  # in which influence functions that are no cubics are interpolated


class LoadInfluence(Module):
    """Static influence of a force on outputs, less that of the modes, over its position.

    Chebyshev `series` of the outputs per newton upwards between the `breaks` (m): nodes of the
    beam, and the outputs, at which moments have kinks and shear forces jump. `mirrored` outputs are
    those, then their negatives.
    """

    breaks: Float[Array, " break"]
    series: Float[Array, "piece term output"]
    mirrored: bool = eqx.field(static=True, default=False)

    def of_forces_at(
        self,
        x: Float[Array, "*position"],
        near: Float[Array, "*position"],
        output: Int[Array, "*position"] | None = None,
    ) -> Float[Array, "..."]:
        """Outputs (*position, output) per newton upwards at positions x (m).

        Off the beam as at its nearer end. At a break the limit on the side of it on which `near`
        (m) is. Only one `output` at each position, if its number is given: (*position,).
        """
        # Further breaks may lie between a position and one nearby.
        largest = LARGEST_SHIFT * np.finfo(x.dtype).eps ** 0.5 * self.breaks[-1]
        toward = x + xp.clip(SIDE_SHIFT * (near - x), -largest, largest)
        piece = xp.sum(toward[..., None] >= self.breaks[1:-1], axis=-1)
        left, right = take(self.breaks, piece), take(self.breaks, piece + 1)
        width = xp.where(right > left, right - left, 1.0)
        local = xp.clip((2 * x - left - right) / width, -1.0, 1.0)
        table = chebyshev_polynomials(local, self.series.shape[1])
        if output is not None:
            return xp.sum(table * self.series[piece, :, output], axis=-1)
        influence = xp.einsum("...k,...ko->...o", table, take(self.series, piece))
        return xp.concatenate([influence, -influence], -1) if self.mirrored else influence

    def spread(self, kernel: Kernel) -> "LoadInfluence":
        """Influence of loads that a track spreads."""
        nodes, series = spread_series(kernel, self.breaks, self.series)
        return LoadInfluence(nodes, series, self.mirrored)

    def plus(self, other: "LoadInfluence") -> "LoadInfluence":
        """Sum with another, whose breaks are among those of this one."""

        def values(x):
            return other.of_forces_at(x, x)

        added = to_series(self.breaks, self.series.shape[1], values)
        return eqx.tree_at(lambda one: one.series, self, self.series + added)


def load_influence(
    case: Case,
    modes: Modes,
    on_modes: Float[Array, "mode output"],
    greens: Sequence[tuple[Flexibility | SectionFlexibility, Float[Array, " _"], Sequence[int]]],
) -> LoadInfluence:
    """Influence of forces on outputs, from influence functions less that of the modes.

    `greens` are influence functions, factors from them to the quantities, and the indices of their
    outputs; the amplitudes of the modes have the influence `on_modes`. Between the breaks both are
    polynomials on a uniform beam; on others, smooth functions, interpolated in parts.
    """
    uniform, terms = is_uniform(case), max(4, modes.series.shape[1])
    breakpoints = [modes.nodes / case.beam.length, *(one.breakpoints for one, _, _ in greens)]
    if not uniform:
        breakpoints.append(np.linspace(0.0, 1.0, PARTS + 1))
    breaks = case.beam.length * xp.sort(xp.clip(xp.concatenate(breakpoints), 0.0, 1.0))
    terms = terms if uniform else max(terms, PART_TERMS)

    def influence(x):
        values = -piecewise_chebyshev(modes.nodes, modes.series @ on_modes, x, (0,))[0]
        for one, factor, index in greens:
            at = np.s_[..., np.array(index, int)]
            values = set_at(values, at, values[at] + factor * one(x / case.beam.length))
        return values

    return LoadInfluence(breaks, to_series(breaks, terms, influence))


def residual_influence(case: Case, model: ModalModel, x, order: int) -> LoadInfluence:
    """Influence of forces of loads on the x-derivative of an order of the deflection at x (m).

    Less that of the modes of a model; filtered by the track of the case.
    """
    rows = model.fields(x.reshape(-1), (order,))[0]
    on_modes = solve(model.stiffness(), rows.T)
    if model.mode_map is not None:
        on_modes = model.mode_map @ on_modes
    greens = flexibility(case, model.modes.layout, x.reshape(-1), order)
    factor = case.beam.length ** (3 - abs(order)) / case.beam.bending_stiffness * xp.ones(x.size)
    found = load_influence(case, model.modes, on_modes, [(greens, factor, range(x.size))])
    return found if case.track is None else found.spread(case.track.kernel())


def spread_line(
    case: Case, line: Callable, breaks: Float[Array, " break"]
) -> tuple[Callable, Float[Array, " _"]]:
    """Line (*position) -> (*position, x) of a force over its position (m), filtered by the track.

    And the positions between which it is smooth; `breaks` are those of the line.
    """
    if case.track is None:
        return line, breaks
    length, terms = case.beam.length, 4
    if not is_uniform(case):
        breaks, terms = xp.append(breaks, length * np.linspace(0.0, 1.0, PARTS + 1)), PART_TERMS
    breaks = xp.sort(xp.clip(xp.concatenate([breaks, xp.stack([0 * length, length])]), 0.0, length))
    found = LoadInfluence(breaks, to_series(breaks, terms, line)).spread(case.track.kernel())
    return (lambda y: found.of_forces_at(y, y)), found.breaks
