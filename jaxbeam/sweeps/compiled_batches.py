"""Integration of the batches of a sweep by compiled programs, in blocks of equal shape."""

import contextlib
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, Future

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbeam.integrator import native_peaks
from jaxbeam.integrator.time_grid import EventSchedule
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.runtime.compiling import Compiled
from jaxbeam.sweeps import programs
from jaxbeam.sweeps.batches import Batches
from jaxbeam.sweeps.step_size import PathEvents


class CompiledBatches:
    """Batches whose runs compiled programs integrate.

    `program` is the data of those of peaks; histories are at the events of the `schedule`. Batches
    share the `model`, if it is given, and have the `load_events`, if these are known. Otherwise
    their models are made by `make_models`.
    """

    def __init__(
        self,
        program: programs.Program,
        batches: Batches,
        block_size: int,
        model: ModalModel | None,
        load_events: PathEvents | None,
        schedule: EventSchedule | None,
    ):
        self.program, self.batches, self.block_size = program, batches, block_size
        self.load_events, self.schedule = load_events, schedule
        self.shares_model = model is not None
        self.models = jax.tree.map(lambda leaf: leaf[None], model)
        self.controlled = program.case.controller is not None
        # The C integrator makes its own step matrices.
        self.discretise_separately = not (self.controlled or program.shapes.native)
        # The variant that measures step sizes is compiled first, others on first use.
        self._compile_lock, self._compiled_variants = threading.Lock(), {(None, False)}

    def begin_compilation(self, pool: Executor) -> list[Future]:
        """Compile the programs of peaks in other threads."""
        return [
            pool.submit(compiled_program.precompile(*arguments))
            for compiled_program, arguments in self._programs_to_compile()
        ]

    def _programs_to_compile(self) -> Iterator[tuple[Compiled, tuple]]:
        """Programs of peaks, the slowest to compile first, and template arguments."""
        program, indices = self.program, np.zeros(self.block_size, int)
        stepping, mask = self._stepping(indices, np.ones(indices.size), indices), indices > 0
        shared_values, models = self.batches.shared_values[self._model_groups()[0]], self.models
        if not self.shares_model:
            model_template, _ = programs.modal_models.template(program, shared_values)
            models = jax.tree.map(lambda leaf: leaf[indices], model_template)
        discretise_arguments = program, mask, models, self.batches.shared_values[indices], stepping
        if self.discretise_separately:
            models = programs.discrete_models.template(*discretise_arguments)
        elif self.controlled:
            models = None
        yield (
            programs.block_program(program, single=False),
            (program, mask, models, *self._values_of(indices), stepping),
        )
        if self.discretise_separately:
            yield programs.discrete_models, discretise_arguments
        if not self.shares_model:
            yield programs.modal_models, (program, shared_values)

    def _model_groups(self) -> list:
        """Indices of batches whose models are made in one call."""
        count = self.batches.run_index.shape[0]
        blocks = -(-count // self.block_size)
        return list(np.resize(np.arange(count), (blocks, self.block_size)))

    def make_models(self) -> Float[np.ndarray, " path"]:
        """Make the models of all batches; their longest stable steps (s)."""
        groups = [
            programs.modal_models(self.program, self.batches.shared_values[group])
            for group in self._model_groups()
        ]
        self.models, limits = jax.tree.map(lambda *leaves: np.concatenate(leaves), *groups)
        return limits[: self.batches.run_index.shape[0]]

    def integrate_few(
        self,
        batch_indices: Int[np.ndarray, " path"],
        steps: Float[np.ndarray, " path"],
        extra_steps: Int[np.ndarray, " path"],
        single: bool,
    ) -> dict[str, np.ndarray]:
        """Results (path, batch, ...) by name of at most a block of batches; see `integrate`."""
        # They are spread over the block, so that each device has its part.
        rows = np.arange(batch_indices.size) * self.block_size // batch_indices.size
        mask = np.zeros(self.block_size, bool)
        mask[rows] = True
        nearest_row = np.cumsum(mask) - 1
        stepping = steps[nearest_row], extra_steps[nearest_row]
        results = self.integrate(batch_indices[nearest_row], *stepping, mask, None, single)
        return {name: values[rows] for name, values in results.items()}

    def integrate(
        self,
        batch_indices: Int[np.ndarray, " path"],
        steps: Float[np.ndarray, " path"],
        extra_steps: Int[np.ndarray, " path"],
        mask: Bool[np.ndarray, " path"],
        substeps: int | None,
        single: bool,
    ) -> dict[str, np.ndarray]:
        """Results (path, batch, ...) by name of a block of batches; any for those not in the mask.

        With steps (s) at most, and extra steps in each panel; with `substeps` between samples also
        histories. In `single` precision they are integrated in float32.
        """
        stepping = self._stepping(batch_indices, steps, extra_steps)
        program, models = self._program(substeps), self._models_of(batch_indices)
        shared_values, batched_values = self._values_of(batch_indices)
        if self.discretise_separately:
            models = programs.discrete_models(program, mask, models, shared_values, stepping)
        arguments = program, mask, models, shared_values, batched_values, stepping
        arguments = jax.tree.map(_to_single_precision, arguments) if single else arguments
        compiled_program = programs.block_program(program, single)
        with _single_precision() if single else contextlib.nullcontext():
            with self._compile_lock:  # other threads wait instead of compiling the same variant
                if (substeps, single) not in self._compiled_variants:
                    compiled_program.precompile(*arguments)()
                    self._compiled_variants.add((substeps, single))
            results = compiled_program(*arguments)
        if compiled_program is programs.native_block:
            max_loads = program.shapes.max_loads
            return native_peaks.integrate_peaks(max_loads, mask, results)._asdict()
        return {name: np.asarray(values) for name, values in results.items()}

    def _program(self, substeps: int | None) -> programs.Program:
        """Data of the programs of peaks, or with `substeps` of histories."""
        if substeps is None:
            return self.program
        return self.program._replace(schedule=self.schedule, substeps=substeps)

    def _stepping(self, batch_indices, steps, extra_steps) -> programs.Stepping:
        """Steps of batches, with their load events, if they are known."""
        events = jax.tree.map(lambda part: part[batch_indices], self.load_events)
        return programs.Stepping(steps, extra_steps, events)

    def _models_of(self, batch_indices):
        """Models of batches; one that all share is single. None with a controller.

        Its closed loop has a model of its own.
        """
        if self.controlled:
            return None
        if self.shares_model:
            return self.models
        return jax.tree.map(lambda leaf: leaf[batch_indices], self.models)

    def _values_of(self, batch_indices):
        """Shared and batched values of batches."""
        return self.batches.shared_values[batch_indices], self.batches.batched_values[batch_indices]


@contextlib.contextmanager
def _single_precision():
    """A context of float32; of all its digits in products, of which GPUs keep three by default."""
    with jax.enable_x64(False), jax.default_matmul_precision("highest"):
        yield


def _to_single_precision(leaf):
    """Array in float32 or int32; booleans and static values as they are."""
    if not eqx.is_array(leaf) or leaf.dtype == bool:
        return leaf
    return np.asarray(leaf, np.float32 if np.issubdtype(leaf.dtype, np.floating) else np.int32)
