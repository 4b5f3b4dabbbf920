"""Memory that the runs of a sweep take in a block, counted from the sizes of its arrays."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.fields import concrete
from jaxbeam.case.sensors import Sensor
from jaxbeam.integrator import native_peaks
from jaxbeam.integrator.propagators import NODE_COUNT, PEAK_NODES
from jaxbeam.integrator.step_matrices import CHUNK_STEPS
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import has_coupling
from jaxbeam.model.modes import mesh_layout
from jaxbeam.simulation.integration_plan import sample_times

STEPS_PER_MODE = 40  # of a crossing: twice those with which a search for step sizes begins


class RunSizes(NamedTuple):
    """Sizes of the runs of a sweep that decide how much memory they take.

    A wheel passes `places` on the beam where steps end, besides those of corrected sensors. With
    histories there are `samples`, and so many `steps` in a run; so many `given_steps` where a
    profile or forces over time are given at the nodes of each, forces of each run.
    """

    modes: int
    states: int
    coupled: bool
    wheels: int
    places: int
    samples: int
    steps: int
    given_steps: int
    has_forces: bool

    def batch_bytes(self, sensors: Sequence[Sensor], runs: int) -> float:
        """Memory (bytes) of a batch of so many runs with some sensors, at most.

        Counted are the matrices of all step lengths (those of C in `native/workspace.h`, those of
        JAX in `DiscreteModel`), of a chunk of steps, and the results.
        """
        panels, outputs = self.panels(sensors), len(sensors)
        side, modes_of_side = (self.states, self.modes) if self.coupled else (2, 1)
        rows, values = NODE_COUNT * self.wheels, len(PEAK_NODES) * outputs
        of_length = self.states * (9 * side + 56 * modes_of_side)
        of_length += values * (self.states + NODE_COUNT * self.modes)
        of_step = 6 * rows * self.states + 3 * rows**2 + values * (self.states + 2 * rows + runs)
        of_run = self.states + 12 * outputs + 6 * self.wheels
        of_run += 3 * self.steps * self.states + self.samples * (self.modes + 2 * outputs)
        return 8.0 * (panels * of_length + 2 * CHUNK_STEPS * of_step + runs * of_run)

    def input_bytes(self, sensors: Sequence[Sensor], runs: int) -> float:
        """Memory (bytes) of the time grid and the loads of a batch, and to make them."""
        of_node = 3 + runs * self.has_forces
        given = self.given_steps * self.wheels * native_peaks.PATH_NODES * of_node
        panels = 4 * self.panels(sensors) * (self.wheels + 8)
        return 8.0 * (panels + 20 * self.wheels * runs + 2 * given)

    def panels(self, sensors: Sequence[Sensor]) -> int:
        """Number of panels of the time grid, at most."""
        corrected = sum(sensor.bends for sensor in sensors)
        return 1 + self.samples + self.wheels * (2 + self.places + corrected)


def run_sizes(case: Case, speeds: Float[np.ndarray, " speed"], histories: bool) -> RunSizes:
    """Sizes of the runs of a case, of which the loads have `speeds` (m/s) up to the largest.

    Those of loads that stand are NaN, and cross nothing.
    """
    case = concrete_case(case)
    loads, layout, modes = load_set(case), mesh_layout(case), case.beam.modes
    pieces = loads.cubics()[0].shape[1] if loads.wheel_count else 0
    duration, length = float(case.run.duration), float(concrete(case.beam.length))
    crossings = duration * np.nan_to_num(np.abs(speeds)).max(initial=0.0) / length
    samples, of_crossings, steps = 0, int(STEPS_PER_MODE * modes * crossings), 0
    if histories:
        samples = len(sample_times(case))
        steps = 2 * samples + of_crossings
    given_steps = of_crossings if native_peaks.has_courses(case) else 0
    states = 2 * modes + 4 * len(case.actuators)
    places = len(layout.degrees) + pieces
    return RunSizes(
        modes=modes,
        states=states,
        coupled=has_coupling(case),
        wheels=loads.wheel_count,
        places=places,
        samples=samples,
        steps=steps,
        given_steps=given_steps,
        has_forces=bool(loads.wheels.histories),
    )


def largest_group(count: int, fits) -> int:
    """Largest number, up to a count and at least 1, that `fits` a limit which falls with it."""
    while count > 1 and not fits(count):
        count = -(-count // 2)
    return count
