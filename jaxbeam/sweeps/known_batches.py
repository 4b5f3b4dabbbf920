"""Integration of the batches of a small sweep in NumPy, which compiles nothing."""

import dataclasses
import functools

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbeam.case.case import Case, concrete_case
from jaxbeam.integrator.integrate import max_stable_step
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modal_model import ModalModel, modal_model
from jaxbeam.runtime.vectorised import NotVectorisedError, vectorised
from jaxbeam.simulation.closed_loop import closed_loop
from jaxbeam.simulation.integration_plan import runs_compiled
from jaxbeam.sweeps import programs
from jaxbeam.sweeps.batches import Batches
from jaxbeam.sweeps.step_size import PathEvents

# Paths and runs up to which NumPy gives the first answer sooner than a compiler: each path takes
# some hundredths of a second, programs some seconds.
MAX_PATHS, MAX_RUNS = 8, 1024


def suits(case: Case, batches: Batches, schedule) -> bool:
    """Whether a sweep is small enough for NumPy, and its controller runs there."""
    paths, runs = batches.run_index.shape
    if not programs.in_sequence() or len(jax.local_devices()) > 1:
        return False
    if case.controller is not None and (runs_compiled(schedule) or case.controller.period is None):
        return False
    return paths <= MAX_PATHS and paths * runs <= MAX_RUNS


class KnownBatches:
    """Batches whose runs NumPy integrates, one batch after the other; see `CompiledBatches`."""

    def __init__(
        self,
        program: programs.Program,
        batches: Batches,
        model: ModalModel | None,
        load_events: PathEvents | None,
        schedule,
    ):
        self.program = program._replace(case=concrete_case(program.case))
        self.batches, self.model, self.schedule = batches, model, schedule
        self.load_events = load_events
        self._of_batch = functools.cache(self._case_and_loads)

    def make_models(self) -> Float[np.ndarray, " path"]:
        """Longest stable steps (s) of all batches."""
        limits = []
        for batch in range(self.batches.run_index.shape[0]):
            case, loads = self._of_batch(batch)
            limits.append(float(max_stable_step(self._model(case), loads)))
        return np.array(limits)

    def integrate_few(self, batch_indices, steps, extra_steps, single):
        """Results (path, batch, ...) by name of some batches; see `integrate`."""
        everyone = np.ones(batch_indices.size, bool)
        return self.integrate(batch_indices, steps, extra_steps, everyone, None, single)

    def integrate(
        self,
        batch_indices: Int[np.ndarray, " path"],
        steps: Float[np.ndarray, " path"],
        extra_steps: Int[np.ndarray, " path"],
        mask: Bool[np.ndarray, " path"],
        substeps: int | None,
        single: bool,
    ) -> dict[str, np.ndarray]:
        """Results (path, batch, ...) by name of batches, zero for those not in the mask."""
        del single  # suits no sweep here
        program = self.program
        if substeps is not None:
            program = program._replace(schedule=self.schedule, substeps=substeps)
        results, known = {}, {}
        for row in np.flatnonzero(mask):
            batch = int(batch_indices[row])
            same = batch, steps[row], extra_steps[row]
            if same in known:  # small samples name a batch more than once
                for values in results.values():
                    values[row] = values[known[same]]
                continue
            known[same], events = row, None
            if self.load_events is not None:
                events = jax.tree.map(lambda part, batch=batch: part[batch], self.load_events)
            stepping = programs.Stepping(steps[row], extra_steps[row], events)
            with np.errstate(all="ignore"):  # as in compiled code
                found = self._results(program, batch, stepping)
            for name, values in found.items():
                if name not in results:
                    results[name] = np.zeros((mask.size, *np.shape(values)))
                results[name][row] = values
        return results

    def _results(self, program: programs.Program, batch: int, stepping) -> dict[str, np.ndarray]:
        shared = self.batches.shared_values[batch]
        case, loads = self._of_batch(batch)
        if case.controller is None:
            discrete = program.discretise(self._model(case), shared, stepping)
            return programs.results(program, discrete, case, loads)
        policy = closed_loop(case, program.shapes.layout, loads, program.schedule)
        discrete = program.discretise(policy.model, shared, stepping, policy)
        return programs.results(program, discrete, case, loads, policy)

    def _case_and_loads(self, batch: int) -> tuple[Case, LoadSet]:
        """Case of a batch, and its loads in all runs."""
        shared = self.batches.shared_values[batch]
        values = self.batches.batched_values[batch]
        case = self.program.case_with(shared)

        def wheels(values):
            return self.program.loads(shared, values).wheels

        with np.errstate(all="ignore"):
            try:
                found = jax.tree.map(lambda part: part[0], vectorised(wheels)(values[None]))
            except NotVectorisedError:
                found = wheels(values)
        return case, dataclasses.replace(load_set(case, self.program.shapes.layout), wheels=found)

    def _model(self, case: Case) -> ModalModel:
        if self.model is not None:
            return self.model
        return modal_model(case, self.program.shapes.layout, self.program.shapes.coupled)
