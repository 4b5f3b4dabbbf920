"""A store under writers that are stopped, resumed, replaced and damaged, in random order."""

import shutil
import tempfile
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray
from hypothesis import settings, strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule

import jaxbeam as jb
from jaxbeam.sweeps.store import ZarrStore
from tests.fuzzing import examples
from tests.sweeps.test_sweep import CASE

OVER = {"loads.0.mass": np.linspace(0.1, 0.9, 200), "loads.0.speed": [1.5, 2.0, 4.0]}
CASES = CASE, jb.replace(CASE, {"beam.flexural_rigidity": 20.0})
BLOCKS = 3
EXPECTED: dict[int, xarray.Dataset] = {}


class Store(RuleBasedStateMachine):
    """Two sweeps of equal shape and one path.

    `begun` is the one it holds, `complete` the one whose results it holds, and `beside` the one
    that was stopped while it overwrote another, which it continues beside it.
    """

    @initialize()
    def start(self):
        self.folder = Path(tempfile.mkdtemp())
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
