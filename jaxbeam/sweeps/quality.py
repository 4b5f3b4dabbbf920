"""Warnings of a sweep: failed runs, and errors of its peaks from truncated modes."""

import warnings
from collections.abc import Collection
from typing import TYPE_CHECKING, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, concrete_case, replace, structure_of
from jaxbeam.case.fields import concrete
from jaxbeam.case.sensors import QUANTITIES
from jaxbeam.integrator.step_size import (
    check_step_count,
    longest_stable_step,
    max_concurrent_loads,
    trial_run,
    without_later_vibration,
)
from jaxbeam.model.deflection_lines import unchecked_influence_line
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import has_coupling, modal_model
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.static_correction import is_supported, modal_influence_line
from jaxbeam.runtime.arrays import Array
from jaxbeam.runtime.memory import remembered
from jaxbeam.simulation.errors import truncation_changes
from jaxbeam.simulation.section_forces import motion_at, motion_of_forces

if TYPE_CHECKING:
    import xarray

SAMPLES = 200  # at least, of the run from which errors of corrected quantities are estimated
ROUNDING = 1e-12  # of L^3 / E I, below which the deflection of a held point under a force is zero


class FailedRunsWarning(UserWarning):
    """Warning of runs of a sweep whose peaks are not finite."""


def failure_sentence(dataset: "xarray.Dataset") -> str:
    """Sentence on the failed runs of the dataset of a sweep, and the first of them; "" without any.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> case = jb.Case(
    ...     beam, sensors=[jb.Sensor(0.3)], loads=[jb.MovingForce(force=5.0, speed=2.0)]
    ... )
    >>> runs = jb.sweep(case, {"loads.0.speed": [1.0, 2.0]}, progress=False)
    >>> print(runs.failed_runs, failure_sentence(runs) == "")
    0 True
    """
    failed = dataset["failed"]
    count, of_all = int(failed.values.sum()), failed.values.size
    if not count:
        return ""
    place = dict(zip(failed.dims, np.argwhere(failed.values)[0], strict=True))
    numbers = []
    for name, values in dataset.coords.items():
        if "." in str(name) and set(values.dims) <= set(failed.dims):
            value = values.values[tuple(place[dim] for dim in values.dims)]
            numbers.append(f"{name} = {value if isinstance(value, str) else f'{value:.6g}'}")
    which = f"all {of_all} runs" if count == of_all else f"{count} of {of_all} runs"
    first = f", the first at {', '.join(numbers)}" if numbers else ""
    return (
        f"{which} failed{first}: their motion is not finite, and their results are NaN; check"
        " controllers, stiffnesses, masses and damping there"
    )


def warn_of_failures(dataset: "xarray.Dataset") -> None:
    """Warn of failed runs of the dataset of a sweep."""
    sentence = failure_sentence(dataset)
    if sentence:
        warnings.warn(sentence, FailedRunsWarning, stacklevel=3)


class StrokeWarning(UserWarning):
    """Warning of absorbers whose strokes exceed the largest allowed in runs of a sweep."""


def warn_of_strokes(case: Case, dataset: "xarray.Dataset") -> None:
    """Warn of absorbers of a case whose strokes exceed `max_stroke` in runs of its sweep."""
    for i, absorber in enumerate(case.absorbers):
        name = next((n for n in _max_stroke_names(i) if n in dataset.coords), None)
        if name is None and absorber.max_stroke is None:
            continue
        strokes = dataset["peak_stroke"].isel(absorber=i)
        limit = float(concrete(absorber.max_stroke)) if name is None else dataset[name]
        above = (strokes > limit).values
        if above.any():
            warnings.warn(
                f"the stroke of absorber {i} exceeds its max_stroke in {above.sum()} of"
                f" {above.size} runs; the largest stroke is {strokes.max().item():.4g} m",
                StrokeWarning,
                stacklevel=3,
            )


def _max_stroke_names(i: int) -> tuple[str, str]:
    """Addresses at which the largest stroke of an absorber may be swept."""
    return f"absorbers.{i}.max_stroke", "absorbers.*.max_stroke"


class TruncationWarning(UserWarning):
    """Warning of a quantity whose peaks have an error from truncated modes."""


def is_corrected(case: Case) -> bool:
    """Whether peaks of curvatures, strains and section forces are statically corrected."""
    case = concrete_case(case)
    return is_supported(case, mesh_layout(case))


def warn_of_truncation(case: Case) -> None:
    """Warn of sensors of curvature, strain or moment whose peaks cannot be corrected."""
    uncorrected = [i for i, sensor in enumerate(case.sensors) if sensor.bends]
    if not uncorrected or is_corrected(case):
        return
    names = ", ".join(f"sensors.{i} ({case.sensors[i].quantity})" for i in uncorrected)
    reason = "wheels run on a rail" if case.on_rail else "the beam can move as a rigid body"
    warnings.warn(
        f"peaks of {names} are sums of {case.beam.modes} modes and not statically corrected, as"
        f" {reason}: keep more modes (beam.modes), and compare",
        TruncationWarning,
        stacklevel=3,
    )


def static_missed_fractions(case: Case) -> dict[str, float]:
    """Largest fraction of static deflections and rotations that the modes miss, by quantity.

    A deflection is taken under a load at the sensor, but at rigid supports; a rotation, which may
    be zero there, under a load at a quarter of the span.
    """
    return dict(_static_missed_fractions(structure_of(concrete_case(case))))


@remembered
def _static_missed_fractions(structure: Case) -> dict[str, float]:
    static = [
        sensor
        for sensor in structure.sensors
        if not (QUANTITIES[sensor.quantity].bends or QUANTITIES[sensor.quantity].time_derivative)
    ]
    layout, fractions = mesh_layout(structure), {}
    if not static or not is_supported(structure, layout):
        return fractions
    for quantity in dict.fromkeys(sensor.quantity for sensor in static):
        derivative = QUANTITIES[quantity].x_derivative
        x = np.stack([sensor.position for sensor in static if sensor.quantity == quantity])
        at = x if derivative == 0 else np.full(x.size, structure.beam.length / 4)
        exact, of_modes = (
            np.diagonal(line(structure, layout, x, at, derivative))
            for line in (unchecked_influence_line, modal_influence_line)
        )
        beam = structure.beam
        compliance = beam.length ** (3 - derivative) / beam.bending_stiffness
        moves = np.abs(exact) > ROUNDING * concrete(compliance)
        missing = np.where(moves, exact - of_modes, 0.0)
        fractions[quantity] = float(np.max(np.abs(missing / np.where(moves, exact, 1.0))))
    return fractions


class WorstRun(NamedTuple):
    """Numbers of the run with the largest peak of a quantity, and the peaks of all its sensors."""

    numbers: dict[str, float]
    peaks: Float[np.ndarray, " sensor"]


def estimated_errors(case: Case, worst: dict[str, WorstRun]) -> dict[str, float]:
    """Truncation errors of peaks relative to the largest, by quantity, where they are estimated.

    `worst` is the run with the largest peak of each quantity. Deflections and rotations have their
    static error; errors of others are estimated from the worst run (see `truncation_changes`), if
    it has no controller.
    """
    errors, found_before = static_missed_fractions(case), {}
    quantities = [sensor.quantity for sensor in case.sensors]
    if case.controller is not None:
        return errors
    for quantity, run in worst.items():
        if quantity in errors:
            continue
        own = np.array([one == quantity for one in quantities])
        key = tuple(run.numbers.items())
        if key not in found_before:
            found_before[key] = _changes_in_run(concrete_case(replace(case, run.numbers)), errors)
        if found_before[key] is None:
            continue
        peaks = run.peaks[own]
        found = np.where(peaks == 0, 0.0, found_before[key][own] / np.where(peaks == 0, 1, peaks))
        if np.isfinite(found).any():
            errors[quantity] = float(np.nanmax(found))
    return errors


def _changes_in_run(case: Case, estimated: Collection[str]) -> Float[np.ndarray, " sensor"] | None:
    """Truncation errors at the sensors; NaN at sensors of quantities `estimated` before.

    None where no step is found.
    """
    asked = np.array([sensor.quantity not in estimated for sensor in case.sensors])
    sensors = tuple(
        sensor for sensor, is_asked in zip(case.sensors, asked, strict=True) if is_asked
    )
    found = _truncation_of(eqx.tree_at(lambda c: c.sensors, case, sensors))
    if found is None:
        return None
    changes = np.full(asked.size, np.nan)
    changes[asked] = found
    return changes


def _truncation_of(case: Case) -> Float[Array, " sensor"] | None:
    """Truncation errors at all sensors of a case in one run; None where no step is found."""
    loads, model = load_set(case), modal_model(case, mesh_layout(case), has_coupling(case))
    case = without_later_vibration(case, model, loads)
    duration = float(case.run.duration)
    found = motion_of_forces(case, model, loads, np.linspace(0.0, duration, SAMPLES))
    if found is not None:
        return truncation_changes(case, model.modes, found)
    if model.modes.has_repeated:
        model = modal_model(case, model.modes.layout)
    # The longest stable step: an estimate needs no search for the step of an error.
    step = min(duration / SAMPLES, float(longest_stable_step(case, model, loads)))
    try:
        check_step_count(duration / step, step)
    except RuntimeError:
        return None
    most = max_concurrent_loads(np.asarray(loads.entry_exit_times()))
    times, states = trial_run(case, model, loads, most, step)
    motion, _ = motion_at(case, model, loads, times, states)
    return truncation_changes(case, model.modes, motion)
