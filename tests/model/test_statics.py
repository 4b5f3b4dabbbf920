"""Static solutions against textbooks, finite elements (exact for point forces), and each other."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import quad

import jaxbeam as jb
from jaxbeam.analysis.sections import influence_table
from jaxbeam.case.actuators.base import Patch, Shaker, SpringDamper
from jaxbeam.case.beam import END_CONDITIONS, Beam, Support
from jaxbeam.case.case import Case, replace, value_at
from jaxbeam.case.fields import kinds
from jaxbeam.case.loads.base import AbstractLoad, MovingForce, MovingMass
from jaxbeam.model.deflection_lines import influence_line, static_deflection
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.statics import static_peak
from tests.differences import central
from tests.loop_as_oracle import as_oracle
from tests.oracles import closed_forms, finite_elements

PROPERTIES = {"flexural_rigidity": 3.0, "mass_per_length": 1.0}
UNSTABLE = ("free-free", "free-pinned", "pinned-free", "free-guided", "guided-free",
            "guided-guided")  # fmt: skip
GENERAL = Case(
    Beam(1.3, 2.0, 0.7, ends="guided-free"),
    supports=[Support(0.3, 500.0, 0.4, 3.0), Support(0.91), Support(1.3, 20.0, 0.2)],
    actuators=[
        Patch(0.2, 0.45, 1e-3, added_mass=0.4, added_rigidity=1.0),
        Shaker(0.7, 300.0),
        Patch(0.4, 0.7, 1e-3, added_mass=0.1, added_rigidity=0.5),
        SpringDamper(0.11, 800.0),
    ],
    loads=[MovingMass(0.5, 0.7), MovingForce(force=2.0, speed=0.7, entry_time=0.4)],
)
X = np.array([0.0, 0.05, 0.25, 0.33, 0.6, 1.0, 1.3])


def oracle_line(case: Case, x, positions) -> np.ndarray:
    """Influence lines (load position, x) of the oracle, exact with few elements."""
    beam = as_oracle(case, elements=1)
    return np.array([finite_elements.static_deflection(beam, x, [(p, -1.0)]) for p in positions])


@pytest.mark.parametrize("ends", [f"{a}-{b}" for a in END_CONDITIONS for b in END_CONDITIONS])
def test_influence_line_of_one_span_by_macaulays_method(ends):
    case, positions = Case(Beam(1.7, **PROPERTIES, ends=ends)), np.linspace(0.0, 1.7, 8)
    if ends in UNSTABLE:
        with pytest.raises(ValueError, match="rigid body.*hold its ends or add supports"):
            influence_line(case, 0.6, positions)
        return
    expected = closed_forms.influence_line(1.7, 3.0, ends, 0.6, positions)
    found = influence_line(case, 0.6, positions)
    assert_allclose(found, expected, rtol=1e-12, atol=1e-13 * np.abs(expected).max())


def test_a_haunched_span_by_the_unit_load_method():
    """Integral of the product of both bending moments over a rigidity of third degree."""
    length, powers = 4.0, [8.0, -9.0, 5.0, 6.0]
    case = Case(Beam(length, mass_per_length=1.0, segments=[jb.Segment(flexural_rigidity=powers)]))

    def moment(s, a):
        return min(s, a) * (length - max(s, a)) / length

    def flexibility(x, a):
        def product(s):
            rigidity = np.polynomial.polynomial.polyval(s / length, powers)
            return moment(s, x) * moment(s, a) / rigidity

        return quad(product, 0.0, length, points=[x, a], epsabs=0.0, epsrel=1e-12)[0]

    x, a = np.array([0.7, 2.3]), np.array([1.1, 3.2])
    expected = [[-flexibility(*pair) for pair in zip(x, [y, y], strict=True)] for y in a]
    assert_allclose(influence_line(case, x, a), expected, rtol=1e-9)


def test_a_long_beam_on_a_foundation_deflects_as_an_endless_one():
    """Hetenyi: beta / (2 k) exp(-beta r) (cos beta r + sin beta r), with beta^4 = k / (4 E I)."""
    rigidity, foundation = 1e10, 1e7
    beam = Beam(200.0, rigidity, 1e4, foundation_stiffness=foundation)
    beta, r = (foundation / (4 * rigidity)) ** 0.25, np.array([0.0, 6.0, 20.0])
    shape = np.exp(-beta * r) * (np.cos(beta * r) + np.sin(beta * r))
    found = influence_line(Case(beam), 100.0 + r, 100.0)
    assert_allclose(found, -beta / (2 * foundation) * shape, rtol=0, atol=1e-9 * beta / foundation)


def test_supports_springs_and_patches_together_against_finite_elements():
    # No load so close to another node that the short element spoils the oracle.
    y = np.array([0.02, 0.11, 0.3, 0.47, 0.7, 0.95, 1.15])
    expected = oracle_line(GENERAL, X, y)
    found = influence_line(GENERAL, X, y)
    assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    load_positions, forces = [0.2, 0.95], [3.0, -1.5]
    expected = finite_elements.static_deflection(
        as_oracle(GENERAL, 1), X, [(0.2, -3.0), (0.95, 1.5)]
    )
    found = static_deflection(GENERAL, X, load_positions, forces)
    assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_forces_left_out_are_the_weights_of_the_loads():
    found = static_deflection(GENERAL, X, [0.2, 0.95])
    expected = static_deflection(GENERAL, X, [0.2, 0.95], [0.5 * 9.81, 2.0])
    assert_allclose(found, expected, rtol=1e-14)


def test_a_beam_supported_by_suspensions_alone():
    springs = [Shaker(0.1, 3500.0), SpringDamper(0.5, 1000.0)]
    case = Case(Beam(0.6, 11.68, 0.535, ends="free-free"), actuators=springs)
    expected = oracle_line(case, [0.2, 0.6], [0.05, 0.3])
    assert_allclose(influence_line(case, [0.2, 0.6], [0.05, 0.3]), expected, rtol=1e-12)
    case = Case(Beam(0.6, 11.68, 0.535, ends="free-free"), actuators=springs[:1])
    with pytest.raises(ValueError, match="rigid body"):
        influence_line(case, 0.2, 0.1)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_derivatives_along_the_beam(order):
    y = [0.02, 0.3, 0.6, 0.95]
    found = influence_line(GENERAL, 0.5, y, order)
    expected = central(lambda x: influence_line(GENERAL, x[0], y, order - 1), [0.5], 1e-2)[:, 0]
    assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


# Peaks while loads travel slowly


def replace_loads(case: Case, loads) -> Case:
    return dataclasses.replace(case, loads=loads)


def sampled_peak(case: Case, x, until: float) -> np.ndarray:
    """Static peak by sampling many instants."""
    times, total = np.linspace(0.0, until, 40001), 0.0
    length = float(case.beam.length)
    for load in case.loads:
        path = load.trajectory(case.beam.length)
        position = np.clip(np.asarray(path.kinematics(times)[0]), 0.0, length)
        entry, leave = (float(t) for t in path.entry_exit_times())
        line = np.asarray(influence_line(case, x, position))
        on = ((times >= entry) & (times <= leave))[:, None]
        total = total + float(load.vehicle(case.run.gravity).static_loads[0]) * on * line
    return np.abs(total).max(axis=0)


@pytest.mark.parametrize("speed", [0.01, 3.0, -3.0])
def test_static_peak_of_one_load_is_the_extreme_of_the_influence_line(speed):
    """Pinned, midspan: P L^3 / 48 E I; a quarter span, by Roark's largest deflection."""
    case = Case(Beam(2.0, **PROPERTIES), loads=[MovingMass(0.4, speed)])
    a = 0.5  # the load at a: deflection elsewhere is largest sqrt((L^2 - a^2) / 3) from the far end
    extreme = a * (4.0 - a**2) ** 1.5 / (9 * np.sqrt(3) * 2.0)
    expected = 0.4 * 9.81 / 3.0 * np.array([8 / 48, extreme])
    assert_allclose(static_peak(case, [1.0, a]), expected, rtol=1e-12)


STREAM = [
    MovingMass(0.509, 0.55, deceleration=0.05),
    MovingForce(force=3.0, speed=-0.7, entry_time=0.3),
    MovingMass(0.4, times=[0.0, 1.0, 2.0, 3.0], positions=[1.3, 0.7, 0.5, 0.1]),
]


@pytest.mark.parametrize("loads", [STREAM[:1], STREAM], ids=["one", "all"])
def test_peaks_of_a_stream_are_those_of_a_fine_sampling(loads):
    case = replace_loads(GENERAL, loads)
    x = np.array([0.1, 0.5, 1.3])
    expected = sampled_peak(case, x, 4.0)
    found = static_peak(case, x)
    assert np.all(found >= expected * (1 - 1e-12))
    assert_allclose(found, expected, rtol=2e-4)  # samples miss the instant of an exit


def test_static_peak_without_loads_is_zero():
    assert_allclose(static_peak(replace_loads(GENERAL, []), X), 0.0)


# Derivatives

NUMBERS = [
    "beam.length", "beam.flexural_rigidity", "supports.0.position", "supports.0.stiffness",
    "supports.0.rotational_stiffness", "supports.1.position", "actuators.0.start",
    "actuators.0.end", "actuators.0.added_rigidity", "actuators.1.position",
    "actuators.1.stiffness", "actuators.3.position", "loads.0.mass", "loads.1.force",
    "loads.1.entry_time", "loads.0.speed", "run.gravity",
]  # fmt: skip


def test_gradients_of_lines_and_peaks():
    """Relative changes of every number, against central differences.

    In reverse mode, the transpose of forward mode: where it is right, both are.
    """
    # A support at the very end cannot follow when the length changes alone.
    case = replace(GENERAL, {"supports.2.position": 1.2, "actuators.2.end": 0.75})
    layout = mesh_layout(case)
    start = np.array([float(value_at(case, address)) for address in NUMBERS])
    x = jnp.array([0.25, 0.6])

    @jax.jit
    def quantities(change):
        changed = replace(case, dict(zip(NUMBERS, start * (1 + change), strict=True)))
        line = influence_line(changed, x, jnp.array([0.35, 1.0]), layout=layout)
        return jnp.append(line.ravel(), static_peak(changed, x, layout))

    none = jnp.zeros(len(NUMBERS))
    expected = central(quantities, none, 1e-3)
    scale = np.abs(expected).max(axis=1, keepdims=True)
    found = jax.jacrev(quantities)(none)
    assert_allclose(found / scale, expected / scale, rtol=1e-6, atol=1e-8)


# Bad input


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: influence_line(GENERAL, 1.4, 0.1), "x must lie on the beam, between 0 and 1.3 m"),
        (lambda: influence_line(GENERAL, 0.1, [0.1, -0.2]), "positions must lie on the beam"),
        (lambda: influence_line(GENERAL, 0.1, jnp.nan), "positions must lie on the beam"),
        (
            lambda: static_deflection(GENERAL, 0.1, [0.1]),
            "each of the 2 wheels of the case",
        ),
        (lambda: static_deflection(GENERAL, 0.1, [0.1, 0.2], 1.0), "one for each of the 1 forces"),
        (lambda: static_peak(GENERAL, -1.0), "x must lie on the beam"),
        (
            lambda: static_peak(replace(GENERAL, {"beam.length": -1.0}), 0.1),
            "beam.length must be positive",
        ),
    ],
)
def test_invalid_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        call()


# Influence lines of every quantity against closed forms of one and two spans, and equilibrium.

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


# Static peaks under every kind of load, against closed forms and sums over the wheels by hand.

LENGTH, RIGIDITY, G, V = 20.0, 6e9, 9.81, 10.0
BRIDGE = jb.Case(
    jb.Beam(LENGTH, RIGIDITY, 9e3, damping_ratio=0.02), sensors=[jb.Sensor(8.0)], run=jb.Run(4.0)
)
PEAK_X = 8.0


def moment_line(y, x=PEAK_X):
    """Moment at x of a simply supported beam under 1 N at y."""
    inside = (np.asarray(y) >= 0) & (np.asarray(y) <= LENGTH)
    return np.where(inside, np.minimum(y, x) - np.asarray(y) * x / LENGTH, 0.0)


def shear_line(y, x=PEAK_X):
    """Shear force right of x under 1 N at y: 1 - y / L beyond x, -y / L before it."""
    inside = (np.asarray(y) >= 0) & (np.asarray(y) <= LENGTH)
    return np.where(inside, (np.asarray(y) > x) - np.asarray(y) / LENGTH, 0.0)


def loaded(*loads) -> jb.Case:
    return dataclasses.replace(BRIDGE, loads=loads)


def peak(case, x=PEAK_X, quantity="moment", **options) -> float:
    return float(jb.statics.static_peak(case, x, quantity=quantity, **options))


# Loads that stand


def test_a_force_that_stands():
    """F a b / L, F a^2 b^2 / (3 E I L), F b / L at the left support."""
    a, b, force = 8.0, 12.0, 3e5
    case = loaded(jb.VaryingForce(force=force, position=a))
    assert_allclose(peak(case), force * a * b / LENGTH, rtol=1e-9)
    deflection = force * (a * b) ** 2 / (3 * RIGIDITY * LENGTH)
    assert_allclose(jb.statics.static_peak(case, a), deflection, rtol=1e-9)
    assert_allclose(peak(case, 0.0, "reaction"), force * b / LENGTH, rtol=1e-9)
    assert_allclose(peak(case, a, "shear"), force * a / LENGTH, rtol=1e-9)
    assert_allclose(peak(case, a, "shear", side="left"), force * b / LENGTH, rtol=1e-9)
    stress = peak(case, a, "stress", section_modulus=0.5)
    assert_allclose(stress, 2 * force * a * b / LENGTH, rtol=1e-9)


def test_a_line_load_that_stands():
    """From 4 m to 16 m with 1500 N/m in closed form, at midspan: q a (2 L - a) / 8, a = 12 m."""
    load = jb.LineLoad(force_per_length=1.5e3, lengths=12.0, position=16.0, points=400)
    moment, span = 1.5e3 * 12.0 * (2 * LENGTH - 12.0) / 8, LENGTH / 2
    assert_allclose(peak(loaded(load), span), moment, rtol=1e-5)
    late = dataclasses.replace(load, entry_time=3.0)
    assert_allclose(peak(loaded(late), span), moment, rtol=1e-5)
    beyond = jb.LineLoad(force_per_length=1.5e3, lengths=12.0, position=26.0, points=400)
    part = 1.5e3 * 6.0 * 3.0 / 2  # 14 m to 20 m: half of the right reaction times 10 m
    assert_allclose(peak(loaded(beyond), span), part, rtol=1e-5)
    assert peak(loaded(dataclasses.replace(load, position=45.0))) == 0.0


def test_a_step_load_amplifies_twofold():
    """Undamped, one mode: twice the share 2 / (pi^4 / 96) of the mode in the static deflection."""
    beam = jb.Beam(LENGTH, RIGIDITY, 9e3, modes=1)
    force = jb.VaryingForce(force=1e4, position=LENGTH / 2)
    case = jb.Case(beam, loads=[force], run=jb.Run(2.0))
    found = jb.sections.amplification(case, [LENGTH / 2])[0]
    assert_allclose(found, 2 * 96 / np.pi**4, rtol=1e-6)
    line = jb.LineLoad(force_per_length=1e3, lengths=LENGTH, position=LENGTH, points=60)
    found = jb.sections.amplification(dataclasses.replace(case, loads=[line]), [LENGTH / 2])[0]
    assert_allclose(found, 2 * 384 * 4 / (5 * np.pi**5), rtol=2e-4)


def test_a_standing_and_a_travelling_load_add_up():
    """The second enters after the first has left, and again while it stands."""
    lorry = jb.MovingForce(force=2e5, speed=V)
    for entry in (0.5, 5.0):
        machine = jb.VaryingForce(force=1e5, position=12.0, entry_time=entry)
        most = max(2e5 * moment_line(PEAK_X), 1e5 * moment_line(12.0))
        if entry < 0.8:  # before the lorry is at x
            most = 2e5 * moment_line(PEAK_X) + 1e5 * moment_line(12.0)
        assert_allclose(peak(loaded(lorry, machine)), most, rtol=1e-9)


# Forces that vary


def test_waves_and_tables():
    """Against a fine sampling of F(t) times the influence line."""
    waves = {"frequencies": [0.7, 3.1], "amplitudes": [4e4, 3e4], "phases": [0.3, 1.0]}
    table = {"force_times": [0.2, 0.9, 1.4], "forces": [0.0, 9e4, -2e4]}
    passage = PEAK_X / (2 * V)
    t = np.sort(np.append(np.linspace(0.0, 4.0, 400_001), passage + 1e-9))

    def force(t):
        sines = 4e4 * np.sin(2 * np.pi * 0.7 * t + 0.3) + 3e4 * np.sin(2 * np.pi * 3.1 * t + 1.0)
        return 1e5 + sines + np.interp(t, table["force_times"], table["forces"])

    for where, y in (({"position": 12.0}, 12.0 + 0 * t), ({"speed": 2 * V}, 2 * V * t)):
        case = loaded(jb.VaryingForce(force=1e5, **waves, **table, **where))
        for quantity, line in (("moment", moment_line), ("shear", shear_line)):
            expected = np.abs(force(t) * line(y)).max()
            assert_allclose(peak(case, quantity=quantity), expected, rtol=2e-5)
    only_table = loaded(jb.VaryingForce(**table, speed=V))
    expected = np.abs(np.interp(t, *table.values()) * moment_line(V * t)).max()
    assert_allclose(peak(only_table), expected, rtol=1e-6)


def test_a_long_run_is_searched_in_blocks(monkeypatch):
    case = loaded(jb.VaryingForce(force=1e5, frequencies=[5.0], amplitudes=[2e4], speed=V))
    expected = peak(case)
    monkeypatch.setattr("jaxbeam.model.deflection_lines.BLOCK", 100)
    assert_allclose(peak(case), expected, rtol=1e-14)


def test_traced_waves_are_refused_and_constant_forces_are_not():
    layout = mesh_layout(BRIDGE)

    def of_force(load):
        def value(force):
            case = jb.replace(loaded(load), {"loads.0.force": force})
            return jb.statics.static_peak(case, PEAK_X, layout, quantity="moment")

        return value

    constant = of_force(jb.VaryingForce(force=1e5, position=12.0))
    assert_allclose(jax.grad(constant)(1e5), central(lambda f: constant(f[0]), [1e5], 1.0)[0])
    assert_allclose(jax.jit(constant)(1e5), 1e5 * moment_line(12.0), rtol=1e-9)
    waves = jb.VaryingForce(force=1e5, frequencies=[1.0], amplitudes=[1.0], position=12.0)
    with pytest.raises(ValueError, match="waves needs concrete numbers of loads, run and length"):
        jax.jit(of_force(waves))(1e5)


# Every kind, by its wheels: distances behind the first (m), and weights (N)

WAGON = jb.vehicles.Wagon(
    4e4, 2e6, 3e3, 4e3, 1e3, 2e6, 1e4, 1e6, 1e4, bogie_distance=14.0, wheelset_distance=2.0,
    speed=V,
)  # fmt: skip
WAGON_AXLE = (4e4 + 2 * 3e3 + 4 * 1e3) / 4 * G
HALF_CAR = jb.vehicles.HalfCar(
    1e4, 3e4, [2.0, -3.0], [500.0, 800.0], [1e5, 1e5], [1e3, 1e3], [1e6, 1e6], [1e3, 1e3],
    speed=V,
)  # fmt: skip
CAR = jb.QuarterCar(1e4, 1e3, 1e5, 1e3, 1e6, 1e3, speed=V)
MANCHESTER_AXLE = (32000.0 + 2 * 2615.0 + 4 * 1813.0) / 4 * G
KINDS = {
    "force": (jb.MovingForce(force=2e5, speed=V), {0.0: 2e5}),
    "mass": (jb.MovingMass(2e4, V), {0.0: 2e4 * G}),
    "oscillator": (jb.Oscillator(2e4, 1e6, wheel_mass=1e3, speed=V), {0.0: 2.1e4 * G}),
    "quarter-car": (CAR, {0.0: 1.1e4 * G}),
    "half-car": (HALF_CAR, {0.0: (6e3 + 500) * G, 5.0: (4e3 + 800) * G}),
    "wagon": (WAGON, {y: WAGON_AXLE for y in (0.0, 2.0, 14.0, 16.0)}),
    "vehicle": (
        jb.vehicles.VehicleLoad(model="quarter-truck", speed=V, count=2, spacing=7.0),
        {0.0: 1.1e4 * G, 7.0: 1.1e4 * G},
    ),
    "train": (
        jb.vehicles.TrainLoad(speed=V, coaches=[jb.vehicles.Coach("manchester-wagon", count=2)]),
        {a + b: MANCHESTER_AXLE for a in (0.0, 25.0) for b in (0.0, 2.56, 19.0, 21.56)},
    ),
    "axles": (
        jb.Axles(offsets=[0.0, 3.0, 4.5], forces=[1e5, 2e5, 1.5e5], speed=V),
        {0.0: 1e5, 3.0: 2e5, 4.5: 1.5e5},
    ),
    "line-load": (
        jb.LineLoad(force_per_length=1e4, lengths=6.0, points=3, speed=V),
        {1.0: 2e4, 3.0: 2e4, 5.0: 2e4},
    ),
    "varying-force": (jb.VaryingForce(force=2e5, speed=V), {0.0: 2e5}),
    "pedestrian": (
        jb.Pedestrian(pace=2.0, weight=800.0, factors=[], speed=1.5),
        {0.0: 800.0},
    ),
    "crowd": (
        jb.Crowd(people=1, length=5.0, pace=2.0, weight=800.0, factors=[], speed=1.5),
        {0.0: 800.0},
    ),
}


def test_every_kind_is_here():
    assert set(KINDS) == set(kinds(AbstractLoad))


@pytest.mark.parametrize("kind", KINDS)
def test_peaks_under_every_kind(kind):
    """Moments are linear between the passages of wheels over x and the ends of the beam."""
    load, wheels = KINDS[kind]
    behind, weights = np.array(list(wheels)), np.array(list(wheels.values()))
    fronts = (np.array([0.0, PEAK_X, LENGTH])[:, None] + behind).ravel()
    expected = np.abs(moment_line(fronts[:, None] - behind) @ weights).max()
    assert_allclose(peak(loaded(load)), expected, rtol=1e-9)
    fronts = np.sort(np.concatenate([fronts - 1e-9, fronts, fronts + 1e-9]))
    expected = np.abs(shear_line(fronts[:, None] - behind) @ weights).max()
    assert_allclose(peak(loaded(load), quantity="shear"), expected, rtol=1e-8)


def test_a_traced_peak_under_several_wheels_and_its_derivative():
    """By a weight the moment line where its wheel is at the largest moment; by the speed, zero."""
    load, wheels = KINDS["axles"]
    behind, weights = np.array(list(wheels)), np.array(list(wheels.values()))
    layout = mesh_layout(BRIDGE)

    def value(forces, speed):
        case = jb.replace(loaded(load), {"loads.0.forces": forces, "loads.0.speed": speed})
        return jb.statics.static_peak(case, PEAK_X, layout, quantity="moment")

    lines = moment_line((np.array([0.0, PEAK_X, LENGTH])[:, None] + behind).reshape(-1, 1) - behind)
    largest = np.argmax(np.abs(lines @ weights))
    found, (by_weights, by_speed) = jax.jit(jax.value_and_grad(value, (0, 1)))(weights, V)
    assert_allclose(found, lines[largest] @ weights, rtol=1e-9)
    assert_allclose(by_weights, lines[largest], rtol=1e-9, atol=1e-12)
    assert_allclose(by_speed, 0.0, atol=1e-9 * found)
