"""Torsion of straight beams: closed forms, and own finite elements with moving masses."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import eigh

import jaxbeam as jb
from jaxbeam.case.sensors import TWIST
from jaxbeam.model.statics import static_peak
from tests.oracles.finite_elements import hermite

LENGTH, EI, MASS, GJ, INERTIA = 30.0, 2e10, 1e4, 4e9, 3e4
BOX = dict(
    length=LENGTH,
    flexural_rigidity=EI,
    mass_per_length=MASS,
    torsional_rigidity=GJ,
    polar_inertia=INERTIA,
    damping_ratio=0.02,
)
QUANTITIES = "twist", "torque", "deflection", "moment", "shear"


def box(loads=(), x=12.0, run=None, supports=(), **beam):
    sensors = [jb.Sensor(x, quantity=name) for name in QUANTITIES]
    run = jb.Run(1.2) if run is None else run
    beam = jb.Beam(**{"modes": 6, **BOX, **beam})
    return jb.Case(beam, sensors=sensors, loads=loads, supports=supports, run=run)


class FiniteElements:
    """Hermite cubics of w and of theta, equal elements; degrees (w, w', theta, theta') of a node.

    Held are w at 0 and L (pinned), and theta at 0 and L and at `forks` (m).
    """

    def __init__(self, count, forks=(), arm=0.0):
        self.size, h = LENGTH / count, LENGTH / count
        self.count, total = count, 4 * (count + 1)
        points, weights = np.polynomial.legendre.leggauss(4)
        s = (points + 1) / 2
        value, slope, bend = (self.cubics(s, order) for order in range(3))
        weights = weights * h / 2
        parts = [(weights[:, None] * one).T @ one for one in (value, slope, bend)]
        self.mass, self.stiffness = np.zeros((total, total)), np.zeros((total, total))
        for e in range(count):
            w = 4 * e + np.array([0, 1, 4, 5])
            t = w + 2
            self.mass[np.ix_(w, w)] += MASS * parts[0]
            self.mass[np.ix_(t, t)] += INERTIA * parts[0]
            self.mass[np.ix_(w, t)] += MASS * arm * parts[0]
            self.mass[np.ix_(t, w)] += MASS * arm * parts[0]
            self.stiffness[np.ix_(w, w)] += EI * parts[2]
            self.stiffness[np.ix_(t, t)] += GJ * parts[1]
        nodes = [round(x / h) for x in (0.0, LENGTH, *forks)]
        held = [0, 4 * count, *(4 * node + 2 for node in nodes)]
        self.free = np.setdiff1d(np.arange(total), held)

    def cubics(self, s, order):
        return hermite(s * self.size, self.size, order).T

    def row(self, x, order, arm):
        """Row of w + arm theta, or of an x-derivative, at x."""
        e = min(int(x / self.size), self.count - 1)
        values = self.cubics(x / self.size - e, order)
        row = np.zeros(4 * (self.count + 1))
        row[4 * e + np.array([0, 1, 4, 5])] = values
        row[4 * e + np.array([2, 3, 6, 7])] = arm * values
        return row[self.free]

    def modes(self, number):
        pair = np.ix_(self.free, self.free)
        values, vectors = eigh(self.stiffness[pair], self.mass[pair])
        return np.sqrt(values[:number]), vectors[:, :number]


def crossing_of_masses(elements, number, loads, end, times):
    """Modal amplitudes under rigid masses (mass, speed, arm) that enter at t = 0; by scipy."""
    omega, vectors = elements.modes(number)
    damping = 2 * BOX["damping_ratio"] * omega

    def rate(t, z):
        q, v = z[:number], z[number:]
        inertia, force = np.eye(number), -(omega**2) * q - damping * v
        for mass, speed, arm in loads:
            if speed * t > LENGTH:
                continue
            rows = [elements.row(speed * t, order, arm) @ vectors for order in range(3)]
            inertia = inertia + mass * np.outer(rows[0], rows[0])
            convective = 2 * speed * rows[1] @ v + speed**2 * rows[2] @ q
            force = force - mass * rows[0] * (9.81 + convective)
        return np.concatenate([v, np.linalg.solve(inertia, force)])

    found = solve_ivp(rate, (0, end), np.zeros(2 * number), "DOP853", times, rtol=1e-7, atol=1e-11)
    return found.y[:number], vectors


def test_frequencies_of_a_straight_box_and_of_one_with_an_eccentric_mass():
    found = np.asarray(jb.modes(box(modes=9)).frequencies)
    n = np.arange(1, 10)
    bending = (n * np.pi / LENGTH) ** 2 * np.sqrt(EI / MASS) / (2 * np.pi)
    torsion = n / (2 * LENGTH) * np.sqrt(GJ / INERTIA)
    np.testing.assert_allclose(found, np.sort([*bending, *torsion])[:9], rtol=1e-9)

    arm, coupled = 0.7, []
    for k in n * np.pi / LENGTH:
        mass = [[MASS, MASS * arm], [MASS * arm, INERTIA]]
        coupled += list(np.sqrt(eigh(np.diag([EI * k**4, GJ * k**2]), mass, eigvals_only=True)))
    found = np.asarray(jb.modes(box(modes=9, mass_eccentricity=arm)).angular_frequencies)
    np.testing.assert_allclose(found, np.sort(coupled)[:9], rtol=1e-9)


@pytest.mark.parametrize("forks", [(), (12.0,)])
def test_static_twist_and_torque_under_an_eccentric_force(forks):
    """Of one span, and of two with a fork in between: the torque of a span goes by its lever."""
    supports = [jb.Support(x) for x in forks]
    case = box([jb.MovingForce(force=1e5, speed=10.0, eccentricity=-1.5)], x=9.0, supports=supports)
    end = forks[0] if forks else LENGTH
    torque = 1.5e5
    ends = [torque * (end - 9.0) / end, torque * 9.0 / end]  # torques in both parts of the span
    assert static_peak(case, 9.0, quantity="twist") == pytest.approx(ends[0] * 9.0 / GJ)
    assert static_peak(case, 9.0, quantity="torque") == pytest.approx(max(ends), rel=1e-6)
    # Under 1 N at 1 m left of the axis, which twists to the right.
    twist = jb.influence_line(case, 9.0, [4.0, 9.0, 20.0], quantity="twist")
    beyond = 0.0 if forks else 9.0 * (end - 20.0) / end
    expected = -np.array([4.0 * (end - 9.0) / end, 9.0 * (end - 9.0) / end, beyond]) / GJ
    np.testing.assert_allclose(twist, expected, rtol=1e-9, atol=1e-22)


def test_springs_against_twist_are_as_stiff_as_their_torques():
    """A column in the middle, pinned in plan: half of the torque each side, less its own."""
    spring = 3e8
    supports = [jb.Support(15.0, stiffness=1e12, torsional_stiffness=spring)]
    case = box(supports=supports, x=15.0)
    found = jb.influence_line(case, 15.0, 15.0, quantity="twist")
    assert float(found) == pytest.approx(-1 / (4 * GJ / LENGTH + spring))
    free = jb.replace(case, {"supports.0.torsional_stiffness": 0.0})
    assert float(jb.influence_line(free, 15.0, 15.0, quantity="twist")) == pytest.approx(
        -LENGTH / (4 * GJ)
    )


@pytest.mark.parametrize(
    ("loads", "arm"),
    [([(2e4, 40.0, 2.0)], 0.0), ([(2e4, 40.0, 2.0), (3e4, 30.0, -1.0)], 0.6)],
    ids=["one mass", "two lanes, eccentric mass"],
)
def test_eccentric_masses_agree_with_finite_elements(loads, arm):
    moving = [jb.MovingMass(mass=m, speed=v, eccentricity=e) for m, v, e in loads]
    run, number = jb.Run(0.8, sample_rate=100.0), 4
    case = box(moving, run=run, modes=number, mass_eccentricity=arm or None)
    record = jb.simulate(case)
    elements = FiniteElements(20, arm=arm)
    times = np.asarray(record.times)
    q, vectors = crossing_of_masses(elements, number, loads, times[-1], times)
    coordinates, modes = np.asarray(record.coordinates), record.modes
    twist = coordinates @ np.asarray(modes.fields(12.0, (TWIST,))[0])
    deflection = coordinates @ np.asarray(modes.shapes(12.0))
    on_axis = elements.row(12.0, 0, 0.0) @ vectors @ q
    of_twist = elements.row(12.0, 0, 1.0) @ vectors @ q - on_axis
    assert np.max(np.abs(of_twist)) > 1e-4
    np.testing.assert_allclose(twist, of_twist, atol=2e-5 * np.max(np.abs(of_twist)))
    np.testing.assert_allclose(deflection, on_axis, atol=2e-5 * np.max(np.abs(on_axis)))


EDGES = [
    jb.Sensor(12.0, name, eccentricity=arm)
    for arm in (3.0, -3.0)
    for name in ("deflection", "acceleration")
]


def test_edges_of_the_deck_agree_with_finite_elements():
    load = jb.MovingMass(mass=2e4, speed=40.0, eccentricity=2.0)
    case = dataclasses.replace(
        box([load], run=jb.Run(0.7, sample_rate=400.0), modes=4), sensors=EDGES
    )
    record, elements = jb.simulate(case), FiniteElements(20)
    times = np.asarray(record.times)
    q, vectors = crossing_of_masses(elements, 4, [(2e4, 40.0, 2.0)], times[-1], times)
    for i, arm in enumerate((3.0, -3.0)):
        exact = elements.row(12.0, 0, arm) @ vectors @ q
        size = np.max(np.abs(exact))
        np.testing.assert_allclose(record.deflection[:, 2 * i], exact, atol=3e-5 * size)
        np.testing.assert_allclose(record.sensor_values[:, 2 * i], exact, atol=3e-5 * size)
        np.testing.assert_allclose(record.measured[:, 2 * i], exact, atol=3e-5 * size)
        extremes = float(record.smallest[2 * i]), float(record.largest[2 * i])
        assert extremes == pytest.approx((exact.min(), max(exact.max(), 0.0)), abs=2e-3 * size)
        assert float(record.peak_deflection[2 * i]) == pytest.approx(size, rel=2e-3)
        # Between samples, by differences of the deflection.
        second = np.diff(exact, 2) * 400.0**2
        found = record.sensor_values[1:-1, 2 * i + 1]
        smooth = np.abs(np.diff(found, prepend=found[0])) < 0.2 * np.max(np.abs(found))
        error = np.abs(found - second)[smooth]
        assert np.median(error) < 0.01 * np.max(np.abs(found))
    sweep = jb.sweep(case, {"loads.0.speed": [35.0, 40.0]})
    for k, name in enumerate(("deflection", "acceleration")):
        for i in range(2):
            own = max(record.largest[2 * i + k], -record.smallest[2 * i + k])
            assert sweep[f"peak_{name}"].values[1, 2 * i + k] == pytest.approx(own, rel=1e-4)


def test_edges_that_cannot_be_read_are_refused():
    load, edge = jb.MovingForce(force=1e5, speed=40.0), jb.Sensor(12.0, eccentricity=3.0)
    straight = jb.Case(jb.Beam(LENGTH, EI, MASS), sensors=[edge], loads=[load])
    with pytest.raises(ValueError, match=r"sensors.0.eccentricity would have no effect: the beam"):
        jb.simulate(straight)
    twist = jb.Sensor(12.0, "twist", eccentricity=3.0)
    with pytest.raises(ValueError, match="no effect on a sensor of twist, which is that of the"):
        jb.simulate(dataclasses.replace(box([load]), sensors=[twist]))


def test_peaks_of_sweeps_are_those_of_runs_and_of_a_train_in_closed_form():
    train = jb.Axles(offsets=np.arange(9) * 3.0, forces=1e5, speed=40.0, eccentricity=2.0)
    case = box([train], modes=4, run=jb.Run(2.0))
    by_speed = jb.sweep(case, {"loads.0.speed": [30.0, 40.0]})  # closed form of forces
    second = jb.MovingMass(mass=3e4, speed=-40.0, eccentricity=-1.0)
    both = dataclasses.replace(case, loads=[train, second])
    by_lane = jb.sweep(both, {"loads.1.eccentricity": [-1.0, 1.0]})
    runs = [(by_speed.isel({"loads.0.speed": 1}), case)]
    for i, arm in enumerate((-1.0, 1.0)):
        own = jb.replace(both, {"loads.1.eccentricity": arm})
        runs.append((by_lane.isel({"loads.1.eccentricity": i}), own))
    for found, alone in runs:
        record = jb.simulate(alone)
        for i, name in enumerate(QUANTITIES):
            peak = max(record.largest[i], -record.smallest[i])
            assert float(found[f"peak_{name}"][i]) == pytest.approx(float(peak), rel=1e-5)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"torsional_rigidity": None, "polar_inertia": None}, "loads.0.eccentricity would have no"),
        ({"polar_inertia": None}, "beam.polar_inertia is missing"),
        ({"ends": "free-free"}, "nothing holds the beam against twist"),
        ({"mass_eccentricity": 2.0}, "beam.polar_inertia is about the axis of twist"),
    ],
)
def test_what_cannot_twist_is_refused(change, words):
    with pytest.raises(ValueError, match=words):
        jb.simulate(box([jb.MovingForce(force=1e5, speed=40.0, eccentricity=2.0)], **change))


def test_a_file_of_a_record_has_the_twists(tmp_path):
    load = jb.MovingForce(force=1e5, speed=40.0, eccentricity=2.0)
    record = jb.simulate(box([load], run=jb.Run(0.5, sample_rate=50.0)))
    record.save(tmp_path / "run.nc")
    loaded = jb.read_record(tmp_path / "run.nc")
    expected = record.at(9.0, "torque")
    np.testing.assert_allclose(loaded.at(9.0, "torque"), expected, rtol=1e-12)
