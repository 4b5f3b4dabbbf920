"""Old names of tuning's public functions, classes and arguments: each works, with a warning."""

import pytest

import tuning
from tuning.aliases import OLD_NAMES, accepts_old_arguments


@pytest.mark.parametrize("old", OLD_NAMES)
def test_old_names_are_aliases_of_the_new_ones(old):
    new = OLD_NAMES[old]
    with pytest.warns(DeprecationWarning, match=f"tuning.{old} is called tuning.{new} now"):
        assert getattr(tuning, old) is getattr(tuning, new)
    assert new in tuning.__all__


def test_unknown_names_are_errors():
    with pytest.raises(AttributeError, match="has no attribute 'Beliefs'"):
        _ = tuning.Beliefs


def test_old_arguments_of_a_class():
    with pytest.warns(DeprecationWarning, match="the argument over of Objective is called"):
        assert tuning.Objective(over="mean") == tuning.Objective(aggregation="mean")
    with pytest.warns(DeprecationWarning):
        constraint = tuning.StabilityConstraint(largest=-1.0, spread={"beam.length": 0.1})
    assert constraint == tuning.StabilityConstraint(-1.0, parameter_tolerance={"beam.length": 0.1})


def test_old_and_new_argument_together_are_an_error():
    @accepts_old_arguments(places="positions")
    def function(positions=()):
        return positions

    with pytest.warns(DeprecationWarning, match="argument places of function is called"):
        assert function(places=[1.0]) == [1.0]
    with pytest.raises(TypeError, match="places is called positions now: give one of them"):
        function(places=[1.0], positions=[2.0])
    with pytest.raises(TypeError, match="unexpected keyword argument 'place'"):
        function(place=[1.0])
