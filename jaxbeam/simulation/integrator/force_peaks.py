"""Peaks of runs under forces at constant speeds, searched only where bounds allow a peak.

Between two instants a time h apart an output y is at most h^2 / 8 max |y''| above the larger of its
values there. The y'' of free vibration is bounded by the amplitudes of its poles, that of the
forces by the tables (see `ForceResponses`). So most of a run need not be searched, and no peak is
missed: outputs there are below a value that is reached elsewhere.

Panels are the intervals between the passages of breaks by forces.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from jaxbeam.case.case import ALL, Case, replace
from jaxbeam.case.fields import concrete
from jaxbeam.case.loads.base import wheel_distances
from jaxbeam.case.trajectory import NEVER
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.numerics.polynomials import estimate_peak, refine_peak
from jaxbeam.simulation.integrator.discrete_model import PEAK_NODES
from jaxbeam.simulation.integrator.force_system import (
    ForceResponses,
    ForceSystem,
    product,
    solution_size,
    table_points,
)
from jaxbeam.simulation.integrator.peaks import Peaks


class ForcePaths(NamedTuple):
    """Moving forces: upwards (N) at x = origin + speed t (m, m/s), until the `duration` (s)."""

    origin: Float[np.ndarray, "run wheel"]
    speed: Float[np.ndarray, "run wheel"]
    force: Float[np.ndarray, " wheel"]
    duration: Float[np.ndarray, " run"]

    def passages(
        self, places: Float[np.ndarray, " place"]
    ) -> tuple[Float[np.ndarray, "run wheel place"], Bool[np.ndarray, "run wheel place"]]:
        """Times (s) at which forces pass places, clipped to the run, and whether they are in it."""
        times = (places - self.origin[..., None]) / self.speed[..., None]
        end = self.duration[:, None, None]
        return np.clip(times, 0.0, end), (times >= 0) & (times < end)

    def windows(self, left: float, right: float) -> tuple[np.ndarray, np.ndarray]:
        """Times (s) at which the forces (run, wheel) enter and leave between two ends (m)."""
        times, _ = self.passages(np.array([left, right]))
        return times.min(axis=-1), times.max(axis=-1)


def constant_speeds(loads: LoadSet) -> bool:
    """Whether all loads are forces that move at constant speeds."""
    if not loads.massless or loads.wheels.histories or not loads.trajectories:
        return False
    times, cubics = (np.asarray(part) for part in loads.cubics())
    straight = not np.any(cubics[:, 0, 2:]) and np.all(cubics[:, 0, 1])
    return bool(straight and np.all(times[:, 1:] >= NEVER))


class ForceWheels(NamedTuple):
    """Wheels, the same in all runs: forces upwards (N), distances behind the first wheel (m)."""

    force: Float[np.ndarray, " wheel"]
    behind: tuple[Float[np.ndarray, " wheel_of_load"], ...]


def force_wheels(case: Case) -> ForceWheels:
    """Wheels of the loads of a case; made once for all runs, as this takes longer than paths."""
    behind = tuple(_distances(case, i) for i in range(len(case.loads)))
    return ForceWheels(-np.asarray(load_set(case).weight)[:, 0], behind)


def _distances(case: Case, load: int) -> Float[np.ndarray, " wheel"]:
    """Distances (m) of the wheels of a load behind its first."""
    vehicle = case.loads[load].vehicle(case.run.gravity)
    return np.asarray(concrete(wheel_distances(case.loads[load], vehicle)))


def force_paths(
    case: Case,
    wheels: ForceWheels,
    addresses: Sequence[str],
    values: Float[np.ndarray, "run address"],
) -> ForcePaths:
    """Paths of the forces in runs with the `values` at some addresses of a case.

    Addresses are speeds, entry times, start positions and spacings of loads, and the duration.
    """
    runs, length = len(values), float(case.beam.length)
    column = dict(zip(addresses, values.T, strict=True))
    origins, speeds = [], []
    for i, load in enumerate(case.loads):

        def of_load(name, default=0.0, i=i, load=load):
            for address in (f"loads.{i}.{name}", f"loads.{ALL}.{name}"):
                if address in column:
                    return column[address]
            given = getattr(load, name)
            return np.broadcast_to(default if given is None else concrete(given), runs)

        speed, entry = of_load("speed"), of_load("entry_time")
        start = np.where(speed < 0, length, 0.0)
        if case.track is not None:
            start = case.track.start(speed, case.beam.length)
        start = of_load("start_position", start)
        behind = wheels.behind[i]
        if {f"loads.{i}.spacing", f"loads.{ALL}.spacing"} & set(addresses):
            spacings, index = np.unique(of_load("spacing"), return_inverse=True)
            own = [replace(case, {f"loads.{i}.spacing": one}) for one in spacings]
            behind = np.stack([_distances(one, i) for one in own])[index]
        first = (start - speed * entry)[:, None]
        origins.append(first - np.sign(speed)[:, None] * behind)
        speeds.append(np.broadcast_to(speed[:, None], origins[-1].shape))
    duration = column.get("run.duration", np.full(runs, float(case.run.duration)))
    return ForcePaths(np.concatenate(origins, 1), np.concatenate(speeds, 1), wheels.force, duration)


SAME_TIME_FRACTION = 1e-12  # of the duration: closer passages are at one time


class Panels(NamedTuple):
    """Panels of all runs in the order of time: run, start and length (s), free vibration, forces.

    `amplitude` is that of the poles at the start of the panel. Each of the `count` forces on the
    beam has a slot: `force` (N, upwards), `origin` (m), the position at t = 0, `speed` (m/s) with
    its index `response`, and `piece` of the beam.
    """

    run: Int[np.ndarray, " panel"]
    start: Float[np.ndarray, " panel"]
    length: Float[np.ndarray, " panel"]
    amplitude: Complex[np.ndarray, "panel pole"]
    count: Int[np.ndarray, " panel"]
    force: Float[np.ndarray, "panel slot"]
    origin: Float[np.ndarray, "panel slot"]
    speed: Float[np.ndarray, "panel slot"]
    response: Int[np.ndarray, "panel slot"]
    piece: Int[np.ndarray, "panel slot"]

    def forces_in(self, panel: Int[np.ndarray, " own"]):
        """Forces in some panels: indices of their panels in `panel`, and (panel, slot)."""
        which, slot = np.nonzero(np.arange(self.force.shape[1]) < self.count[panel][:, None])
        return which, (panel[which], slot)


def force_panels(responses: ForceResponses, paths: ForcePaths) -> Panels:
    """Panels of runs that begin at rest, with the free vibration in each."""
    system, duration = responses.system, paths.duration
    runs = duration.size
    response = np.searchsorted(responses.speeds, paths.speed)
    times, passed = paths.passages(system.breaks)
    jumps = _jumps(responses, paths, response, passed)
    times = times.reshape(runs, -1)
    order = np.argsort(times, axis=1, kind="stable")
    start = np.zeros((runs, order.shape[1] + 1))
    start[:, 1:] = np.take_along_axis(times, order, axis=1)
    length = np.diff(start, axis=1, append=duration[:, None])
    jumps = np.take_along_axis(jumps.reshape(runs, -1, system.poles.size), order[..., None], axis=1)
    decay = np.exp(system.poles * length[..., None])
    amplitude = np.empty((start.shape[1], runs, system.poles.size), complex)
    now = _of_forces_at_start(responses, paths, response)
    for i in range(start.shape[1]):
        amplitude[i] = now
        if i < order.shape[1]:
            now = now * decay[:, i] + jumps[:, i]
    run, kept = np.nonzero(length > SAME_TIME_FRACTION * duration[:, None])
    start, length = start[run, kept], length[run, kept]
    on_beam = _forces_on_beam(system, paths, run, start + length / 2)
    count, force, piece = on_beam
    parts = paths.force[force], paths.origin[run[:, None], force], paths.speed[run[:, None], force]
    own_response = response[run[:, None], force]
    return Panels(run, start, length, amplitude[kept, run], count, *parts, own_response, piece)


def _jumps(responses: ForceResponses, paths: ForcePaths, response, passed):
    """Jumps of the amplitudes of free vibration (run, wheel, break, pole) where forces pass breaks.

    Only nodes change the amplitudes: there the particular solution of a force changes.
    """
    system = responses.system
    change = np.zeros((responses.speeds.size, system.breaks.size, system.poles.size), complex)
    change[:, np.searchsorted(system.breaks, system.nodes)] = responses.before - responses.after
    change *= np.sign(responses.speeds)[:, None, None]
    return change[response] * (passed * paths.force[:, None])[..., None]


def _of_forces_at_start(responses: ForceResponses, paths: ForcePaths, response):
    """Amplitudes of free vibration (run, pole) at t = 0, from forces on the beam at the start."""
    system, nodes = responses.system, responses.system.nodes
    amplitude = np.zeros((paths.duration.size, system.poles.size), complex)
    x, speed = paths.origin, paths.speed
    # A force that enters at t = 0 passes the end then; a force that leaves then was inside.
    inside = np.where(
        speed > 0, (nodes[0] < x) & (x <= nodes[-1]), (nodes[0] <= x) & (x < nodes[-1])
    )
    for run, wheel in np.argwhere(inside):
        place = x[run, wheel]
        side = "left" if speed[run, wheel] > 0 else "right"  # a node is passed at t = 0
        segment = int(np.searchsorted(nodes[1:-1], place, side))
        p = responses.particular(int(response[run, wheel]), segment, np.array([place]))[0]
        amplitude[run] -= paths.force[wheel] * p
    return amplitude


def _forces_on_beam(system, paths: ForcePaths, run, middle):
    """Number, wheels and pieces of the beam of the forces on the beam at the middles of panels."""
    entry, leave = paths.windows(system.nodes[0], system.nodes[-1])
    on_beam = (entry[run] < middle[:, None]) & (middle[:, None] < leave[run])
    count = np.count_nonzero(on_beam, axis=1)
    panel, wheel = np.nonzero(on_beam)
    slot = np.arange(panel.size) - np.repeat(np.cumsum(count) - count, count)
    force = np.zeros((run.size, max(1, count.max(initial=0))), int)
    force[panel, slot] = wheel
    x = paths.origin[run[:, None], force] + paths.speed[run[:, None], force] * middle[:, None]
    piece = np.clip(np.searchsorted(system.breaks, x) - 1, 0, system.breaks.size - 2)
    return count, force, piece


BASIS_ERROR = 1e-13  # of outputs as sums of others, relative to the largest
CHUNK_STEPS = 24  # steps of a chunk
FEW_STEPS = 2  # steps of a chunk that is no longer than these
REFINEMENTS = 4  # parts into which a step is divided
MAX_REFINEMENTS = 4  # divisions of a step, one after the other
ENOUGH_STEPS = 8  # steps left in a run at which division ends
MAX_VALUES = 2.5e5  # values of forces at instants that are computed at once


def peaks_of_forces(responses: ForceResponses, paths: ForcePaths, phase: float) -> Peaks:
    """Peaks of runs from rest, one run in each batch; the fastest pole turns by `phase` in a step.

    `responses` include all speeds of the paths, `phase` is in rad. A run that is not finite has
    NaN.
    """
    panels = force_panels(responses, paths)
    search = _Search(responses, panels, paths.duration.size, phase)
    value, time = search.peaks()
    nodes = responses.system.nodes
    entry, leave = paths.windows(nodes[0], nodes[-1])
    entered = leave > entry
    lowest = np.where(entered, -paths.force, np.inf)
    lost = np.where(entered & (paths.force > 0), entry, np.nan)
    return Peaks(value[:, None], time[:, None], lowest[:, None], lost[:, None])


def search_bytes(
    system: ForceSystem, wheels: int, at_once: int, duration: float, slowest: float, phase: float
) -> float:
    """Upper bound of the memory (bytes) of the search of a run, without one chunk of values.

    The run has `wheels` forces, `at_once` of them on the beam, until the `duration` (s); the
    slowest moves at `slowest` (m/s), steps have a `phase` (rad). Counted are the arrays of
    `Panels`, of `_Search` and of `ForceResponses`.
    """
    outputs, poles = system.on_outputs.shape
    segments, terms, _ = system.forces.shape
    size = solution_size(terms)
    panels = 1 + wheels * system.breaks.size
    chunks = panels + duration * system.fastest / phase / CHUNK_STEPS
    points = table_points(system, slowest) + 8 * system.breaks.size
    numbers = panels * (12 * poles + 16 * at_once) + chunks * (12 * outputs + 8 * poles + 90)
    solutions = segments * size * (8 * poles + outputs) + 2 * poles * size**2
    return 8.0 * (numbers + solutions + points * (8 * outputs + size))


class _Search:
    """Search for peaks in chunks of a few steps, with bounds of the outputs in each chunk.

    `bound` is a bound of the output, `bend` of its second derivative (1/s^2), (chunk, output).
    """

    def __init__(self, responses: ForceResponses, panels: Panels, runs: int, phase: float):
        self.responses, self.panels, self.runs, self.phase = responses, panels, runs, phase
        system = responses.system
        self.poles, self.C = system.poles, system.on_outputs
        self._place_forces()
        parts = np.ceil(panels.length * (system.fastest / phase / CHUNK_STEPS)).astype(int)
        parts = np.maximum(parts, 1)
        self.panel = np.repeat(np.arange(parts.size), parts)
        self.run, self.length = panels.run[self.panel], (panels.length / parts)[self.panel]
        number = np.arange(self.panel.size) - np.repeat(np.cumsum(parts) - parts, parts)
        since = number * self.length
        self.start = panels.start[self.panel] + since
        self.amplitude = panels.amplitude[self.panel] * np.exp(since[:, None] * self.poles)
        growth = np.exp(np.maximum(self.poles.real, 0.0) * self.length.max(initial=0.0))
        size, largest = np.abs(self.amplitude) * growth, np.abs(self.C.T)
        on_beam = panels.force * (np.arange(panels.force.shape[1]) < panels.count[:, None])

        def of_forces(bound):
            """Sum (panel, output) of a bound (speed, piece, output) over the forces on the beam."""
            slots = zip(np.abs(on_beam).T, panels.response.T, panels.piece.T, strict=True)
            return sum(force[:, None] * bound[number, piece] for force, number, piece in slots)

        forced_bend = of_forces(responses.curvature)[self.panel]
        self.bend = product(size, largest * np.abs(self.poles[:, None]) ** 2) + forced_bend
        lines, self.cubic_slack = (
            2 * of_forces(error) for error in (responses.table_error, responses.cubic_error)
        )  # errors of a value and of the largest value reached
        self.slack = lines[self.panel]
        # Slow poles are bounded by values and curvature, too, the others by their amplitudes.
        half = (self.length / 2)[:, None]
        turn = (np.abs(self.poles) * half) ** 2 / 8
        slow = turn < 1
        now, growing = np.where(slow, self.amplitude, 0.0), np.exp(self.poles * half)
        index, weights = _basis_of_outputs(system)
        table = responses.table.reshape(-1, self.C.shape[0])[:, index]
        self.bound = np.zeros(self.bend.shape)
        for fraction in (0.0, 0.5, 1.0):
            times = (self.start + fraction * self.length)[:, None]
            forced = self._from_table(table, self.panel, times, np.zeros(self.panel.size, int))[
                :, 0
            ]
            if not fraction:
                values = product(forced + _free(self.amplitude, self.C[index]), weights)
                self.first = np.abs(values, out=values)
            values = product(forced + _free(now, self.C[index]), weights)
            np.maximum(self.bound, np.abs(values, out=values), out=self.bound)
            now = now * growing
        self.bound += product(size * np.where(slow, turn, 1.0), largest)
        self.bound += forced_bend * half**2 / 8
        self.bound += self.slack
        self.tables = np.moveaxis(responses.table, 2, 0).ravel()

    def _place_forces(self):
        """Set the table positions of forces: `place` at t = 0 (points), `rate` (points/s)."""
        panels, responses = self.panels, self.responses
        breaks, count = responses.system.breaks, responses.count
        density = ((count - 1) / np.diff(breaks))[panels.piece]
        self.place = (panels.origin - breaks[panels.piece]) * density
        self.rate = panels.speed * density
        points = responses.table.shape[1]
        self.offset = panels.response * points + responses.first[panels.piece]
        self.last = count[panels.piece] - 2

    def _from_table(self, table, panel, times, first, cubic: bool = False):
        """Sums of the values of the forces in panels, at times (panel, time), from tables.

        The tables, of each panel from its `first` row on, are interpolated linearly or by cubics.
        """
        width = times.shape[1] * (table.size // table.shape[0])
        if self._too_many(panel, width):
            parts = _halves(panel, times, first)
            return np.concatenate([self._from_table(table, *one, cubic=cubic) for one in parts])
        which, at = self.panels.forces_in(panel)
        place = self.place[at][:, None] + self.rate[at][:, None] * times[which]
        last = self.last[at][:, None]
        low = np.clip(place.astype(int), int(cubic), last - int(cubic))
        fraction = np.clip(place, 0.0, last + 1) - low
        low += (self.offset[at] + first[which])[:, None]
        if cubic:
            r = sum(w * table[low + i] for i, w in enumerate(_cubic_weights(fraction), start=-1))
            return _sums(self.panels.force[at][:, None] * r, which, panel.size)
        force = self.panels.force[at].reshape(-1, *(1,) * table.ndim)
        fraction = fraction.reshape(*fraction.shape, *(1,) * (table.ndim - 1))
        below = table[low]
        below += fraction * (table[low + 1] - below)
        below *= force
        return _sums(below, which, panel.size)

    def _too_many(self, panel, width: int) -> bool:
        """Whether arrays with `width` numbers for each force in panels are too large."""
        return panel.size > 1 and int(self.panels.count[panel].sum()) * width > MAX_VALUES

    def peaks(self) -> tuple[Float[np.ndarray, "run output"], Float[np.ndarray, "run output"]]:
        """Peaks of the outputs in all runs, and their times (s)."""
        return self._refined(*self._steps_of_peaks())

    def _steps_of_peaks(self):
        """Outputs, panels, starts, lengths (s) and initial amplitudes of steps that may have peaks.

        Each run has the peak of each output in one of these short steps.
        """
        outputs = self.C.shape[0]
        reached = np.zeros((outputs, self.runs))
        first = np.flatnonzero(np.diff(self.run, prepend=-1))
        if first.size:
            reached[:, self.run[first]] = np.maximum.reduceat(self.first, first, axis=0).T
        few = self.length * self.responses.system.fastest <= FEW_STEPS * self.phase
        found, bound = [], self.bound.T
        for chunks, parts in ((~few, CHUNK_STEPS), (few, FEW_STEPS)):
            may_have = (bound >= reached[:, self.run]) & (bound > 0) & chunks
            output, chunk = np.nonzero(may_have)
            own = self.panel[chunk], self.start[chunk], self.length[chunk], self.amplitude[chunk]
            bounds = self.bend[chunk, output], self.slack[chunk, output]
            found.append(self._parts_of_steps(reached.ravel(), parts, output, *own, *bounds))
        steps = [np.concatenate(part) for part in zip(*found, strict=True)]
        order = np.argsort(self._number(steps[0], steps[1]), kind="stable")
        steps = [part[order] for part in steps]
        for _ in range(MAX_REFINEMENTS):
            steps[-1] = self.cubic_slack[steps[1], steps[0]]
            reached = np.zeros(outputs * self.runs)  # those of linear interpolation may be too high
            steps = list(self._parts_of_steps(reached, REFINEMENTS, *steps, cubic=True))
            if steps[0].size <= ENOUGH_STEPS * reached.size:
                break
        return steps[:5]

    def _number(self, output, panel):
        """Number of an output in the run of a panel, among all outputs in all runs."""
        return output * self.runs + self.panels.run[panel]

    def _parts_of_steps(
        self, reached, parts, output, panel, start, length, amplitude, bend, slack, cubic=False
    ):
        """Output, panel, start, length, amplitude and bounds of steps' parts that may have a peak.

        An output may exceed the largest value `reached` in its run there; `reached` is updated.
        """
        if panel.size > 1 and panel.size * parts > MAX_VALUES:
            halves = _halves(output, panel, start, length, amplitude, bend, slack)
            found = [self._parts_of_steps(reached, parts, *half, cubic=cubic) for half in halves]
            return [np.concatenate(part) for part in zip(*found, strict=True)]
        step = length / parts
        times = start[:, None] + step[:, None] * np.arange(parts + 1)
        values, growth = self._values(output, panel, amplitude, step, times, cubic)
        number = self._number(output, panel)
        _raise_to(reached, number, values.max(axis=1))
        above = bend * step**2 / 8 + slack
        limit = np.maximum(values[:, 1:], values[:, :-1]) + above[:, None]
        which, part = np.nonzero(limit >= reached[number, None])
        amplitude = amplitude[which] * growth[which] ** part[:, None]
        parts_of = output[which], panel[which], times[which, part], step[which], amplitude
        return *parts_of, bend[which], slack[which]

    def _values(self, output, panel, amplitude, step, times, cubic: bool):
        """Magnitudes of outputs at equally spaced times; growth of free vibration in a step."""
        first = output * (self.tables.size // self.C.shape[0])
        values = self._from_table(self.tables, panel, times, first, cubic)
        growth = np.exp(step[:, None] * self.poles)
        now = amplitude * self.C[output]
        for i in range(times.shape[1]):
            values[:, i] += now.real.sum(axis=1)
            now *= growth
        return np.abs(values), growth

    def _refined(self, output, panel, start, length, amplitude):
        """Peaks and times (s) from polynomials through exact values at the nodes of short steps."""
        since = np.array(PEAK_NODES) * length[:, None]
        growth = np.exp(since[..., None] * self.poles)
        free = growth @ (amplitude * self.C[output])[..., None]
        samples = (free[..., 0].real + self._exact(output, panel, start[:, None] + since)).T
        number = self._number(output, panel)
        order = np.lexsort((estimate_peak(samples, PEAK_NODES), number))
        best = order[np.diff(number[order], append=-1) != 0]
        value, time = np.zeros((2, self.runs * self.C.shape[0]))
        found, position = refine_peak(samples[:, best], PEAK_NODES)
        value[number[best]], time[number[best]] = found, start[best] + position * length[best]
        finite = np.ones(self.runs, bool)
        finite[self.run[~np.isfinite(self.bound).all(axis=1)]] = False
        value, time = (
            np.where(finite[:, None], part.reshape(-1, self.runs).T, np.nan)
            for part in (value, time)
        )
        return value, time

    def _exact(self, output, panel, times):
        """Exact values of outputs due to the forces in panels at times (panel, time)."""
        if self._too_many(panel, times.shape[1] * self.responses.solutions.shape[2]):
            parts = _halves(output, panel, times)
            return np.concatenate([self._exact(*one) for one in parts])
        panels, breaks = self.panels, self.responses.system.breaks
        which, at = panels.forces_in(panel)
        piece = panels.piece[at]
        x = panels.origin[at][:, None] + panels.speed[at][:, None] * times[which]
        x = np.clip(x, breaks[piece, None], breaks[piece + 1, None])
        r = self.responses.exact(panels.response[at], piece, x, output[which])
        return _sums(panels.force[at][:, None] * r, which, panel.size)


def _free(amplitude, rows) -> Float[np.ndarray, "chunk output"]:
    """Outputs of free vibration with the amplitudes (chunk, pole), by rows (output, pole)."""
    parts = np.concatenate([amplitude.real, -amplitude.imag], axis=1)
    return product(parts, np.concatenate([rows.real.T, rows.imag.T]))


def _basis_of_outputs(system: ForceSystem):
    """Indices of some outputs, and weights (basis, output) with which they add up to all.

    Without static parts outputs are sums of modes, of which there are few.
    """
    # Imported here: it takes longer than most sweeps.
    from scipy.linalg.interpolative import interp_decomp, reconstruct_interp_matrix

    dynamic = np.flatnonzero(~system.has_static)
    index, weights = np.arange(system.on_outputs.shape[0]), np.eye(system.on_outputs.shape[0])
    if dynamic.size <= system.poles.size:
        return index, weights
    rows = system.on_outputs[dynamic]
    parts = np.concatenate([rows.real, rows.imag], axis=1)
    size = np.abs(parts).max(axis=1, keepdims=True)
    size[size == 0] = 1.0
    decomposed: Any = interp_decomp((parts / size).T, BASIS_ERROR, rand=False)
    rank, order, others = decomposed
    found = reconstruct_interp_matrix(order, others) * (size.T / size[order[:rank]])
    index = np.append(dynamic[order[:rank]], np.flatnonzero(system.has_static))
    weights = weights[index]
    weights[:rank, dynamic] = found
    return index, weights


def _halves(*arrays):
    """Both halves of arrays along their first axis."""
    half = arrays[0].shape[0] // 2
    return [part[:half] for part in arrays], [part[half:] for part in arrays]


def _cubic_weights(s):
    """Weights of the values at -1, 0, 1 and 2 in their interpolating cubic at s."""
    return (
        -s * (s - 1) * (s - 2) / 6,
        (s + 1) * (s - 1) * (s - 2) / 2,
        -(s + 1) * s * (s - 2) / 2,
        (s + 1) * s * (s - 1) / 6,
    )


def _sums(values, which, count: int):
    """Sums (count, ...) of consecutive values; `which` is the index of the sum of each value."""
    result = np.zeros((count, *values.shape[1:]))
    first = np.flatnonzero(np.diff(which, prepend=-1))
    if first.size:
        result[which[first]] = np.add.reduceat(values, first, axis=0)
    return result


def _raise_to(reached, run, values) -> None:
    """Raise `reached` of each run to the largest of its values, in place; runs are in order."""
    first = np.flatnonzero(np.diff(run, prepend=-1))
    if first.size:
        own = run[first]
        reached[own] = np.maximum(reached[own], np.maximum.reduceat(values, first))
