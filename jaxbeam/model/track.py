"""Tracks: the filter that spreads the force of an axle, and layers of rail, sleepers and ballast.

A force that acts in fractions w_k at x + o_k has the influence sum_k w_k f(x + o_k) where f(x) is
that of a force at x, zero off the beam. An even one over a length s has (F(x + s/2) - F(x - s/2)) /
s, with the integral F of f from the left end. As f is a polynomial between the nodes of the beam,
both are polynomials between the nodes less the offsets: the filter is exact, for mode shapes, hence
forces on the modes, and for static influence alike.

Layers are a rail on pads, sleepers and ballast, on the beam and on the ground around it.

    B r'''' + mu r_tt + p (r - s) = F,    sigma s_tt - p (r - s) + b (s - w) = 0,

with the deflections r of the rail and s of the sleepers, the beam's w below them or, on the ground,
0; B and mu are the bending stiffness and mass per length of the rail, sigma, p and b the mass of a
sleeper and the stiffnesses of its pads and ballast over the sleeper spacing. The beam bears b (s -
w). Forces F of wheels act on the rail.

Rail and sleepers are sums of sin(n pi (x + a) / l) over the length l = L + 2 a of the rail, half as
many as the case has modes; the beam is that of its own Ritz expansion. At an end that moves, where
the sleepers jump from the beam to the ground, they have a ramp over the beam besides. Undamped
modes of all together have the damping of their dampers, and that of the beam by its share of their
strain energy, or of their kinetic energy where it is proportional to mass; damping between
different modes is left out.

It is the track of Zhai, Wang and Lin (2004) with two of its layers, even along it.
"""

import functools
from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from numpy.polynomial import chebyshev, legendre

from jaxbeam.case.case import Case
from jaxbeam.case.track import Kernel
from jaxbeam.model.elements import Layout
from jaxbeam.numerics.polynomials import chebyshev_polynomials
from jaxbeam.runtime.arrays import Array, Module, add_at, block_diag, take, xp


class SpreadShapes(Module):
    """Series of filtered mode shapes (kg^-1/2) between nodes (m), over the position of an axle.

    `offsets` (m) are those of the track's kernel; `twist` is the series of the twist, if any.
    """

    nodes: Float[Array, " node"]
    series: Float[Array, "segment degree mode"]
    offsets: Float[Array, " share"]
    twist: Float[Array, "segment degree mode"] | None = None


def to_series(breaks, terms: int, function: Callable) -> Float[Array, "piece term output"]:
    """Chebyshev series between breaks (m) through the values (..., output) of a function."""
    points = chebyshev.chebpts1(terms)
    middle, half = (breaks[1:] + breaks[:-1]) / 2, xp.diff(breaks) / 2
    values = function(middle[:, None] + half[:, None] * points)
    scale = np.where(np.arange(terms) == 0, 1.0, 2.0)[:, None] / terms
    to_series = scale * chebyshev.chebvander(points, terms - 1).T
    return xp.einsum("kp,spo->sko", to_series, values)


@functools.cache
def _integration_matrix(terms: int) -> np.ndarray:
    """Matrix from a Chebyshev series to that of its integral from -1, one term longer."""
    return chebyshev.chebint(np.eye(terms), lbnd=-1)


def spread_series(
    kernel: Kernel, nodes: Float[Array, " node"], series: Float[Array, "segment term column"]
) -> tuple[Float[Array, " break"], Float[Array, "piece _ column"]]:
    """Breaks (m), and series between them, of a function filtered by the kernel of a track.

    The function is given by its `series` between `nodes` (m) and is zero beyond.
    """
    last = 0.0
    if kernel.integrated:
        integral = _integration_matrix(series.shape[1]) @ series
        integral = integral * (xp.diff(nodes) / 2)[:, None, None]
        ends = xp.cumsum(xp.sum(integral, axis=1), axis=0)
        first = xp.concatenate([xp.zeros_like(ends[:1]), ends[:-1]])
        series, last = add_at(integral, np.s_[:, 0], first), ends[-1]
    breaks = xp.sort((nodes[:, None] - kernel.offsets).reshape(-1))
    middle = (breaks[1:] + breaks[:-1]) / 2

    def values(x):
        total = xp.zeros((*x.shape, series.shape[2]))
        for offset, weight in zip(kernel.offsets, kernel.weights, strict=True):
            within = (middle + offset)[:, None]  # in which segment, whatever rounding does
            segment = xp.sum(within[..., None] >= nodes[1:-1], axis=-1)
            left, right = take(nodes, segment), take(nodes, segment + 1)
            width = xp.where(right > left, right - left, 1.0)
            local = xp.clip((2 * (x + offset) - left - right) / width, -1.0, 1.0)
            table = chebyshev_polynomials(local, series.shape[1])
            found = xp.einsum("spk,skc->spc", table, take(series, segment[:, 0]))
            found = xp.where((within < nodes[0])[..., None], 0.0, found)
            found = xp.where((within >= nodes[-1])[..., None], last, found)
            total = total + weight * found
        return total

    return breaks, to_series(breaks, series.shape[1], values)


SINES_PER_PIECE, PIECE_TERMS = 6, 32  # of the series of the rail: exact to rounding
FURTHER_POINTS = 10  # of the quadrature, beyond the degree of the beam and the number of sines


class Layers(Module):
    """Rail and sleepers of a case, and springs between them and the beam, in beam units.

    Unknowns are those of the beam, then of the rail, then of the sleepers. `pad` and `ballast` are
    the stiffness matrices of unit springs per length; `rail_stiffness` is a diagonal, `masses` the
    matrix of rail and sleepers.
    """

    rail_stiffness: Float[Array, " unknown"]
    masses: Float[Array, "unknown unknown"]
    pad: Float[Array, "unknown unknown"]
    ballast: Float[Array, "unknown unknown"]
    springs: tuple[Float[Array, ""], Float[Array, ""]]

    def with_beam(
        self, stiffness: Float[Array, "own own"], mass: Float[Array, "own own"]
    ) -> tuple[Float[Array, "unknown unknown"], Float[Array, "unknown unknown"]]:
        """Stiffness and mass matrix of beam and track, from those of the beam."""
        of_pads, of_ballast = self.springs
        more = self.masses.shape[0] - stiffness.shape[0]
        stiffness, mass = (xp.pad(each, (0, more)) for each in (stiffness, mass))
        stiffness = stiffness + xp.diag(self.rail_stiffness)
        stiffness = stiffness + of_pads * self.pad + of_ballast * self.ballast
        return stiffness, mass + self.masses

    def damping(
        self,
        case: Case,
        vectors: Float[Array, "unknown mode"],
        of_beam: Float[Array, " mode"],
        values: Float[Array, " mode"],
        stiffness: Float[Array, "own own"],
        mass: Float[Array, "own own"],
    ) -> Float[Array, " mode"]:
        """Modal damping (1/s) of beam and track, from eigenvectors and eigenvalues in beam units.

        `of_beam` is the damping of a mode whose energy is all in the beam; `stiffness` and `mass`
        are the matrices of the beam.
        """
        track, beam = case.track, case.beam
        per_mass = 1.0 / (track.sleeper_spacing * beam.linear_density)
        of_pads, of_ballast = (
            xp.sum(vectors * (matrix @ vectors), axis=0) for matrix in (self.pad, self.ballast)
        )
        own = vectors[: stiffness.shape[0]]
        elastic = values > 0
        energy = xp.sum(own * (stiffness @ own), axis=0) / xp.where(elastic, values, 1.0)
        fraction = xp.where(elastic, energy, 1.0)
        dampers = track.pad_damping * of_pads + track.ballast_damping * of_ballast
        of_mass = 0.0 if beam.rayleigh_damping is None else beam.rayleigh_damping[0]
        moving = xp.sum(own * (mass @ own), axis=0)
        return fraction * (of_beam - of_mass) + moving * of_mass + per_mass * dampers

    def rail(
        self, case: Case, vectors: Float[Array, "rail_and_sleeper mode"], unit: Float[Array, ""]
    ) -> tuple[Float[Array, " node"], Float[Array, "piece term mode"]]:
        """Nodes (m) of the rail, and series of its mode shapes (kg^-1/2) between them."""
        count, length = sine_count(case), case.beam.length
        approach = case.track.ground
        pieces = -(-count // SINES_PER_PIECE)
        nodes = -approach + (length + 2 * approach) * np.linspace(0.0, 1.0, pieces + 1)
        amplitudes = vectors[:count] / unit

        def shapes(x):
            return _sines(case, x / length) @ amplitudes

        return nodes, to_series(nodes, PIECE_TERMS, shapes)


def sine_count(case: Case) -> int:
    """Number of sines of the rail, and of the sleepers: half of the modes.

    Each sine has two modes, of rail and sleepers in phase and against each other.
    """
    return max(1, case.beam.modes // 2)


def _sines(case: Case, x: Float[Array, "*position"]) -> Float[Array, "*position sine"]:
    """Sines of the rail at positions (in L), whose squares have the integral 1 over its length."""
    approach = case.track.ground / case.beam.length
    length, number = 1.0 + 2 * approach, np.arange(1, sine_count(case) + 1)
    return xp.sqrt(2.0 / length) * xp.sin(np.pi * number * (x[..., None] + approach) / length)


def layers(
    case: Case,
    layout: Layout,
    nodes: Float[Array, " node"],
    series: Float[Array, "segment term own"],
) -> Layers:
    """Layers of the track of a case on the beam with these nodes (in L) and series of unknowns."""
    beam, track, count, own = case.beam, case.track, sine_count(case), series.shape[2]
    length = 1.0 + 2 * track.ground / beam.length
    waves = (np.pi * np.arange(1, count + 1) / length) ** 4
    rail = track.rail_rigidity / beam.bending_stiffness * waves
    jumps = [i for i, end in enumerate((0, -1)) if not layout.constrained[end][0]]
    points, weights = legendre.leggauss(max(layout.degrees) + count + FURTHER_POINTS)
    table = chebyshev.chebvander(points, series.shape[1] - 1)
    sleepers = count + len(jumps)
    squares, products = xp.zeros((own, own)), xp.zeros((own, sleepers))
    of_ramps = xp.zeros((len(jumps), sleepers))
    for i in range(len(layout.degrees)):
        half = (nodes[i + 1] - nodes[i]) / 2
        x, values = nodes[i] + half * (points + 1), table @ series[i]
        ramps = xp.stack([1.0 - x, x], -1)[:, jumps]
        functions = xp.concatenate([_sines(case, x), ramps], axis=1)
        weighted = (half * weights)[:, None] * values
        squares = squares + weighted.T @ values
        products = products + weighted.T @ functions
        of_ramps = of_ramps + ((half * weights)[:, None] * ramps).T @ functions
    of_sines = xp.concatenate([np.eye(count), of_ramps[:, :count].T], axis=1)
    gram = xp.concatenate([of_sines, of_ramps])
    no_rail, no_beam = np.zeros((own, count)), np.zeros((count, own))
    ballast = [
        [squares, no_rail, -products],
        [no_beam, np.zeros((count, count + sleepers))],
        [-products.T, np.zeros((sleepers, count)), gram],
    ]
    pad = block_diag(
        np.zeros((own, own)), xp.block([[np.eye(count), -of_sines], [-of_sines.T, gram]])
    )
    spread = track.sleeper_spacing * beam.linear_density
    masses = block_diag(
        np.zeros((own, own)),
        track.rail_mass / beam.linear_density * np.eye(count),
        track.sleeper_mass / spread * gram,
    )
    unit = beam.length**4 / (beam.bending_stiffness * track.sleeper_spacing)
    return Layers(
        xp.concatenate([np.zeros(own), rail, np.zeros(sleepers)]),
        masses,
        pad,
        xp.block(ballast),
        (track.pad_stiffness * unit, track.ballast_stiffness * unit),
    )
