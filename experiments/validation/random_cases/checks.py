"""What a random case is checked for: finite numbers, true verdicts, stated errors that hold."""

import dataclasses
import time
import warnings
from typing import NamedTuple

import jax
import numpy as np

import jaxbeam as jb
from experiments.validation.random_cases.drawing import LENGTH, SENSORS, Drawn, draw
from jaxbeam.simulation.record import Record
from jaxbeam.simulation.simulate import ContactLossWarning
from tests.oracles import modal_equations

TIGHT = 1e-10  # tolerance of the run beside which the errors of each case are measured
ROUNDING = 1e-9  # of the largest deflection; neither scipy nor the tight run are more accurate
FORCE_ERROR = 5e-3  # of the largest contact force, which follows accelerations, not deflections
PLACES = np.linspace(0.0, LENGTH, 34)[1:-1]  # m
SCIPY_SHARE = 0.08  # of the cases that scipy integrates in seconds: 500 of 10 000
MAX_PHASE = 3000.0  # rad; scipy takes seconds for as much of the highest mode, loads on the beam


class Outcome(NamedTuple):
    """What was found of a case; errors are relative to the largest deflection."""

    index: int
    modes: int
    steps: int = 0
    stated: float = 0.0  # error
    true: float = 0.0  # error beside a run of tighter tolerance
    by_scipy: float | None = None  # error beside scipy, None where that was not asked
    faults: tuple[str, ...] = ()
    refusal: str = ""  # message of a case that no step integrates
    seconds: float = 0.0  # of the processor

    @property
    def exceeds(self) -> bool:
        """Whether a true error is larger than the stated one, and than rounding."""
        return max(self.true, self.by_scipy or 0.0) > max(self.stated, ROUNDING)


def check(seed: int, index: int) -> Outcome:
    """Draw a case and check it."""
    start, drawn = time.process_time(), draw(seed, index)
    outcome = Outcome(index, drawn.case.beam.modes)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)
        try:
            record = jb.simulate(drawn.case)
        except RuntimeError as error:
            return outcome._replace(refusal=str(error), seconds=time.process_time() - start)
        faults = nan_faults(record)
        tight = _tight(drawn.case)
    true, by_scipy = 0.0, None
    if tight is not None:
        true = relative_error(*(_along(each) for each in (record, tight)))
        faults += verdict_faults(record, tight)
    sampled = np.random.default_rng([seed, index, 1]).random() < SCIPY_SHARE
    if sampled and highest_phase(drawn) < MAX_PHASE:
        by_scipy, wrong = beside_scipy(drawn, record)
        faults += wrong
    stated = float(record.error_estimate)
    outcome = outcome._replace(steps=record.steps, stated=stated, true=true, by_scipy=by_scipy)
    seconds = time.process_time() - start
    return outcome._replace(faults=tuple(faults), seconds=seconds)


def _tight(case: jb.Case) -> Record | None:
    """The run at a tighter tolerance; None where rounding is larger than that."""
    try:
        return jb.simulate(case, tolerance=TIGHT)
    except RuntimeError:
        return None


def _along(record: Record) -> np.ndarray:
    """Deflections (m) at SENSORS and PLACES: errors are relative to the largest of the beam."""
    x = np.concatenate([SENSORS, PLACES])
    return np.asarray(record.coordinates) @ np.asarray(record.modes.shapes(x)).T


def nan_faults(record: Record) -> list[str]:
    """Numbers that are not finite in a record whose verdict tells nothing of it."""
    if "diverges" in record.verdict:
        return []
    may_be_nan = {"load_position", "contact_lost_time", "contact_lost_position"}
    faults = []
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        if field.name in {"case", "modes", *may_be_nan} or value is None:
            continue
        if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(value)):
            faults.append(f"{field.name} is not finite: {record.verdict}")
    return faults


def relative_error(found, expected) -> float:
    """Largest difference relative to the largest of the expected numbers."""
    size = np.abs(expected).max()
    return float(np.abs(np.asarray(found) - expected).max() / size) if size else 0.0


def verdict_faults(record: Record, tight: Record) -> list[str]:
    """Smallest contact forces in which two runs differ."""
    scale = FORCE_ERROR * np.abs(tight.contact_force).max(initial=0.0)
    lowest, exact = (np.asarray(each.lowest_contact_force) for each in (record, tight))
    wrong = (np.abs(lowest - exact) > scale) & ~np.isnan(exact)
    return [
        f"the lowest force of load {i} is {lowest[i]:.6g} N, not {exact[i]:.6g}"
        for i in np.flatnonzero(wrong)
    ]


def highest_phase(drawn: Drawn) -> float:
    """Phase (rad) of the highest mode while loads are on the beam."""
    ends = [min(load.time_at(drawn.span.length), drawn.duration) for load in drawn.loads]
    last = max(end - load.entry_time for end, load in zip(ends, drawn.loads, strict=True))
    return float(drawn.span.frequencies[-1] * last)


def beside_scipy(drawn: Drawn, record: Record) -> tuple[float, list[str]]:
    """Error of the deflections beside scipy, and verdicts that are wrong."""
    span, loads, duration = drawn.span, drawn.loads, drawn.duration
    samples, lost = np.asarray(record.times), np.asarray(record.contact_lost_time)
    marks = [t + side * 1e-9 * duration for t in lost[np.isfinite(lost)] for side in (-1, 1)]
    times = np.unique(np.clip([*samples, *marks], 0.0, samples[-1]))
    found = modal_equations.respond(span, loads, np.concatenate([SENSORS, PLACES]), times)
    at_samples = np.searchsorted(times, samples)
    error = relative_error(_along(record), found.deflection[at_samples])
    forces = found.contact_force
    scale = FORCE_ERROR * np.abs(forces).max(initial=0.0)
    faults = []
    for i, (force, lost_time) in enumerate(zip(forces.T, lost, strict=True)):
        # With a first time of negative force, no force is negative before, and one is after.
        before = force[times < lost_time] if np.isfinite(lost_time) else force
        after = force[times > lost_time][:1]
        if before.min(initial=0.0) < -scale:
            faults.append(f"load {i} pulls by {-before.min():.6g} N: {record.verdict}")
        if after.size and after[0] > scale:
            faults.append(f"load {i} presses with {after[0]:.6g} N: {record.verdict}")
        pressing = force[force != 0.0]  # on the beam
        if pressing.min(initial=np.inf) < record.lowest_contact_force[i] - scale:
            faults.append(f"load {i} has a force of {force.min():.6g} N: {record.verdict}")
    return error, faults
