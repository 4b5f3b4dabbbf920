"""Verdicts on published numbers: tolerances, null models, fitted and repeated numbers, readings."""

import numpy as np
import pytest

from experiments.thesis.published_numbers import PublishedNumbers, Tolerance
from experiments.thesis.verdicts import (
    EXPLAINED,
    FITTED,
    IRREPRODUCIBLE,
    NOT_REPRODUCED,
    NULL_MET,
    REPEATED,
    REPRODUCED,
    assign_verdicts,
    likeliest_interpretation,
    make_finding,
)

RELATIVE = Tolerance("for a test", relative=0.1)
TWO = PublishedNumbers("here", "two numbers", "m", "computed", RELATIVE, "1.0 20", "a b")
FAR = ("nothing", 0.0)


def verdicts(*findings):
    return [assigned.verdicts for assigned in assign_verdicts(findings)]


def test_verdicts():
    assert verdicts(make_finding(TWO, [1.1, 22.1], null=FAR)) == [[REPRODUCED, NOT_REPRODUCED]]
    proof = make_finding(TWO, [1.1, 22.1], null=FAR, impossible="of that")
    assert verdicts(proof) == [[REPRODUCED, IRREPRODUCIBLE]]
    other = make_finding(TWO, [1.1, 0.0], {"else": [1.1, 20.0]}, null=FAR)
    assert verdicts(other) == [[REPRODUCED, EXPLAINED]]
    nearer = make_finding(TWO, [1.1, 0.0], {"else": [1.0, 20.0]}, null=FAR)
    assert verdicts(nearer) == [[EXPLAINED, EXPLAINED]]
    nothing = make_finding(TWO, [np.nan, np.inf], null=FAR)
    assert verdicts(nothing) == [[NOT_REPRODUCED, NOT_REPRODUCED]]
    with pytest.raises(ValueError, match="2 numbers are printed"):
        make_finding(TWO, [1.0], null=FAR)
    with pytest.raises(ValueError, match="none: 2 numbers are printed"):
        make_finding(TWO, [1.0, 2.0], null=("none", [0.0, 0.0, 0.0]))


def test_what_the_null_model_meets_counts_for_nothing():
    one = make_finding(TWO, [1.0, 20.0], null=("no control", [0.95, 17.0]))
    assert verdicts(one) == [[NULL_MET, REPRODUCED]]
    missed = make_finding(TWO, [1.15, 20.0], null=("no control", [1.0, 16.0]))
    assert verdicts(missed) == [[NOT_REPRODUCED, REPRODUCED]]


def test_an_interpretation_less_likely_than_the_null_model_explains_nothing():
    one = make_finding(TWO, [0.0, 0.0], {"p": [1.1, 0.0]}, null=("static", [1.11, 22.2]))
    assert verdicts(one) == [[NOT_REPRODUCED, NOT_REPRODUCED]]


def test_a_number_that_a_parameter_was_fitted_to_counts_for_nothing():
    one = make_finding(TWO, [0, 0], {"p": [1.0, 20.0]}, null=FAR, fitted={"p": "b"})
    assert verdicts(one) == [[EXPLAINED, FITTED]]
    assert one.misfit("p") == 2.0 and one.misfit("as printed") == 72.0


def test_numbers_that_repeat_others_count_for_nothing():
    published = PublishedNumbers(
        "here", "", "", "computed", RELATIVE, "1.0 20", "a b", repeats="there", repeated_labels="a"
    )
    one = make_finding(published, [1.0, 20.0], null=FAR)
    assert verdicts(one) == [[REPEATED, REPRODUCED]]
    assert make_finding(published, [5.0, 20.0], null=FAR).misfit("as printed") == 0.0


def test_one_interpretation_serves_for_all_numbers():
    """The likeliest is taken, for hits and for misses; nothing is picked from the others."""
    first = make_finding(TWO, [1, 0], {"p": [0.0, 20.0], "q": [0.0, 0.0]}, null=FAR)
    second = make_finding(TWO, [0, 0], {"p": [1.0, 0.0], "q": [1.0, 0.0]}, null=FAR)
    assert likeliest_interpretation([first, second]) == "p"
    assert verdicts(first, second) == [[NOT_REPRODUCED, EXPLAINED], [EXPLAINED, NOT_REPRODUCED]]


def test_parameters_that_explain_no_more_than_themselves_do_not_make_an_interpretation_likelier():
    near = make_finding(TWO, [1.05, 20.0], {"p": [1.0, 20.0]}, null=FAR, fitted={"p": "a"})
    assert likeliest_interpretation([near]) == "as printed"


@pytest.mark.parametrize(
    ("tolerance", "values", "allowed"),
    [
        (RELATIVE, "2 -30", [0.2, 3.0]),
        (Tolerance("", absolute=1.0), "2 0.5", [1.0, 1.0]),
        (Tolerance("", digits=1), "20.387 326.2 100660 21 340", [0.001, 0.1, 10.0, 1.0, 1.0]),
        (Tolerance("", digits=1), "8.292e-4 -6250 3e12", [1e-7, 10.0, 1e12]),
    ],
)
def test_tolerances(tolerance, values, allowed):
    printed = PublishedNumbers("", "", "", "", tolerance, values)
    np.testing.assert_allclose(printed.allowed_error, allowed)
