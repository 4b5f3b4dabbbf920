"""Tuned mass dampers and inerters: published and independent numbers, and energy."""

import dataclasses
import inspect
import itertools

import jax
import numpy as np
import pytest
import scipy

import jaxbeam as jb
from jaxbeam.case.case import crossing_times
from jaxbeam.model.state_space import poles

BRIDGE = jb.Beam(25.0, 30e9, 15e3, damping_ratio=0.01, modes=5)
# HSLM-A1 over a bridge with an absorber of 3750 kg at midspan, by its speed (km/h): smallest and
# largest deflection at midspan and largest stroke (m), from complex modes of beam and absorber with
# exactly integrated forces on the grid of the axles; an independent program of NumPy and scipy.
UNDER_TRAIN = {
    225.0: (-0.008849131, 0.002591197, 0.01465006),
    245.0: (-0.008839783, 0.003728881, 0.01522278),
}
DEN_HARTOG = {"stiffness": 1797630.2843645206, "damping": 14080.768660467944}  # of that absorber
# Smallest deflection at midspan while a mass of 0.1 crosses at alpha = 0.5, largest within two
# crossings after it; Radau IIA with 8 modes, agreement with 16 modes 1e-4 and 3e-5.
UNDER_MASS = -0.03553101, 0.02737637


def with_absorbers(case, *absorbers):
    return dataclasses.replace(case, absorbers=absorbers)


@pytest.mark.parametrize(("speed", "rate"), [(225.0, 2000.0), (245.0, 20.0)])
def test_bridge_under_train(speed, rate):
    train = jb.Axles(train="HSLM-A1", speed=speed / 3.6)
    case = jb.Case(BRIDGE, sensors=[jb.Sensor(12.5)], loads=[train])
    run = jb.Run(float(crossing_times(case).max()) + 0.5, sample_rate=rate)
    absorber = jb.Absorber(12.5, mass=3750.0, **DEN_HARTOG)
    record = jb.simulate(dataclasses.replace(case, run=run, absorbers=[absorber]))
    smallest, largest, stroke = UNDER_TRAIN[speed]
    assert record.smallest[0] == pytest.approx(smallest, rel=1e-6)
    assert record.largest[0] == pytest.approx(largest, rel=3e-6)
    if rate == 2000.0:  # the stroke is that at samples
        assert np.max(np.abs(record.stroke)) == pytest.approx(stroke, rel=1e-5)
    assert "loses contact" not in record.verdict


def test_beam_under_mass():
    speed = np.pi / 2
    case = jb.Case(
        jb.Beam(1.0, 1.0, 1.0, damping_ratio=0.01, modes=8),
        sensors=[jb.Sensor(0.5)],
        loads=[jb.MovingMass(mass=0.1, speed=speed)],
        absorbers=[
            jb.Absorber(0.5, mass=0.025, stiffness=2.2088229259410976, damping=0.0628038743)
        ],
        run=jb.Run(3 / speed, sample_rate=4000.0, gravity=10.0),
    )
    record = jb.simulate(case)
    history, times = record.deflection[:, 0], record.times
    crossing = times <= 1 / speed
    found = np.min(history[crossing]), np.max(np.abs(history[~crossing]))
    assert found == pytest.approx(UNDER_MASS, rel=1e-4)


def first_principles(case, times, push=lambda amplitudes, rates: 0.0):
    """Modal amplitudes and heights of bodies by scipy, from the equations with inerters.

    Loads are forces, rows of forces, and masses. `push` are the forces of a law on the modes.
    """
    beam, absorbers = case.beam, case.absorbers
    length, modes = float(beam.length), np.arange(1, beam.modes + 1)
    omega = (modes * np.pi / length) ** 2 * np.sqrt(beam.flexural_rigidity / beam.mass_per_length)
    scale = np.sqrt(2 / (beam.mass_per_length * length))

    def shape(x, derivative=0):
        phase = np.pi * modes * x / length + derivative * np.pi / 2
        return scale * (np.pi * modes / length) ** derivative * np.sin(phase)

    places = np.array([shape(float(a.position)) for a in absorbers]).reshape(-1, beam.modes)
    m, b, ground, k, c = (
        np.array([float(getattr(a, name)) for a in absorbers])
        for name in ("mass", "inertance", "ground_inertance", "stiffness", "damping")
    )
    count, bodies = beam.modes, len(absorbers)
    mass = np.eye(count + bodies)
    mass[:count, :count] += places.T @ (b[:, None] * places)
    mass[:count, count:] = -(places.T * b)
    mass[count:, :count] = mass[:count, count:].T
    mass[count:, count:] = np.diag(m + b + ground)
    wheels = []  # weight, mass, speed, entry
    for load in case.loads:
        row = load.vehicle(case.run.gravity)
        parts = row.static_loads, row.wheel_masses, load.speed, row.offsets / load.speed
        wheels += [tuple(map(float, wheel)) for wheel in np.broadcast(*parts)]

    def rates(t, z, on_beam):
        q, u, dq, du = np.split(z, [count, count + bodies, 2 * count + bodies])
        pull = k * (places @ q - u) + c * (places @ dq - du)
        modal = -(omega**2) * q - 2 * 0.01 * omega * dq - places.T @ pull + push(q, dq)
        inertia = mass.copy()
        for weight, moving, speed, entry in on_beam:
            x = speed * (t - entry)
            bend = 2 * speed * shape(x, 1) @ dq + speed**2 * shape(x, 2) @ q
            modal = modal - (weight + moving * bend) * shape(x)
            inertia[:count, :count] += moving * np.outer(shape(x), shape(x))
        return np.concatenate([dq, du, np.linalg.solve(inertia, np.concatenate([modal, pull]))])

    ends = np.array([(entry, entry + length / speed) for *_, speed, entry in wheels])
    events = np.unique(np.clip(np.append(ends, [0.0, times[-1]]), 0.0, times[-1]))
    found, start = [], np.zeros(2 * (count + bodies))
    for first, last in itertools.pairwise(events):
        middle = (first + last) / 2
        on_beam = [
            w for w, (entry, leave) in zip(wheels, ends, strict=True) if entry < middle < leave
        ]
        within = times[(times >= first) & (times < last) | (times == last) & (last == times[-1])]
        instants = np.unique(np.append(within, last))
        one = scipy.integrate.solve_ivp(
            rates, (first, last), start, "DOP853", instants, args=(on_beam,), rtol=1e-11, atol=1e-14
        )
        found.append(one.y[:, np.isin(instants, within)])
        start = one.y[:, -1]
    states = np.concatenate(found, axis=1)
    return states[:count].T, states[count : count + bodies].T, places


ROW_AND_MASS = [
    jb.Axles(offsets=[0.0, 3.0, 15.0], forces=[1e5, 5e4, 8e4], masses=[0.0, 4e3, 0.0], speed=40.0),
    jb.MovingMass(mass=8e3, speed=45.0),
]


@pytest.mark.parametrize(
    ("loads", "count"),
    [([jb.MovingForce(force=2e5, speed=40.0)], 3), (ROW_AND_MASS, 3), (ROW_AND_MASS, 0)],
    ids=["force", "row and mass", "without absorbers"],
)
def test_inerters_against_their_equations(loads, count):
    absorbers = [
        jb.Absorber(9.0, mass=2000.0, stiffness=1e6, damping=9e3, inertance=1500.0),
        jb.Absorber(14.0, ground_inertance=1000.0, stiffness=2e6, damping=2e4),
        jb.Absorber(
            20.0, mass=900.0, stiffness=3e6, damping=3e3, inertance=300.0, ground_inertance=400.0
        ),
    ]
    case = jb.Case(
        dataclasses.replace(BRIDGE, modes=3),
        sensors=[jb.Sensor(12.5)],
        loads=loads,
        absorbers=absorbers[:count],
        run=jb.Run(1.2, sample_rate=200.0),
    )
    record = jb.simulate(case)
    amplitudes, heights, places = first_principles(case, np.asarray(record.times))
    deflection = amplitudes @ (np.sqrt(2 / (15e3 * 25)) * np.sin(np.pi * np.arange(1, 4) / 2))
    largest = np.abs(deflection).max()
    assert record.deflection[:, 0] == pytest.approx(deflection, abs=1e-8 * largest)
    if not count:
        return
    assert record.body_displacement == pytest.approx(heights, abs=1e-8 * np.abs(heights).max())
    strokes = heights - amplitudes @ places.T
    assert record.stroke == pytest.approx(strokes, abs=1e-8 * np.abs(strokes).max())
    assert record.bodies == [f"absorbers.{i} body" for i in range(3)]


def test_the_road_is_not_under_what_hangs_on_the_beam():
    case = jb.Case(
        dataclasses.replace(BRIDGE, modes=3),
        sensors=[jb.Sensor(12.5)],
        loads=[jb.MovingForce(force=2e5, speed=40.0)],  # whose force no road changes
        absorbers=[jb.Absorber(9.0, mass=2e3, stiffness=1e6, damping=9e3, inertance=500.0)],
        run=jb.Run(1.0, sample_rate=200.0),
    )
    road = jb.profiles.SineProfile(amplitude=0.01, wavelength=7.0)
    level, rough = (jb.simulate(dataclasses.replace(case, profile=r)) for r in (None, road))
    assert rough.stroke == pytest.approx(level.stroke, abs=1e-12)
    assert rough.body_displacement == pytest.approx(level.body_displacement, abs=1e-12)


def feedback_and_gain(at):
    """Displacement feedback at a place, and its gain (N per amplitude and rate of the modes)."""
    return jb.Feedback([4e6]), 4e6 * np.append(at, 0 * at)


def regulator_and_gain(at):
    """Regulator, and its gain by scipy; it is designed for the beam without the absorber."""
    omega = (np.arange(1, 4) * np.pi / 25) ** 2 * np.sqrt(30e9 / 15e3)
    matrix = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.diag(omega**2), -np.diag(0.02 * omega)]])
    inputs, weights = np.append(0 * at, at)[:, None], np.array([1e3, 1e3, 1e3, 1.0, 1.0, 1.0])
    riccati = scipy.linalg.solve_continuous_are(matrix, inputs, np.diag(weights), [[1e-9]])
    return jb.LQR(state_weight=weights, command_weight=[1e-9]), 1e9 * inputs[:, 0] @ riccati


@pytest.mark.parametrize("law_and_gain", [feedback_and_gain, regulator_and_gain])
def test_an_absorber_beside_a_law(law_and_gain):
    at = np.sqrt(2 / (15e3 * 25)) * np.sin(np.pi * np.arange(1, 4) * 10.0 / 25)
    law, gain = law_and_gain(at)
    case = jb.Case(
        dataclasses.replace(BRIDGE, modes=3),
        actuators=[jb.PointForce(10.0)],
        sensors=[jb.Sensor(10.0)],
        loads=[jb.MovingForce(force=2e5, speed=30.0)],
        absorbers=[jb.Absorber(12.5, mass=3750.0, **DEN_HARTOG, inertance=400.0)],
        controller=law,
        run=jb.Run(2.0, sample_rate=100.0),
    )
    record = jb.simulate(case, tolerance=1e-8)

    def push(amplitudes, rates):
        return -at * (gain @ np.append(amplitudes, rates))

    amplitudes, heights, _ = first_principles(case, np.asarray(record.times), push)
    expected = amplitudes @ at
    assert record.deflection[:, 0] == pytest.approx(expected, abs=1e-7 * np.abs(expected).max())
    largest = np.abs(heights).max()
    assert record.body_displacement == pytest.approx(heights, abs=1e-7 * largest)


def test_receptance_with_absorbers():
    absorber = jb.Absorber(
        11.0,
        mass=3750.0,
        frequency=3.48,
        damping_ratio=0.086,
        inertance=800.0,
        ground_inertance=500.0,
    )
    case = jb.Case(dataclasses.replace(BRIDGE, modes=3), absorbers=[absorber])
    f, x, n = np.linspace(0.5, 12.0, 40), np.array([12.5, 11.0]), np.arange(1, 4)
    s = 2j * np.pi * f
    omega = (n * np.pi / 25) ** 2 * np.sqrt(30e9 / 15e3)
    shape = np.sqrt(2 / (15e3 * 25)) * np.sin(np.outer(x, n) * np.pi / 25)
    own = np.einsum(
        "xm,ym,fm->fxy", shape, shape, 1 / (s[:, None] ** 2 + 0.02 * omega * s[:, None] + omega**2)
    )
    moving = 3750.0 + 800.0 + 500.0
    spring = moving * (2 * np.pi * 3.48) ** 2
    link = spring + 2 * 0.086 * np.sqrt(spring * moving) * s + 800.0 * s**2
    stiffness = link * 4250.0 * s**2 / (link + 4250.0 * s**2)
    change = stiffness / (1 + stiffness * own[:, 1, 1])
    expected = own - own[:, :, 1, None] * own[:, 1, None, :] * change[:, None, None]
    found = jb.frequency_responses.receptance(case, f, x, x)
    assert found == pytest.approx(expected, abs=1e-12 * np.abs(expected).max())


def test_poles_are_those_of_the_state_space():
    absorber = jb.Absorber(11.0, mass=3750.0, frequency=3.48, damping_ratio=0.086, inertance=800.0)
    case = jb.Case(dataclasses.replace(BRIDGE, modes=3), absorbers=[absorber])
    expected = np.linalg.eigvals(np.asarray(jb.state_space(case).at(0.0).A))
    by_imaginary = (np.sort_complex(1j * found) for found in (poles(case), expected))
    assert next(by_imaginary) == pytest.approx(next(by_imaginary), rel=1e-9)
    assert "absorber_0_body" in [s.name for s in jb.state_space(case).at(0.0).states]


def test_energy_after_the_crossing():
    beam = dataclasses.replace(BRIDGE, damping_ratio=0.0, modes=2)
    absorber = jb.Absorber(9.0, mass=2e3, stiffness=9e5, damping=8e3, inertance=500.0)
    case = jb.Case(
        beam,
        sensors=[jb.Sensor(12.5)],
        loads=[jb.MovingForce(force=2e5, speed=40.0)],
        absorbers=[absorber],
        run=jb.Run(3.0, sample_rate=4000.0),
    )
    record = jb.simulate(case)
    omega = (np.arange(1, 3) * np.pi / 25) ** 2 * np.sqrt(30e9 / 15e3)
    energy = np.sum(record.rates**2 + (omega * record.coordinates) ** 2, axis=1) / 2
    stroke, rate = record.stroke[:, 0], record.stroke_rate[:, 0]
    energy += (2e3 * record.body_velocity[:, 0] ** 2 + 9e5 * stroke**2 + 500.0 * rate**2) / 2
    after = record.times > 0.65
    balance = energy + record.absorber_energy[:, 0]
    assert np.ptp(balance[after]) < 1e-6 * energy[after][0]
    assert energy[-1] < 0.6 * energy[after][0]


def test_moments_with_few_modes():
    """The absorber's force is among those of the static correction."""
    absorber = jb.Absorber(9.0, mass=4e3, frequency=3.4, damping_ratio=0.1)
    case = jb.Case(
        BRIDGE,
        sensors=[jb.Sensor(9.0)],
        loads=[jb.MovingForce(force=2e5, speed=40.0)],
        absorbers=[absorber],
        run=jb.Run(0.8, sample_rate=50.0),
    )
    many = dataclasses.replace(case, beam=dataclasses.replace(BRIDGE, modes=20))
    few, exact = (jb.simulate(one).bending_moment([9.0])[-10:] for one in (case, many))
    assert few == pytest.approx(exact, abs=2e-3 * np.abs(exact).max())


def test_largest_stroke_is_stated(tmp_path):
    absorber = jb.Absorber(12.5, mass=3e3, frequency=3.4, damping_ratio=0.1, max_stroke=1e-5)
    case = jb.Case(
        dataclasses.replace(BRIDGE, modes=2),
        sensors=[jb.Sensor(12.5)],
        loads=[jb.MovingForce(force=2e5, speed=40.0)],
        absorbers=[absorber],
        run=jb.Run(0.8, sample_rate=50.0),
    )
    record = jb.simulate(case)
    assert f"the stroke of absorber 0 is {record.peak_stroke[0]:.4g} m" in record.verdict
    dataset = record.to_xarray()
    assert dataset.stroke.dims == ("time", "absorber")
    record.to_netcdf(tmp_path / "run.nc")
    again = jb.read_record(tmp_path / "run.nc")
    for name in ("stroke", "peak_stroke", "peak_absorber_force"):
        assert np.array_equal(getattr(again, name), getattr(record, name))


def test_case_file(tmp_path):
    path = tmp_path / "case.toml"
    absorber = jb.Absorber(12.5, mass=3e3, frequency=3.4, damping_ratio=0.1, max_stroke=0.02)
    case = jb.Case(BRIDGE, absorbers=[absorber])
    jb.save_case(case, path)
    assert "[[absorbers]]" in path.read_text()
    again = jb.load_case(path).absorbers[0]
    assert all(
        getattr(again, field.name) == getattr(absorber, field.name)
        for field in dataclasses.fields(absorber)
    )


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ({"stiffness": 1e5, "damping": 1e3}, "absorbers.0.mass must be positive"),
        ({"mass": 1e3, "damping": 1e3}, "has neither stiffness nor frequency"),
        ({"mass": 1e3, "stiffness": 1e5, "frequency": 3.0, "damping": 1.0}, "has both stiffness"),
        ({"mass": 1e3, "stiffness": 1e5}, "has neither damping nor damping_ratio"),
        ({"mass": -1.0, "stiffness": 1e5, "damping": 1.0}, "absorbers.0.mass must not be negative"),
    ],
)
def test_refusals(numbers, words):
    case = jb.Case(BRIDGE, absorbers=[jb.Absorber(12.5, **numbers)], sensors=[jb.Sensor(12.5)])
    with pytest.raises(ValueError, match=words):
        jb.simulate(case)
    with pytest.raises(ValueError, match="absorbers.0.position must lie on the beam"):
        jb.simulate(with_absorbers(case, jb.Absorber(26.0, 1e3, stiffness=1e5, damping=1e3)))


def one_mode(mass_ratio):
    """A beam of one undamped mode, an absorber's mass, and the static deflection under 1 N."""
    case = jb.Case(dataclasses.replace(BRIDGE, damping_ratio=0.0, modes=1))
    return case, mass_ratio * 15e3 * 25 / 2


@pytest.mark.parametrize("mass_ratio", [0.02, 0.1])
def test_den_hartog_has_the_least_of_the_two_peaks(mass_ratio):
    case, mass = one_mode(mass_ratio)
    start = jb.tuned_absorber(case, 12.5, mass)
    first = float(jb.modes(case).frequencies[0])
    frequencies = np.linspace(0.75, 1.25, 4001) * first

    def peak(absorber):
        response = jb.frequency_responses.receptance(
            with_absorbers(case, absorber), frequencies, 12.5, 12.5
        )
        return np.abs(response).max()

    numbers = np.array([start.frequency, start.damping_ratio])
    best = scipy.optimize.minimize(
        lambda z: 1e9 * peak(jb.Absorber(12.5, mass, frequency=z[0], damping_ratio=z[1])),
        numbers * [1.01, 0.9],
        method="Nelder-Mead",
        options={"xatol": 1e-7, "fatol": 1e-7},
    ).x
    # Den Hartog's damping is the mean of two values, not quite the best one.
    assert numbers[0] == pytest.approx(best[0], rel=1e-3)
    assert numbers[1] == pytest.approx(best[1], rel=0.02)
    static = 1 / (2 * np.pi * first) ** 2 * 2 / (15e3 * 25)
    assert peak(start) == pytest.approx(static * np.sqrt(1 + 2 / mass_ratio), rel=2e-3)


@pytest.mark.parametrize("mass_ratio", [0.02, 0.1])
def test_warburton_has_the_least_variance(mass_ratio):
    case, mass = one_mode(mass_ratio)
    start = jb.tuned_absorber(case, 12.5, mass, rule="warburton")

    def variance(numbers):
        """Of the deflection under white noise at midspan, by Lyapunov's equation."""
        m, omega = 15e3 * 25 / 2, 2 * np.pi * float(jb.modes(case).frequencies[0])
        own = 2 * np.pi * numbers[0]
        k, c = mass * own**2, 2 * numbers[1] * mass * own
        stiffness = np.array([[m * omega**2 + k, -k], [-k, k]])
        damping = np.array([[c, -c], [-c, c]])
        inertia = np.diag([1 / m, 1 / mass])
        A = np.block([[np.zeros((2, 2)), np.eye(2)], [-inertia @ stiffness, -inertia @ damping]])
        force = np.array([[0.0], [0.0], [1 / m], [0.0]])
        return 1e12 * scipy.linalg.solve_continuous_lyapunov(A, -force @ force.T)[0, 0]

    numbers = np.array([start.frequency, start.damping_ratio])
    best = scipy.optimize.minimize(
        variance,
        numbers * [1.01, 0.9],
        method="Nelder-Mead",
        options={"xatol": 1e-9, "fatol": 1e-9},
    ).x
    assert numbers == pytest.approx(best, rel=1e-4)


def test_tuned_absorber_refusals():
    tune = inspect.unwrap(jb.tuned_absorber)  # types of arguments are checked in tests alone
    with pytest.raises(ValueError, match="^mass must be a real number, not 'x'"):
        tune(jb.Case(BRIDGE), 12.5, mass="x")
    with pytest.raises(ValueError, match="^position must be a real number, not 'x'"):
        tune(jb.Case(BRIDGE), "x", mass=1.0)
    case = jb.Case(BRIDGE)
    for arguments, words in (
        ({"position": 12.5, "mass": 1.0, "mode": 2}, "at a node of mode 2"),
        ({"position": 30.0, "mass": 1.0}, "position must lie on the beam"),
        ({"position": 12.5, "mass": 0.0}, "mass must be positive"),
        ({"position": 12.5, "mass": 1.0, "mode": 9}, "mode must be from 1 to 5"),
        ({"position": 12.5, "mass": 1.0, "rule": "brock"}, "rule cannot be 'brock'"),
    ):
        with pytest.raises(ValueError, match=words):
            jb.tuned_absorber(case, **arguments)


def test_sensors_on_absorbers():
    sensors = [
        jb.vehicles.VehicleSensor(absorber=1, quantity="stroke"),
        jb.vehicles.VehicleSensor(absorber=0, quantity="acceleration", offset=0.5),
    ]
    absorbers = [
        jb.Absorber(x, mass=3e3, frequency=3.4, damping_ratio=0.1, inertance=200.0)
        for x in (9.0, 12.5)
    ]
    case = jb.Case(
        dataclasses.replace(BRIDGE, modes=2),
        loads=[jb.MovingForce(force=2e5, speed=40.0)],
        absorbers=absorbers,
        vehicle_sensors=sensors,
        run=jb.Run(0.8, sample_rate=50.0),
    )
    record = jb.simulate(case)
    expected = [record.stroke[:, 1], record.body_acceleration[:, 0] + 0.5]
    assert np.array_equal(record.vehicle_readings, np.transpose(expected))
    for faulty, words in (
        (
            jb.vehicles.VehicleSensor(absorber=2),
            "vehicle_sensors.0.absorber is 2, but the case has 2",
        ),
        (
            jb.vehicles.VehicleSensor(absorber=0, body="axle 1"),
            "leave out load, vehicle, body",
        ),
        (jb.vehicles.VehicleSensor(quantity="stroke"), "give its number"),
    ):
        with pytest.raises(ValueError, match=words):
            jb.simulate(dataclasses.replace(case, vehicle_sensors=[faulty]))


def test_filters_know_that_absorbers_have_no_weight():
    """One deviation for each load: absorbers are states of the filter, but no unknown loads."""
    case = jb.Case(
        jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
        actuators=[jb.PointForce(0.35, limits=(-2.0, 2.0))],
        sensors=[jb.Sensor(0.2)],
        loads=[jb.MovingMass(mass=0.3, speed=2.0)],
        absorbers=[jb.Absorber(0.25, mass=0.02, frequency=20.0, damping_ratio=0.1)],
        run=jb.Run(0.1),
    )
    weights = {"state_weight": [1e6, 1.0], "command_weight": [1e-2], "period": 0.002}

    def peak(deviation):
        estimator = jb.Kalman(0.02, 1e-5, loads="estimated", weight_deviation=deviation)
        law = jb.LQR(**weights, estimator=estimator)
        return jb.simulate(dataclasses.replace(case, controller=law)).peak_deflection[0]

    assert peak([1.0]) == pytest.approx(peak(1.0), rel=1e-12)
    following = jb.ExtendedKalman(0.02, 1e-5, mass_deviation=0.1, speed_deviation=0.2)
    law = jb.LQR(**weights, estimator=following)
    with pytest.raises(ValueError, match="kind is for beams without absorbers"):
        jb.simulate(dataclasses.replace(case, controller=law))


def test_derivatives_under_a_train_take_little_memory():
    """Three runs and two derivatives, as in a tuning: 3.6 GB, of matrices of all steps, before."""
    absorber = jb.Absorber(12.5, mass=3750.0, **DEN_HARTOG)
    train = jb.Axles(train="HSLM-A1", speed=62.0)
    run = jb.Run(2.0, sample_rate=100.0)
    case = jb.Case(BRIDGE, sensors=[jb.Sensor(12.5)], loads=[train], absorbers=[absorber], run=run)

    ranges = {"absorbers.0.stiffness": (1.5e6, 2e6), "loads.0.speed": (61.0, 63.0)}
    simulator = jb.Simulator(case, ranges, tolerance=1e-4)

    def peak(stiffness, speed):
        return simulator((stiffness, speed)).peak_deflection[0]

    gradients = jax.vmap(jax.jacfwd(peak, (0, 1)))
    program = jax.jit(gradients).lower(np.full(3, 1.8e6), np.array([61.0, 62.0, 63.0])).compile()
    assert program.memory_analysis().temp_size_in_bytes < 0.4e9
