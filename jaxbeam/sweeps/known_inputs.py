"""What the C integrator needs to know of batches that share a model, without a compiler."""

import dataclasses
import functools
import threading
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxbeam.case.case import Case, concrete_case, structure_of
from jaxbeam.integrator import native_peaks
from jaxbeam.integrator.time_grid import event_places, grid_between_events
from jaxbeam.model.load_set import WheelSet, load_set
from jaxbeam.model.modal_model import ModalModel, has_coupling, modal_model
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.sensing.output_rows import corrected_places
from jaxbeam.runtime.remembering import remembered
from jaxbeam.runtime.vectorised import vectorised
from jaxbeam.sweeps.batches import Batches, values_at
from jaxbeam.sweeps.native_loops import NativeLoops
from jaxbeam.sweeps.programs import Outputs, Program, outputs_of
from jaxbeam.sweeps.step_size import PathEvents

GROUP_RUNS = 4096  # whose inputs are made at once; those of 512 take as long


class KnownModel(NamedTuple):
    """What a structure determines: its modal model, and the outputs of its sensors.

    At the `event_places` (m) a passing wheel is a load event.
    """

    model: ModalModel
    outputs: Outputs
    event_places: Float[np.ndarray, " place"]


def known_model(case: Case) -> KnownModel:
    """Model that all batches share whose loads and settings of the run alone differ."""
    return _model_of(structure_of(concrete_case(case)))


@remembered
def _model_of(structure: Case) -> KnownModel:
    layout = mesh_layout(structure)
    model = modal_model(structure, layout, has_coupling(structure))
    places = event_places(model, corrected_places(structure, model, structure.sensors))
    found = KnownModel(model, outputs_of(structure, model), places)
    return jax.tree.map(np.asarray, found)


class KnownInputs:
    """Inputs of the C integrator of batches of known numbers that share a model and outputs.

    `events` are those of all paths. Raises NotVectorisedError where loads cannot be vectorised.
    """

    def __init__(
        self,
        program: Program,
        known: KnownModel,
        events: PathEvents,
        batches: Batches,
    ):
        self.program, self.batches = program, batches
        self.known, self.loops = known, None
        self.events = events, values_at(program.case, batches, "run.duration")
        with np.errstate(all="ignore"):  # as in compiled code
            if program.schedule is None:
                of_model = native_peaks.model_inputs(known.model, *known.outputs)
            else:
                self.loops = NativeLoops(program, batches)
                of_model = self.loops.model_inputs()
        self.of_model = {
            name: None if part is None else part[None] for name, part in of_model.items()
        }
        # Those of large sweeps are made for each call; a single batch tells whether they can be.
        count, runs = batches.run_index.shape
        few = count * runs <= GROUP_RUNS
        loads = _paths_and_wheels(program, batches, np.arange(count if few else 1))
        self.all_loads = loads if few else None

    def of_batches(
        self,
        batch_indices: Int[np.ndarray, " task"],
        max_steps: Float[np.ndarray, " task"],
        extra_steps: Int[np.ndarray, " task"],
    ) -> native_peaks.NativeInputs:
        """Inputs of some batches, with steps (s) at most and extra steps in each panel."""

        def of_batch(events, duration, max_step, extra_steps, *loads):
            grid = grid_between_events(events, duration, max_step, extra_steps)
            return native_peaks.batch_inputs(grid, *loads)

        events = jax.tree.map(lambda part: part[batch_indices], self.events)
        with np.errstate(all="ignore"):
            loads = self._loads(batch_indices)
            if self.loops is None:
                found = vectorised(of_batch)(*events, max_steps, extra_steps, *loads)
            else:
                stepping = max_steps, extra_steps, events[0]
                found = self.loops.of_batches(batch_indices, *stepping, loads)
        if native_peaks.has_courses(self.program.case):
            found |= self._over_time(batch_indices, loads[1], found)
        return native_peaks.NativeInputs(**self.of_model, **found)

    def _over_time(self, batch_indices, wheels: WheelSet, found) -> dict[str, np.ndarray]:
        """Inputs of batches that are functions of time, for the steps that have been found."""
        batches = []
        for row, batch in enumerate(batch_indices):
            case = self.program.case_with(self.batches.shared_values[batch])
            own = jax.tree.map(lambda part, row=row: part[row], wheels)
            loads = load_set(case, self.program.shapes.layout)
            batches.append(dataclasses.replace(loads, wheels=own))
        names = "panel_starts", "step_counts", "step_lengths"
        starts, counts, lengths = (found[name] for name in names)
        if self.loops is not None:
            lengths = np.take_along_axis(lengths, found["lengths_of_panels"], axis=1)
        panels = starts, counts, lengths
        swept = any(name.startswith("profile.") for name in self.batches.shared_addresses)
        return native_peaks.inputs_over_time(batches, *panels, one_profile=not swept)

    def of_blocks(
        self, max_steps: Float[np.ndarray, " path"], batches_per_block: int, most_batches: int
    ) -> Callable[[int], native_peaks.NativeInputs]:
        """Function of a block's number: its inputs, which are made for several blocks at once.

        `max_steps` (s) are those of all batches, of which inputs of `most_batches` are made at once
        if a block has no more.
        """
        count, runs = self.batches.run_index.shape
        most = max(1, min(GROUP_RUNS // runs, most_batches) // batches_per_block)
        blocks = min(-(-count // batches_per_block), most)
        group_size = blocks * batches_per_block

        lock = threading.Lock()  # threads that ask for the same group wait for it

        @functools.lru_cache(maxsize=4)  # blocks are taken in their order, by few threads
        def of_group(group: int) -> native_peaks.NativeInputs:
            batch_indices = np.arange(group * group_size, (group + 1) * group_size) % count
            no_more = np.zeros(batch_indices.size, int)
            return self.of_batches(batch_indices, max_steps[batch_indices], no_more)

        def of_block(block: int) -> native_peaks.NativeInputs:
            group, place = divmod(block, blocks)
            rows = slice(place * batches_per_block, (place + 1) * batches_per_block)
            with lock:
                inputs = of_group(group)
            return inputs_of_rows(inputs, rows)

        return of_block

    def integrate(self, batch_indices, mask, inputs: native_peaks.NativeInputs):
        """Results (path, batch, ...) by name of batches with these inputs."""
        max_loads = self.program.shapes.max_loads
        if self.loops is None:
            return native_peaks.integrate_peaks(max_loads, mask, inputs)._asdict()
        return self.loops.integrate(batch_indices, max_loads, mask, inputs)

    def _loads(self, batch_indices):
        """Cubics and wheels of the loads of some batches."""
        if self.all_loads is None:
            return _paths_and_wheels(self.program, self.batches, batch_indices)
        return jax.tree.map(lambda part: part[batch_indices], self.all_loads)


def _paths_and_wheels(program: Program, batches: Batches, batch_indices):
    def of_batch(*values):
        loads = program.loads(*values)
        return loads.cubics(), loads.wheels

    values = batches.shared_values[batch_indices], batches.batched_values[batch_indices]
    with np.errstate(all="ignore"):
        return vectorised(of_batch)(*values)


def inputs_of_rows(inputs: native_peaks.NativeInputs, rows) -> native_peaks.NativeInputs:
    """Inputs of some of the batches; what all share stays as it is."""
    parts = (part if part is None or len(part) == 1 else part[rows] for part in inputs)
    return native_peaks.NativeInputs(*parts)
