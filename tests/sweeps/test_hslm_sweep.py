"""Peaks of high-speed trains on a bridge of 25 m, against an independent implementation.

Peaks (mm) at midspan are those of `trains.json`, cases 3a: 20 modes, exact recursion on instants
0.0125 m of travel apart, static correction. Nine modes leave out at most 96 / pi^4 (1/11^4 + 1/13^4
+ ...) = 1.4e-4 of the static deflection under a force at midspan; even modes do not move it.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.files.case_file import load_case, with_settings
from tests.modules import ROOT

CASE = load_case(ROOT / "examples" / "railway_bridge" / "case.toml")
SPEEDS = np.array([165.0, 230.0, 307.5, 332.5])  # km/h
PEAKS = {
    "HSLM-A1": [7.449978, 17.82763, 8.37692, 7.573409],
    "HSLM-A7": [9.469584, 10.20521, 55.68435, 16.85602],
    "HSLM-A9": [19.56476, 10.99256, 26.55292, 64.65258],
}


@pytest.mark.parametrize("train", PEAKS)
def test_peaks_agree_with_an_independent_implementation(train):
    numbers = {"beam.modes": 9, "run.duration": 10.0, "run.sample_rate": 20.0}
    case = with_settings(CASE, numbers | {"loads.0.train": train})
    speeds = SPEEDS / 3.6
    runs = [jb.simulate(jb.replace(case, {"loads.0.speed": v}), tolerance=1e-5) for v in speeds]
    found = [1e3 * float(run.peak_deflection[0]) for run in runs]
    assert_allclose(found, PEAKS[train], rtol=1.4e-4)
