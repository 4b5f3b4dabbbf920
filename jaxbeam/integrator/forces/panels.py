"""Panels of runs under moving forces: intervals between the passages of breaks by forces."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from jaxbeam.integrator.forces.paths import ForcePaths
from jaxbeam.integrator.forces.system import ForceResponses

SAME_TIME_SHARE = 1e-12  # of the duration: closer passages are at one time


class Panels(NamedTuple):
    """Panels of all runs in the order of time: run, start and length (s), free vibration, forces.

    `amplitude` is that of the poles at the start. Of the `count` forces on the beam in each panel:
    N upwards, position at t = 0 (m), speed (m/s) with its number, and piece of the beam.
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
        """Forces in some of the panels: which of these, and indices of panel and slot."""
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
    run, kept = np.nonzero(length > SAME_TIME_SHARE * duration[:, None])
    start, length = start[run, kept], length[run, kept]
    on_beam = _forces_on_beam(system, paths, run, start + length / 2)
    count, force, piece = on_beam
    parts = paths.force[force], paths.origin[run[:, None], force], paths.speed[run[:, None], force]
    own_response = response[run[:, None], force]
    return Panels(run, start, length, amplitude[kept, run], count, *parts, own_response, piece)


def _jumps(responses: ForceResponses, paths: ForcePaths, response, passed):
    """Jumps of the amplitudes (run, wheel, break, pole) where forces pass breaks.

    Only nodes change them: there a force leaves one particular solution for another.
    """
    system = responses.system
    change = np.zeros((responses.speeds.size, system.breaks.size, system.poles.size), complex)
    change[:, np.searchsorted(system.breaks, system.nodes)] = responses.before - responses.after
    change *= np.sign(responses.speeds)[:, None, None]
    return change[response] * (passed * paths.force[:, None])[..., None]


def _of_forces_at_start(responses: ForceResponses, paths: ForcePaths, response):
    """Amplitudes (run, pole) at t = 0, of the forces that are on the beam then."""
    system, nodes = responses.system, responses.system.nodes
    amplitude = np.zeros((paths.duration.size, system.poles.size), complex)
    x, speed = paths.origin, paths.speed
    # One that enters at t = 0 passes the end then; one that leaves then was inside.
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
    """Number of the forces on the beam at the middles of panels; those forces, and their pieces."""
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
