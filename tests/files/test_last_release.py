"""Files that release 0.1.0 wrote are read by this one, and hold the same numbers.

`tests/data/release_0_1_0` was written by the commands of commit 3019fe3: `simulate case.toml`,
`sweep case.toml` over mass and speed, `identify rig.toml log_1.csv` for the flexural rigidity, and
`export` of `regulator.toml` (gains, filter and estimator) and of `table.toml` (`--points 6`).
Its fit was written anew by release 0.2.0, in `release_0_2_0`.
"""

import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.files.export import export_gains, read_gains
from jaxbeam.files.export.gains import ARRAYS
from jaxbeam.simulation.stored_record import read_record
from tuning import load_fit, read_logs

FOLDER = Path(__file__).parents[1] / "data" / "release_0_1_0"
OVER = {"loads.0.mass": [0.2, 0.5, 0.8], "loads.0.speed": [1.0, 2.0]}


def test_a_record_holds_the_same_run():
    record = read_record(FOLDER / "record.nc")
    case = jb.replace(jb.load_case(FOLDER / "case.toml"), {"run.sample_rate": 50.0})
    again = jb.simulate(case)
    assert_allclose(record.deflection, again.deflection, rtol=1e-6, atol=1e-10)
    assert_allclose(record.command, again.command, rtol=1e-6, atol=1e-7)


def test_a_sweep_holds_the_same_peaks(tmp_path):
    case = jb.load_case(FOLDER / "case.toml")
    runs = xarray.open_zarr(FOLDER / "runs.zarr", consolidated=False).load()
    again = jb.sweep(case, OVER, progress=False)
    assert_allclose(runs.peak_deflection, again.peak_deflection, rtol=1e-6)
    store = tmp_path / "runs.zarr"
    shutil.copytree(FOLDER / "runs.zarr", store)
    with pytest.raises(ValueError, match="by another version: it cannot be resumed .* overwrite"):
        jb.sweep(case, OVER, store=store, resume=True, progress=False)


def test_a_fit_holds_its_parameters_logs_and_cases():
    fit = load_fit(FOLDER.with_name("release_0_2_0") / "fit.npz")
    (parameter,) = fit.parameters
    assert parameter.address == "beam.flexural_rigidity"
    assert_allclose(fit.values, 10.99979, atol=6e-4)  # as printed by that release
    assert jb.load_case(FOLDER / "fit.toml").beam.flexural_rigidity == fit.values[0]
    (log,) = read_logs(FOLDER / "log_1.csv")
    assert_allclose(fit.dataset.logs[0].values, log.values)


@pytest.mark.parametrize("ending", ["csv", "mat"])
def test_gains_hold_the_same_numbers(ending):
    gains = read_gains(FOLDER / f"regulator.{ending}")
    again = export_gains(jb.load_case(FOLDER / "regulator.toml"))
    assert (gains.period, gains.columns, gains.commands) == (0.002, again.columns, again.commands)
    for part in ARRAYS:
        expected = getattr(again, part)
        atol = 1e-6 * np.abs(expected).max(initial=0.0)
        assert_allclose(getattr(gains, part), expected, rtol=0, atol=atol, err_msg=part)


def test_a_table_of_gains_holds_the_numbers_of_its_file():
    gains = read_gains(FOLDER / "table.csv")  # which agree with its check values
    assert_allclose(gains.shares, np.linspace(0, 1, 6))
    expected = [85567.1939, 114808.3578, 436.6325, 210.4399]  # as printed in the file
    assert_allclose(gains.table[0, 0, 1, 0], expected, rtol=1e-6)


def test_former_kinds_are_named_with_their_present_word():
    with pytest.raises(ValueError, match="'passage'; it is called 'feedforward' now"):
        jb.load_case(FOLDER / "feedforward.toml")
