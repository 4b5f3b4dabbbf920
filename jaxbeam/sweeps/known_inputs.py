"""What the C integrator needs to know of batches that share a model, without a compiler."""

import functools

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxbeam.integrator import native_peaks
from jaxbeam.integrator.time_grid import grid_between_events
from jaxbeam.model.load_set import WheelSet
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.runtime.vectorised import vectorised
from jaxbeam.sweeps.batches import Batches, values_at
from jaxbeam.sweeps.programs import Paths, Program

GROUP_RUNS = 4096  # of which wheels are made at once; one of 512 takes as long


class KnownInputs:
    """Inputs of the C integrator of batches of known numbers that share a model and outputs."""

    def __init__(self, program: Program, model: ModalModel, paths: Paths, batches: Batches):
        self.program, self.paths, self.batches = program, paths, batches
        self.durations = values_at(program.case, batches, "run.duration")
        assert program.known_outputs is not None
        with np.errstate(all="ignore"):  # as in compiled code
            of_model = native_peaks.model_inputs(model, *program.known_outputs)
        self.of_model = {
            name: None if part is None else part[None] for name, part in of_model.items()
        }
        count, runs = batches.run_index.shape
        self.group_size = min(count, max(1, GROUP_RUNS // runs))
        # Blocks are taken in their order, by few threads.
        self._wheels_of_group = functools.lru_cache(maxsize=4)(self._make_wheels_of_group)

    def of_batches(
        self,
        batch_indices: Int[np.ndarray, " task"],
        max_steps: Float[np.ndarray, " task"],
        extra_steps: int = 0,
    ) -> native_peaks.NativeInputs:
        """Inputs of some batches, with steps (s) at most and extra steps in each panel.

        Raises NotVectorisedError where loads cannot be vectorised.
        """

        def of_batch(path, wheels, duration, max_step):
            grid = grid_between_events(path.load_events, duration, max_step, extra_steps)
            return native_peaks.batch_inputs(grid, path.cubics, wheels)

        rows = jax.tree.map(lambda part: part[batch_indices], (self.paths, self.durations))
        with np.errstate(all="ignore"):
            wheels = self._wheels(batch_indices)
            found = vectorised(of_batch)(rows[0], wheels, rows[1], max_steps)
        return native_peaks.NativeInputs(**self.of_model, **found)

    def _wheels(self, batch_indices) -> WheelSet:
        """Wheels of some batches, which have these as their first axis."""
        groups, rows = np.divmod(batch_indices, self.group_size)
        if np.any(groups != groups[0]):
            return self._make_wheels(batch_indices)
        return jax.tree.map(lambda part: part[rows], self._wheels_of_group(int(groups[0])))

    def _make_wheels_of_group(self, group: int) -> WheelSet:
        first, count = group * self.group_size, self.batches.run_index.shape[0]
        return self._make_wheels(np.arange(first, min(first + self.group_size, count)))

    def _make_wheels(self, batch_indices) -> WheelSet:
        batches = self.batches
        values = batches.shared_values[batch_indices], batches.batched_values[batch_indices]
        with np.errstate(all="ignore"):
            return vectorised(self.program.wheels)(*values)
