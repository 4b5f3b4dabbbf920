"""Two sweeps and one store: one writes, the other is refused, and neither loses finished runs."""

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import xarray

import jaxbeam as jb
from jaxbeam.runtime.output_file import InUseError
from jaxbeam.sweeps import store as store_writing
from jaxbeam.sweeps.store import ZarrStore, block_places, create_store, status, writing
from tests.sweeps.test_store import CASE, OVER, files_of, stop_after, sweep

OTHER = jb.replace(CASE, {"beam.flexural_rigidity": 20.0})


@pytest.fixture(scope="module")
def expected():
    return sweep(None)


@pytest.mark.parametrize("options", [{}, {"resume": True}, {"overwrite": True}])
def test_second_sweep_is_refused_while_the_first_writes(tmp_path, expected, options):
    path, started, go_on, refusals = (
        tmp_path / "runs.zarr",
        threading.Event(),
        threading.Event(),
        [],
    )
    write = ZarrStore.write

    def wait(self, block, results):
        started.set()
        go_on.wait(60)
        write(self, block, results)

    def second():
        started.wait(60)
        for case in (CASE, OTHER):
            with pytest.raises(InUseError, match=f"by process {os.getpid()} on .* since") as raised:
                jb.sweep(case, OVER, store=path, progress=False, **options)
            refusals.append(str(raised.value))
        go_on.set()

    thread = threading.Thread(target=second)
    thread.start()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ZarrStore, "write", wait)
        found = sweep(path)
    thread.join()
    assert len(refusals) == 2
    xarray.testing.assert_identical(found, expected)
    xarray.testing.assert_identical(sweep(path, resume=True), expected)
    assert [entry.name for entry in tmp_path.iterdir()] == ["runs.zarr"]


def test_failed_overwriting_loses_nothing_and_goes_on_when_repeated(tmp_path, expected):
    path = tmp_path / "runs.zarr"
    jb.sweep(OTHER, OVER, store=path, progress=False)
    before = files_of(path)
    stop_after(2, path, overwrite=True)
    assert files_of(path) == before
    blocks = tmp_path / ".runs.zarr.new" / "blocks"
    (kept,) = blocks.glob("*/*.blocks")
    content = kept.read_bytes()
    assert len(list(block_places(kept))) == 2

    def compare_blocks(self, dataset):
        assert kept.read_bytes() == content
        (added,) = set(blocks.glob("*/*.blocks")) - {kept}
        assert len(list(block_places(added))) == 1
        finish(self, dataset)

    finish = ZarrStore.finish
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ZarrStore, "finish", compare_blocks)
        found = sweep(path, overwrite=True)
    xarray.testing.assert_identical(found, expected)
    xarray.testing.assert_identical(sweep(path, resume=True), expected)
    assert [entry.name for entry in tmp_path.iterdir()] == ["runs.zarr"]


def test_interrupted_overwriting_can_be_resumed_or_replaced(tmp_path, expected):
    path = tmp_path / "runs.zarr"
    jb.sweep(OTHER, OVER, store=path, progress=False)
    stop_after(1, path, overwrite=True)
    with pytest.raises(ValueError, match="cannot be resumed"):
        jb.sweep(OTHER, {"loads.0.mass": [0.3]}, store=path, resume=True, progress=False)
    xarray.testing.assert_identical(sweep(path, resume=True), expected)
    stop_after(1, path, overwrite=True)
    other = jb.sweep(OTHER, OVER, store=path, overwrite=True, progress=False)
    again = jb.sweep(OTHER, OVER, store=path, resume=True, progress=False)
    xarray.testing.assert_identical(again, other)
    assert [entry.name for entry in tmp_path.iterdir()] == ["runs.zarr"]


@pytest.mark.parametrize("crash_before", ["path", "new"])
def test_crash_while_folders_are_swapped(tmp_path, expected, crash_before):
    """Both folders are there at each moment, and the next command ends what was begun."""
    path = tmp_path / "runs.zarr"
    jb.sweep(OTHER, OVER, store=path, progress=False)
    rename, crashing = (
        Path.rename,
        path if crash_before == "path" else path.with_name(".runs.zarr.new"),
    )

    def crash(self, target):
        if self == crashing:
            raise KeyboardInterrupt
        return rename(self, target)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Path, "rename", crash)
        with pytest.raises(KeyboardInterrupt):
            sweep(path, overwrite=True)
    xarray.testing.assert_identical(sweep(path, resume=True), expected)
    assert [entry.name for entry in tmp_path.iterdir()] == ["runs.zarr"]


def test_old_sweep_comes_back_if_the_new_one_was_not_complete(tmp_path):
    path = tmp_path / "runs.zarr"
    dataset = jb.sweep(OTHER, OVER, store=path, progress=False)
    path.rename(tmp_path / ".runs.zarr.old")
    assert status(path) is None
    found = jb.sweep(OTHER, OVER, store=path, resume=True, progress=False)
    xarray.testing.assert_identical(found, dataset)
    assert [entry.name for entry in tmp_path.iterdir()] == ["runs.zarr"]


def test_blocks_of_an_earlier_sweep_do_not_get_among_those_of_another(tmp_path):
    """A worker of a cluster may live longer than the sweep that it works for."""
    path, results = tmp_path / "runs.zarr", {"peak_deflection": np.ones((1, 2, 1))}
    with writing(path, "a" * 64, False, False) as place:
        worker = create_store(place.folder, "a" * 64, {}, np.ones(3))
    with writing(path, "b" * 64, False, True) as place:
        assert place.folder != path
        create_store(place.folder, "b" * 64, {}, np.ones(3))
    store = ZarrStore(path)
    store.write(0, results)
    for block in (0, 1):
        with pytest.raises(OSError, match="cannot write"):
            worker.write(block, {"peak_deflection": 9 * results["peak_deflection"]})
    store = ZarrStore(path)
    assert store.missing([0, 1]) == [1]
    np.testing.assert_array_equal(store.collect(1, np.array([[0, 1]]))["peak_deflection"], 1.0)
    with pytest.raises(OSError, match="another sweep has taken its place"):
        worker.finish(xarray.Dataset(attrs={"jaxbeam_sweep": "a" * 64}))


KILLED = """
import sys, jaxbeam as jb, tests.sweeps.test_store as t
t.sweep(sys.argv[1], overwrite=True)
"""


def test_killed_overwriting_leaves_the_old_sweep_and_no_lock_that_counts(tmp_path, expected):
    path = tmp_path / "runs.zarr"
    other = jb.sweep(OTHER, OVER, store=path, progress=False)
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(path)])
    while process.poll() is None and not list(tmp_path.glob(".runs.zarr.new/blocks/*/*.blocks")):
        time.sleep(0.001)
    process.kill()
    process.wait()
    assert (tmp_path / ".runs.zarr.lock").exists(), "killed after the sweep was complete"
    again = jb.sweep(OTHER, OVER, store=path, resume=True, progress=False)
    xarray.testing.assert_identical(again, other)
    xarray.testing.assert_identical(sweep(path, overwrite=True), expected)
    assert [entry.name for entry in tmp_path.iterdir()] == ["runs.zarr"]
    assert store_writing._status_or_none(tmp_path / ".runs.zarr.new") is None
