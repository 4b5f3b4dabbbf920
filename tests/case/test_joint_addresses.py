"""Addresses that stand for a number of all loads, `loads.*.speed`."""

import jax
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.case import overlap, own_addresses, unit_at, value_at
from jaxbeam.files.case_file import with_settings
from tests.differences import central

CASE = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=2),
    sensors=[jb.Sensor(0.15), jb.Sensor(0.3)],
    loads=[
        jb.MovingMass(mass=0.4, speed=2.0),
        jb.MovingForce(force=3.0, speed=2.0, entry_time=0.1),
    ],
    run=jb.Run(duration=0.5),
)


def test_one_address_stands_for_all_loads():
    assert own_addresses(CASE, "loads.*.speed") == ["loads.0.speed", "loads.1.speed"]
    assert own_addresses(CASE, "loads.1.speed") == ["loads.1.speed"]
    assert value_at(CASE, "loads.*.speed") == 2.0
    assert unit_at(CASE, "loads.*.speed") == "m/s"
    for changed in (
        jb.replace(CASE, {"loads.*.speed": 3.0}),
        with_settings(CASE, {"loads.*.speed": 3.0}),
    ):
        assert [float(load.speed) for load in changed.loads] == [3.0, 3.0]
    moved = jb.replace(CASE, {"sensors.*.position": 0.2})
    assert_allclose(moved.sensor_positions, [0.2, 0.2])


def test_gradient_is_that_of_all_speeds_together():
    def peak(speed):
        return jb.simulate(jb.replace(CASE, {"loads.*.speed": speed})).deflection[-1, 0]

    def by_two_names(speed):
        both = {"loads.0.speed": speed, "loads.1.speed": speed}
        return jb.simulate(jb.replace(CASE, both)).deflection[-1, 0]

    assert float(peak(2.5)) == float(by_two_names(2.5))
    (slope,) = central(lambda speeds: by_two_names(speeds[0]), [2.5])
    assert_allclose(jax.grad(peak)(2.5), slope, rtol=1e-5)


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("loads.*.mass", "a number of all loads, and loads.1 has no mass"),
        ("supports.*.position", "the case has no supports"),
        ("loads.*", r"followed by a name, as in loads\.\*\.speed"),
        (
            "*.speed",
            r"lists are supports\.\*, absorbers\.\*, actuators\.\*, sensors\.\*, loads\.\*",
        ),
        ("beam.*.length", "stands for all parts of a list"),
    ],
)
def test_addresses_that_some_part_lacks(address, message):
    for use in (value_at, unit_at, own_addresses, lambda case, a: jb.replace(case, {a: 1.0})):
        with pytest.raises(ValueError, match=message):
            use(CASE, address)


def test_numbers_that_differ_have_no_common_value():
    different = jb.replace(CASE, {"loads.0.speed": 5.0})
    with pytest.raises(ValueError, match=r"differ, 5.0, 2.0: set them to one value"):
        value_at(different, "loads.*.speed")
    assert jb.replace(different, {"loads.*.speed": 1.0}).loads[0].speed == 1.0


def test_addresses_that_overlap():
    sizes = {"loads": 2}
    assert overlap(["loads.*.speed", "loads.0.mass"], sizes) is None
    assert overlap(["loads.*.speed", "loads.1.speed"], sizes) == "loads.1.speed"
