"""Wheels of a case in words: labels of datasets, reports and figures, and where contact is lost."""

import numpy as np

from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.model.load_set import load_set

MAX_LISTED = 4  # wheels in a sentence


def wheel_labels(case: Case) -> np.ndarray:
    """Labels of all wheels: the number of the load, "0", or of one of its wheels, "0 wheel 2".

    Wheels of a load of several are counted from 1, front first, through all its vehicles.
    """
    loads, labels = load_set(case).load_of_wheel, []
    for wheel, load in enumerate(loads):
        is_only = loads.count(load) == 1
        labels.append(f"{load}" if is_only else f"{load} wheel {wheel - loads.index(load) + 1}")
    return np.array(labels, dtype=str)


def contact_sentence(case: Case, lost_times, lost_positions, lowest_forces) -> str:
    """Where and when (s, m) wheels first would have to pull, and their smallest forces (N).

    Times are NaN for wheels that press on the beam throughout. The first of many wheels are listed.
    Prescribed forces may be negative: these pull because they were given so.
    """
    negative, prescribed = np.isfinite(lost_times), load_set(case).prescribed
    lost = np.flatnonzero(negative & ~prescribed)
    pulling = np.flatnonzero(negative & prescribed)
    if pulling.size and not lost.size:
        i = int(pulling[np.argmin(lowest_forces[pulling])])
        more = f" and {pulling.size - 1} others" if pulling.size > 1 else ""
        return (
            f"the prescribed force of load {wheel_labels(case)[i]}{more} is negative at times, down"
            f" to {lowest_forces[i]:.4g} N, as given"
        )
    if case.loads and not _any_on_beam(case):
        return "no load is on the beam during the run"
    if not lost.size:
        return "every load presses on the beam throughout"
    labels = wheel_labels(case)
    first = lost[np.argsort(lost_times[lost], kind="stable")][:MAX_LISTED]
    parts = [
        f"load {labels[i]} loses contact, first at t = {lost_times[i]:.4g} s,"
        f" x = {lost_positions[i]:.4g} m (smallest contact force {lowest_forces[i]:.4g} N)"
        for i in sorted(first)
    ]
    more = lost.size - first.size
    return "; ".join([*parts, f"{more} more wheels lose contact"] if more else parts)


def _any_on_beam(case: Case) -> bool:
    """Whether any wheel is on the beam at some time of the run."""
    enter, leave = concrete(load_set(case).entry_exit_times()).T
    return bool(np.any((enter < concrete(case.run.duration)) & (leave > 0)))
