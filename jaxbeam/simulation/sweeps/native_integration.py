"""Integration of the batches of a sweep in C: inputs of the integrator, and sampled loops in C.

The inputs of batches that share a model are made in NumPy, without a compiler. The events of a
sampled loop are the functions of `closed_loop`, traced and translated (`runtime/c_translation`),
for eight runs at once. Numbers of the loop are arguments, so that loops of one structure use the
same compiled code.
"""

import copy
import dataclasses
import functools
import itertools
import os
import threading
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbeam.case.case import Case, concrete_case, structure_of
from jaxbeam.case.profiles.spectra import profiles_of_runs
from jaxbeam.model.load_set import LoadSet, WheelSet, load_set
from jaxbeam.model.modal_model import ModalModel, has_coupling, modal_model
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.output_rows import corrected_places
from jaxbeam.model.sensor_signals import with_sensor_filters
from jaxbeam.model.state_space import build_plant
from jaxbeam.runtime.c_translation import Translation
from jaxbeam.runtime.c_writer import (
    HEADERS,
    CArray,
    UntranslatedError,
    Writer,
    kind_of,
    used_variables,
    without_unused,
)
from jaxbeam.runtime.memory import remembered
from jaxbeam.runtime.native_library import Library
from jaxbeam.runtime.vectorised import NotVectorisedError, vectorised
from jaxbeam.simulation.closed_loop import LoopMemory, SampledLoop, closed_loop
from jaxbeam.simulation.integrator import native_peaks
from jaxbeam.simulation.integrator.inputs import StepInfo, growth_limit, load_amplitude
from jaxbeam.simulation.integrator.peaks import Peaks
from jaxbeam.simulation.integrator.time_grid import (
    EventSchedule,
    event_places,
    grid_between_events,
    grid_by_schedule,
)
from jaxbeam.simulation.sweeps.batches import (
    PROFILE_NUMBER,
    Batches,
    evenly_spaced,
    values_at,
    with_few_runs,
)
from jaxbeam.simulation.sweeps.integration import Outputs, Program, outputs_of
from jaxbeam.simulation.sweeps.step_size import PathEvents

UNUSED = CArray("d", (), "", False)
HEAD = """
void process_event(const void *const *inputs, int64_t event, double time, Register *memory,
                   const Register *state, Register *commands) {
"""

MAX_DESIGNS = 1024  # laws of more batches would take much memory
LOOP_HEADERS = "registers.h", "translated.h", "algebra.h", "decompose.h"
GROUP_RUNS = 4096  # whose inputs are made at once; those of 512 take as long


class TranslatedLoop(NamedTuple):
    """C code of the events of a loop, its arguments, and its memory at the start of a run.

    `failures` is the index in the memory of the number of samples without a solution.
    """

    text: str
    inputs: tuple[np.ndarray, ...]
    memory: Float[np.ndarray, " memory"]
    failures: int


class _Program(NamedTuple):
    """C code of the events of loops of one structure: its arguments, and the parts they share.

    `given` flags the `constants` and numbers of a loop that are arguments; `rest` are the leaves of
    a loop that are no numbers, None for these, `kinds` its structure, the flags of its numbers,
    their shapes and types.
    """

    text: str
    constants: list[np.ndarray]
    given: list[bool]
    rest: list
    kinds: list


def translated_loops(loops: Iterable[SampledLoop]) -> list[TranslatedLoop]:
    """Events of loops in C; loops that differ in numbers alone share a program.

    Raises UntranslatedError for a loop with a part that is not translated: accelerations, which
    follow from the contact forces, and a law with other functions than `c_translation` has.
    """
    found: list[TranslatedLoop] = []
    program = None
    for loop in loops:
        leaves, structure = jax.tree.flatten(loop)
        flags = list(map(_is_number, leaves))
        numbers = [np.asarray(leaf) for leaf in itertools.compress(leaves, flags)]
        rest = [None if own else leaf for own, leaf in zip(flags, leaves, strict=True)]
        memory = jax.tree.map(np.asarray, loop.start(1))
        kept = jax.tree.leaves(memory)
        kinds = [structure, flags, *((one.shape, one.dtype) for one in numbers)]
        same = program is not None and kinds == program.kinds
        if not (same and eqx.tree_equal(rest, program.rest) is True):
            program = _program(loop, numbers, rest, memory, kinds)
        arrays = [*program.constants, *numbers]
        given = itertools.compress(arrays, program.given)
        start = np.concatenate([np.ravel(leaf).astype(float) for leaf in kept])
        place = sum(np.size(leaf) for leaf in kept[:-1])  # failures are the last
        found.append(TranslatedLoop(program.text, tuple(map(_as_argument, given)), start, place))
    return found


def _program(loop: SampledLoop, numbers, rest, memory: LoopMemory, kinds) -> _Program:
    """Program of a loop, from its numbers, its other leaves (None for numbers), and its memory."""
    if loop.measured_rows is not None:
        raise UntranslatedError("readings of accelerations")
    if loop.voltages is not None:
        raise UntranslatedError("limits of the voltage within a step")

    structure, flags, *_ = kinds

    def process(numbers, event, time, memory, state):
        left = iter(numbers)
        leaves = [next(left) if own else leaf for own, leaf in zip(flags, rest, strict=True)]
        own = jax.tree.unflatten(structure, leaves)
        memory = own._process_event(memory, state, StepInfo(time, jnp.zeros(()), event))
        return own.path.acting(memory.commands), memory

    state = np.zeros((loop.model.state_count, 1))
    closed = jax.make_jaxpr(process)(numbers, np.int64(0), np.float64(0), memory, state)
    jaxpr = without_unused(closed.jaxpr)
    used, constants = used_variables(jaxpr), list(map(np.asarray, closed.consts))
    arrays = [*constants, *numbers]
    given = [v in used for v, _ in zip([*jaxpr.constvars, *jaxpr.invars], arrays, strict=False)]
    shown = [array if own else None for array, own in zip(arrays, given, strict=True)]
    text = _text(jaxpr, shown, jax.tree.leaves(memory), state)
    return _Program(text, constants, given, rest, kinds)


def _is_number(leaf: Any) -> bool:
    """Whether a leaf is a number, which may differ between loops of the same structure."""
    if isinstance(leaf, np.ndarray | np.generic | jax.Array):
        return np.issubdtype(leaf.dtype, np.floating)
    return isinstance(leaf, float)


def _as_argument(array) -> np.ndarray:
    """Contiguous array of float64 or int64, as an argument of C."""
    kind = float if np.issubdtype(np.asarray(array).dtype, np.floating) else np.int64
    return np.ascontiguousarray(array, kind)


def _text(jaxpr, arrays, leaves, state) -> str:
    """C file of the program of an event."""
    writer = Translation()
    given: list[CArray] = []
    number = itertools.count()
    for array in arrays:
        if array is None:
            given.append(UNUSED)
            continue
        value = CArray(kind_of(array), np.shape(array), writer.new_name(), False)
        writer.line(f"const {value.type} *{value.name} = inputs[{next(number)}];")
        given.append(value)
    event, time = CArray("i", (), "&event", False), CArray("d", (), "&time", False)
    given += [event._replace(name="(&event)"), time._replace(name="(&time)")]
    place, kept = 0, []
    for leaf in leaves:
        stored = CArray("d", leaf.shape, f"(memory + {place})", True)
        kept.append(stored)
        given.append(_loaded(writer, stored, kind_of(leaf)))
        place += leaf.size
    given.append(CArray("d", state.shape, "state", True))
    constants = len(jaxpr.constvars)
    commands, *after = writer.run_open(jaxpr, given[:constants], given[constants:])
    writer.copy(CArray("d", commands.shape, "commands", True), commands)
    for stored, value in zip(kept, after, strict=True):
        writer.copy(stored, writer.converted(value, "d"))
    return "\n".join([HEADERS + HEAD.rstrip("\n"), *writer.lines, "}", ""])


def _loaded(writer: Writer, stored: CArray, kind: str) -> CArray:
    """Copy of a part of the memory, which the program may change while it reads the copy."""
    texts = {"d": "{}", "i": "__builtin_convertvector({}, Mask)", "b": "{} != 0"}
    return writer.each(texts[kind], kind, stored.shape, [stored], True)


class NativeLoops:
    """Sampled loops of the batches of a sweep in C; a law that all batches share is designed once.

    All share the `model` of the beam. Raises NotVectorisedError where a loop cannot be translated
    or compiled.
    """

    def __init__(self, program: Program, batches: Batches, model: ModalModel):
        self.program, self.batches, self.model = program, batches, model
        self._filtered = None
        self.shared = self._is_shared()
        if not self.shared and len(batches.shared_values) > MAX_DESIGNS:
            raise NotVectorisedError("a law for each of many runs")
        designs = range(1 if self.shared else len(batches.shared_values))
        try:
            self.translations = translated_loops(map(self._policy, designs))
            first = self.translations[0]
            if any(one.text != first.text for one in self.translations):
                raise NotVectorisedError("laws of several structures")
            architecture = native_peaks.LIBRARY.loaded_architecture()
            library = Library((), LOOP_HEADERS, first.text, architecture)
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

    def model_inputs(self, histories: bool) -> dict[str, Any]:
        """Fields of `NativeInputs` that depend on the model of the loop, which all share."""
        assert self._filtered is not None
        case, model = self.program.case, self._filtered[0]
        rows = history_rows(case, model) if histories else None
        return native_peaks.loop_model_inputs(model, *outputs_of(case, model), rows)

    def law_inputs(self, batch_indices: Int[np.ndarray, " path"]) -> dict[str, np.ndarray]:
        """Fields of `NativeInputs` that depend on the laws of batches."""
        design = np.zeros(len(batch_indices), int) if self.shared else batch_indices
        starts = np.stack([self.translations[i].memory for i in design])
        return {"memory": starts, "loop_numbers": self.addresses[design]}

    def integrate(
        self,
        batch_indices: Int[np.ndarray, " path"],
        max_loads: int,
        mask: Bool[np.ndarray, " path"],
        inputs: native_peaks.NativeInputs,
    ) -> dict[str, np.ndarray]:
        """Results of batches by name; NaN for runs that diverge."""
        absorbers = len(self.program.case.absorbers)
        found = native_peaks.integrate_loops(max_loads, mask, inputs, self.loop, absorbers)
        peaks, failures, amplitudes, history = found
        for row in np.flatnonzero(mask):
            grown = np.moveaxis(amplitudes[row], -1, 0)
            if not np.isfinite(growth_limit(grown, np.zeros(grown.shape[1]))).any():
                continue
            least = self._least_amplitude(int(batch_indices[row]))
            failed = grown[0] > growth_limit(grown, least)
            for part in peaks:
                part[row, failed] = np.nan
        return Peaks(*peaks)._asdict() | {"controller_failures": failures, "deflection": history}

    def _least_amplitude(self, batch: int) -> Float[np.ndarray, " run"]:
        """Amplitudes of the runs of a batch above which growth counts as divergence."""
        if self.program.case.controller.open_loop:
            return np.full(self.batches.run_index.shape[1], np.inf)
        shared = self.batches.shared_values[batch]
        loads = self.program.loads(shared, self.batches.batched_values[batch])
        return np.asarray(load_amplitude(self.program.case_with(shared), self.model, loads))

    def _policy(self, batch: int) -> SampledLoop:
        case = self.program.case_with(self.batches.shared_values[batch])
        layout = self.program.shapes.layout
        plant = build_plant(case, self.model)
        if self._filtered is None:
            self._filtered = with_sensor_filters(plant)
        known = plant, self._filtered
        loop = closed_loop(case, layout, plant.loads, self.program.schedule, known=known)
        assert isinstance(loop, SampledLoop)
        return loop

    def _is_shared(self) -> bool:
        """Whether one law serves all batches: it depends on no number that differs between them."""
        controller = self.program.case.controller
        if controller.design_depends_on_loads or controller.design_depends_on_paths:
            return len(self.batches.shared_values) == 1
        return not any(name.startswith("controller.") for name in self.batches.shared_addresses)


def history_rows(case: Case, model: ModalModel) -> Float[np.ndarray, "sensor state"]:
    """Output rows of the deflections (m) at the sensors of a case, on the state of a model."""
    rows = np.zeros((len(case.sensors), model.state_count))
    modes = slice(0, 2 * case.beam.modes, 2)
    rows[:, modes] = model.shapes(case.sensor_positions, (0,))[0]
    return rows


class SharedModel(NamedTuple):
    """Modal model and sensor outputs of a structure, shared by all batches of a sweep of loads.

    A wheel that passes one of the `event_places` (m) is a load event.
    """

    model: ModalModel
    outputs: Outputs
    event_places: Float[np.ndarray, " place"]


def shared_model(case: Case) -> SharedModel:
    """Model that batches share if they differ only in loads, profiles, control and run settings."""
    return _model_of(structure_of(concrete_case(case)))


@remembered
def _model_of(structure: Case) -> SharedModel:
    layout = mesh_layout(structure)
    model = modal_model(structure, layout, has_coupling(structure))
    places = event_places(model, corrected_places(structure, model, structure.sensors))
    found = SharedModel(model, outputs_of(structure, model), places)
    return jax.tree.map(np.asarray, found)


class NativeBatches:
    """Batches of concrete numbers that share a model and outputs, integrated in C.

    `events` are the load events of all paths. Histories are at the samples of a `schedule`. Inputs
    are made for at most `most_at_once` batches, unless a block has more. Raises NotVectorisedError
    where loads cannot be vectorised.
    """

    def __init__(
        self,
        program: Program,
        shared: SharedModel,
        events: PathEvents,
        batches: Batches,
        block_size: int,
        most_at_once: int,
        schedule: EventSchedule | None,
    ):
        self.program, self.batches, self.schedule = program, batches, schedule
        self.block_size, self.most_at_once = block_size, most_at_once
        self.shared_model, self.loops = shared, None
        self._load_set = functools.cache(self._load_set_of)
        self.events = events, values_at(program.case, batches, "run.duration")
        with np.errstate(all="ignore"):  # as in compiled code
            if program.schedule is None:
                of_model = native_peaks.model_inputs(shared.model, *shared.outputs)
                if schedule is not None:
                    of_model["history_rows"] = history_rows(program.case, shared.model)
            else:
                self.loops = NativeLoops(program, batches, shared.model)
                of_model = self.loops.model_inputs(schedule is not None)
        self.of_model = {
            name: None if part is None else part[None] for name, part in of_model.items()
        }
        # Loads of large sweeps are computed in each call; here, those of one batch show whether
        # they can be vectorised.
        count, runs = batches.run_index.shape
        few = count * runs <= GROUP_RUNS
        loads = _paths_and_wheels(program, batches, np.arange(count if few else 1))
        self.all_loads = loads if few else None

    def inputs_of_batches(
        self,
        batch_indices: Int[np.ndarray, " task"],
        max_steps: Float[np.ndarray, " task"],
        extra_steps: Int[np.ndarray, " task"],
        substeps: int | None = None,
    ) -> native_peaks.NativeInputs:
        """Inputs of the C integrator for some batches, from their steps (s) and extra steps.

        `max_steps` (s) are upper limits, `extra_steps` are added in each panel. With `substeps`
        between the events of the schedule, inputs are those of histories.
        """

        def inputs_of_batch(events, duration, max_step, extra_steps, *loads):
            grid = grid_between_events(events, duration, max_step, extra_steps)
            return native_peaks.batch_inputs(grid, *loads)

        events = jax.tree.map(lambda part: part[batch_indices], self.events)
        with np.errstate(all="ignore"):
            loads = self._loads(batch_indices)
            if self.program.schedule is None and substeps is None:
                found = vectorised(inputs_of_batch)(*events, max_steps, extra_steps, *loads)
            else:
                found = self._scheduled(
                    batch_indices, max_steps, extra_steps, events[0], loads, substeps
                )
            if self.loops is not None:
                found |= self.loops.law_inputs(batch_indices)
        found |= native_peaks.shared_vehicles(found)
        if native_peaks.has_inputs_over_time(self.program.case):
            found |= self._over_time(batch_indices, loads[1], found)
        return native_peaks.NativeInputs(**self.of_model, **found)

    def _over_time(self, batch_indices, wheels: WheelSet, found) -> dict[str, np.ndarray]:
        """Fields of `NativeInputs` for profiles and forces over time, at the steps in `found`."""
        batches = []
        for row, batch in enumerate(batch_indices):
            own = jax.tree.map(lambda part, row=row: part[row], wheels)
            batches.append(dataclasses.replace(self._load_set(int(batch)), wheels=own))
        names = "panel_starts", "step_counts", "step_lengths"
        starts, counts, lengths = (found[name] for name in names)
        if "lengths_of_panels" in found:
            lengths = np.take_along_axis(lengths, found["lengths_of_panels"], axis=1)
        panels = starts, counts, lengths
        swept = any(name.startswith("profile.") for name in self.batches.shared_addresses)
        one_profile = not (swept or self.program.profiles)
        return native_peaks.inputs_over_time(batches, *panels, one_profile)

    def _scheduled(
        self, batch_indices, max_steps, extra_steps, events, loads, substeps: int | None
    ) -> dict[str, np.ndarray | None]:
        """Fields of `NativeInputs` of batches whose steps end at the events of a schedule.

        `events` are the times of the load events (s), `loads` cubics and wheels of the loads.
        """
        rows, schedule = [], self.program.schedule if substeps is None else self.schedule
        assert schedule is not None
        for row, batch in enumerate(batch_indices):
            case = self.program.case_with(self.batches.shared_values[batch])
            batch_events, paths = (
                jax.tree.map(lambda part, row=row: part[row], one) for one in (events, loads)
            )
            count = np.ceil(schedule.lengths.max() / max_steps[row]) + extra_steps[row]
            model, parts = self.shared_model.model, int(count) if substeps is None else substeps
            grid = grid_by_schedule(case, model, schedule, parts, given_events=batch_events)
            inputs = native_peaks.batch_inputs(grid, *paths)
            inputs |= {"lengths_of_panels": grid.length_index, "events": grid.event}
            if substeps is not None:
                samples = np.full(grid.boundaries.size, -1)
                sampled = grid.event_panels[schedule.sample_events]
                samples[sampled] = np.arange(sampled.size)
                inputs["samples"] = samples
            rows.append(inputs)
        return {
            name: None if part is None else np.stack([one[name] for one in rows])
            for name, part in rows[0].items()
        }

    def _load_set_of(self, batch: int) -> LoadSet:
        """Loads of a batch, with the profile of each of its runs."""
        case = self.program.case_with(self.batches.shared_values[batch])
        loads, profiles = load_set(case, self.program.shapes.layout), self.program.profiles
        if not profiles:
            return loads
        numbers = self.batches.batched_values[batch][
            :, self.batches.batched_addresses.index(PROFILE_NUMBER)
        ]
        together = profiles_of_runs([profiles[int(number)] for number in numbers])
        return dataclasses.replace(loads, profile=together)

    def rows_integrator(self, batch_indices, steps, extra_steps, single: bool, per_call: int):
        """Function from rows of `batch_indices` to their results by name; and number of calls."""
        del single, per_call
        inputs = self.inputs_of_batches(batch_indices, steps, extra_steps)

        def integrate(rows):
            everyone = np.ones(rows.size, bool)
            return self.integrate(batch_indices[rows], everyone, inputs_of_rows(inputs, rows))

        return integrate, min(batch_indices.size, os.cpu_count() or 1)

    def with_few_runs(self, most: int) -> "NativeBatches | None":
        """Integrator of the batches reduced to `most` runs; None with a control loop."""
        if self.loops is not None:
            return None
        few, chosen = copy.copy(self), evenly_spaced(self.batches.run_index.shape[1], most)
        few.batches = with_few_runs(self.batches, most)
        few._load_set = functools.cache(few._load_set_of)
        if self.all_loads is not None:
            paths, wheels = self.all_loads
            few.all_loads = paths, jax.tree.map(lambda part: part[..., chosen], wheels)
        return few

    def block_integrator(
        self, batches_of: Callable, steps, extra_steps, substeps: int | None, single: bool
    ):
        """Function from the number of a block and a mask of its batches to results by name.

        `batches_of` gives the batches of a block; `steps` (s) and `extra_steps` are those of all
        batches. Inputs are made for several blocks at once.
        """
        del single
        count, runs = self.batches.run_index.shape
        most = max(1, min(GROUP_RUNS // runs, self.most_at_once) // self.block_size)
        blocks = min(-(-count // self.block_size), most)
        group_size = blocks * self.block_size

        lock = threading.Lock()  # threads that ask for the same group wait for it

        @functools.lru_cache(maxsize=4)  # blocks are taken in their order, by few threads
        def inputs_of_group(group: int) -> native_peaks.NativeInputs:
            batch_indices = np.arange(group * group_size, (group + 1) * group_size) % count
            given = steps[batch_indices], extra_steps[batch_indices], substeps
            return self.inputs_of_batches(batch_indices, *given)

        def integrate_block(block, mask):
            group, place = divmod(block, blocks)
            rows = slice(place * self.block_size, (place + 1) * self.block_size)
            with lock:
                inputs = inputs_of_group(group)
            return self.integrate(batches_of(block), mask, inputs_of_rows(inputs, rows))

        return integrate_block

    def integrate(self, batch_indices, mask, inputs: native_peaks.NativeInputs):
        """Results (path, batch, ...) by name of batches with the given inputs."""
        max_loads = self.program.shapes.max_loads
        if self.loops is not None:
            found = self.loops.integrate(batch_indices, max_loads, mask, inputs)
        else:
            absorbers = len(self.program.case.absorbers)
            integrated = native_peaks.integrate_loops(max_loads, mask, inputs, None, absorbers)
            found = integrated.peaks._asdict() | {"deflection": integrated.history}
        if inputs.samples is None:
            del found["deflection"]
        return found

    def _loads(self, batch_indices):
        """Cubics and wheels of the loads of some batches."""
        if self.all_loads is None:
            return _paths_and_wheels(self.program, self.batches, batch_indices)
        return jax.tree.map(lambda part: part[batch_indices], self.all_loads)


def _paths_and_wheels(program: Program, batches: Batches, batch_indices):
    def paths_and_wheels(*values):
        loads = program.loads(*values)
        return loads.cubics(), loads.wheels

    values = batches.shared_values[batch_indices], batches.batched_values[batch_indices]
    with np.errstate(all="ignore"):
        return vectorised(paths_and_wheels)(*values)


def inputs_of_rows(inputs: native_peaks.NativeInputs, rows) -> native_peaks.NativeInputs:
    """Inputs of some rows of the batches; arrays of length one, which all share, are unchanged."""
    parts = (part if part is None or len(part) == 1 else part[rows] for part in inputs)
    return native_peaks.NativeInputs(*parts)
