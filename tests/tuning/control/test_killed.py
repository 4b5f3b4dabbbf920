"""Searches and samplings that are killed outright go on to the very same end."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest

import tuning
from tests.tuning.small_rig import GAIN, rig
from tests.tuning.stand_in import fit, search
from tuning.fit.multi_start import multi_start
from tuning.fit.uncertainty.posterior import sample

# What a process does until, having written its first state, it is killed.
CHILD = """
import os, signal, sys
import tuning.control.optimisation, tuning.fit.uncertainty.posterior, tuning.fit.multi_start
from pathlib import Path
from tests.tuning import test_killed
from tests.tuning.stand_in import fit, search
file = Path(sys.argv[1])
def save_and_die(path, mark, arrays):
    saved(path, mark, arrays)
    os.kill(os.getpid(), signal.SIGKILL)
saved = tuning.fit.multi_start.save
tuning.fit.multi_start.save = tuning.fit.uncertainty.posterior.save = tuning.control.optimisation.save = save_and_die
{task}
"""
SCOUT = (
    "wide = search(); tuning.fit.multi_start.scout(wide, wide.campaign.measured, 12, 1, file, 'it')"
)
TUNE = "test_killed.tuned(file)"
SAMPLE = "tuning.fit.uncertainty.posterior.sample(fit(), 200, 2, 50, checkpoint=file)"


def killed(task, file):
    line = [sys.executable, "-c", CHILD.format(task=task), str(file)]
    ended = subprocess.run(line, capture_output=True, env=os.environ)
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    assert file.exists()


def tuned(file, **options):
    """A tuning in mini-batches, from two starts, that keeps its state in a file, or not."""
    cases = tuning.LoadCases(tuning.full_grid({"loads.0.mass": [0.2, 0.3, 0.4]}))
    return tuning.tune(
        rig(), {GAIN: (500.0, 7500.0)}, cases, steps=12, starts=2, batch=2, least_peaks=False,
        progress=False, checkpoint=file, **options,
    )  # fmt: skip


@pytest.mark.slow
def test_a_tuning(tmp_path):
    killed(TUNE, tmp_path / "search.npz")
    resumed, whole = tuned(tmp_path / "search.npz", resume=True), tuned(None)
    np.testing.assert_array_equal(resumed.history, whole.history)
    np.testing.assert_array_equal(resumed.values, whole.values)


def test_a_search_from_many_starts(tmp_path):
    killed(SCOUT, tmp_path / "search.npz")
    found = search()
    given = found, found.data.measured, 12, 1
    resumed = multi_start(*given, tmp_path / "search.npz", "it")
    for one, other in zip(resumed, multi_start(*given), strict=True):
        assert one.cost == other.cost and one.starts == other.starts
        np.testing.assert_array_equal(one.values, other.values)


def test_draws_of_a_posterior(tmp_path):
    pytest.importorskip("blackjax")
    killed(SAMPLE, tmp_path / "draws.npz")
    resumed = sample(fit(), 200, 2, 50, checkpoint=tmp_path / "draws.npz", resume=True)
    np.testing.assert_array_equal(resumed.draws, sample(fit(), 200, 2, 50).draws)
