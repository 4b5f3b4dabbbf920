"""What of the loads the designs of laws depend on: no more than they declare, for every kind."""

import dataclasses
import itertools

import equinox as eqx
import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.case import unit_at, value_at
from jaxbeam.integrator import native_peaks
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modes import mesh_layout
from jaxbeam.simulation.closed_loop import closed_loop, loop_schedule
from jaxbeam.simulation.integration_plan import sample_times
from tests.c_code.cases import CASES

OF_LOADS = "loads.0.mass", "run.gravity"
OF_PATHS = "loads.0.speed", "loads.0.entry_time"
# Those that have the loads in their model; all others share a design over masses.
WITH_LOADS = {
    *("feedback-scheduled", "feedback-stepped", "kalman-known", "kalman-extended"),
    *("moving-horizon", "table", "family", "position", "position-followed", "nearest"),
    *("mpc-varying", "mpc-estimated"),
}


def numbers_of_law(case: jb.Case) -> list:
    """Numbers of the law that is designed for a case."""
    schedule = loop_schedule(case, np.asarray(sample_times(case)), float(case.run.duration))
    layout = mesh_layout(case)
    law = closed_loop(case, layout, load_set(case, layout), schedule).law
    return [np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(law, eqx.is_array_like))]


@pytest.mark.parametrize("kind", CASES)
def test_designs_depend_on_no_more_of_the_loads_than_they_declare(kind):
    case = CASES[kind]
    controller = case.controller
    assert controller.design_depends_on_loads == (kind in WITH_LOADS)
    free = [] if controller.design_depends_on_loads else list(OF_LOADS)
    free += [] if controller.design_depends_on_paths else list(OF_PATHS)
    before = numbers_of_law(case)
    for address in free:
        changed = 1.01 * value_at(case, address) + 1e-3
        after = numbers_of_law(jb.replace(case, {address: changed}))
        for one, other in zip(before, after, strict=True):
            np.testing.assert_array_equal(
                one, other, err_msg=f"{address} ({unit_at(case, address)})"
            )


@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
@pytest.mark.parametrize("kind", ["dlqr-kalman", "feedforward"])
def test_sweeps_of_loads_under_one_design_are_those_of_single_runs(kind, monkeypatch, tmp_path):
    """In C, where the loads of a path share a law."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(native_peaks, "MIN_RUNS_OF_LOOPS", 1)
    native_peaks.LIBRARY.build()
    case = dataclasses.replace(CASES[kind], sensors=CASES[kind].sensors[:1])
    over = {"loads.0.mass": [0.2, 0.6], "loads.0.speed": [2.0, 3.0]}
    found = jb.sweep(case, over, progress=False).peak_deflection.values
    for (i, mass), (j, speed) in itertools.product(*map(enumerate, over.values())):
        record = jb.simulate(jb.replace(case, {"loads.0.mass": mass, "loads.0.speed": speed}))
        assert_allclose(found[i, j], record.peak_deflection, rtol=2e-6)
