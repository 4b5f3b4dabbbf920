"""Sweeps over words: trains and vehicles of the library, in one dataset and one store."""

import dataclasses
import json

import jax
import numpy as np
import pytest
import xarray
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.case.case import own_addresses
from jaxbeam.case.loads.axles import Axles
from jaxbeam.case.loads.vehicles import VehicleLoad
from jaxbeam.files.case_file import with_settings
from jaxbeam.model.load_set import load_set
from jaxbeam.runtime import compiling
from jaxbeam.simulation.sweeps import integration
from jaxbeam.simulation.sweeps.store import ZarrStore, kept_blocks, status
from jaxbeam.simulation.sweeps.sweep import with_numbers

BEAM = jb.Beam(25.0, 3.0e10, 15000.0, damping_ratio=0.01, modes=1)
CASE = jb.Case(
    BEAM,
    sensors=[jb.Sensor(12.5)],
    loads=[Axles(train="LM71-axles", speed=30.0)],
    run=jb.Run(duration=1.0),
)
TRAINS, SPEEDS = ["LM71-axles", "HL93-truck"], [30.0, 50.0, 70.0]
OVER = {"loads.0.speed": SPEEDS, "loads.0.train": TRAINS}


def sweep(over=OVER, case=CASE, **options) -> xarray.Dataset:
    return jb.sweep(case, over, progress=False, **{"tolerance": 1e-6} | options)


@pytest.fixture(scope="module")
def dataset():
    return sweep()


def test_words_are_labels_and_peaks_those_of_single_runs(dataset):
    assert dataset.peak_deflection.dims == ("loads.0.speed", "loads.0.train", "sensor")
    assert dataset["loads.0.train"].values.tolist() == TRAINS
    for train in TRAINS:
        for speed in SPEEDS[::2]:
            case = with_settings(CASE, {"loads.0.train": train, "loads.0.speed": speed})
            found = dataset.peak_deflection.sel({"loads.0.train": train, "loads.0.speed": speed})
            assert_allclose(found, jb.simulate(case).peak_deflection, rtol=1e-5)
    assert not dataset.failed.any()
    cases = [json.loads(text) for text in dataset.cases.values]
    assert [case["loads"][0]["train"] for case in cases] == TRAINS


def test_wheels_that_a_train_lacks_are_nan(dataset):
    forces = dataset.lowest_contact_force.isel({"loads.0.speed": 0})
    wheels = [int(np.isfinite(forces.sel({"loads.0.train": train})).sum()) for train in TRAINS]
    assert wheels == [4, 3]


def test_words_without_numbers():
    peaks = sweep({"loads.0.train": TRAINS}).peak_deflection
    assert peaks.dims == ("loads.0.train", "sensor")
    expected = [
        jb.simulate(with_settings(CASE, {"loads.0.train": train})).peak_deflection
        for train in TRAINS
    ]
    assert_allclose(peaks, expected, rtol=1e-5)


def test_trains_with_equally_many_axles_share_programs(monkeypatch):
    """HSLM-A6 and A7 have 40 axles each: the program of the second is there already.

    In single precision, as in double precision forces at constant speeds compile nothing.
    """
    compiling._compiled_signatures.cache_clear()
    compiled = compiling._compiled_signatures(integration.integrate_block)
    counts, original = [], integration.integrate_block.precompile

    def precompile(*arguments):
        counts.append(len(compiled))
        return original(*arguments)

    case = with_settings(CASE, {"loads.0.train": "HSLM-A6", "run.duration": 9.0})
    monkeypatch.setattr(integration.integrate_block, "precompile", precompile)
    over = {"loads.0.train": ["HSLM-A6", "HSLM-A7"], "loads.0.speed": [60.0, 70.0]}
    sweep(over, case)
    assert not counts
    sweep(over, case, precision="single")
    # Two programs of the first train, that in double precision for the steps; no more afterwards.
    assert counts[0] == 0 and counts[2:] == [2, 2] and len(compiled) == 2


@pytest.mark.parametrize(
    "load",
    [
        Axles(train="HSLM-A2", speed=50.0),
        Axles(train="EN15528-D2", count=3, speed=50.0),
        VehicleLoad(model="quarter-truck", speed=20.0),
    ],
)
def test_numbers_in_place_of_words_mean_the_same(load):
    case = jb.Case(BEAM, sensors=[jb.Sensor(1.0)], loads=[load])
    for part, other in zip(
        *(map(np.asarray, _numbers(load_set(c))) for c in (case, with_numbers(case))), strict=True
    ):
        assert_array_equal(part, other)


def _numbers(loads):
    return loads.weight, loads.inertia, loads.entry_exit_times()


def test_store_is_resumed_after_an_interrupt(tmp_path, monkeypatch, dataset):
    """The first train is in the store, the second is not when the sweep is interrupted."""
    path, finish = tmp_path / "runs.zarr", ZarrStore.finish

    def stop(self, joined):
        finish(self, joined)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(ZarrStore, "finish", stop)
        with pytest.raises(KeyboardInterrupt):
            sweep(store=path)
    assert status(path)[0] == "unfinished" and status(path / "blocks" / "0")[0] == "complete"
    assert kept_blocks(path) == "finished blocks are kept"
    with pytest.raises(FileExistsError, match="resume it"):
        sweep(store=path)
    with pytest.raises(ValueError, match="another case, other values"):
        sweep(OVER | {"loads.0.train": ["LM71-axles", "HL93-tandem"]}, store=path, resume=True)
    resumed = sweep(store=path, resume=True)
    assert status(path)[0] == "complete"
    for name in dataset.data_vars:
        assert_array_equal(resumed[name], dataset[name])
        assert_array_equal(sweep(store=path, resume=True)[name], dataset[name])
    assert [entry.name for entry in path.iterdir() if entry.name == "blocks"] == []


def test_one_speed_for_all_loads():
    loads = [*CASE.loads, jb.MovingForce(force=1e5, speed=30.0, entry_time=0.2)]
    case = jb.Case(BEAM, sensors=CASE.sensors, loads=loads, run=CASE.run)
    assert own_addresses(case, "loads.*.speed") == ["loads.0.speed", "loads.1.speed"]
    peaks = sweep({"loads.*.speed": [40.0, 60.0]}, case).peak_deflection
    assert peaks.dims == ("loads.*.speed", "sensor")
    expected = jb.simulate(jb.replace(case, {"loads.0.speed": 60.0, "loads.1.speed": 60.0}))
    assert_allclose(peaks[1], expected.peak_deflection, rtol=1e-5)


@pytest.mark.parametrize(
    ("over", "options", "message"),
    [
        ({"loads.0.train": ["LM71-axle"]}, {}, "loads.0.train cannot be 'LM71-axle'; did you mean"),
        ({"loads.0.tran": ["LM71-axles"]}, {}, "loads.0 has no key 'tran'"),
        ({"loads.0.train": ["LM71-axles", 3]}, {}, "words or of numbers, not both"),
        ({"loads.0.speed": ["fast"]}, {}, "takes a list of numbers"),
        (OVER, {"paired": True}, "cannot be paired"),
        (
            {"run.seed": range(200_000)},
            {},
            r"2.0e\+05 combinations of words and counts at run.seed",
        ),
        (OVER | {"loads.0.sped": [1.0]}, {}, "with loads.0.train = LM71-axles: the case has no"),
        ({"loads.0.speed": [1.0], "loads.*.speed": [2.0]}, {}, "both give the number loads.0"),
        ({"loads.*.force": [1.0]}, {}, "loads.0 has no force"),
    ],
)
def test_words_that_are_refused(over, options, message):
    with pytest.raises(ValueError, match=message):
        sweep(over, **options)


def test_seeds_and_counts_are_swept_as_words():
    """With fractiles over the seeds; numbers of the profile may vary beside them."""
    case = dataclasses.replace(
        CASE,
        loads=[jb.MovingMass(mass=2e4, speed=20.0)],
        profile=jb.profiles.ISO8608Profile("A", seed=0, scale=0.1, highest_wavenumber=1.0),
    )
    over = {"profile.seed": [3, 5.0], "beam.modes": [1, 2], "profile.scale": [0.1, 0.2]}
    found = sweep(over, case)
    assert found.peak_deflection.shape == (2, 2, 2, 1)
    assert found["profile.seed"].values.tolist() == [3, 5]
    settings = {"profile.seed": 5, "beam.modes": 2, "profile.scale": 0.2}
    single = jb.simulate(with_settings(case, settings)).peak_deflection
    assert_allclose(found.peak_deflection.sel(settings), single, rtol=1e-5)
    half = found.peak_deflection.quantile(0.5, "profile.seed")
    assert_allclose(half, found.peak_deflection.mean("profile.seed"))
    with pytest.raises(ValueError, match=r"profile\.seed takes whole numbers, not 1\.5"):
        sweep({"profile.seed": [1, 1.5]}, case)


def test_profiles_of_several_seeds_have_one_structure():
    case = dataclasses.replace(CASE, profile=jb.profiles.ISO8608Profile("C", seed=0))
    first, second = (
        with_numbers(with_settings(case, {"profile.seed": seed})).profile for seed in (1, 2)
    )
    assert jax.tree.structure(first) == jax.tree.structure(second)
    kept = with_numbers(case, ["profile.scale"]).profile
    assert isinstance(kept, jb.profiles.ISO8608Profile)
