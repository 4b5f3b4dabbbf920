"""Functions whose latest results are kept, by the contents of what they take."""

import dataclasses

import numpy as np

import jaxbeam as jb
from jaxbeam.runtime.memory import KEPT_RESULTS, remembered

BEAM = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
CASE = jb.Case(BEAM, sensors=[jb.Sensor(0.3)])


def counted():
    """A remembered function, and the trees of which it was computed."""
    computed = []

    @remembered
    def function(tree):
        computed.append(tree)
        return len(computed)

    return function, computed


def test_equal_contents_are_computed_once():
    function, computed = counted()
    again = jb.replace(CASE, {"beam.length": 0.6})
    assert again is not CASE and function(CASE) == function(again) == 1 and len(computed) == 1


def test_other_contents_are_computed():
    """Other numbers, another structure, another shape with the same bytes, another class."""
    function, _ = counted()
    others = (
        CASE,
        jb.replace(CASE, {"beam.length": np.nextafter(0.6, 1.0)}),
        dataclasses.replace(CASE, sensors=(*CASE.sensors, jb.Sensor(0.2))),
        dataclasses.replace(CASE, sensors=(jb.Sensor(0.3, quantity="velocity"),)),
    )
    assert [function(other) for other in others] == [1, 2, 3, 4]
    one, two = np.zeros((1, 2)), np.zeros((2, 1))
    assert (function(one), function(two), function([two])) == (5, 6, 7)


def test_few_results_are_kept():
    function, computed = counted()
    for number in (*range(KEPT_RESULTS + 1), 0):
        function(float(number))
    assert len(computed) == KEPT_RESULTS + 2
