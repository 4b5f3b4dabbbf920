"""Peaks of runs under forces at constant speeds: search where bounds allow one.

Between two instants a time h apart an output y is at most h^2 / 8 max |y''| above the larger of its
values there. Of free vibration y'' is bounded by the amplitudes of its poles, of the forces by the
tables (see `ForceResponses`). So most of a run is left out without a look, and no peak is missed:
what is left out is below a value that is reached.
"""

import numpy as np
from jaxtyping import Float

from jaxbeam.integrator.forces.panels import Panels, force_panels
from jaxbeam.integrator.forces.paths import ForcePaths
from jaxbeam.integrator.forces.products import product
from jaxbeam.integrator.forces.system import (
    ForceResponses,
    ForceSystem,
    solution_size,
    table_points,
)
from jaxbeam.integrator.peaks.running_peaks import Peaks
from jaxbeam.integrator.propagators import PEAK_NODES
from jaxbeam.numerics.peak_search import estimate_peak, refine_peak

CHUNK_STEPS = 16  # of a chunk, or FEW_STEPS of one that is no longer than these
FEW_STEPS = 2
REFINEMENTS = 4  # of a step,
MAX_REFINEMENTS = 4  # at most so often,
ENOUGH_STEPS = 8  # until no more steps than these are left in a run
MAX_VALUES = 2.5e5  # of forces at instants at once


def peaks_of_forces(responses: ForceResponses, paths: ForcePaths, phase: float) -> Peaks:
    """Peaks of runs from rest, one to a batch; the fastest pole turns by `phase` (rad) in a step.

    `responses` are those to forces of all speeds of the paths. A run that is not finite has NaN.
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
    """Memory (bytes) that the search of a run takes at most, beside that of one chunk of values.

    Of `wheels` forces, so many `at_once` on the beam, until the `duration` (s), the slowest at a
    speed (m/s); steps are of a `phase` (rad). Counted are the arrays of `Panels`, of `_Search` and
    of `ForceResponses`.
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
    """Chunks of a few steps, within panels, with bounds of the outputs in each.

    `bound` is one of the output, `bend` one of its second derivative (1/s^2), both (chunk, output).
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
        )  # of a value, and of that which is reached
        self.slack = lines[self.panel]
        forced = np.stack([self._forced(share) for share in (0.0, 0.5, 1.0)])
        half = (self.length / 2)[:, None]
        self.bound = product(size, largest) + np.abs(forced).max(axis=0) + forced_bend * half**2 / 8
        self.bound += self.slack
        self.tables = np.ascontiguousarray(np.moveaxis(responses.table, 2, 0))
        self.tables = self.tables.reshape(self.C.shape[0], -1)
        self.first = np.abs(forced[0] + product(self.amplitude, self.C.T).real)

    def _place_forces(self):
        """Where forces are in the tables: index of the point before it at t = 0, and points/s."""
        panels, responses = self.panels, self.responses
        breaks, count = responses.system.breaks, responses.count
        density = ((count - 1) / np.diff(breaks))[panels.piece]
        self.place = (panels.origin - breaks[panels.piece]) * density
        self.rate = panels.speed * density
        points = responses.table.shape[1]
        self.offset = panels.response * points + responses.first[panels.piece]
        self.last = count[panels.piece] - 2

    def _forced(self, share: float) -> Float[np.ndarray, "chunk output"]:
        """All outputs under the forces, at the same share of each chunk, from the tables."""
        table = self.responses.table.reshape(-1, self.C.shape[0])
        times = (self.start + share * self.length)[:, None]
        return self._from_table(table, self.panel, times)[:, 0]

    def _from_table(self, table, panel, times, cubic: bool = False):
        """Values of a table under the forces in panels, at times (panel, time).

        On lines between its points, or on cubics.
        """
        width = times.shape[1] * (table.size // table.shape[0])
        if self._too_many(panel, width):
            parts = _halves(panel, times)
            return np.concatenate([self._from_table(table, *one, cubic=cubic) for one in parts])
        which, at = self.panels.forces_in(panel)
        place = self.place[at][:, None] + self.rate[at][:, None] * times[which]
        last = self.last[at][:, None]
        low = np.clip(place.astype(int), int(cubic), last - int(cubic))
        share = np.clip(place, 0.0, last + 1) - low
        low += self.offset[at][:, None]
        if cubic:
            r = sum(w * table[low + i] for i, w in enumerate(_cubic_weights(share), start=-1))
            return _sums(self.panels.force[at][:, None] * r, which, panel.size)
        force = self.panels.force[at].reshape(-1, *(1,) * table.ndim)
        share = share.reshape(*share.shape, *(1,) * (table.ndim - 1))
        below = table[low]
        below += share * (table[low + 1] - below)
        below *= force
        return _sums(below, which, panel.size)

    def _too_many(self, panel, width: int) -> bool:
        """Whether arrays with so many numbers for each force in panels are too large."""
        return panel.size > 1 and int(self.panels.count[panel].sum()) * width > MAX_VALUES

    def peaks(self) -> tuple[Float[np.ndarray, "run output"], Float[np.ndarray, "run output"]]:
        """Peaks of the outputs in all runs, and their times (s)."""
        steps = [self._steps_of_peak(output) for output in range(self.C.shape[0])]
        output = np.repeat(np.arange(len(steps)), [step[0].size for step in steps])
        return self._refined(output, *(np.concatenate(part) for part in zip(*steps, strict=True)))

    def _steps_of_peak(self, output: int):
        """Short steps in one of which each run has the peak of an output.

        Their panels, starts and lengths (s), and the amplitudes at the start.
        """
        reached, bound = np.zeros(self.runs), self.bound[:, output]
        _raise_to(reached, self.run, self.first[:, output])
        few = self.length * self.responses.system.fastest <= FEW_STEPS * self.phase
        found = []
        for chunks, parts in ((~few, CHUNK_STEPS), (few, FEW_STEPS)):
            chunk = np.flatnonzero(chunks & (bound >= reached[self.run]) & (bound > 0))
            own = self.panel[chunk], self.start[chunk], self.length[chunk], self.amplitude[chunk]
            bounds = self.bend[chunk, output], self.slack[chunk, output]
            found.append(self._parts_of_steps(output, parts, reached, *own, *bounds))
        steps = [np.concatenate(part) for part in zip(*found, strict=True)]
        order = np.argsort(self.panels.run[steps[0]], kind="stable")
        steps = [part[order] for part in steps]
        for _ in range(MAX_REFINEMENTS):
            steps[-1] = self.cubic_slack[steps[0], output]
            reached = np.zeros(self.runs)  # what lines reach may be too high
            steps = list(self._parts_of_steps(output, REFINEMENTS, reached, *steps, cubic=True))
            if steps[0].size <= ENOUGH_STEPS * self.runs:
                break
        return steps[:4]

    def _parts_of_steps(
        self, output, parts, reached, panel, start, length, amplitude, bend, slack, cubic=False
    ):
        """Parts of steps in which an output may be above what is reached, which is raised.

        Panel, start, length, amplitude, and bounds of each.
        """
        step = length / parts
        times = start[:, None] + step[:, None] * np.arange(parts + 1)
        values, growth = self._values(output, panel, amplitude, step, times, cubic)
        run = self.panels.run[panel]
        _raise_to(reached, run, values.max(axis=1))
        above = bend * step**2 / 8 + slack
        limit = np.maximum(values[:, 1:], values[:, :-1]) + above[:, None]
        which, part = np.nonzero(limit >= reached[run, None])
        amplitude = amplitude[which] * growth[which] ** part[:, None]
        parts_of = panel[which], times[which, part], step[which], amplitude
        return *parts_of, bend[which], slack[which]

    def _values(self, output: int, panel, amplitude, step, times, cubic: bool):
        """Magnitudes of an output at equally spaced times, and growth of free vibration in a step.

        From one time to the next by the growth.
        """
        values = self._from_table(self.tables[output], panel, times, cubic)
        growth = np.exp(step[:, None] * self.poles)
        now = amplitude * self.C[output]
        for i in range(times.shape[1]):
            values[:, i] += now.real.sum(axis=1)
            now *= growth
        return np.abs(values), growth

    def _refined(self, output, panel, start, length, amplitude):
        """Peaks, and times (s), by the polynomials through exact values at nodes of short steps."""
        since = np.array(PEAK_NODES) * length[:, None]
        growth = np.exp(since[..., None] * self.poles)
        free = growth @ (amplitude * self.C[output])[..., None]
        samples = (free[..., 0].real + self._exact(output, panel, start[:, None] + since)).T
        number = self.panels.run[panel] * self.C.shape[0] + output
        order = np.lexsort((estimate_peak(samples, PEAK_NODES), number))
        best = order[np.diff(number[order], append=-1) != 0]
        value, time = np.zeros((2, self.runs * self.C.shape[0]))
        found, position = refine_peak(samples[:, best], PEAK_NODES)
        value[number[best]], time[number[best]] = found, start[best] + position * length[best]
        finite = np.ones(self.runs, bool)
        finite[self.run[~np.isfinite(self.bound).all(axis=1)]] = False
        value, time = (
            np.where(finite[:, None], part.reshape(self.runs, -1), np.nan) for part in (value, time)
        )
        return value, time

    def _exact(self, output, panel, times):
        """Exact values of outputs under the forces in panels at times (panel, time)."""
        if self._too_many(panel, times.shape[1] * self.responses.solutions.shape[2]):
            parts = _halves(output, panel, times)
            return np.concatenate([self._exact(*one) for one in parts])
        panels, breaks = self.panels, self.responses.system.breaks
        which, at = panels.forces_in(panel)
        piece = np.repeat(panels.piece[at], times.shape[1])
        x = panels.origin[at][:, None] + panels.speed[at][:, None] * times[which]
        x = np.clip(x.reshape(-1), breaks[piece], breaks[piece + 1])
        number, own = (np.repeat(a, times.shape[1]) for a in (panels.response[at], output[which]))
        r = self.responses.exact(number, piece, x, own).reshape(-1, times.shape[1])
        return _sums(panels.force[at][:, None] * r, which, panel.size)


def _halves(*arrays):
    """Both halves of arrays along their first axis."""
    half = arrays[0].shape[0] // 2
    return [part[:half] for part in arrays], [part[half:] for part in arrays]


def _cubic_weights(s):
    """Weights of values at -1, 0, 1 and 2 in the cubic through them, at s."""
    return (
        -s * (s - 1) * (s - 2) / 6,
        (s + 1) * (s - 1) * (s - 2) / 2,
        -(s + 1) * s * (s - 2) / 2,
        (s + 1) * s * (s - 1) / 6,
    )


def _sums(values, which, count: int):
    """Sums (count, ...) of consecutive values, of which each belongs to one."""
    result = np.zeros((count, *values.shape[1:]))
    first = np.flatnonzero(np.diff(which, prepend=-1))
    if first.size:
        result[which[first]] = np.add.reduceat(values, first, axis=0)
    return result


def _raise_to(reached, run, values) -> None:
    """Raise what is reached in each run to the largest of its values; runs are in order."""
    first = np.flatnonzero(np.diff(run, prepend=-1))
    if first.size:
        own = run[first]
        reached[own] = np.maximum(reached[own], np.maximum.reduceat(values, first))
