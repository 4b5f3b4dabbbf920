"""Batches of a sweep: runs on one load path, and the memory that they take in a block.

Loads that differ in masses, forces, springs or dampers only have the same path; step matrices that
depend on the path are computed once for all runs of a batch. Memory is counted from the sizes of
the arrays.
"""

import dataclasses
import re
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxbeam.case.case import Case, concrete_case, replace, unit_at, value_at
from jaxbeam.case.fields import concrete
from jaxbeam.case.sensors import Sensor
from jaxbeam.model.elements import largest_layout
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import has_coupling
from jaxbeam.model.modes import Layout, mesh_layout
from jaxbeam.simulation.integration_plan import sample_times
from jaxbeam.simulation.integrator import native_peaks
from jaxbeam.simulation.integrator.discrete_model import NODE_COUNT, PEAK_NODES
from jaxbeam.simulation.integrator.step_matrices import CHUNK_STEPS

PATH_UNITS = {"m", "m/s", "s", "m/s^2"}  # of numbers of a load on which its path may depend
# Target and largest number of runs of a batch: many more exceed the cache of the processor. Runs
# are split evenly, as padding runs take as long as others.
BATCH_SIZE, MAX_BATCH_SIZE = 256, 384

# Numbers that decide the order of positions, or the degrees and parts of a beam not uniform.
POSITION_ADDRESS = re.compile(
    r"beam\.(length|axial_force|foundation_stiffness|(segments|hinges)\..*)"
    r"|(supports|actuators)\.(\d+|\*)\.(position|start|end)"
)

# Address of the number of a run's profile, in a sweep over profiles. It changes the excitation of
# the wheels only.
PROFILE_NUMBER = "profile"
MOST_PROFILES = 64  # runs of a batch with profiles of their own, as profile values are stored

STEPS_PER_MODE = 40  # of a crossing: twice the initial number in the search for step sizes


@dataclasses.dataclass(frozen=True)
class Batches:
    """Values of the runs at addresses of the case, in batches with one load path each.

    `shared_values` determine path and model, `batched_values` masses and forces of the loads.
    `run_index` is the number of each run, -1 for padding.
    """

    shared_addresses: tuple[str, ...]
    batched_addresses: tuple[str, ...]
    shared_values: Float[np.ndarray, "path shared"]
    batched_values: Float[np.ndarray, "path batch batched"]
    run_index: Int[np.ndarray, "path batch"]


def addresses_within_batches(case: Case, addresses: Collection[str]) -> list[str]:
    """Addresses that may differ within a batch, as no path depends on them.

    These are masses, forces and springs of loads, gravity and profile numbers.
    """
    return [
        address
        for address in addresses
        if address in ("run.gravity", PROFILE_NUMBER)
        or (address.startswith("loads.") and unit_at(case, address) not in PATH_UNITS)
    ]


def make_batches(
    addresses: list[str],
    runs: Float[np.ndarray, "run address"],
    within: Collection[str],
    most: int = MAX_BATCH_SIZE,
) -> Batches:
    """Batches of runs, given by their values (SI units) at the addresses.

    Runs that differ only at the addresses `within` are in the same batch, of `most` runs.
    """
    is_batched = np.array([address in within for address in addresses], bool)
    shared_values, batched_values = runs[:, ~is_batched], runs[:, is_batched]
    order = np.lexsort((np.zeros(len(runs)), *shared_values.T[::-1]))
    new_path = np.any(np.diff(shared_values[order], axis=0) != 0, axis=1)
    runs_by_path = np.split(order, np.flatnonzero(new_path) + 1)
    largest = max(part.size for part in runs_by_path)
    parts = max(-(-largest // most), round(largest / BATCH_SIZE), 1)
    batch_size = -(-largest // parts)
    rows = [
        part[i : i + batch_size] for part in runs_by_path for i in range(0, part.size, batch_size)
    ]
    index = np.full((len(rows), batch_size), -1)
    for row, runs_of_row in zip(index, rows, strict=True):
        row[: runs_of_row.size] = runs_of_row
    padded_index = np.where(index < 0, index[:, :1], index)
    names = np.array(addresses)
    return Batches(
        tuple(names[~is_batched].tolist()),
        tuple(names[is_batched].tolist()),
        shared_values[padded_index[:, 0]],
        batched_values[padded_index],
        index,
    )


def evenly_spaced(count: int, most: int) -> Int[np.ndarray, " chosen"]:
    """Indices of at most `most` of some things, evenly spaced from the first to the last."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int))


def with_few_runs(batches: Batches, most: int) -> Batches:
    """Batches reduced to at most `most` of their runs, evenly spaced from the first to the last."""
    chosen = evenly_spaced(batches.run_index.shape[1], most)
    values, index = batches.batched_values[:, chosen], batches.run_index[:, chosen]
    return dataclasses.replace(batches, batched_values=values, run_index=index)


def values_at(case: Case, batches: Batches, address: str) -> Float[np.ndarray, " path"]:
    """Value at an address of the case in each batch."""
    if address in batches.shared_addresses:
        return batches.shared_values[:, batches.shared_addresses.index(address)]
    return np.full(batches.shared_values.shape[0], float(value_at(case, address)))


def swept_masses(case: Case, batches: Batches) -> Float[np.ndarray, " path"]:
    """Largest sum of the swept masses of loads (kg) among the runs of each batch."""
    total = np.zeros(batches.run_index.shape)
    parts = (
        (batches.shared_addresses, batches.shared_values[:, None]),
        (batches.batched_addresses, batches.batched_values),
    )
    for addresses, values in parts:
        for i, address in enumerate(addresses):
            if address.startswith("loads.") and unit_at(case, address) == "kg":
                total = total + values[..., i]
    return total.max(axis=1)


def common_layout(case: Case, batches: Batches) -> Layout:
    """Layout for all batches: common order of positions, and the largest degree of each element.

    Raises ValueError if positions along the beam change their order within the sweep.
    """
    varying = [i for i, a in enumerate(batches.shared_addresses) if POSITION_ADDRESS.fullmatch(a)]
    if not varying:
        return mesh_layout(case)
    values = np.unique(batches.shared_values[:, varying], axis=0)
    names = [batches.shared_addresses[i] for i in varying]
    layouts = [mesh_layout(replace(case, dict(zip(names, row, strict=True)))) for row in values]
    largest = largest_layout(layouts)
    if largest is None:
        raise ValueError(
            f"positions along the beam change their order over {', '.join(names)}: split the sweep "
            "where supports or patch ends meet"
        )
    return largest


class RunSizes(NamedTuple):
    """Sizes of the runs of a sweep that decide how much memory they take.

    `places` on the beam end steps when a wheel passes, in addition to corrected sensors. Histories
    have `samples` and `steps` per run. Strokes and forces of `absorbers` are outputs, too. A
    profile or forces over time are stored at the nodes of `given_steps`: forces (`has_forces`) and
    own profiles (`has_profiles`) for each run.
    """

    modes: int
    states: int
    coupled: bool
    wheels: int
    absorbers: int
    places: int
    samples: int
    steps: int
    given_steps: int
    has_forces: bool
    has_profiles: bool

    def batch_bytes(self, sensors: Sequence[Sensor], runs: int) -> float:
        """Upper bound of the memory (bytes) of a batch, for a number of runs and some sensors.

        It counts the matrices of all step lengths (for C in `native/workspace.h`, for JAX in
        `DiscreteModel`), of a chunk of steps, and the results.
        """
        panels, outputs = self.panels(sensors), len(sensors) + 2 * self.absorbers
        side, modes_of_side = (self.states, self.modes) if self.coupled else (2, 1)
        rows, values = NODE_COUNT * self.wheels, len(PEAK_NODES) * outputs
        of_length = self.states * (9 * side + 56 * modes_of_side)
        of_length += values * (self.states + NODE_COUNT * self.modes)
        of_step = 6 * rows * self.states + 3 * rows**2 + values * (self.states + 2 * rows + runs)
        of_run = self.states + 12 * outputs + 6 * self.wheels
        of_run += 3 * self.steps * self.states + self.samples * (self.modes + 2 * outputs)
        return 8.0 * (panels * of_length + 2 * CHUNK_STEPS * of_step + runs * of_run)

    def input_bytes(self, sensors: Sequence[Sensor], runs: int) -> float:
        """Memory (bytes) to compute and hold the time grid and the loads of a batch."""
        of_node = 3 * (runs if self.has_profiles else 1) + runs * self.has_forces
        given = self.given_steps * self.wheels * native_peaks.PATH_NODES * of_node
        panels = 4 * self.panels(sensors) * (self.wheels + 8)
        return 8.0 * (panels + 20 * self.wheels * runs + 2 * given)

    def panels(self, sensors: Sequence[Sensor]) -> int:
        """Upper bound of the number of panels of the time grid."""
        corrected = sum(sensor.bends for sensor in sensors)
        return 1 + self.samples + self.wheels * (2 + self.places + corrected)


def run_sizes(
    case: Case, speeds: Float[np.ndarray, " speed"], histories: bool, profiles: bool
) -> RunSizes:
    """Sizes of the runs of a case whose loads have `speeds` (m/s); NaN for loads that stand.

    With `profiles` each run has its own profile.
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
    given_steps = max(of_crossings, steps) if native_peaks.has_inputs_over_time(case) else 0
    states = 2 * modes + 4 * len(case.actuators)
    places = len(layout.degrees) + pieces
    return RunSizes(
        modes=modes,
        states=states,
        coupled=has_coupling(case),
        wheels=loads.wheel_count,
        absorbers=loads.absorbers,
        places=places,
        samples=samples,
        steps=steps,
        given_steps=given_steps,
        has_forces=bool(loads.wheels.histories),
        has_profiles=profiles,
    )


def largest_group(count: int, fits) -> int:
    """Number of items that `fits` accepts: the count, halved until it fits; at least 1."""
    while count > 1 and not fits(count):
        count = -(-count // 2)
    return count
