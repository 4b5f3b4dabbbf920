"""Layers of the tests: names in the lists are those of tests."""

import re

import threadpoolctl

from tests.layers.selection import layers, matches
from tests.layers.touched import nearest_tests
from tests.modules import ROOT, module_files

NIGHTLY, _ = layers()


def test_nightly_tests_exist():
    """With any parameters."""
    for test in NIGHTLY:
        file, _, function = test.partition("[")[0].partition("::")
        source = (ROOT / file).read_text(encoding="utf-8")
        assert re.search(rf"^def {function}\(", source, re.MULTILINE), test


def test_a_test_is_named_with_or_without_its_parameters():
    names = frozenset({"a.py::test_one[x-1]", "b.py::test_two", "c.py"})
    assert matches("a.py::test_one[x-1]", names) and not matches("a.py::test_one[x-2]", names)
    assert matches("b.py::test_two[y]", names) and matches("c.py::test_three", names)
    assert not matches("b.py::test_two_more", names)


def test_the_nearest_tests_of_a_module():
    assert nearest_tests(["jaxbeam/model/modes.py"]) == ["tests/model/test_modes.py"]
    assert nearest_tests(["tests/test_layers.py", "tests/test_gone.py"]) == ["tests/test_layers.py"]
    assert nearest_tests(["tests/layers/selection.py"]) == ["tests/test_layers.py"]
    assert nearest_tests(["docs/conf.py"]) == []


def test_all_modules_have_tests_near():
    """But for `jaxbeam/__init__.py` and `__main__.py`, which many tests use."""
    for path in module_files().values():
        file = path.relative_to(ROOT).as_posix()
        near = nearest_tests([file])
        assert near or file in ("jaxbeam/__init__.py", "jaxbeam/__main__.py"), file
        assert all((ROOT / test).exists() for test in near)


def test_matrices_are_computed_by_one_thread():
    """In one process and in many, whatever loaded NumPy first."""
    import scipy.linalg  # noqa: F401

    libraries = threadpoolctl.threadpool_info()
    assert {one["num_threads"] for one in libraries if one["user_api"] == "blas"} == {1}
