"""Searches and samplings whose process is killed are resumed to the same results."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest

import tuning
from tests.tuning.small_rig import GAIN, fit, least_squares, rig
from tuning import checkpoint
from tuning.checkpoint import Checkpoint
from tuning.fit.least_squares import multi_start
from tuning.fit.uncertainty import sample

# Code of a process that is killed once it has written its first checkpoint.
CHILD = """
import os, signal, sys
import tuning.checkpoint
from pathlib import Path
from tests.tuning import small_rig
from tests.tuning.control import test_killed
from tuning.checkpoint import Checkpoint
from tuning.fit.least_squares import multi_start
from tuning.fit.uncertainty import sample
file = Path(sys.argv[1])
save = tuning.checkpoint.save
def save_and_die(path, digest, arrays):
    save(path, digest, arrays)
    os.kill(os.getpid(), signal.SIGKILL)
tuning.checkpoint.save = save_and_die
{task}
"""
SEARCH = """
problem = small_rig.least_squares()
multi_start(problem, problem.data.measured, 12, 1, Checkpoint(file, "digest"))
"""
TUNE = "test_killed.tuned(file)"
SAMPLE = "sample(small_rig.fit(), 200, 2, 50, checkpoint=file)"


def killed(task, file):
    line = [sys.executable, "-c", CHILD.format(task=task), str(file)]
    ended = subprocess.run(line, capture_output=True, env=os.environ)
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    assert file.exists()


def tuned(file, **options):
    """A tuning in mini-batches from two starts, with a checkpoint unless `file` is None."""
    cases = tuning.LoadCases(tuning.full_grid({"loads.0.mass": [0.2, 0.3, 0.4]}))
    return tuning.tune(
        rig(), {GAIN: (500.0, 7500.0)}, cases, steps=12, starts=2, batch=2, least_peaks=False,
        progress=False, checkpoint=file, **options,
    )  # fmt: skip


def assert_resumed(file):
    """Check that a tuning that ended after its first checkpoint is resumed to the same result."""
    resumed, whole = tuned(file, resume=True), tuned(None)
    np.testing.assert_array_equal(resumed.history, whole.history)
    np.testing.assert_array_equal(resumed.values, whole.values)


def test_a_killed_tuning_is_resumed(tmp_path):
    killed(TUNE, tmp_path / "search.npz")
    assert_resumed(tmp_path / "search.npz")


def test_a_stopped_tuning_is_resumed(tmp_path, monkeypatch):
    """In one process, which compiles once."""
    save = checkpoint.save

    def save_and_stop(*arguments):
        save(*arguments)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(checkpoint, "save", save_and_stop)
        tuned(tmp_path / "search.npz")
    assert_resumed(tmp_path / "search.npz")


def test_a_killed_multi_start_search_is_resumed(tmp_path):
    killed(SEARCH, tmp_path / "search.npz")
    problem = least_squares()
    arguments = problem, problem.data.measured, 12, 1
    resumed = multi_start(*arguments, Checkpoint(tmp_path / "search.npz", "digest"))
    for one, other in zip(resumed, multi_start(*arguments), strict=True):
        assert one.cost == other.cost and one.starts == other.starts
        np.testing.assert_array_equal(one.values, other.values)


def test_a_killed_sampling_is_resumed(tmp_path):
    pytest.importorskip("blackjax")
    killed(SAMPLE, tmp_path / "draws.npz")
    resumed = sample(fit(), 200, 2, 50, checkpoint=tmp_path / "draws.npz", resume=True)
    np.testing.assert_array_equal(resumed.draws, sample(fit(), 200, 2, 50).draws)
