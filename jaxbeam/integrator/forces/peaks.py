"""Peaks of a run under forces at constant speeds, from its events (see `system`)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from numpy.polynomial import chebyshev

from jaxbeam.case.trajectory import NEVER
from jaxbeam.integrator.forces.system import (
    ForceSystem,
    local_position,
    particular_solution,
    tabulated,
)
from jaxbeam.integrator.propagators import PEAK_NODES
from jaxbeam.integrator.running_peaks import Peaks
from jaxbeam.model.load_set import LoadSet
from jaxbeam.numerics.peak_search import estimate_peak, refine_peak

# Steps that can hold the peak are found from samples between which the fastest pole turns by 4/3
# rad: without faster parts, a peak is at most 1 / cos(2/3) times a sample (Duffin and Schaeffer).
COARSE_PHASE, COARSE_NODES = 4.0, (0.0, 1 / 3, 2 / 3, 1.0)
COARSE_MARGIN = 1.3
SAME_TIME_SHARE = 1e-12  # of the duration: closer times are one event


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
        tables[v] = tabulated(system, solutions[v])
    panels = _panels(system, row, solutions, duration)
    table = np.concatenate([tables[v] for v in np.unique(speed)])
    first_point = np.searchsorted(np.unique(speed), speed) * len(system.influence)
    outputs = _RowOutputs(system, row, panels, table, first_point)
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
            local = local_position(system.nodes, s, row.origin + row.speed * times[:, end])
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


class _RowOutputs(NamedTuple):
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
