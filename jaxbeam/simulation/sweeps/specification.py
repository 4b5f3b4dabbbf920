"""Specification of a sweep: case, values at addresses and settings, checked; its fingerprint."""

import dataclasses
import functools
import hashlib
import importlib.metadata
import json
import math
import os
import re
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.arguments import describe_value
from jaxbeam.case.case import (
    Case,
    addresses,
    check_distinct,
    concrete_case,
    each_address,
    list_sizes,
    own_addresses,
    replace,
    unit_at,
)
from jaxbeam.case.contact import ONE_RUN
from jaxbeam.case.fields import concrete
from jaxbeam.case.profiles.shapes import AbstractProfile
from jaxbeam.case.sensors import QUANTITIES, Sensor
from jaxbeam.case.toml_file import attribute_address, in_si
from jaxbeam.case.validation import check_case
from jaxbeam.files.case_file import case_from_dict, case_to_dict
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.static_correction import is_supported
from jaxbeam.runtime.memory import block_memory
from jaxbeam.simulation.integrator import native_peaks
from jaxbeam.simulation.integrator.native_peaks import MIN_RUNS_TO_COMPILE
from jaxbeam.simulation.integrator.step_size import check_tolerance
from jaxbeam.simulation.sweeps import MAX_RUNS
from jaxbeam.simulation.sweeps.batches import (
    MAX_BATCH_SIZE,
    MOST_PROFILES,
    Batches,
    RunSizes,
    addresses_within_batches,
    largest_group,
    make_batches,
    run_sizes,
)
from jaxbeam.simulation.sweeps.blocks import MAX_BLOCK_RUNS, Runner, SensorGroups
from jaxbeam.simulation.sweeps.force_runner import FORCE_BLOCK_RUNS, ForceRunner, force_runner

# Positions and list entries, whose values are valid only in combination.
JOINTLY_CHECKED = re.compile(
    r"beam\.length|(supports|actuators|sensors)\.(\d+|\*)\.(position|start|end)|.*\.\d+"
)

AnyRunner = Runner | ForceRunner | SensorGroups

PRECISIONS = ("double", "single")

# Numbers that determine the schedule of a closed loop.
SCHEDULE_ADDRESS = re.compile(
    r"run\.(duration|sample_rate)|controller\.(period|delay|dropout|jitter|times\.\d+)"
    r"|sensors\.(\d+|\*)\.(sampling_period|delay|dropout|jitter)"
)

# Contents of the steps in a store; a sweep begun with other contents cannot be resumed.
STORED_STEPS = "sizes of batches, extra steps, error"


@dataclasses.dataclass(frozen=True, eq=False)
class SweepSpecification:
    """Case, values at some of its addresses, and settings of the runs.

    The runs are all combinations of the values, or with `paired` the first of each address, the
    second, and so on. `tolerance` is the relative error allowed of peaks, rounding in `single`
    precision excluded. A block of runs takes at most `block_bytes` of memory, if one run takes no
    more. `several` sweeps of one structure use the same compiled programs. `profiles` are those of
    the runs, whose numbers are values of an axis, `PROFILE_NUMBER`.
    """

    case: Case
    axes: dict[str, Float[np.ndarray, " value"]]
    paired: bool
    histories: bool
    tolerance: float
    single: bool
    block_bytes: float
    several: bool = False
    profiles: tuple[AbstractProfile, ...] = ()

    @property
    def shape(self) -> tuple[int, ...]:
        """Sizes of the dimensions of the results."""
        sizes = tuple(values.size for values in self.axes.values())
        return sizes[:1] if self.paired else sizes

    @property
    def count(self) -> int:
        """Number of runs."""
        return math.prod(self.shape)

    @property
    def dims(self) -> tuple[str, ...]:
        """Names of the dimensions of the results."""
        return ("run",) if self.paired else tuple(self.axes)

    def runs(self) -> Float[np.ndarray, "run address"]:
        """Values of all runs (SI units)."""
        values = self.axes.values()
        columns = values if self.paired else np.meshgrid(*values, indexing="ij")
        return np.stack([column.ravel() for column in columns], axis=-1)

    @functools.cached_property
    def batches(self) -> Batches:
        """Batches of the runs."""
        controller = self.case.controller
        one_run_each = controller is not None and controller.design_depends_on_loads
        within = [] if one_run_each else addresses_within_batches(self.case, self.axes)
        largest = MOST_PROFILES if self.profiles else MAX_BATCH_SIZE
        most = largest_group(largest, lambda runs: self._fits(self.case.sensors[:1], runs))
        return make_batches(list(self.axes), self.runs(), within, most)

    @functools.cached_property
    def _sizes(self) -> RunSizes:
        """Sizes of the runs, from which their memory is computed."""
        swept = [values for name, values in self.axes.items() if name.endswith(".speed")]
        given = [getattr(load, "speed", None) for load in self.case.loads]
        speeds = [float(concrete(speed)) for speed in given if speed is not None]
        speeds = np.concatenate([speeds, *swept])
        return run_sizes(self.case, speeds, self.histories, bool(self.profiles))

    def _fits(self, sensors: Sequence[Sensor], runs: int) -> bool:
        """Whether a batch of so many runs with some sensors fits into a block."""
        return self._sizes.batch_bytes(sensors, runs) <= self.block_bytes

    @functools.cached_property
    def sensor_groups(self) -> list[list[int]]:
        """Groups of sensor numbers whose peaks are integrated together: one, if memory allows it.

        Corrected sensors of a group are neighbours, as steps end where wheels pass them. With a
        controller, which reads all sensors, there is one group.
        """
        sensors, runs = self.case.sensors, self.batches.run_index.shape[1]
        order = sorted(range(len(sensors)), key=lambda i: (sensors[i].bends, sensors[i].position))
        if self.case.controller is not None:
            return [order]
        most = largest_group(
            len(order), lambda count: self._fits([sensors[i] for i in order[-count:]], runs)
        )
        return [order[first : first + most] for first in range(0, len(order), most)]

    @functools.cached_property
    def _force_runner(self) -> ForceRunner | None:
        """Runner of peaks in closed form; None where the sweep has no closed form."""
        if self.histories or self.single or self.profiles:
            return None
        return force_runner(self.case, self.batches, self.tolerance, self.block_bytes)

    def runner(self, native: bool) -> AnyRunner:
        """Runner of the batches in blocks: in closed form, or else with steps in C if `native`.

        Raises ValueError if positions along the beam change their order within the sweep.
        """
        if self._force_runner is not None:
            return self._force_runner
        runs, groups = self.batches.run_index.shape[1], self.sensor_groups
        sensors = [[self.case.sensors[i] for i in group] for group in groups]
        batch_bytes = max(self._sizes.batch_bytes(group, runs) for group in sensors)
        input_bytes = max(self._sizes.input_bytes(group, runs) for group in sensors)
        limits = (max(1, int(self.block_bytes / size)) for size in (batch_bytes, input_bytes))
        small = not (self.single or self.several)
        settings: tuple = (
            self.batches,
            self.histories,
            self.tolerance,
            self.single,
            native,
            *limits,
            small,
            self.profiles,
        )
        if len(groups) == 1:
            return Runner(self.case, *settings)
        cases = [dataclasses.replace(self.case, sensors=tuple(group)) for group in sensors]
        return SensorGroups([Runner(case, *settings) for case in cases], groups)

    def resumed_runner(self, content: dict[str, Any]) -> AnyRunner:
        """Runner that resumes the sweep of a store with this content, in C if it was begun in C.

        So all blocks are bit-identical. Raises ValueError if the C code cannot be compiled here.
        """
        native = bool(content["native"])
        same = dataclasses.replace(self, block_bytes=content["block_bytes"])
        if native and not native_peaks.available():
            try:
                native_peaks.LIBRARY.build()
            except RuntimeError as error:
                raise ValueError(
                    f"the sweep was begun with steps in C, which continuing it needs: {error}"
                ) from None
        return same.runner(native)

    def uses_c(self) -> bool:
        """Whether a new sweep takes its steps in C (see `native_peaks.chosen_for`)."""
        if self._force_runner is not None or self.single:
            return False
        count = max(self.count, MIN_RUNS_TO_COMPILE) if self.profiles else self.count
        return native_peaks.chosen_for(self.case, count)

    @functools.cached_property
    def case_dict(self) -> dict[str, Any]:
        """Case as a dictionary of plain values (see `case_to_dict`)."""
        return case_to_dict(self.case)

    def to_dict(self) -> dict[str, Any]:
        """Dictionary of plain values; `specification_from_dict` is the inverse."""
        return {
            "case": self.case_dict,
            "axes": {address: values.tolist() for address, values in self.axes.items()},
            "settings": [self.paired, self.histories, self.tolerance, self.single],
            "several": self.several,
            "block_bytes": self.block_bytes,
        }

    def fingerprint(self) -> str:
        """SHA-256 of all that determines the results: case, values, settings and versions.

        The memory of blocks is not included: a resumed sweep takes it from the store.
        """
        content = self.to_dict() | {
            "block_bytes": None,
            "blocks": [
                MAX_BLOCK_RUNS,
                FORCE_BLOCK_RUNS,
                MAX_BATCH_SIZE,
                jax.default_backend(),
                len(jax.local_devices()),
            ],
            "steps": STORED_STEPS,
            "versions": [_version(), jax.__version__],
        }
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()


@functools.cache
def _version() -> str:
    return importlib.metadata.version("jaxbeam")


def specification_from_dict(content: dict[str, Any]) -> SweepSpecification:
    """Specification from the dictionary of `SweepSpecification.to_dict`, without checks."""
    axes = {address: np.asarray(values, float) for address, values in content["axes"].items()}
    case, settings = case_from_dict(content["case"]), content["settings"]
    kept = {name: content[name] for name in ("block_bytes", "several")}
    return SweepSpecification(case, axes, *settings, **kept)


def is_corrected(case: Case) -> bool:
    """Whether peaks of curvatures, strains and section forces are statically corrected."""
    case = concrete_case(case)
    return is_supported(case, mesh_layout(case))


def sweep_specification(
    case: Case,
    over: dict[str, Any],
    paired: bool,
    histories: bool,
    tolerance: float,
    precision: str,
    memory: float | str | None = None,
) -> SweepSpecification:
    """Specification of a sweep of a case, checked before compilation.

    Its blocks take at most `memory` together (see `block_memory`): two for each core, and one that
    is written. Raises ValueError for an unknown address, invalid or too many values, a case without
    sensors, an unknown precision, or a tolerance below that of double precision.
    """
    check_tolerance(tolerance)
    check_case(case)
    if case.lifts:
        raise ValueError(ONE_RUN)
    if precision not in PRECISIONS:
        raise ValueError(
            f"precision must be {' or '.join(PRECISIONS)}, not {describe_value(precision)}"
        )
    single = precision == "single"
    if single and case.controller is not None:
        raise ValueError(
            "controllers need double precision, as they are designed for every run: leave out"
            " precision, or the controller"
        )
    if not over:
        raise ValueError("give at least one address to sweep over, with a list of values")
    if not case.sensors:
        raise ValueError("the case has no sensors, and peaks are taken there; add one to `sensors`")
    for i, sensor in enumerate(case.sensors):
        if QUANTITIES[sensor.quantity].jumps and not is_corrected(case):
            raise ValueError(
                f"sensors.{i} measures {sensor.quantity}, whose sum of modes converges too slowly,"
                " and which is not statically corrected, as the beam can move as a rigid body:"
                " leave it out, or hold the beam"
            )
    sizes_of_lists = list_sizes(case)
    check_distinct({one: each_address(attribute_address(one), sizes_of_lists) for one in over})
    over = {attribute_address(address): given for address, given in over.items()}
    numbers = addresses(case)
    axes = {
        address: _checked_values(case, address, given, numbers) for address, given in over.items()
    }
    for address in axes:
        if histories and address in ("run.duration", "run.sample_rate"):
            raise ValueError(
                f"histories of different length do not fit together: leave out {address}"
            )
    sizes = {address: values.size for address, values in axes.items()}
    if paired and len(set(sizes.values())) > 1:
        raise ValueError(f"paired values must be equally many, not {sizes}")
    block_bytes = block_memory(memory) / (1 + 2 * (os.cpu_count() or 1))
    settings = paired, histories, tolerance, single, block_bytes
    specification = SweepSpecification(case, axes, *settings)
    if specification.count > MAX_RUNS:
        raise ValueError(
            f"{specification.count:.1e} combinations of values are more than the"
            f" {MAX_RUNS:.0e} runs of a sweep: split it"
        )
    for row in _rows_to_check(specification):
        check_case(replace(case, row))
    return specification


def _rows_to_check(specification: SweepSpecification) -> list[dict[str, float]]:
    """Values by address of the runs to check: all runs are valid if these are.

    The valid values of one number are a range, so that runs with its smallest and its largest value
    are enough. All combinations are checked of numbers that are valid only in combination.
    """
    axes, runs = specification.axes, specification.runs()
    jointly_checked = [name for name in axes if JOINTLY_CHECKED.fullmatch(name)]
    if specification.paired:
        extremes = np.unique([runs.argmin(axis=0), runs.argmax(axis=0)])
        rows = [dict(zip(axes, row, strict=True)) for row in runs[extremes]]
    else:
        ranges = {
            name: (values.min(), values.max())
            for name, values in axes.items()
            if name not in jointly_checked
        }
        rows = [dict(zip(ranges, row, strict=True)) for row in zip(*ranges.values(), strict=True)]
    if jointly_checked:
        columns = [list(axes).index(name) for name in jointly_checked]
        rows += [
            dict(zip(jointly_checked, row, strict=True))
            for row in np.unique(runs[:, columns], axis=0)
        ]
    return rows


def _checked_values(
    case: Case, address: str, values_given: Any, numbers: dict[str, Any]
) -> Float[np.ndarray, " value"]:
    """Values of one address as an array (SI units), checked as far as one address allows.

    `numbers` are those of the case by address.
    """
    each = each_address(address, list_sizes(case))
    if not set(each) <= set(numbers):
        each = own_addresses(case, address)  # raises its error
    if any(np.ndim(numbers[one]) for one in each):
        raise ValueError(f"{address} is a list; sweep over one of its entries, {address}.0")
    if isinstance(values_given, list | tuple):
        values_given = in_si(values_given, unit_at(case, address), address)
    try:
        values = np.atleast_1d(np.asarray(values_given, float))
    except (TypeError, ValueError, OverflowError):
        raise ValueError(
            f"{address} takes a list of numbers, not {describe_value(values_given)}"
        ) from None
    if values.ndim != 1 or values.size == 0:
        raise ValueError(f"{address} takes a list of values, not one of shape {values.shape}")
    if case.controller is not None and SCHEDULE_ADDRESS.fullmatch(address):
        raise ValueError(
            f"{address} determines the schedule, which all runs with a controller share:"
            " make a sweep for each of its values"
        )
    if not JOINTLY_CHECKED.fullmatch(address):
        # A range may exclude zero.
        for value in values[~np.isfinite(values) | (values == 0)][:1]:
            check_case(replace(case, {address: value}))
    return values
