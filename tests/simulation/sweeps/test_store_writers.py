"""Two sweeps and one store: one writes, the other is refused, and neither loses finished runs.

A store under writers that are stopped, resumed, replaced and damaged, in random order.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray
from hypothesis import settings, strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule

import jaxbeam as jb
from jaxbeam.runtime.output_file import InUseError
from jaxbeam.simulation.sweeps import store as store_writing
from jaxbeam.simulation.sweeps.store import ZarrStore, block_places, create_store, status, writing
from tests.fuzzing import examples
from tests.simulation.sweeps.test_store import CASE, OVER, files_of, stop_after, sweep

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
import sys, jaxbeam as jb, tests.simulation.sweeps.test_store as t
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


CASES = CASE, jb.replace(CASE, {"beam.flexural_rigidity": 20.0})
BLOCKS = 3
EXPECTED: dict[int, xarray.Dataset] = {}


class Store(RuleBasedStateMachine):
    """Two sweeps of equal shape and one path.

    `begun` is the one it holds, `complete` the one whose results it holds, and `beside` the one
    that was stopped while it overwrote another, which it continues beside it.
    """

    def __init__(self):
        super().__init__()
        self.folder = Path(tempfile.mkdtemp())  # before any rule: `teardown` runs without one, too

    @initialize()
    def start(self):
        self.path = self.folder / "runs.zarr"
        self.begun = self.complete = self.beside = None
        for i, case in enumerate(CASES):
            if i not in EXPECTED:
                EXPECTED[i] = jb.sweep(case, OVER, progress=False)

    def teardown(self):
        shutil.rmtree(self.folder)

    @rule(
        sweep=st.sampled_from([0, 1]),
        how=st.sampled_from(["new", "resume", "overwrite"]),
        stop_at=st.sampled_from([*range(BLOCKS + 1), None]),
    )
    def run(self, sweep, how, stop_at):
        """Run a sweep, and stop it before it writes a block, before its end, or not at all."""
        write, finish = ZarrStore.write, ZarrStore.finish

        def stop_write(store, block, results):
            if block == stop_at:
                raise KeyboardInterrupt
            write(store, block, results)

        def stop_finish(store, dataset):
            if stop_at == BLOCKS:
                raise KeyboardInterrupt
            finish(store, dataset)

        options = {} if how == "new" else {how: True}
        with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".* finished blocks are damaged")
            patch.setattr(ZarrStore, "write", stop_write)
            patch.setattr(ZarrStore, "finish", stop_finish)
            try:
                found = jb.sweep(CASES[sweep], OVER, store=self.path, progress=False, **options)
            except KeyboardInterrupt:
                assert how == "overwrite" or self.may_go_on(sweep)
                if self.begun is None:
                    self.begun = sweep
                elif how == "overwrite":
                    self.beside = sweep
                return
            except FileExistsError as error:
                assert how == "new" and self.begun is not None
                assert "resume it, overwrite it, or choose" in str(error)
                return
            except ValueError as error:
                assert how == "resume" and not self.may_go_on(sweep)
                assert "another case, other values or settings" in str(error)
                return
        xarray.testing.assert_identical(found, EXPECTED[sweep])
        assert how == "overwrite" or self.may_go_on(sweep)
        if how == "overwrite" or self.begun == 1 - sweep:
            self.beside = None
        self.begun = self.complete = sweep

    def may_go_on(self, sweep):
        """Whether a sweep can be begun or resumed: no other is in its place."""
        return self.begun in (None, sweep) or self.beside == sweep

    @rule(which=st.integers(0, 10**6), damage=st.sampled_from(["truncate", "delete", "change"]))
    def damage_an_unfinished_block(self, which, damage):
        """Blocks of an unfinished sweep are computed again."""
        files = sorted(self.path.glob("blocks/*/*.blocks"))
        if not files:
            return
        file = files[which % len(files)]
        content = bytearray(file.read_bytes())
        if damage == "delete" or not content:
            file.unlink()
        elif damage == "truncate":
            file.write_bytes(content[:-1])
        else:
            content[which % len(content)] ^= 1
            file.write_bytes(content)

    @rule()
    def read(self):
        """What was complete stays readable until another sweep is."""
        if self.complete is not None:
            found = xarray.open_zarr(self.path, consolidated=False).load()
            expected = EXPECTED[self.complete]
            np.testing.assert_array_equal(found.peak_deflection, expected.peak_deflection)


TestStore = Store.TestCase
TestStore.settings = settings(max_examples=examples(6), stateful_step_count=8)
