"""Forces that move at constant speeds, in closed form: no time step, and no contact to solve.

In coordinates eta of the states z = V eta of the model, A V = V lambda, a force F at x = x0 + v t
acts by

    eta' = lambda eta + b(x) F,    b(x) = V^-1 B psi(x),

so that eta = F p(x) + a exp(lambda t), where v p' - lambda p = b(x): a polynomial between the nodes
of the mode shapes, as b is. All forces of one speed share p. The amplitudes a of the free vibration
change where a force enters, passes a node or leaves, so that eta is continuous. Outputs then are

    y = sum over the forces of F r(x) + Re(C a exp(lambda t)),    r(x) = Re(C p(x)) + influence(x),

the second term of r being static (`LinearOutputs`). r is tabulated once for a speed; a train is a
sum of shifted tables. Between samples the peaks are those of polynomials (`peak_search`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.sensing.linear_outputs import LinearOutputs
from jaxbeam.numerics.piecewise import chebyshev_polynomials

MAX_CONDITION = 1e6  # of the eigenvectors; beyond, poles are nearly repeated
TABLE_POINTS = 3000  # of the beam, at least; cubics between them are exact to 1e-9


class ForceSystem(NamedTuple):
    """A model and its outputs in coordinates of its poles (1/s), one of each conjugate pair.

    `forces` are the series (segment, term, pole) of b(x), `on_outputs` is C. Between the `breaks`
    (m) r(x) is smooth; it is tabulated at points in equal distances, a `count` of them from the
    `first` on in each piece: `influence` is its static part there, and `polynomials` are those of
    the series of all segments.
    """

    poles: Complex[np.ndarray, " pole"]
    forces: Complex[np.ndarray, "segment term pole"]
    on_outputs: Complex[np.ndarray, "output pole"]
    nodes: Float[np.ndarray, " node"]
    breaks: Float[np.ndarray, " break"]
    influence: Float[np.ndarray, "point output"]
    polynomials: tuple[Float[np.ndarray, "_ term"], ...]
    first: np.ndarray
    count: np.ndarray

    @property
    def wavenumber(self) -> float:
        """Bound of those of the mode shapes of a beam of one span (rad/m)."""
        return (self.poles.size + 1) * np.pi / float(self.nodes[-1] - self.nodes[0])

    @property
    def fastest(self) -> float:
        """Largest magnitude of a pole (1/s)."""
        return float(np.abs(self.poles).max())


def force_system(
    model: ModalModel, outputs: LinearOutputs, places: Float[np.ndarray, " place"]
) -> ForceSystem | None:
    """Model and outputs for moving forces; None for repeated poles, as of rigid-body motion.

    At the `places` (m) the influence of a force on outputs has kinks or jumps.
    """
    poles, vectors = np.linalg.eig(model.A)
    if not np.linalg.cond(vectors) < MAX_CONDITION or not np.abs(poles).min() > 0:
        return None
    own = poles.imag >= 0
    into = np.linalg.inv(vectors)[own][:, model.rate_index]
    if model.mode_map is not None:
        into = into @ model.mode_map.T
    on_outputs = outputs.rows @ vectors[:, own] * np.where(poles[own].imag > 0, 2.0, 1.0)
    nodes = np.asarray(model.modes.nodes)
    breaks = np.unique(np.concatenate([nodes, np.clip(places, nodes[0], nodes[-1])]))
    length = nodes[-1] - nodes[0]
    count = np.maximum(4, np.ceil(TABLE_POINTS * np.diff(breaks) / length).astype(int) + 1)
    pieces = [
        np.linspace(left, right, n)
        for left, right, n in zip(breaks[:-1], breaks[1:], count, strict=True)
    ]
    points = np.concatenate(pieces)
    near = np.repeat((breaks[:-1] + breaks[1:]) / 2, count)
    influence = np.zeros((points.size, on_outputs.shape[0]))
    if outputs.influence is not None:
        influence = np.asarray(outputs.influence.of_forces_at(points, near))
    first = np.cumsum(count) - count
    series = np.asarray(model.modes.series) @ into.T
    size, segment = _solution_size(series.shape[1]), np.searchsorted(nodes[1:-1], near)
    polynomials = tuple(
        chebyshev_polynomials(local_position(nodes, s, points[segment == s]), size)
        for s in range(nodes.size - 1)
    )
    parts = poles[own], series, on_outputs, nodes, breaks, influence, polynomials
    return ForceSystem(*parts, first, count)


def _solution_size(terms: int) -> int:
    """Number of terms of a particular solution, for as many of the force."""
    return terms + 6 * int(np.ceil(np.cbrt(terms))) + 12


def particular_solution(system: ForceSystem, speed: float) -> Complex[np.ndarray, "segment n pole"]:
    """Chebyshev series of p(x), with v p' - lambda p = b(x), in each segment at a speed v (m/s).

    By the recurrence 2 n p_n = c_(n-1) p'_(n-1) - p'_(n+1) of the coefficients of a derivative. Of
    a pole that turns far within a segment the polynomial of the degree of b; of others, the
    solution that vanishes at the left node.
    """
    segments, terms, poles = system.forces.shape
    size = _solution_size(terms)
    n = np.arange(size)
    c = np.where(n == 0, 2.0, 1.0)
    b = np.zeros((segments, size + 1, poles), complex)
    b[:, :terms] = system.forces
    right = np.zeros((segments, size, poles), complex)
    right[:, 1:] = c[:-1, None] * b[:, : size - 1] - b[:, 2:]
    result = np.zeros((segments, size, poles), complex)
    for s, half in enumerate(np.diff(system.nodes) / 2):
        rate = speed / half
        turns = np.abs(system.poles / rate)
        far = turns >= terms
        p = np.zeros((size + 1, poles), complex)
        for k in range(terms, 0, -1):  # from the highest coefficient down
            known = 2 * k * rate * p[k] + system.poles * p[k + 1] - right[s, k]
            p[k - 1] = known / (system.poles * c[k - 1])
        result[s] = np.where(far, p[:size], 0.0)
        near = np.flatnonzero(~far)
        if near.size:
            matrix = np.zeros((near.size, size, size), complex)
            matrix[:, n, n] = 2 * n * rate
            matrix[:, n[1:], n[:-1]] -= system.poles[near, None] * c[:-1]
            matrix[:, n[1:-1], n[2:]] += system.poles[near, None]
            matrix[:, 0] = (-1.0) ** n
            result[s][:, near] = np.linalg.solve(matrix, right[s][:, near].T[..., None])[..., 0].T
    return result


def tabulated(system: ForceSystem, solution) -> Float[np.ndarray, "point four output"]:
    """r(x) at the points of the beam for one speed, each with the three next points."""
    on_outputs = solution @ system.on_outputs.T
    parts = [T @ own.real for T, own in zip(system.polynomials, on_outputs, strict=True)]
    table = np.concatenate(parts) + system.influence
    return np.stack([np.roll(table, -i, axis=0) for i in range(4)], axis=1)


def local_position(nodes, segment: int, x):
    """Positions within a segment, -1 to 1."""
    return np.clip(2 * (x - nodes[segment]) / (nodes[segment + 1] - nodes[segment]) - 1, -1, 1)
