"""Runs of a sweep that fail: their number, and a warning that names the first."""

import warnings
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX


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
