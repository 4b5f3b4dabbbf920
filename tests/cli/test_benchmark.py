"""Command `benchmark`: the stored tables, and scores of a controller."""

from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.benchmark.problem import TEST_SEEDS


def test_the_command_prints_the_tables(run, refused):
    printed = run("benchmark")
    assert all(name in printed for name in jb.benchmark.names())
    found = run("benchmark patch --json")
    assert_allclose(found["score"], jb.benchmark.baselines()["patch"].mean)
    assert [row["seed"] for row in found["runs"]] == list(TEST_SEEDS)
    assert "has footbridge" in refused("benchmark rope")
    assert "name it" in refused("benchmark --seed 3")


def test_the_command_scores_a_controller(run, folder):
    (folder / "law.toml").write_text(
        '[controller]\nkind = "feedback"\ngains = [4000.0]\nperiod = 0.01\nresolution = 0.01\n'
    )
    found = run("benchmark unknown_mass --controller law.toml --seed 1 --json")
    law = jb.Feedback(gains=[4000.0], period=0.01, resolution=0.01)
    expected = jb.benchmark.score("unknown_mass", law, seed=1)
    assert_allclose(found["score"], expected.mean, rtol=1e-9)
    assert found["runs"][0]["seed"] == 1
