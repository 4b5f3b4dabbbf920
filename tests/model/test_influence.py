"""Influence lines of every quantity against closed forms of one and two spans, and equilibrium."""

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.sections import influence_table
from jaxbeam.model.modes import mesh_layout
from tests.differences import central

ONE = jb.Case(jb.Beam(2.0, 6.0, 1.0))
TWO = jb.Case(jb.Beam(4.0, 6.0, 1.0), supports=[jb.Support(2.0)])
HAUNCHED = jb.Case(
    jb.Beam(25.0, 3e10, 1e4, ends="clamped-pinned", shear_stiffness=2e9, axial_force=2e8),
    supports=[jb.Support(10.0, stiffness=4e8), jb.Support(18.0)],
)
SPRING = jb.Case(jb.Beam(4.0, 6.0, 1.0), supports=[jb.Support(1.5, stiffness=5.0)])
LAYOUT = mesh_layout(SPRING)
P = np.array([0.0, 0.3, 1.0, 1.6, 2.0])


def test_one_span():
    x, length = 0.5, 2.0
    expected = np.where(x > P, P * (length - x), x * (length - P)) / length
    assert_allclose(jb.influence_line(ONE, x, P, quantity="moment"), expected, atol=1e-11)
    stress = jb.influence_line(ONE, x, P, quantity="stress", section_modulus=-0.5)
    assert_allclose(stress, expected / -0.5, atol=1e-11)
    shear = jb.influence_line(ONE, x, [0.4, 0.6], quantity="shear")
    assert_allclose(shear, [-0.2, 0.7], atol=1e-12)
    sides = [jb.influence_line(ONE, x, x, quantity="shear", side=s) for s in ("left", "right")]
    assert_allclose(sides, [0.75, -0.25], atol=1e-10)
    assert_allclose(jb.influence_line(ONE, 2.0, P, quantity="reaction"), P / 2, atol=1e-10)
    rotation = jb.influence_line(ONE, 0.0, 1.0, quantity="rotation")
    assert_allclose(rotation, -(2.0**2) / (16 * 6.0), rtol=1e-12)  # -L^2 / (16 E I)
    assert_allclose(jb.influence_line(ONE, 0.0, 1.0, quantity="slope"), rotation, rtol=1e-12)


def test_support_moment_and_reactions_of_two_spans():
    share = P / 2.0  # of the first span
    moment = jb.influence_line(TWO, 2.0, P, quantity="moment")
    assert_allclose(moment, -2.0 * share * (1 - share**2) / 4, atol=1e-10)
    middle = jb.influence_line(TWO, 2.0, P, quantity="reaction")
    assert_allclose(middle, share * (3 - share**2) / 2, atol=1e-10)


@pytest.mark.parametrize("load", [3.0, 10.0, 12.0, 22.0])
def test_reactions_balance_the_load(load):
    """Forces, and moments about the left end, which is clamped; the axial force acts on w = 0."""
    x = np.array([0.0, 10.0, 18.0, 25.0])
    reactions = jb.influence_line(HAUNCHED, x, load, quantity="reaction")
    assert_allclose(reactions.sum(), 1.0, rtol=1e-9)
    clamp = jb.influence_line(HAUNCHED, 0.0, load, quantity="moment")
    assert_allclose(reactions @ x - load - clamp, 0.0, atol=1e-8)
    slope, rotation = (
        float(jb.influence_line(HAUNCHED, 5.0, load, quantity=q)) for q in ("slope", "rotation")
    )
    h = 1e-3
    w = jb.influence_line(HAUNCHED, [5.0 - h, 5.0 + h], load)
    assert_allclose(slope, (w[1] - w[0]) / (2 * h), rtol=1e-6)
    assert abs(slope - rotation) > 0.01 * abs(slope)


def test_gradient():
    def moment(rigidity):
        case = jb.replace(SPRING, {"beam.flexural_rigidity": rigidity})
        line = jb.influence_line(case, 0.7, [1.0], layout=LAYOUT, quantity="moment")
        return line[0]

    expected = central(lambda values: moment(values[0]), [6.0], 1e-4).ravel()
    assert_allclose(jax.grad(moment)(6.0), expected[0], rtol=1e-6)


def test_refusals():
    with pytest.raises(ValueError, match=r"no reaction at 1 m; the deflection is held at \(m\): 0"):
        jb.influence_line(ONE, 1.0, P, quantity="reaction")
    with pytest.raises(ValueError, match="no influence line of 'momnet'; did you mean 'moment'"):
        jb.influence_line(ONE, 1.0, P, quantity="momnet")
    with pytest.raises(ValueError, match="side must be 'left' or 'right'"):
        jb.influence_line(ONE, 1.0, P, quantity="shear", side="up")


def test_tables_have_the_extremes_of_lines():
    """Two spans of 11 and 9 m, off the grid: support moments, and both sides of a shear force."""
    case = jb.Case(jb.Beam(20.0, 6.0, 1.0), supports=[jb.Support(11.0)])
    found = influence_table(case)
    moment = found.columns["moment at support 2 (m)"]
    # Three-moment equation: -l a (1 - a^2) l / (2 (l + m)) at a = 1 / sqrt(3) of the span l.
    expected = -11.0 * 11.0 * (2 / 3 / np.sqrt(3)) / (2 * 20.0)
    assert_allclose(moment.min(), expected, rtol=1e-4)
    one = jb.Case(jb.Beam(20.0, 6.0, 1.0))
    shear = influence_table(one, ("shear",), (7.13,)).columns["shear at 7.13 m (1)"]
    assert_allclose([shear.min(), shear.max()], [-7.13 / 20, 12.87 / 20], rtol=1e-6)
    at = influence_table(one, ("moment",), (7.13,))
    assert_allclose(at.values.max(), 7.13 * 12.87 / 20, rtol=1e-9)
    assert np.all(np.diff(at.positions) > 0)
