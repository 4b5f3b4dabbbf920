"""Bounds of free parameters, with and without units."""

import pytest

import jaxbeam as jb
from jaxbeam.cli.arguments import bounds_in_si, pair_in_si, parse_bounds, parse_prior

CASE = jb.Case(jb.Beam(25.0, 3e10, 1.5e4), loads=[jb.MovingForce(force=1e5, speed=20.0)])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("beam.flexural_rigidity=8 GN m^2:12 GN m^2", (8e9, 12e9)),
        ("beam.flexural_rigidity=8000 MN m^2 : 1.2e10 N m^2", (8e9, 12e9)),
        ("loads.*.speed=36 km/h:20 m/s", (10.0, 20.0)),
        ("beam.length=20:30", (20.0, 30.0)),
        ("beam.length", None),
    ],
)
def test_bounds_in_si_units(text, expected):
    address, pair = parse_bounds(text)
    found = bounds_in_si(CASE, {address: pair})[address]
    assert found == (expected and pytest.approx(expected))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("beam.length=25 m:20 m", "--free beam.length: bounds are LOW:HIGH"),
        ("beam.length=25 m:30 kg", "must be in m, or a unit of the same kind, not '30 kg'"),
        ("beam.lenght=25 m:30 m", "did you mean .beam.length"),
    ],
)
def test_bounds_that_are_refused(text, message):
    with pytest.raises(ValueError, match=message):
        bounds_in_si(CASE, dict([parse_bounds(text)]))


def test_priors_in_si_units():
    address, pair = parse_prior("beam.flexural_rigidity=30 GN m^2:500 MN m^2")
    assert pair_in_si(CASE, address, pair, "--prior") == pytest.approx((3e10, 5e8))
    assert parse_prior("beam.length=25:0.1") == ("beam.length", (25.0, 0.1))
    with pytest.raises(ValueError, match="give both numbers a unit, as in"):
        parse_prior("beam.length=25 m:0.1")
    with pytest.raises(ValueError, match="--prior beam.length.1 must be in m"):
        pair_in_si(CASE, "beam.length", ("25 m", "1 kg"), "--prior")
