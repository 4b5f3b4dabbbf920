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
from numpy.polynomial import chebyshev

from jaxbeam.case.trajectory import NEVER
from jaxbeam.integrator.linear_outputs import LinearOutputs
from jaxbeam.integrator.propagators import PEAK_NODES
from jaxbeam.integrator.running_peaks import Peaks
from jaxbeam.model.load_set import LoadSet
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.numerics.peak_search import estimate_peak, refine_peak
from jaxbeam.numerics.piecewise import chebyshev_polynomials

MAX_CONDITION = 1e6  # of the eigenvectors; beyond, poles are nearly repeated
TABLE_POINTS = 3000  # of the beam, at least; cubics between them are exact to 1e-9
# Steps that can hold the peak are found from samples between which the fastest pole turns by 4/3
# rad: without faster parts, a peak is at most 1 / cos(2/3) times a sample (Duffin and Schaeffer).
COARSE_PHASE, COARSE_NODES = 4.0, (0.0, 1 / 3, 2 / 3, 1.0)
COARSE_MARGIN = 1.3
SAME_TIME_SHARE = 1e-12  # of the duration: closer times are one event


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
        np.linspace(*ends, n) for *ends, n in zip(breaks[:-1], breaks[1:], count, strict=True)
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
        chebyshev_polynomials(_local(nodes, s, points[segment == s]), size)
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


class _Row(NamedTuple):
    """Forces of one run or batch: positions x0 + v t (m), times on the beam (s), forces (N)."""

    origin: Float[np.ndarray, " wheel"]
    speed: Float[np.ndarray, " wheel"]
    windows: Float[np.ndarray, "wheel 2"]
    force: Float[np.ndarray, "wheel batch"]


class _Panels(NamedTuple):
    """Panels between events: boundaries (s), amplitudes at their start, wheels on the beam.

    `piece` is that of the beam on which each of the wheels is.
    """

    boundaries: Float[np.ndarray, " boundary"]
    amplitude: Complex[np.ndarray, "panel pole batch"]
    wheels: np.ndarray
    on_beam: np.ndarray
    piece: np.ndarray


def constant_speeds(loads: LoadSet) -> bool:
    """Whether all loads are forces that move at constant speeds."""
    if not loads.massless or loads.wheels.histories or not loads.trajectories:
        return False
    times, cubics = (np.asarray(part) for part in loads.cubics())
    straight = not np.any(cubics[:, 0, 2:]) and np.all(cubics[:, 0, 1])
    return bool(straight and np.all(times[:, 1:] >= NEVER))


def peaks_of_forces(
    system: ForceSystem, loads: LoadSet, duration: float, max_phase: float
) -> Peaks:
    """Peaks of a run of `duration` (s) under forces at constant speeds, from rest.

    Polynomials find the peaks between samples, in steps in which the fastest pole turns by at most
    `max_phase` (rad), and so does the highest of the mode shapes under a force.
    """
    starts, cubics = (np.asarray(part) for part in loads.cubics())
    speed = cubics[:, 0, 1]
    windows = np.clip(np.asarray(loads.entry_exit_times()), 0.0, duration)
    row = _Row(cubics[:, 0, 0] - speed * starts[:, 0], speed, windows, -np.asarray(loads.weight))
    tables, solutions = {}, {}
    for v in np.unique(speed):
        solutions[v] = particular_solution(system, v)
        tables[v] = _table(system, solutions[v])
    panels = _panels(system, row, solutions, duration)
    table = np.concatenate([tables[v] for v in np.unique(speed)])
    first_point = np.searchsorted(np.unique(speed), speed) * len(system.influence)
    outputs = _Outputs(system, row, panels, table, first_point)
    rate = max(system.fastest, system.wavenumber * np.abs(speed).max())
    max_step, coarse = max_phase / rate, max(max_phase, COARSE_PHASE) / rate
    steps = _steps(panels.boundaries, coarse)
    largest = np.abs(outputs.at(*steps, COARSE_NODES)).max(axis=0)
    reached = largest.max(axis=0)
    chosen = np.flatnonzero((largest * COARSE_MARGIN >= reached).any(axis=(1, 2)))
    parts = int(np.ceil(coarse / max_step * (1 - 1e-9)))
    panel, start, length = (np.repeat(part[chosen], parts) for part in steps)
    length = length / parts
    start = start + length * np.tile(np.arange(parts), chosen.size)
    samples = outputs.at(panel, start, length, PEAK_NODES)
    estimate = estimate_peak(samples, PEAK_NODES)
    best = np.argmax(estimate, axis=0)  # output, batch
    of_best = np.take_along_axis(samples, best[None, None], axis=1)[:, 0]
    value, position = refine_peak(of_best, PEAK_NODES)
    time = start[best] + position * length[best]
    entered = (windows[:, 1] > windows[:, 0])[:, None]
    lowest = np.where(entered, -row.force, np.inf)
    lost = np.where(entered & (row.force > 0), windows[:, :1], np.nan)
    return Peaks(value.T, time.T, lowest.T, lost.T)


def _table(system: ForceSystem, solution) -> Float[np.ndarray, "point four output"]:
    """r(x) at the points of the beam for one speed, each with the three next points."""
    on_outputs = solution @ system.on_outputs.T
    parts = [T @ own.real for T, own in zip(system.polynomials, on_outputs, strict=True)]
    table = np.concatenate(parts) + system.influence
    return np.stack([np.roll(table, -i, axis=0) for i in range(4)], axis=1)


def _local(nodes, segment: int, x):
    """Positions within a segment, -1 to 1."""
    return np.clip(2 * (x - nodes[segment]) / (nodes[segment + 1] - nodes[segment]) - 1, -1, 1)


def _panels(system: ForceSystem, row: _Row, solutions, duration: float) -> _Panels:
    """Panels between the events of a run, and the free vibration in each."""
    entry, leave = row.windows.T
    passages = (system.breaks - row.origin[:, None]) / row.speed[:, None]
    passages = np.clip(passages, entry[:, None], leave[:, None])
    times = np.sort(np.concatenate([[0.0], row.windows.ravel(), passages.ravel()]))
    same = SAME_TIME_SHARE * duration
    times = times[(np.diff(times, prepend=-np.inf) > same) & (times < duration - same)]
    boundaries = np.append(times, duration)
    jumps = np.zeros((boundaries.size, system.poles.size, row.force.shape[1]), complex)
    at_nodes = (system.nodes - row.origin[:, None]) / row.speed[:, None]
    at_nodes = np.clip(at_nodes, entry[:, None], leave[:, None])
    for s in range(system.nodes.size - 1):
        times = np.sort(at_nodes[:, s : s + 2], axis=1)
        inside = times[:, 1] > times[:, 0]
        for end, sign in ((0, -1.0), (1, 1.0)):
            local = _local(system.nodes, s, row.origin + row.speed * times[:, end])
            for v, solution in solutions.items():
                wheels = np.flatnonzero(inside & (row.speed == v))
                p = chebyshev.chebval(local[wheels], solution[s]).T.reshape(wheels.size, -1)
                index = np.searchsorted(boundaries, times[wheels, end] - same)
                np.add.at(jumps, index, sign * p[:, :, None] * row.force[wheels, None])
    decay = np.exp(system.poles * np.diff(boundaries, prepend=0.0)[:, None])[..., None]
    amplitude, now = np.zeros((boundaries.size - 1, *jumps.shape[1:]), complex), 0.0
    for i in range(boundaries.size - 1):
        now = now * decay[i] + jumps[i]
        amplitude[i] = now
    middle = (boundaries[1:] + boundaries[:-1]) / 2
    on_beam = (entry < middle[:, None]) & (middle[:, None] < leave)
    most = max(1, int(on_beam.sum(axis=1).max()))
    wheels = np.argsort(~on_beam, axis=1, kind="stable")[:, :most]
    on_beam = np.take_along_axis(on_beam, wheels, axis=1)
    x = row.origin[wheels] + row.speed[wheels] * middle[:, None]
    piece = np.clip(np.searchsorted(system.breaks, x) - 1, 0, system.count.size - 1)
    return _Panels(boundaries, amplitude, wheels, on_beam, piece)


def _steps(boundaries, max_step: float):
    """Panel, start (s) and length (s) of equal steps within panels."""
    lengths = np.diff(boundaries)
    counts = np.ceil(lengths / max_step).astype(int)
    panel = np.repeat(np.arange(counts.size), counts)
    length = (lengths / np.maximum(counts, 1))[panel]
    number = np.arange(panel.size) - np.repeat(np.cumsum(counts) - counts, counts)
    return panel, boundaries[panel] + number * length, length


class _Outputs(NamedTuple):
    """Outputs at the peak nodes of steps."""

    system: ForceSystem
    row: _Row
    panels: _Panels
    table: Float[np.ndarray, "point four output"]
    first_point: np.ndarray

    def at(self, panel, start, length, nodes) -> Float[np.ndarray, "node step output batch"]:
        """Outputs at nodes (shares of the length) of steps: panel, start and length (s)."""
        nodes = np.asarray(nodes)
        return self._free(panel, start, length, nodes) + self._forced(panel, start, length, nodes)

    def _free(self, panel, start, length, nodes):
        """Free vibration: growth from the start of the panel to that of the step, and within it."""
        poles, C = self.system.poles, self.system.on_outputs
        since = start - self.panels.boundaries[panel]
        amplitude = self.panels.amplitude[panel] * np.exp(since[:, None] * poles)[..., None]
        lengths, kind = np.unique(length, return_inverse=True)
        growth = np.exp(np.multiply.outer(lengths[:, None] * nodes, poles))
        growth = np.concatenate([growth.real, -growth.imag], axis=-1)[kind]
        vibration = C[:, :, None] * amplitude[:, None]  # step, output, pole, batch
        vibration = np.concatenate([vibration.real, vibration.imag], axis=2)
        return np.einsum("snk,sokb->nsob", growth, vibration)

    def _forced(self, panel, start, length, nodes):
        """Forces on the beam: r(x) by cubics through four points of its table."""
        outputs, batch = self.table.shape[2], self.row.force.shape[1]
        result = np.zeros((nodes.size, panel.size, outputs, batch))
        breaks, count, first = self.system.breaks, self.system.count, self.system.first
        for on_beam, wheels, pieces in zip(
            self.panels.on_beam.T, self.panels.wheels.T, self.panels.piece.T, strict=True
        ):
            here = np.flatnonzero(on_beam[panel])
            wheel, piece = wheels[panel[here]], pieces[panel[here]]
            x = self.row.origin[wheel] + self.row.speed[wheel] * start[here]
            x = x + np.multiply.outer(nodes, self.row.speed[wheel] * length[here])
            place = (x - breaks[piece]) * ((count - 1) / np.diff(breaks))[piece]
            low = np.clip(place.astype(int) - 1, 0, count[piece] - 4)
            s = place - low
            weights = (
                -(s - 1) * (s - 2) * (s - 3) / 6,
                s * (s - 2) * (s - 3) / 2,
                -s * (s - 1) * (s - 3) / 2,
                s * (s - 1) * (s - 2) / 6,
            )
            around = self.table[low + self.first_point[wheel] + first[piece]]
            values = np.einsum("ins,nsio->nso", np.stack(weights), around)
            result[:, here] += values[..., None] * self.row.force[wheel][:, None]
        return result
