"""Data of the test of the tests: tests that should notice changes, and what may go unnoticed."""

import re

from tests.modules import ROOT
from tests.mutants.__main__ import left_ones, targets


def test_targets_name_tests_that_exist():
    files = targets()
    packages = {name.split("/")[1] for name in files}
    assert packages == {"model", "case", "integrator", "estimation", "analysis"}
    for test in sorted({test for own in files.values() for test in own}):
        path, _, name = test.partition("::")
        assert (ROOT / path).exists(), test
        assert not name or re.search(rf"^def {name}\(", (ROOT / path).read_text(), re.M), test


def test_mutants_that_may_survive_are_of_lines_that_exist():
    for entry in left_ones():
        assert entry["before"] != entry["after"] and len(entry["why"]) > 20
