"""Wheels of a case in words: labels of datasets, reports and figures, and where contact is lost."""

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.model.load_set import LoadSet, load_set

MAX_LISTED = 4  # wheels in a sentence
ROUNDING = 1e-12  # of a given force


def wheel_labels(case: Case) -> np.ndarray:
    """Labels of all wheels: the number of the load, "0", or of one of its wheels, "0 wheel 2".

    Wheels of a load of several are counted from 1, front first, through all its vehicles. Absorbers
    come last, "absorber 0".
    """
    loads, labels = load_set(case).load_of_wheel, []
    for wheel, load in enumerate(loads):
        is_only = loads.count(load) == 1
        label = f"{load}" if is_only else f"{load} wheel {wheel - loads.index(load) + 1}"
        absorber = load - len(case.loads)
        labels.append(label if absorber < 0 else f"absorber {absorber}")
    return np.array(labels, dtype=str)


def contact_sentence(case: Case, lost_times, lost_positions, lowest_forces) -> str:
    """Where and when (s, m) wheels first would have to pull, and their smallest forces (N).

    Times are NaN for wheels that press on the beam throughout. The first of many wheels are listed.
    Prescribed forces may be negative: these pull because they were given so.
    """
    loads = load_set(case)
    negative, prescribed = np.isfinite(lost_times), loads.prescribed
    rounding = ROUNDING * _given_forces(loads)
    lowest_forces = np.where(np.abs(lowest_forces) <= rounding, 0.0, lowest_forces)
    negative = negative & ~(prescribed & (lowest_forces == 0))
    lost = np.flatnonzero(negative & ~prescribed)
    pulling = np.flatnonzero(negative & prescribed)
    if pulling.size and not lost.size:
        i = int(pulling[np.argmin(lowest_forces[pulling])])
        more = f" and {pulling.size - 1} others" if pulling.size > 1 else ""
        return (
            f"the prescribed force of load {wheel_labels(case)[i]}{more} is negative at times, down"
            f" to {lowest_forces[i]:.4g} N, as given"
        )
    if not lost.size:
        return _pressing_sentence(case, loads, lowest_forces)
    labels = wheel_labels(case)
    first = lost[np.argsort(lost_times[lost], kind="stable")][:MAX_LISTED]
    parts = [
        f"load {labels[i]} loses contact, first at t = {lost_times[i]:.4g} s,"
        f" x = {lost_positions[i]:.4g} m (smallest contact force {lowest_forces[i]:.4g} N)"
        for i in sorted(first)
    ]
    more = lost.size - first.size
    return "; ".join([*parts, f"{more} more wheels lose contact"] if more else parts)


def _given_forces(loads: LoadSet) -> Float[np.ndarray, " wheel"]:
    """Bounds (N) of the given forces of wheels: weights, waves and tables."""
    bounds = np.abs(concrete(loads.weight)[:, 0])
    for wheel, history in loads.wheels.histories.items():
        amplitudes, forces = concrete(history.amplitudes), concrete(history.forces)
        bounds[wheel] += np.sum(np.abs(amplitudes)) + np.max(np.abs(forces), initial=0.0)
    return bounds


def _pressing_sentence(case: Case, loads: LoadSet, lowest_forces) -> str:
    """Which wheels press on the beam throughout, where none pulls: none without weight, say."""
    if not case.loads:
        return "the case has no loads"
    labels = wheel_labels(case)
    enter, leave = concrete(loads.entry_exit_times()).T
    crosses = (enter < concrete(case.run.duration)) & (leave > 0) & ~loads.fixed
    if not np.any(crosses):
        return "no load is on the beam during the run"
    weightless = crosses & (concrete(loads.weight)[:, 0] == 0) & (lowest_forces == 0)
    weightless[list(loads.wheels.histories)] = False
    released = crosses & (lowest_forces == 0) & ~weightless
    exceptions = [
        (weightless, "{} has no weight", "{} have no weight"),
        (released, "the force of {} falls to 0 N", "the forces of {} fall to 0 N"),
        (~crosses & ~loads.fixed, "{} is not on the beam", "{} are not on the beam"),
    ]
    parts = []
    for wheels, one, several in exceptions:
        index = np.flatnonzero(wheels)
        if index.size:
            listed = ", ".join(labels[index[:MAX_LISTED]])
            more = f" and {index.size - MAX_LISTED} more" if index.size > MAX_LISTED else ""
            words, loads_of = (one, "load") if index.size == 1 else (several, "loads")
            parts.append(words.format(f"{loads_of} {listed}{more}"))
    if np.any(crosses & ~weightless & ~released):
        other = "other " if parts else ""
        parts.append(f"every {other}load presses on the beam throughout")
    return "; ".join(parts)
