"""Sweeps as tables: a row for each run, with the swept values and what was found."""

import json
from typing import TYPE_CHECKING

import numpy as np

from jaxbeam.case.case import Case, unit_at
from jaxbeam.case.display.addresses import address_words
from jaxbeam.case.sensors import sensor_labels
from jaxbeam.files.case_file import case_from_dict

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX

MAX_LOADS = 8  # wheels with a column each; of more the least contact force of all


def sweep_columns(dataset: "xarray.Dataset") -> dict[str, np.ndarray]:
    """Columns of the dataset of a sweep by head, as "speed of the load (m/s)"; a row for each run.

    Swept values, peaks of all sensors with their times, smallest contact forces in N, and whether
    the run failed (1) or not (0); histories are left out. `pandas.DataFrame(columns)` works. Raises
    ValueError for a dataset that is not that of a sweep.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> case = jb.Case(
    ...     beam, sensors=[jb.Sensor(0.3)], loads=[jb.MovingForce(force=5.0, speed=2.0)]
    ... )
    >>> runs = jb.sweep(case, {"loads.0.speed": [1.0, 2.0]}, progress=False)
    >>> print(next(iter(sweep_columns(runs))))
    speed of the load (m/s)
    """
    if "failed" not in dataset or "case" not in dataset.attrs:
        raise ValueError("not a sweep of jaxbeam: the dataset lacks its runs or its case")
    case = case_from_dict(json.loads(dataset.attrs["case"]))
    failed = dataset["failed"]

    def of_runs(values: "xarray.DataArray") -> np.ndarray:
        return values.broadcast_like(failed).transpose(*failed.dims).values.ravel()

    names = dict.fromkeys([*map(str, failed.dims), *map(str, dataset.coords)])
    columns = {
        _head(case, name): of_runs(dataset[name])
        for name in names
        if "." in name and name in dataset.coords
    }
    labels = [str(label) for label in np.atleast_1d(dataset["sensor"].values)]
    for i, label in enumerate(labels):
        sensor = case.sensors[sensor_labels(case.sensors).index(label)]
        name = sensor.name or f"sensor {label.partition(':')[0]}"
        peak, time = f"peak_{sensor.quantity}", "peak_time"
        words = f"{name} peak {sensor.quantity}"
        columns[words + _in_brackets(sensor.unit)] = of_runs(_entry(dataset[peak], "sensor", i))
        columns[f"time of {words} (s)"] = of_runs(_entry(dataset[time], "sensor", i))
    forces = dataset.get("lowest_contact_force", None)
    if forces is not None and "load" in forces.dims and 0 < forces.sizes["load"] <= MAX_LOADS:
        for i in range(forces.sizes["load"]):
            columns[f"load {i} lowest contact force (N)"] = of_runs(forces.isel(load=i))
    elif forces is not None and forces.size:
        columns["lowest contact force (N)"] = of_runs(forces.min("load"))
    return columns | {"failed": of_runs(failed)}


def _entry(values: "xarray.DataArray", dim: str, index: int) -> "xarray.DataArray":
    return values.isel({dim: index}) if dim in values.dims else values


def _head(case: Case, address: str) -> str:
    try:
        unit = unit_at(case, address)
    except ValueError:  # a word has no unit
        unit = ""
    return address_words(case, address) + _in_brackets(unit)


def _in_brackets(unit: str) -> str:
    return "" if unit in ("", "1") else f" ({unit})"
