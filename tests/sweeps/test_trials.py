"""Results of trials: a sweep takes over those with its own steps."""

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.integrator import native_peaks
from jaxbeam.sweeps.step_size import Trials

CASE = jb.Case(
    jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, modes=2),
    sensors=[jb.Sensor(0.2), jb.Sensor(0.3)],
    loads=[jb.MovingMass(mass=0.5, speed=2.0)],
    run=jb.Run(0.5),
)
OVER = {"loads.0.mass": [0.2, 0.4], "loads.0.speed": np.linspace(1.0, 5.0, 40)}


def test_only_results_with_the_same_steps_are_known():
    trials, results = Trials(), {"peak": np.arange(6.0).reshape(3, 2)}
    trials.add(np.array([4, 7, 9]), np.array([0.1, 0.2, 0.3]), np.array([0, 0, 1]), results)
    latest = {"peak": np.array([[8.0, 9.0]])}
    for step in (0.5, 0.4, 0.3, 0.25):  # as many as are kept, so that the first is forgotten
        trials.add(np.array([7]), np.array([step]), np.array([0]), latest)
    given = (
        np.array([9, 9, 7, 7, 5]),
        np.array([0.3, 0.3, 0.2, 0.4, 0.1]),
        np.array([1, 0, 0, 0, 0]),
    )
    known = trials.has_results(*given)
    assert known.tolist() == [True, False, False, True, False]
    found = trials.completed({"peak": np.full((5, 2), -1.0)}, *given, known)["peak"].tolist()
    assert found == [[4.0, 5.0], [-1.0, -1.0], [-1.0, -1.0], [8.0, 9.0], [-1.0, -1.0]]


@pytest.mark.parametrize("way", ["C", "XLA", "single"])
def test_results_of_trials_are_those_of_stored_sweeps(way, tmp_path, monkeypatch):
    """Sweeps in memory compute fewer batches; stored ones and single precision take over none."""
    native, precision = way == "C", "single" if way == "single" else "double"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    if native:
        native_peaks.LIBRARY.build()
    monkeypatch.setattr(native_peaks, "available", lambda: native)
    masks, completed = [], Trials.completed

    def counted(trials, results, batch_indices, steps, extra_steps, known):
        if results:  # of a block, not of a trial
            masks.append(known.sum())
        return completed(trials, results, batch_indices, steps, extra_steps, known)

    monkeypatch.setattr(Trials, "completed", counted)
    given = {"progress": False, "precision": precision}
    in_memory = jb.sweep(CASE, OVER, **given)
    blocks, count = len(masks), sum(masks)
    assert count < 40 and (count == 0) == (precision == "single")
    stored = jb.sweep(CASE, OVER, store=tmp_path / "sweep.zarr", **given)
    # XLA may round otherwise where a batch has another place in its block.
    tolerance = 0 if native else 1e-7
    for name in in_memory:
        np.testing.assert_allclose(in_memory[name], stored[name], tolerance, err_msg=name)
    assert len(masks) == blocks
