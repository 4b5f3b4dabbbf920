"""What the C integrator needs to know of batches that share a model, without a compiler."""

import functools

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxbeam.integrator import native_peaks
from jaxbeam.integrator.time_grid import grid_between_events
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.runtime.vectorised import vectorised
from jaxbeam.sweeps.batches import Batches, values_at
from jaxbeam.sweeps.programs import Program

GROUP_RUNS = 4096  # whose loads are made at once; those of 512 take as long


class KnownInputs:
    """Inputs of the C integrator of batches of known numbers that share a model and outputs.

    `events` are the `LoadEvents` of all paths.
    """

    def __init__(
        self,
        program: Program,
        model: ModalModel,
        events: tuple[Float[np.ndarray, "path wheel 2"], Float[np.ndarray, "path event"]],
        batches: Batches,
    ):
        self.program, self.batches = program, batches
        self.events = events, values_at(program.case, batches, "run.duration")
        assert program.known_outputs is not None
        with np.errstate(all="ignore"):  # as in compiled code
            of_model = native_peaks.model_inputs(model, *program.known_outputs)
        self.of_model = {
            name: None if part is None else part[None] for name, part in of_model.items()
        }
        count, runs = batches.run_index.shape
        self.group_size = group_size = min(count, max(1, GROUP_RUNS // runs))

        @functools.lru_cache(maxsize=4)  # blocks are taken in their order, by few threads
        def loads_of_group(group: int):
            end = min((group + 1) * group_size, count)
            return _paths_and_wheels(program, batches, np.arange(group * group_size, end))

        self._loads_of_group = loads_of_group

    def of_batches(
        self,
        batch_indices: Int[np.ndarray, " task"],
        max_steps: Float[np.ndarray, " task"],
        extra_steps: int = 0,
    ) -> native_peaks.NativeInputs:
        """Inputs of some batches, with steps (s) at most and extra steps in each panel.

        Raises NotVectorisedError where loads cannot be vectorised.
        """

        def of_batch(events, duration, max_step, *loads):
            grid = grid_between_events(events, duration, max_step, extra_steps)
            return native_peaks.batch_inputs(grid, *loads)

        events = jax.tree.map(lambda part: part[batch_indices], self.events)
        with np.errstate(all="ignore"):
            loads = self._loads(batch_indices)
            found = vectorised(of_batch)(*events, max_steps, *loads)
        return native_peaks.NativeInputs(**self.of_model, **found)

    def _loads(self, batch_indices):
        """Cubics and wheels of the loads of some batches."""
        groups, rows = np.divmod(batch_indices, self.group_size)
        if np.any(groups != groups[0]):
            return _paths_and_wheels(self.program, self.batches, batch_indices)
        return jax.tree.map(lambda part: part[rows], self._loads_of_group(int(groups[0])))


def _paths_and_wheels(program: Program, batches: Batches, batch_indices):
    def of_batch(*values):
        loads = program.loads(*values)
        return loads.cubics(), loads.wheels

    values = batches.shared_values[batch_indices], batches.batched_values[batch_indices]
    with np.errstate(all="ignore"):
        return vectorised(of_batch)(*values)
