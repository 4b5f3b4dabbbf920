"""Files of labelled variables, beside those that xarray writes."""

import numpy as np
import xarray

from jaxbeam.files.netcdf import write_netcdf

PARTS = (
    {
        "deflection": (("time", "sensor"), np.arange(6.0).reshape(3, 2), {"units": "m"}),
        "shape": (("mode", "time"), np.array([[1.0, np.nan, -2.0]]), {"long_name": "Ä"}),
        "count": (("time",), np.arange(3, dtype=np.int32), {}),
        "scale": ((), np.array(2.5), {"units": "1"}),
    },
    {
        "time": ("time", np.array([0.0, 0.1, 0.2]), {"units": "s"}),
        "sensor": ("sensor", np.array(["0: deflection", "1: µ"])),
        "frequency": ("mode", np.array([12.5]), {"units": "Hz"}),
    },
    {"title": "", "remark": "m²", "error": 1.5e-9, "steps": 12},
)


def test_xarray_reads_the_dataset_and_would_have_written_the_same_file(tmp_path):
    ours, theirs = tmp_path / "ours.nc", tmp_path / "theirs.nc"
    write_netcdf(ours, *PARTS)
    dataset = xarray.Dataset(*PARTS)
    dataset.to_netcdf(theirs, engine="scipy")
    xarray.testing.assert_identical(xarray.load_dataset(ours, engine="scipy"), dataset)
    raw, expected = (
        xarray.load_dataset(path, engine="scipy", decode_cf=False) for path in (ours, theirs)
    )
    xarray.testing.assert_identical(raw, expected)
    assert all(raw[name].dtype == expected[name].dtype for name in expected.variables)


def test_variables_without_entries_are_left_out(tmp_path):
    path = tmp_path / "file.nc"
    empty = {"force": (("time", "load"), np.zeros((3, 0)), {})}
    write_netcdf(path, PARTS[0] | empty, *PARTS[1:])
    read = xarray.load_dataset(path, engine="scipy")
    assert "force" not in read and "load" not in read.sizes
