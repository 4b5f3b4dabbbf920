"""Runs on settled supports: closed forms, finite elements, equilibrium."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import jaxbeam as jb
from jaxbeam.case.case import replace
from jaxbeam.case.loads.vehicles import Oscillator
from jaxbeam.case.profiles.shapes import RampProfile
from tests.oracles import finite_elements as fe

EI, SPAN, DROP = 6.0, 2.0, 0.02
UNLOADED = jb.Case(
    jb.Beam(2 * SPAN, EI, 1.0),
    supports=[jb.Support(SPAN, settlement=DROP)],
    sensors=[jb.Sensor(1.0), jb.Sensor(1.0, "moment")],
    run=jb.Run(0.01),
)


def test_locked_in_forces_of_two_spans():
    """M = 3 E I s / l^2 over the support, which is relieved by 6 E I s / l^3, the ends by half."""
    record = jb.simulate(UNLOADED)
    moment = 3 * EI * DROP / SPAN**2
    assert_allclose(record.bending_moment([1.0, 2.0])[0], [moment / 2, moment], rtol=1e-11)
    assert_allclose(record.at(2.0, "stress", section_modulus=0.5)[0], 2 * moment, rtol=1e-11)
    for side, sign in (("left", 1), ("right", -1)):
        assert_allclose(record.shear_force(2.0, side)[0], sign * moment / SPAN, rtol=1e-11)
    expected = np.array([1.0, -2.0, 1.0]) * moment / SPAN
    assert_allclose(record.reactions[0], expected, rtol=1e-11)
    assert_allclose(record.envelope("moment", np.array([2.0])).largest, moment, rtol=1e-11)
    assert not np.any(record.deflection) and not np.any(record.extremes.largest)
    assert not np.any(record.sensor_values)


def rolled_over(case: jb.Case, times, modes: int):
    """Deflection at 1 m, and contact force, of one mass that rolls over finite elements.

    It follows W = w_s + w. In static equilibrium w_s the foot of the spring pulls with -k s.
    """
    beam, (support,), (load,) = case.beam, case.supports, case.loads
    place, k = float(support.position), float(support.stiffness)
    model = fe.assemble(fe.Beam(4.0, EI, 1.0, beam.ends, [fe.Support(place, k)], elements=160))
    omega, shapes = model.modes(modes)
    settled, free = np.zeros(len(model.mass)), model.free
    pull = -k * float(support.settlement) * model.shape(place)
    settled[free] = np.linalg.solve(model.stiffness[np.ix_(free, free)], pull[free])
    mass, speed = float(load.mass), float(load.speed)

    def accelerations(t, q, rates):
        nodal = [model.shape(speed * t, n) for n in range(3)]
        rows = [row @ shapes for row in nodal]
        convective = 2 * speed * rows[1] @ rates
        convective += speed**2 * (rows[2] @ q + nodal[2] @ settled)
        inner = -(omega**2) * q
        force = mass * (rows[0] @ inner + convective + 9.81) / (1 + mass * rows[0] @ rows[0])
        return inner - rows[0] * force, force

    def rate(t, state):
        q, rates = np.split(state, 2)
        return np.concatenate([rates, accelerations(t, q, rates)[0]])

    state = np.zeros(2 * modes)
    found = solve_ivp(rate, (0, times[-1]), state, "DOP853", times, rtol=1e-8, atol=1e-11).y.T
    q, rates = np.split(found, 2, axis=1)
    forces = [accelerations(*parts)[1] for parts in zip(times, q, rates, strict=True)]
    return q @ (model.shape(1.0) @ shapes), np.array(forces)


def test_mass_on_a_settled_beam_against_finite_elements():
    """Its contact force has m v^2 w_s''."""
    case = jb.Case(
        jb.Beam(2 * SPAN, EI, 1.0, modes=6),
        supports=[jb.Support(SPAN, stiffness=30.0, settlement=0.15)],
        loads=[jb.MovingMass(mass=0.2, speed=3.0)],
        run=jb.Run(4 / 3.0),
    )
    times = np.linspace(0, 4 / 3.0, 41)[1:-1]
    record = jb.simulate(case, times=times)
    level = jb.simulate(replace(case, {"supports.0.settlement": 0.0}), times=times)
    deflection, force = rolled_over(case, times, 6)
    scale = np.abs(record.contact_force - level.contact_force).max()
    assert scale > 0.08 * 0.2 * 9.81
    assert_allclose(record.contact_force[:, 0], force, rtol=0, atol=1e-3 * scale)
    scale = np.abs(record.at(1.0) - level.at(1.0)).max()
    assert_allclose(record.at(1.0), deflection, rtol=0, atol=1e-3 * scale)


@pytest.mark.parametrize(
    "others",
    [{}, {"shear_stiffness": 90.0, "axial_force": -2.0, "foundation_stiffness": 3.0}],
)
def test_equilibrium(others):
    """Reactions, foundation and settled forces balance at once, about both ends, at rest."""
    case = jb.Case(
        jb.Beam(4.0, EI, 1.0, ends="clamped-free", **others),
        supports=[jb.Support(1.0, settlement=0.1), jb.Support(3.0, 50.0, settlement=-0.2)],
        run=jb.Run(0.01),
    )
    record = jb.simulate(case)
    reaction = float(np.sum(record.reactions[0]))
    if others:
        points, weights = np.polynomial.legendre.leggauss(12)
        for start, end in ((0.0, 1.0), (1.0, 3.0), (3.0, 4.0)):
            x = (start + end) / 2 + (end - start) / 2 * points
            w = jb.statics.settlement_response(case, [0.1, -0.2], x)
            reaction -= float(weights @ w) * 3.0 * (end - start) / 2
    assert_allclose(reaction, 0.0, atol=1e-10 * np.abs(record.reactions).max())


def test_vehicle_on_a_tilted_beam():
    """One span tilts without bending: a ramp of the surface. Equal settlements change nothing."""

    def force(left, right, profile=None):
        case = jb.Case(
            jb.Beam(4.0, EI, 1.0, ends="free-free"),
            [jb.Support(0.0, settlement=left), jb.Support(4.0, settlement=right)],
            loads=[Oscillator(0.3, 40.0, 0.5, speed=3.0, entry_time=0.1)],
            run=jb.Run(2.0, sample_rate=50.0),
            profile=profile,
        )
        record = jb.simulate(case)
        assert_allclose(record.reactions[0], 0.0, atol=1e-12)
        assert_allclose(record.body_displacement[0], -left, atol=1e-12)
        return np.asarray(record.contact_force)

    level, ramp = force(0.0, 0.0), RampProfile(0.0, 4.0, -0.1)
    assert_allclose(force(0.1, 0.1), level, rtol=0, atol=1e-10)
    found = force(0.0, 0.1)
    assert_allclose(found, force(0.0, 0.0, ramp), rtol=0, atol=1e-9)
    assert np.abs(found - level).max() > 0.2


def test_sweep_of_settlement():
    """Peaks are those of single runs; a settled beam does not use the compiled C integrator."""
    case = jb.Case(
        jb.Beam(2 * SPAN, EI, 1.0, modes=1),
        supports=[jb.Support(SPAN, settlement=0.1)],
        sensors=[jb.Sensor(1.0)],
        loads=[jb.MovingMass(mass=0.3, speed=3.0)],
    )
    found = jb.sweep(case, over={"supports.0.settlement": [0.0, 0.1]})
    single = [jb.simulate(replace(case, {"supports.0.settlement": s})) for s in (0.0, 0.1)]
    expected = np.array([record.peak_deflection for record in single])
    assert_allclose(found.peak_deflection, expected, rtol=1e-5)


def test_a_mechanism_cannot_settle():
    case = jb.Case(jb.Beam(4.0, EI, 1.0, ends="pinned-free"), [jb.Support(0.0, settlement=0.1)])
    with pytest.raises(ValueError, match="do not hold the beam in place"):
        jb.simulate(case)
