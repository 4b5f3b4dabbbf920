"""Layers of the tests: names in the lists are those of tests."""

import re

import pytest

from tests.layers.selection import layers, matches
from tests.modules import ROOT

NIGHTLY, SLOW = layers()


@pytest.mark.parametrize("test", sorted(NIGHTLY))
def test_nightly_tests_exist(test):
    file, _, function = test.partition("[")[0].partition("::")
    source = (ROOT / file).read_text(encoding="utf-8")
    assert re.search(rf"^def {function}\(", source, re.MULTILINE)


def test_a_test_is_named_with_or_without_its_parameters():
    names = frozenset({"a.py::test_one[x-1]", "b.py::test_two", "c.py"})
    assert matches("a.py::test_one[x-1]", names) and not matches("a.py::test_one[x-2]", names)
    assert matches("b.py::test_two[y]", names) and matches("c.py::test_three", names)
    assert not matches("b.py::test_two_more", names)
