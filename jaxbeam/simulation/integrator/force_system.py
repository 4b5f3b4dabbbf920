"""Forces that move at constant speeds, in closed form: no time step, and no contact to solve.

In coordinates eta of the states z = V eta of the model, A V = V lambda, a force F at x = x0 + v t
acts by

    eta' = lambda eta + b(x) F,    b(x) = V^-1 B psi(x),

so that eta = F p(x) + a exp(lambda t), where v p' - lambda p = b(x): a polynomial between the nodes
of the mode shapes, as b is. All forces of one speed have one p. The amplitudes a of free vibration
change where a force enters, passes a node or leaves, so that eta is continuous. Outputs then are

    y = sum over the forces of F r(x) + Re(C a exp(lambda t)),    r(x) = Re(C p(x)) + influence(x),

the second term of r being static (`LinearOutputs`). r is found once for a speed; a train is a sum
of shifted copies of it.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int
from numpy.polynomial import chebyshev

from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.output_rows import LinearOutputs


def product(left, right) -> np.ndarray:
    """left (row, term) times right (..., term, column)."""
    return np.einsum("rt,...tc->...rc", left, right)


MAX_CONDITION = 1e6  # of the eigenvectors; beyond, poles are nearly repeated
TABLE_POINTS = 600  # least number of points on the beam, between which tables are linear
POINTS_PER_MODE = 40
TABLE_PHASE = 0.3  # rad of the fastest pole, at most, between two points under the slowest force
SHORTEST = 1e-12  # fraction of the length; shorter segments are left out
CURVATURE_MARGIN = 1.2  # bound of the curvature over second differences of the table


class ForceSystem(NamedTuple):
    """A model and its outputs in coordinates of its poles (1/s), one of each conjugate pair.

    `forces` are the series (segment, term, pole) of b(x), `on_outputs` is C, `static` the static
    part of r(x). Between the `breaks` (m), nodes among them, r(x) is smooth.
    """

    poles: Complex[np.ndarray, " pole"]
    forces: Complex[np.ndarray, "segment term pole"]
    on_outputs: Complex[np.ndarray, "output pole"]
    nodes: Float[np.ndarray, " node"]
    breaks: Float[np.ndarray, " break"]
    static: LinearOutputs

    @property
    def fastest(self) -> float:
        """Largest magnitude of a pole (1/s)."""
        return float(np.abs(self.poles).max())

    @property
    def segment(self) -> Int[np.ndarray, " piece"]:
        """Index of the segment that contains each piece between two breaks."""
        middle = (self.breaks[:-1] + self.breaks[1:]) / 2
        return np.searchsorted(self.nodes[1:-1], middle)

    @property
    def has_static(self) -> Bool[np.ndarray, " output"]:
        """Whether r of each output has a static part."""
        if self.static.influence is None:
            return np.zeros(self.on_outputs.shape[0], bool)
        return np.any(np.asarray(self.static.influence.series), axis=(0, 1))

    def static_part(self, x, piece, output=None) -> Float[np.ndarray, "force ..."]:
        """Static part of r (force, output) at positions (m) in pieces.

        With `output` it is that of one output at each position, (force,).
        """
        if self.static.influence is None:
            return np.zeros((x.size, self.on_outputs.shape[0]))
        near = (self.breaks[piece] + self.breaks[piece + 1]) / 2
        return np.asarray(self.static.influence.of_forces_at(x, near, output))


def force_system(
    model: ModalModel,
    outputs: LinearOutputs,
    places: Float[np.ndarray, " place"],
    eccentricity: float = 0.0,
) -> ForceSystem | None:
    """Model and outputs for moving forces; None for repeated poles, as of rigid-body motion.

    At the `places` (m) the influence of a force on outputs has kinks or jumps. All forces have one
    `eccentricity` (m).
    """
    poles, vectors = np.linalg.eig(model.A)
    if not np.linalg.cond(vectors) < MAX_CONDITION or not np.abs(poles).min() > 0:
        return None
    own = poles.imag >= 0
    into = np.linalg.inv(vectors)[own][:, model.rate_index]
    if model.mode_map is not None:
        into = into @ model.mode_map.T
    on_outputs = outputs.rows @ vectors[:, own] * np.where(poles[own].imag > 0, 2.0, 1.0)
    series = np.asarray(model.load_series)
    if model.load_twist is not None:
        series = series + eccentricity * np.asarray(model.load_twist)
    if outputs.influence is not None:
        outputs = dataclasses.replace(outputs, influence=outputs.influence.on_line(eccentricity))
    nodes, series = np.asarray(model.load_nodes), series @ into.T
    if model.spread is not None:  # parts of a spread axle force may pass nodes at one time
        long = np.diff(nodes) > SHORTEST * (nodes[-1] - nodes[0])
        nodes, series = np.append(nodes[:-1][long], nodes[-1]), series[long]
    places = np.clip(model.load_places(places), nodes[0], nodes[-1])
    breaks = np.unique(np.concatenate([nodes, places]))
    return ForceSystem(poles[own], series, on_outputs, nodes, breaks, outputs)


def solution_size(terms: int) -> int:
    """Number of terms of a particular solution, for as many of the force."""
    return terms + 6 * int(np.ceil(np.cbrt(terms))) + 12


def particular_solutions(
    system: ForceSystem, speeds: Float[np.ndarray, " speed"]
) -> Complex[np.ndarray, "speed segment n pole"]:
    """Chebyshev series of p(x), with v p' - lambda p = b(x), in each segment at speeds v (m/s).

    Coefficients follow the recurrence 2 n p_n = c_(n-1) p'_(n-1) - p'_(n+1) of derivatives. For a
    pole that turns far within a segment p is the polynomial of the degree of b, for others the
    solution that vanishes at the left node.
    """
    segments, terms, poles = system.forces.shape
    size = solution_size(terms)
    n = np.arange(size)
    c = np.where(n == 0, 2.0, 1.0)
    b = np.zeros((segments, size + 1, poles), complex)
    b[:, :terms] = system.forces
    right = np.zeros((segments, size, poles), complex)
    right[:, 1:] = c[:-1, None] * b[:, : size - 1] - b[:, 2:]
    result = np.zeros((speeds.size, segments, size, poles), complex)
    for s, half in enumerate(np.diff(system.nodes) / 2):
        rates = (speeds / half)[:, None]
        far = np.abs(system.poles / rates) >= terms
        p = np.zeros((size, speeds.size, poles), complex)
        for k in range(terms, 0, -1):  # from the highest coefficient down
            higher = 2 * k * rates * p[k] + system.poles * p[k + 1] - right[s, k]
            p[k - 1] = np.where(far, higher / (system.poles * c[k - 1]), 0.0)
        result[:, s] = np.moveaxis(p, 0, 1)
        at_speed, near = np.nonzero(~far)
        if near.size:
            matrix = np.zeros((near.size, size, size), complex)
            matrix[:, n, n] = 2 * n * rates[at_speed]
            matrix[:, n[1:], n[:-1]] -= system.poles[near, None] * c[:-1]
            matrix[:, n[1:-1], n[2:]] += system.poles[near, None]
            matrix[:, 0] = (-1.0) ** n
            found = np.linalg.solve(matrix, right[s][:, near].T[..., None])[..., 0]
            result[at_speed, s, :, near] = found
    return result


class ForceResponses(NamedTuple):
    """Responses to a unit force at each of some `speeds` (m/s): p(x) and r(x).

    `before` and `after` are p at the left and at the right side of the nodes, zero off the beam.
    `on_outputs` are the series of Re(C p). r is tabulated in equal distances, at `count` points
    from the `first` on in each piece; on lines between them it has errors up to `table_error` in
    each piece, on cubics up to `cubic_error`. `curvature` bounds d2r/dt2 (1/s^2) under the moving
    force.
    """

    system: ForceSystem
    speeds: Float[np.ndarray, " speed"]
    solutions: Complex[np.ndarray, "speed segment n pole"]
    before: Complex[np.ndarray, "speed node pole"]
    after: Complex[np.ndarray, "speed node pole"]
    on_outputs: Float[np.ndarray, "speed segment n output"]
    table: Float[np.ndarray, "speed point output"]
    table_error: Float[np.ndarray, "speed piece output"]
    cubic_error: Float[np.ndarray, "speed piece output"]
    curvature: Float[np.ndarray, "speed piece output"]
    first: Int[np.ndarray, " piece"]
    count: Int[np.ndarray, " piece"]

    def exact(self, speed, piece, x, output) -> Float[np.ndarray, "force time"]:
        """r(x) of outputs for forces at x (force, time), in m.

        `speed`, `piece` and `output` are indices of each force.
        """
        segment = self.system.segment[piece]
        series = self.on_outputs[speed, segment, :, output].T[..., None]
        t = _local(self.system.nodes, segment[:, None], x)
        twice, lower, value = 2 * t, np.zeros(x.shape), np.zeros(x.shape)
        for coefficient in series[:0:-1]:  # Clenshaw's recurrence
            lower, value = value, twice * value - lower
            value += coefficient
        value = t * value - lower + series[0]
        own = np.flatnonzero(self.system.has_static[output])
        if own.size:
            of_each = (np.repeat(part[own], x.shape[1]) for part in (piece, output))
            static = self.system.static_part(x[own].ravel(), *of_each)
            value[own] += static.reshape(own.size, -1)
        return value

    def particular(self, speed: int, segment: int, x) -> Complex[np.ndarray, "force pole"]:
        """p(x) at positions (m) in a segment."""
        local = _local(self.system.nodes, segment, x)
        return chebyshev.chebval(local, self.solutions[speed, segment]).T


def _local(nodes, segment, x):
    """Local coordinates (-1 to 1) in their segments of positions x (m)."""
    return np.clip(2 * (x - nodes[segment]) / (nodes[segment + 1] - nodes[segment]) - 1, -1, 1)


def force_responses(system: ForceSystem, speeds: Float[np.ndarray, " speed"]) -> ForceResponses:
    """Responses of a system to forces of some speeds (m/s)."""
    solutions = particular_solutions(system, speeds)
    signs = (-1.0) ** np.arange(solutions.shape[2])
    outside = np.zeros((speeds.size, 1, system.poles.size))
    after = np.concatenate([np.einsum("usnk,n->usk", solutions, signs), outside], axis=1)
    before = np.concatenate([outside, solutions.sum(axis=2)], axis=1)
    on_outputs = (solutions @ system.on_outputs.T).real
    points, piece, first, count = _points(system, np.abs(speeds).min())
    table = np.empty((speeds.size, points.size, system.on_outputs.shape[0]))
    for s in range(system.nodes.size - 1):
        own = system.segment[piece] == s
        local = _local(system.nodes, s, points[own])
        shapes = chebyshev.chebvander(local, solutions.shape[2] - 1)
        table[:, own] = product(shapes, on_outputs[:, s])
    table += system.static_part(points, piece)
    bends, fourth = (_largest_differences(table, first, order) for order in (2, 4))
    error = CURVATURE_MARGIN / 8 * bends
    # At the ends of a piece the cubic is used in an outer interval, where its error is largest.
    cubic_error = CURVATURE_MARGIN / 24 * fourth
    distance = (np.diff(system.breaks) / (count - 1))[:, None]
    curvature = CURVATURE_MARGIN * speeds[:, None, None] ** 2 * bends / distance**2
    parts = solutions, before, after, on_outputs, table, error, cubic_error, curvature
    return ForceResponses(system, speeds, *parts, first, count)


def _largest_differences(table, first, order: int):
    """Largest magnitude (speed, piece, output) of the differences of an order in each piece."""
    differences = np.abs(np.diff(table, order, axis=1, append=np.zeros_like(table[:, :order])))
    last = np.append(first[1:], table.shape[1]) - order
    bounds = np.stack([first, last], axis=1).reshape(-1)
    return np.maximum.reduceat(differences, bounds, axis=1)[:, ::2]


def table_points(system: ForceSystem, slowest: float) -> float:
    """Least number of points of a table, for forces of at least the `slowest` speed (m/s).

    Poles that turn further than `terms` in half a segment have polynomials as particular solutions.
    """
    segments, terms, poles = system.forces.shape
    phase = system.fastest * (system.breaks[-1] - system.breaks[0]) / slowest
    turning = min(phase, 2 * terms * segments) / TABLE_PHASE
    return float(max(TABLE_POINTS, POINTS_PER_MODE * poles, turning))


def _points(system: ForceSystem, slowest: float):
    """Points of the tables (m), their pieces, and first point and number of points of each."""
    lengths = np.diff(system.breaks)
    most = table_points(system, slowest)
    count = np.maximum(8, np.ceil(most * lengths / lengths.sum()).astype(int) + 1)
    pieces = [
        np.linspace(left, right, n)
        for left, right, n in zip(system.breaks[:-1], system.breaks[1:], count, strict=True)
    ]
    piece = np.repeat(np.arange(count.size), count)
    return np.concatenate(pieces), piece, np.cumsum(count) - count, count
