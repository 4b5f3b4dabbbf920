"""Garbage collection is as it was after a context of rare collections."""

import gc

import pytest

from jaxbeam.runtime.garbage import RARELY, rare_collections


def test_thresholds_are_restored():
    former = gc.get_threshold()
    with rare_collections():
        assert gc.get_threshold() == RARELY
    assert gc.get_threshold() == former
    with pytest.raises(ZeroDivisionError), rare_collections():
        raise ZeroDivisionError
    assert gc.get_threshold() == former


def test_thresholds_are_restored_after_two_threads():
    """The second begins within the first, and ends after it."""
    former = gc.get_threshold()
    first, second = rare_collections(), rare_collections()
    for context in (first, second):
        context.__enter__()
    for context in (first, second):
        context.__exit__(None, None, None)
    assert gc.get_threshold() == former
