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
from jaxbeam.integrator.forces.system import ForceResponses
from jaxbeam.integrator.propagators import PEAK_NODES
from jaxbeam.integrator.running_peaks import Peaks
from jaxbeam.numerics.peak_search import estimate_peak, refine_peak

CHUNK_STEPS = 12
REFINEMENTS = 4  # of a step


def peaks_of_forces(responses: ForceResponses, paths: ForcePaths, phase: float) -> Peaks:
    """Peaks of runs from rest, one to a batch; the fastest pole turns by `phase` (rad) in a step.

    `responses` are those to forces of all speeds of the paths. A run that is not finite has NaN.
    """
    panels = force_panels(responses, paths)
    search = _Search(responses, panels, paths.duration.size, phase)
    found = [search.peaks(output) for output in range(responses.table.shape[2])]
    value, time = (np.stack(part, axis=-1)[:, None] for part in zip(*found, strict=True))
    nodes = responses.system.nodes
    entry, leave = paths.windows(nodes[0], nodes[-1])
    entered = leave > entry
    lowest = np.where(entered, -paths.force, np.inf)
    lost = np.where(entered & (paths.force > 0), entry, np.nan)
    return Peaks(value, time, lowest[:, None], lost[:, None])


class _Search:
    """Chunks of a few steps, within panels, with bounds of the outputs in each.

    `bound` is one of the output, `bend` one of its second derivative (1/s^2), both (chunk, output).
    """

    def __init__(self, responses: ForceResponses, panels: Panels, runs: int, phase: float):
        self.responses, self.panels, self.runs = responses, panels, runs
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
        forced_bend = np.einsum(
            "ps,pso->po", np.abs(on_beam), responses.curvature[panels.response]
        )[self.panel]
        self.bend = size @ (largest * np.abs(self.poles[:, None]) ** 2) + forced_bend
        slack = np.einsum("ps,pso->po", np.abs(on_beam), responses.table_error[panels.response])
        self.slack = 2 * slack[self.panel]  # of a value, and of that which is reached
        forced = np.stack([self._forced_all(share) for share in (0.0, 0.5, 1.0)])
        half = (self.length / 2)[:, None]
        self.bound = size @ largest + np.abs(forced).max(axis=0) + forced_bend * half**2 / 8
        self.bound += self.slack
        self.first = np.abs(forced[0] + (self.amplitude @ self.C.T).real)

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

    def _forced_all(self, share: float) -> Float[np.ndarray, "chunk output"]:
        """All outputs under the forces, at the same share of each chunk, from the tables."""
        table = self.responses.table.reshape(-1, self.C.shape[0])
        return self._from_table(table, self.panel, self.start + share * self.length)

    def _from_table(self, table, panel, time):
        """Values of a table under the forces in panels, at times (panel, *time)."""
        result = np.zeros((*time.shape, *table.shape[1:]))
        for slot in range(self.place.shape[1]):
            here = np.flatnonzero(self.panels.count[panel] > slot)
            at = panel[here], slot
            own = time[here]

            def wide(array, like=own, at=at):
                return array[at].reshape(-1, *(1,) * (like.ndim - 1))

            place = wide(self.place) + wide(self.rate) * own
            low = np.clip(place.astype(int), 0, wide(self.last))
            share = np.clip(place - low, 0.0, 1.0)
            share = share.reshape(*share.shape, *(1,) * (table.ndim - 1))
            low += wide(self.offset)
            below, above = table[low], table[low + 1]
            force = self.panels.force[at].reshape(-1, *(1,) * (below.ndim - 1))
            result[here] += force * (below + share * (above - below))
        return result

    def peaks(self, output: int):
        """Peak of an output in each run, and its time (s)."""
        reached = np.zeros(self.runs)
        np.maximum.at(reached, self.run, self.first[:, output])
        bad = np.isnan(self.bound[:, output])
        reached[self.run[bad]] = np.nan
        bound = self.bound[:, output]
        chunk = np.flatnonzero((bound >= reached[self.run]) & (bound > 0))
        panel, start, amplitude = self.panel[chunk], self.start[chunk], self.amplitude[chunk]
        length, bend, slack = self.length[chunk], self.bend[chunk, output], self.slack[chunk, output]
        for parts in (CHUNK_STEPS, REFINEMENTS, REFINEMENTS):
            step = length / parts
            times = start[:, None] + step[:, None] * np.arange(parts + 1)
            values, growth = self._values(output, panel, amplitude, step, times)
            np.maximum.at(reached, self.panels.run[panel], values.max(axis=1))
            limit = np.maximum(values[:, 1:], values[:, :-1]) + (bend * step**2 / 8 + slack)[:, None]
            which, part = np.nonzero(limit >= reached[self.panels.run[panel], None])
            amplitude = amplitude[which] * growth[which] ** part[:, None]
            start, panel, length = times[which, part], panel[which], step[which]
            bend, slack = bend[which], slack[which]
        return self._refined(output, panel, start, length, amplitude, reached)

    def _values(self, output: int, panel, amplitude, step, times):
        """Magnitudes of an output at equally spaced times, and growth of free vibration in a step.

        From one time to the next by the growth.
        """
        table = np.ascontiguousarray(self.responses.table[..., output]).reshape(-1)
        values = self._from_table(table, panel, times)
        growth = np.exp(step[:, None] * self.poles)
        now = amplitude * self.C[output]
        for i in range(times.shape[1]):
            values[:, i] += now.real.sum(axis=1)
            now = now * growth
        return np.abs(values), growth

    def _refined(self, output: int, panel, start, length, amplitude, reached):
        """Peaks in short steps by the polynomials through exact values at the peak nodes."""
        nodes = np.asarray(PEAK_NODES)
        since = nodes[:, None] * length
        free = np.einsum("nsk,sk->ns", np.exp(since[..., None] * self.poles), amplitude * self.C[output]).real
        samples = free + self._exact(output, panel, start + since)
        run = self.panels.run[panel]
        estimate = estimate_peak(samples, PEAK_NODES)
        order = np.lexsort((estimate, run))
        last = np.flatnonzero(np.diff(run[order], append=-1))
        best = order[last]
        value, time = np.full(self.runs, np.nan), np.zeros(self.runs)
        value[reached == 0] = 0.0
        refined, position = refine_peak(samples[:, best], PEAK_NODES)
        value[run[best]] = refined
        time[run[best]] = start[best] + position * length[best]
        return value, time

    def _exact(self, output: int, panel, times):
        """Exact values of an output under the forces at times (node, panel)."""
        result, panels, breaks = np.zeros(times.shape), self.panels, self.responses.system.breaks
        for slot in range(panels.force.shape[1]):
            here = np.flatnonzero(panels.count[panel] > slot)
            at = panel[here], slot
            piece = panels.piece[at]
            x = panels.origin[at] + panels.speed[at] * times[:, here]
            x = np.clip(x, breaks[piece], breaks[piece + 1])
            number, pieces = (np.broadcast_to(a, x.shape) for a in (panels.response[at], piece))
            result[:, here] += panels.force[at] * self.responses.exact(number, pieces, x, output)
        return result
