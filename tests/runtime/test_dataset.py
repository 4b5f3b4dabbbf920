"""Labelled datasets against those of xarray itself."""

import subprocess
import sys

import numpy as np
import xarray

from jaxbeam.runtime.printer import labelled_dataset

VARIABLES = {
    "peak": (("speed", "sensor"), np.arange(6.0).reshape(3, 2), {"units": "m"}),
    "count": ("speed", np.arange(3)),
    "unit": ((), 4.0, {"units": "1"}),
    "failed": (("speed",), np.array([True, False, False]), {"long_name": "whether the run failed"}),
}
COORDINATES = {
    "speed": ("speed", np.array([1.0, 3.0, 2.0]), {"units": "m/s"}),
    "sensor": ("sensor", np.array(["midspan", "end"])),
    "position": ("sensor", [0.5, 1.0], {"units": "m"}),
    "place": ("place", np.array(["a", "bc"], object)),
    "mode": ("mode", np.arange(1, 4)),
}


def test_the_dataset_is_that_of_xarray():
    found = labelled_dataset(VARIABLES, COORDINATES, {"title": "a beam"})
    expected = xarray.Dataset(VARIABLES, COORDINATES, {"title": "a beam"})
    xarray.testing.assert_identical(found, expected)
    assert str(found) == str(expected)
    assert {name: one.dtype for name, one in found.variables.items()} == {
        name: one.dtype for name, one in expected.variables.items()
    }
    assert all(
        type(one.to_index()) is type(expected[n].to_index())
        for n, one in found.coords.items()
        if one.ndim
    )
    assert found.sel(speed=2.0, sensor="end").peak == 5.0


def test_no_package_of_other_arrays_is_imported():
    program = (
        "import sys; from jaxbeam.runtime.printer import labelled_dataset;"
        "labelled_dataset({'a': ('x', [1.0])}, {'x': ('x', [2.0]), 'name': ('x', ['b'])});"
        "assert not {'dask', 'pint', 'cupy', 'sparse'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
