"""Line loads against closed forms and integrals of influence lines."""

import jax
import numpy as np
import pytest
from scipy.integrate import quad

import jaxbeam as jb
from jaxbeam.case.validation import check_case
from jaxbeam.files.case_file import case_from_dict, case_to_dict
from jaxbeam.library.published import line_loads
from jaxbeam.model.load_set import load_set
from tests.differences import central

LENGTH, RIGIDITY = 20.0, 1e10


def case_of(load, damping=0.0, duration=30.0, length=LENGTH) -> jb.Case:
    beam = jb.Beam(
        length=length, flexural_rigidity=RIGIDITY, mass_per_length=8000.0, damping_ratio=damping,
        modes=4,
    )  # fmt: skip
    run = jb.Run(duration=duration, sample_rate=20.0)
    return jb.Case(beam, sensors=[jb.Sensor(length / 2)], loads=[load], run=run)


def influence(x, length=LENGTH):
    """Moment at midspan under a unit force at x on a simply supported span."""
    return min(x, length - x) / 2 if 0 <= x <= length else 0.0


def midspan_moment(load, front, length=LENGTH) -> float:
    """Static moment at midspan under the point forces of a load whose front is at a position."""
    wheels = load_set(case_of(load, length=length))
    places = front - np.asarray(wheels.behind[0])
    return sum(f * influence(x, length) for f, x in zip(wheels.weight[:, 0], places, strict=True))


def test_a_load_all_over_the_span_is_the_uniform_load():
    """The error falls as the square of the distance of the point forces."""
    expected, errors = 5 * 1e4 * LENGTH**4 / (384 * RIGIDITY), []
    for points in (50, 100, 200):
        load = jb.LineLoad(force_per_length=1e4, lengths=3 * LENGTH, speed=1.0, points=points)
        peak = float(jb.statics.static_peak(case_of(load), LENGTH / 2))
        errors.append(peak / expected - 1)
    assert 0 < errors[2] < 1e-4
    assert 3.5 < errors[1] / errors[2] < 4.5 and 3.5 < errors[0] / errors[1] < 4.5


def test_a_standing_load_bends_the_beam_to_its_static_deflection():
    """Over a part of the span, from 4 m to 11 m; the rest of it is on the embankment."""
    load = jb.LineLoad(force_per_length=[2e4, 1e4], lengths=[7.0, 9.0], gaps=[0.0, 2.0],
                       position=11.0, points=20)  # fmt: skip
    case = case_of(load, damping=0.3, duration=6.0)
    record = jb.simulate(case)

    def under(x):
        return float(jb.statics.static_deflection(case, LENGTH / 2, [x], [1.0]))

    expected = 2e4 * quad(under, 4.0, 11.0)[0] + 1e4 * quad(under, 0.0, 2.0)[0]
    assert record.deflection[-1, 0] == pytest.approx(expected, rel=2e-3)  # and truncated modes
    assert np.isnan(np.asarray(record.load_position)[-1, -1])  # of a force off the beam


@pytest.mark.parametrize(
    ("model", "length"), [("SW/0", 15.0), ("SW/2", 25.0), ("unloaded-train", 20.0)]
)
def test_moments_of_models_are_integrals(model, length):
    """The first part covers the span, or the load covers it all."""
    code = line_loads()[model]
    load = jb.LineLoad(model=model, speed=10.0, points=200)
    moment = midspan_moment(load, length, length)
    assert moment == pytest.approx(code.force_per_length[0] * length**2 / 8, rel=1e-3)


def test_lm71_has_its_axles_between_its_line_loads():
    load = jb.LineLoad(model="LM71", speed=10.0, tail=60.0, points=600)
    wheels = load_set(case_of(load))
    total = float(np.sum(wheels.weight))
    assert total == pytest.approx(2 * 60.0 * 80e3 + 4 * 250e3)
    line = quad(influence, 0, 6.8)[0] + quad(influence, 13.2, LENGTH)[0]
    axles = sum(influence(LENGTH / 2 + at) for at in (-2.4, -0.8, 0.8, 2.4))
    # Symmetrical at midspan: the axles begin 0.8 m behind the first part.
    moment = midspan_moment(load, 60.0 + 3.2 + LENGTH / 2)
    assert moment == pytest.approx(80e3 * line + 250e3 * axles, rel=1e-3)


def test_in_case_files_and_gradients():
    table = {"kind": "line-load", "model": "SW/2", "speed": 20.0}
    beam = {"length": 20.0, "flexural_rigidity": 1e10, "mass_per_length": 8000.0}
    case = case_from_dict({"beam": beam, "loads": [table]})
    check_case(case)
    written = case_to_dict(case)["loads"][0]
    assert written["model"] == "SW/2" and "lengths" not in written

    def peak(numbers):
        load = jb.LineLoad(force_per_length=numbers[0], lengths=numbers[1], speed=1.0, points=10)
        return jb.statics.static_peak(case_of(load), LENGTH / 2)

    point = np.array([1e4, 6.0])
    found = jax.grad(peak)(jax.numpy.asarray(point))
    expected = [
        central(lambda x: peak([x[0], 6.0]), point[:1], 10.0)[0],
        central(lambda x: peak([1e4, x[0]]), point[1:], 1e-4)[0],
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ({"model": "SW/1"}, r"loads.0.model cannot be 'SW/1'; did you mean"),
        ({"model": "SW/0", "lengths": 3.0}, "has both model and lengths; leave one out"),
        ({"lengths": 3.0}, "has neither model nor force_per_length with lengths"),
        ({"lengths": 3.0, "force_per_length": [1.0, 2.0]}, "lengths must be a list as force_per_"),
        ({"lengths": [3.0], "force_per_length": [1.0, 2.0]}, "force_per_length has 2 entries and"),
        ({"model": "SW/0", "position": 3.0}, "has both position and speed; leave one out"),
    ],
)
def test_bad_input(numbers, words):
    with pytest.raises(ValueError, match=words):
        check_case(case_of(jb.LineLoad(**numbers, speed=1.0)))
