"""Batches of a sweep under a sampled controller, for the C integrator."""

import functools
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbeam.integrator import native_peaks
from jaxbeam.integrator.growth import growth_limit, load_amplitude
from jaxbeam.integrator.peaks import Peaks
from jaxbeam.integrator.time_grid import grid_by_schedule
from jaxbeam.model.load_set import load_set
from jaxbeam.runtime.c_writer import UntranslatedError
from jaxbeam.runtime.native_library import Library
from jaxbeam.runtime.vectorised import NotVectorisedError
from jaxbeam.simulation.closed_loop import closed_loop
from jaxbeam.simulation.sampled_loop import SampledLoop
from jaxbeam.simulation.translated_loop import translated_loop
from jaxbeam.sweeps.batches import Batches
from jaxbeam.sweeps.programs import Program, outputs_of

MAX_DESIGNS = 64  # laws of more batches are sooner designed by one program
HEADERS = "registers.h", "translated.h"


class NativeLoops:
    """Sampled loops of the batches of a sweep in C, whose law is designed once where it is one.

    Raises NotVectorisedError where a loop cannot be translated or compiled.
    """

    def __init__(self, program: Program, batches: Batches):
        self.program, self.batches = program, batches
        self._policy = functools.cache(self._policy_of)
        self.shared = self._is_shared()
        if not self.shared and len(batches.shared_values) > MAX_DESIGNS:
            raise NotVectorisedError("a law for each of many runs")
        designs = range(1 if self.shared else len(batches.shared_values))
        try:
            self.translations = [translated_loop(self._policy(batch)) for batch in designs]
            first = self.translations[0]
            if any(one.text != first.text for one in self.translations):
                raise NotVectorisedError("laws of several structures")
            library = Library((), HEADERS, (), first.text)
            if not library.available():
                library.build()
            self.process = library.load().process_event
        except (UntranslatedError, RuntimeError) as error:
            raise NotVectorisedError(str(error)) from error
        commands = len(program.case.actuators)
        self.loop = native_peaks.NativeLoop(self.process, commands, first.failures)
        self.addresses = np.array(
            [[array.ctypes.data for array in one.inputs] for one in self.translations], np.int64
        )

    def model_inputs(self) -> dict[str, Any]:
        """Those of the `NativeInputs` that the model of the loop determines, which all share."""
        policy = self._policy(0)
        return native_peaks.loop_model_inputs(
            policy.model, *outputs_of(self.program.case, policy.model)
        )

    def of_batches(
        self, batch_indices, max_steps, extra_steps, events, loads
    ) -> dict[str, np.ndarray | None]:
        """Those of the `NativeInputs` that differ between batches; see `KnownInputs.of_batches`.

        From the times of the load events, and from cubics and wheels of the loads.
        """
        rows, schedule = [], self.program.schedule
        windows, times = events
        cubics, wheels = loads
        for row, batch in enumerate(batch_indices):
            case = self.program.case_with(self.batches.shared_values[batch])
            longest = schedule.lengths.max()
            substeps = int(np.ceil(longest / max_steps[row])) + int(extra_steps[row])
            own = windows[row], times[row]
            grid = grid_by_schedule(
                case, self._policy(0).model, schedule, substeps, known_events=own
            )
            paths = jax.tree.map(lambda part, row=row: part[row], (cubics, wheels))
            of_batch = native_peaks.batch_inputs(grid, *paths)
            of_batch |= {"lengths_of_panels": grid.length_index, "events": grid.event}
            rows.append(of_batch)
        design = np.zeros(len(batch_indices), int) if self.shared else batch_indices
        starts = np.stack([self.translations[i].memory for i in design])
        found = {
            name: None if part is None else np.stack([one[name] for one in rows])
            for name, part in rows[0].items()
        }
        return found | {"memory": starts, "loop_numbers": self.addresses[design]}

    def integrate(
        self,
        batch_indices: Int[np.ndarray, " path"],
        max_loads: int,
        mask: Bool[np.ndarray, " path"],
        inputs: native_peaks.NativeInputs,
    ) -> dict[str, np.ndarray]:
        """Results by name; those of runs that diverge are NaN."""
        found = native_peaks.integrate_loops(max_loads, mask, inputs, self.loop)
        peaks, failures, amplitudes = found
        for row in np.flatnonzero(mask):
            grown = np.moveaxis(amplitudes[row], -1, 0)
            if not np.isfinite(growth_limit(grown, np.zeros(grown.shape[1]))).any():
                continue
            least = self._least_amplitude(int(batch_indices[row]))
            failed = grown[0] > growth_limit(grown, least)
            for part in peaks:
                part[row, failed] = np.nan
        return Peaks(*peaks)._asdict() | {"controller_failures": failures}

    def _least_amplitude(self, batch: int) -> Float[np.ndarray, " run"]:
        """Amplitudes from which growth is divergence, of the runs of a batch."""
        if self.program.case.controller.open_loop:
            return np.full(self.batches.run_index.shape[1], np.inf)
        shared = self.batches.shared_values[batch]
        loads = self.program.loads(shared, self.batches.batched_values[batch])
        model = self._policy(0).plant.modal_model
        return np.asarray(load_amplitude(self.program.case_with(shared), model, loads))

    def _policy_of(self, batch: int) -> SampledLoop:
        case = self.program.case_with(self.batches.shared_values[batch])
        layout = self.program.shapes.layout
        loop = closed_loop(case, layout, load_set(case, layout), self.program.schedule)
        assert isinstance(loop, SampledLoop)
        return loop

    def _is_shared(self) -> bool:
        """Whether all batches have one law: it depends on no number that differs between them."""
        controller = self.program.case.controller
        if controller.design_depends_on_loads or controller.design_depends_on_paths:
            return len(self.batches.shared_values) == 1
        return not any(name.startswith("controller.") for name in self.batches.shared_addresses)
