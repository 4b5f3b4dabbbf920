"""The runs of a sweep, cut into blocks of equal shape that are compiled once."""

import contextlib
import dataclasses
import os
import re
import threading
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, replace, value_at
from jaxbeam.integrator import native_peaks
from jaxbeam.integrator.events import sampled
from jaxbeam.model.modal_model import couples
from jaxbeam.model.modes import Layout, lay_out
from jaxbeam.simulation.closed_loop import loop_schedule
from jaxbeam.simulation.integration_plan import Form, most_at_once, sample_times
from jaxbeam.sweeps import programs
from jaxbeam.sweeps.batches import Tasks
from jaxbeam.sweeps.step_size import ORDER, choose_steps, drawn, rounding

RUNS = 512  # in a block, at most, about: each is one call and one write
BLOCKS = 8  # at least, if each then has more runs than are tried at once: for all cores
TRIED = 256  # runs, about, at once while time steps are looked for
PACES = 4  # at which time steps are measured, at least
PLACE = re.compile(r"beam\.length|(supports|actuators)\.\d+\.(position|start|end)")


class Work:
    """All tasks of a sweep, cut into blocks of equal shape.

    `single` says that runs are integrated in single precision; rigs and propagators are made in
    double all the same. Raises ValueError if places along the beam change their order within the
    sweep.
    """

    def __init__(
        self, case: Case, tasks: Tasks, histories: bool, tolerance: float, single: bool = False
    ):
        self.case, self.tasks, self.histories, self.tolerance = case, tasks, histories, tolerance
        self.single = single
        self.schedule = None
        if case.controller is not None:
            self.schedule = loop_schedule(case, np.asarray(sample_times(case)))
        elif histories:
            self.schedule = sampled(sample_times(case), True)
        count, lanes = tasks.index.shape
        # Twice as many threads as cores: some hand over work while others wait for theirs.
        self.pool = ThreadPoolExecutor(2 * (os.cpu_count() or 1))
        # What finds the steps is compiled below, all else when it is first wanted.
        self._compiling, self._ready = threading.Lock(), {(None, False)}
        # Each device takes an equal part of a block.
        self.devices = len(jax.local_devices())
        most, tried = (max(1, runs * self.devices // lanes) for runs in (RUNS, TRIED))
        self.tried = _filled(min(count, tried), self.devices)
        self.each = max(self.tried, _filled(min(count // BLOCKS, most), self.devices))
        self.blocks = -(-count // self.each)
        self.addresses = (tasks.heavy_addresses, tasks.light_addresses)
        layout = _common_layout(case, tasks)
        # Loads, settings of the run and controllers leave the rig as it is: one serves all tasks,
        # but not on several devices, each of which takes its part of them.
        outside = ("loads.", "run.", "controller.")
        alike = all(name.startswith(outside) for name in self.addresses[0])
        self.shared = alike and self.devices == 1
        parts = [[0]] if self.shared else np.resize(np.arange(count), (self.blocks, self.each))

        def windows():
            return np.asarray(programs.windows(case, self.addresses[0], tasks.heavy))

        # One load takes one slot, whenever it comes: what is compiled below need not wait for that.
        slots = len(case.loads)
        if slots > 1:
            slots = max(most_at_once(window) for window in windows())
        self.form = Form(layout, couples(case), slots, native_peaks.supports(case) and not single)
        # C puts rigs on their steps itself.
        self.apart = case.controller is None and not self.form.by_hand
        job = self.job()
        # What takes longest to compile goes first; meanwhile the others are made ready for it.
        compiling = [
            self.pool.submit(program.precompile(*arguments))
            for program, arguments in self._programs(job, tasks.heavy[parts[0]])
        ]
        entries, exits = np.moveaxis(windows(), 2, 0)
        for program in compiling:
            program.result()  # raises what went wrong
        found = [programs.rigs(job, tasks.heavy[part]) for part in parts]
        if self.shared:
            self.rigs, limit = found[0]
            limits = np.repeat(np.asarray(limit), count)
        else:
            self.rigs, limits = jax.tree.map(lambda *leaves: np.concatenate(leaves), *found)
        limits = limits[:count]
        limits = np.where(np.isfinite(limits), limits, np.inf)  # else the run fails with any step
        duration = _values(case, tasks, "run.duration")
        spans = np.minimum(exits, duration[:, None]) - entries
        spans = np.where(spans > 0, spans, duration[:, None])
        crossing = np.min(spans, axis=1, initial=np.inf)
        crossing = np.where(np.isfinite(crossing), crossing, duration)
        self.paces = 1 / crossing
        self.limits = np.minimum(limits, duration)
        if case.controller is not None:  # between its samples there is a step at least
            self.limits = np.minimum(self.limits, self.schedule.lengths.max())
        # As found for beams of one and two spans, 1 to 12 modes, at fast and slow crossings, errors
        # of 1e-7.
        modes = case.beam.modes
        self.guesses = crossing / (20 * modes + 1.84 * crossing / limits / np.sqrt(modes))
        self.guesses *= (tolerance / 1e-7) ** (1 / ORDER)

    def steps(self) -> tuple[Float[np.ndarray, " task"], float]:
        """Time steps (s) of all tasks, and the relative error of peaks seen with them.

        Raises RuntimeError if no time step meets the tolerance.
        """
        count = _filled(PACES, self.tried)

        def measure(chosen, steps, more=0, single=False):
            batches = chosen.size // self.tried
            parts = zip(np.split(chosen, batches), np.split(steps, batches), strict=True)
            found = [self._run(*part, None, single, more)["peak_deflection"] for part in parts]
            return np.concatenate(found)

        given = self.paces, self.guesses, self.limits, count, self.tolerance
        steps, error = choose_steps(measure, *given, self.pool.map)
        if self.single:
            some = drawn(self.paces, count)
            error += rounding(
                *(measure(some, steps[some], single=single) for single in (False, True))
            )
        return steps, error

    def runs(self, number: int) -> int:
        """How many runs are in a block, apart from those that only fill it up."""
        tasks = slice(number * self.each, (number + 1) * self.each)
        return int((self.tasks.index[tasks] >= 0).sum())

    def block(self, number: int, steps: Float[np.ndarray, " task"]) -> dict[str, np.ndarray]:
        """Results of a block of tasks, (task, lane, ...), with the steps (s) of all tasks."""
        count = self.tasks.index.shape[0]
        chosen = np.arange(number * self.each, (number + 1) * self.each) % count
        substeps = None
        if self.histories:
            substeps = max(1, int(np.ceil(float(self.schedule.lengths.max()) / steps.min())))
        return self._run(chosen, steps[chosen], substeps, self.single)

    def _programs(self, job, heavy):
        """What finds the steps, slowest to compile first, with arguments of the right shapes."""
        alike, _ = programs.rigs.template(job, heavy)
        first = np.zeros(self.each, int)
        pace = np.ones(self.each), first
        wanted = first > 0
        rigs = alike if self.shared else jax.tree.map(lambda leaf: leaf[first], alike)
        given = job, wanted, rigs, self.tasks.heavy[first], pace
        rigs = programs.riggings.template(*given) if self.apart else self._bare(rigs)
        yield programs.block, (job, self.devices, wanted, rigs, *self._values_of(first), pace)
        if self.apart:
            yield programs.riggings, given
        yield programs.rigs, (job, heavy)

    def _run(self, chosen, steps, substeps, single, more=0):
        # What is not a whole block is spread over it, so that each device has its part.
        places = np.arange(chosen.size) * self.each // chosen.size
        wanted = np.zeros(self.each, bool)
        wanted[places] = True
        among = np.cumsum(wanted) - 1
        chosen, steps = chosen[among], steps[among]
        pace = steps, np.full(chosen.size, more)
        job, rigs = self.job(substeps), self._rigs_of(chosen)
        given = job, wanted, rigs, self.tasks.heavy[chosen], pace
        rigs = programs.riggings(*given) if self.apart else self._bare(rigs)
        arguments = job, self.devices, wanted, rigs, *self._values_of(chosen), pace
        arguments = jax.tree.map(_shortened, arguments) if single else arguments
        with jax.enable_x64(False) if single else contextlib.nullcontext():
            with self._compiling:  # others wait for the first, instead of compiling the same again
                if (substeps, single) not in self._ready:
                    programs.block.precompile(*arguments)()
                    self._ready.add((substeps, single))
            results = programs.block(*arguments)
        found = {name: np.asarray(values) for name, values in results.items()}
        # Histories are large, and copied only where some of them were not wanted.
        return found if wanted.all() else {name: found[name][places] for name in found}

    def _rigs_of(self, chosen):
        """Rigs of some tasks."""
        return self.rigs if self.shared else jax.tree.map(lambda leaf: leaf[chosen], self.rigs)

    def _bare(self, rigs):
        """Rigs that `programs.block` takes; none with a controller, which has one of its own."""
        return rigs if self.case.controller is None else None

    def _values_of(self, chosen):
        """What varies in some tasks, and in their lanes."""
        return self.tasks.heavy[chosen], self.tasks.light[chosen]

    def job(self, substeps: int | None = None) -> programs.Job:
        """What all tasks share; with `substeps` from sample to sample histories are kept."""
        scheduled = substeps is not None or self.case.controller is not None
        clock = (self.schedule if scheduled else None), substeps
        return programs.Job(self.case, self.form, *self.addresses, *clock)


def _filled(count: int, unit: int) -> int:
    """The next multiple of a unit."""
    return -(-count // unit) * unit


def _values(case: Case, tasks: Tasks, address: str) -> np.ndarray:
    """A number of the case in every task."""
    if address in tasks.heavy_addresses:
        return tasks.heavy[:, tasks.heavy_addresses.index(address)]
    return np.full(tasks.heavy.shape[0], float(value_at(case, address)))


def _common_layout(case: Case, tasks: Tasks) -> Layout:
    """One layout for all tasks: the same order of places, degrees high enough for each.

    Raises ValueError if places change their order along the beam within the sweep.
    """
    moved = [i for i, name in enumerate(tasks.heavy_addresses) if PLACE.fullmatch(name)]
    if not moved:
        return lay_out(case)
    values = np.unique(tasks.heavy[:, moved], axis=0)
    names = [tasks.heavy_addresses[i] for i in moved]
    layouts = [lay_out(replace(case, dict(zip(names, row, strict=True)))) for row in values]
    degrees = (
        np.max([layout.degrees for layout in layouts], axis=0)
        if len({len(layout.degrees) for layout in layouts}) == 1
        else layouts[0].degrees
    )
    common = {dataclasses.replace(layout, degrees=tuple(map(int, degrees))) for layout in layouts}
    if len(common) > 1:
        raise ValueError(
            f"places along the beam change their order over {', '.join(names)}: split the sweep "
            "where supports or patch edges meet"
        )
    return common.pop()


def _shortened(leaf):
    """Numbers in half the length."""
    if not eqx.is_array(leaf) or leaf.dtype == bool:
        return leaf
    return np.asarray(leaf, np.float32 if np.issubdtype(leaf.dtype, np.floating) else np.int32)
