"""Records from labelled datasets and from their netCDF files."""

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxbeam.case.arguments import checks_classes
from jaxbeam.case.beam import has
from jaxbeam.case.case import Case
from jaxbeam.files.case_file import case_from_dict
from jaxbeam.files.netcdf import check_codecs
from jaxbeam.model.elements import Layout, is_uniform, sections
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modes import Modes, mesh_layout, modes
from jaxbeam.runtime.arrays import xp
from jaxbeam.runtime.input_file import check_input, not_as_named
from jaxbeam.simulation.record import Record
from jaxbeam.simulation.views import (
    MODE_FIELDS,
    MODE_VARIABLES,
    OF_ABSORBERS,
    OF_FLIGHTS,
    VARIABLES,
    Flights,
)

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX

_VARIABLES = VARIABLES | OF_ABSORBERS
_STORED_VARIABLES = [name for name in _VARIABLES if name in Record.__annotations__]


def record_from_xarray(dataset: "xarray.Dataset") -> Record:
    """Record from a dataset of `Record.to_xarray`, or read from its file.

    Raises ValueError if the dataset is not that of a record.
    """
    if "case" not in dataset.attrs:
        raise ValueError("not a record of jaxbeam: it lacks its case")
    case = case_from_dict(json.loads(dataset.attrs["case"]))
    # Without sensors, loads or absorbers a file lacks their variables.
    sizes = {
        "sensor": len(case.sensors),
        "load": load_set(case).wheel_count,
        "actuator": len(case.actuators),
        "absorber": len(case.absorbers),
        **dataset.sizes,
    }
    may_be_empty = *_STORED_VARIABLES, "measured"
    shapes = {name: [sizes.get(d, 0) for d in _VARIABLES[name][0]] for name in may_be_empty}
    empty = {
        name: (_VARIABLES[name][0], np.zeros(shape))
        for name, shape in shapes.items()
        if 0 in shape and name not in dataset.variables
    }
    dataset = _with_extremes(dataset.assign(empty), case)
    if "step_errors" not in dataset.variables:  # of release 0.1.0
        dataset = dataset.assign(step_errors=("sensor", np.full(len(case.sensors), np.nan)))
    sampled = case.controller is not None and case.controller.period is not None
    mode_variables = {name: f"mode_{name}" for name in MODE_VARIABLES}
    required = (*_STORED_VARIABLES, *mode_variables.values(), "time")
    missing = [name for name in required if name not in dataset.variables]
    if missing:
        raise ValueError(f"not a record of jaxbeam: it lacks {', '.join(missing)}")
    values = {name: xp.asarray(dataset[name].values) for name in _STORED_VARIABLES}
    layout, acting = mesh_layout(case), dataset.variables.get("acting_command")
    result = dataset.attrs.get("result")  # since release 0.3.0
    return Record(
        case=case,
        modes=Modes(
            **{
                MODE_FIELDS.get(name, name): xp.asarray(dataset[label].values)
                for name, label in mode_variables.items()
            },
            layout=layout,
            sections=None if is_uniform(case) else sections(case, layout),
            rotation_series=_rotation_series(dataset, case, layout),
            twist_series=(
                xp.asarray(dataset["mode_twist_series"].values) if case.beam.twists else None
            ),
        ),
        times=xp.asarray(dataset["time"].values),
        error_estimate=xp.asarray(float(dataset.attrs["error_estimate"])),
        steps=int(dataset.attrs["steps"]),
        controller_readings=xp.asarray(dataset["measured"].values) if sampled else None,
        acting_command=None if acting is None else xp.asarray(acting.values),
        result=None if result is None else xp.asarray(int(result)),
        flights=_flights(dataset, case),
        **values,
    )


def _flights(dataset: "xarray.Dataset", case: Case) -> Flights | None:
    """Flights of a run with unilateral contact; a file without any lacks their variables."""
    if not (case.lifts and case.loads):
        return None
    parts = {
        name: np.asarray(dataset[f"flight_{name}"].values if f"flight_{name}" in dataset else [])
        for name in OF_FLIGHTS
    }
    return Flights(**parts | {"wheel": parts["wheel"].astype(int)})


def _rotation_series(dataset: "xarray.Dataset", case: Case, layout: Layout):
    """Rotations of the modes; computed again for a file that lacks those of a Timoshenko beam."""
    if "mode_rotation_series" in dataset.variables:
        return xp.asarray(dataset["mode_rotation_series"].values)
    return modes(case, layout).rotation_series if has(case.beam, "shear_stiffness") else None


def _with_extremes(dataset: "xarray.Dataset", case: Case) -> "xarray.Dataset":
    """The dataset of release 0.1.0 with extremes of the samples: of deflections, else NaN."""
    if "smallest" in dataset.variables or "deflection" not in dataset.variables:
        return dataset
    measured = np.array([sensor.quantity == "deflection" for sensor in case.sensors], bool)
    values, times = dataset["deflection"].values, dataset["time"].values
    found = {}
    for name, index in (("smallest", values.argmin(axis=0)), ("largest", values.argmax(axis=0))):
        extreme = np.take_along_axis(values, index[None], axis=0)[0]
        found[name] = ("sensor", np.where(measured, extreme, np.nan))
        found[f"{name}_time"] = ("sensor", np.where(measured, times[index], np.nan))
    return dataset.assign(found)


@checks_classes
def read_record(path: str | os.PathLike) -> Record:
    """Record from a netCDF file or zarr store written by `Record.save`.

    Raises OSError if the file cannot be read, ValueError if it is damaged or not that of a record.

    >>> import jaxbeam as jb
    >>> import pathlib, tempfile
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> record = jb.simulate(jb.Case(beam, loads=[jb.MovingMass(mass=0.5, speed=2.0)]))
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "run.nc"
    >>> record.save(path)
    >>> print(jb.read_record(path).times.size)
    1001
    """
    import xarray

    if os.path.isdir(path):
        check_codecs(Path(path))
        dataset = xarray.open_zarr(path, consolidated=False, zarr_format=3)
        return record_from_xarray(dataset.load())
    check_input(path, "record")
    try:
        dataset = xarray.load_dataset(path, engine="scipy")
    except Exception:  # xarray and scipy raise many types for damaged files
        raise not_as_named(path, "classic netCDF file", b"CDF") from None
    return record_from_xarray(dataset)
