"""Beams under a track of layers: finite elements with all damping, TTB-2D, sweeps, refusals."""

import dataclasses

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.sparse.linalg import spsolve

import jaxbeam as jb
from tests.oracles.layered_track import TrackOnBeam

# Rail, pads, sleepers and ballast of Zhai, Wang and Lin (2004), for both rails, as in TTB-2D.
SPACING, RAIL, SLEEPER = 0.6, (2.059e11 * 2 * 3.217e-5, 2 * 60.64), 251.0
PADS, BALLAST, BALLAST_MASS = (6.5e7, 7.5e4), (137.75e6, 5.88e4), 531.4
LENGTH, RIGIDITY, MASS = 24.0, 2e10, 8000.0 + BALLAST_MASS / SPACING
FIRST = (np.pi / LENGTH) ** 2 * np.sqrt(RIGIDITY / MASS)  # rad/s, of the beam alone
SPEED = 50.0


def track(approach=18.0, **changes) -> jb.Track:
    layers = dict(
        rail_rigidity=RAIL[0],
        rail_mass=RAIL[1],
        pad_stiffness=PADS[0],
        pad_damping=PADS[1],
        sleeper_mass=SLEEPER,
        ballast_stiffness=BALLAST[0],
        ballast_damping=BALLAST[1],
        sleeper_spacing=SPACING,
        approach=approach,
    )
    return jb.Track(**(layers | changes))


def bridge(load, modes=90, duration=1.4, **changes) -> jb.Case:
    # One per cent in the first two modes of the beam alone.
    rayleigh = [0.02 * FIRST * 4 / 5, 0.02 / (5 * FIRST)]
    beam = jb.Beam(LENGTH, RIGIDITY, MASS, rayleigh_damping=rayleigh, modes=modes)
    sensors = [jb.Sensor(LENGTH / 2, q) for q in ("deflection", "acceleration", "moment")]
    parts = dict(sensors=sensors, loads=[load], track=track(), run=jb.Run(duration, 1000.0))
    return jb.Case(**({"beam": beam} | parts | changes))


@pytest.fixture(scope="module")
def elements() -> TrackOnBeam:
    per_length = [tuple(np.array(pair) / SPACING) for pair in (PADS, BALLAST)]
    return TrackOnBeam(
        LENGTH, 18.0, (RIGIDITY, MASS), RAIL, SLEEPER / SPACING, *per_length, ratio=0.01, size=0.3
    )


def test_frequencies_of_beam_and_track_together(elements):
    (mass, _, stiffness), _ = elements.matrices()
    squares = eigh(stiffness.toarray(), mass.toarray(), eigvals_only=True, subset_by_index=(0, 24))
    for modes, tolerance in ((90, 3e-4), (180, 5e-5)):
        found = jb.modes(bridge(jb.MovingForce(force=1.0, speed=1.0), modes)).frequencies[:25]
        np.testing.assert_allclose(found, np.sqrt(squares) / (2 * np.pi), rtol=tolerance)


def test_a_beam_on_bearings_whose_ends_move(elements):
    """Sleepers jump where the ground ends: with sines alone frequencies were up to 5 % too high."""
    k = 1e8
    (mass, _, stiffness), row = dataclasses.replace(elements, bearings=k).matrices()
    squares = eigh(stiffness.toarray(), mass.toarray(), eigvals_only=True, subset_by_index=(0, 19))
    beam = jb.Beam(LENGTH, RIGIDITY, MASS, 0.5, ends="free-free", modes=120)
    bearings = [jb.Support(x, stiffness=k) for x in (0.0, LENGTH)]
    stands = jb.VaryingForce(force=1e5, position=7.5)
    case = bridge(stands, beam=beam, supports=bearings, duration=4.0)
    found = jb.modes(case).frequencies[:20]
    np.testing.assert_allclose(found, np.sqrt(squares) / (2 * np.pi), rtol=3e-4)
    at_rest = -1e5 * spsolve(stiffness, row(7.5, 0))
    record = jb.simulate(case)
    assert record.deflection[-1, 0] == pytest.approx(row(LENGTH / 2, 2) @ at_rest, rel=5e-4)
    ends = [-k * row(x, 2) @ at_rest for x in (0.0, LENGTH)]
    np.testing.assert_allclose(record.reactions[-1], ends, rtol=1e-3)


def test_rayleigh_damping_of_the_mass_of_the_beam_alone(elements):
    """At resonance a force on the beam moves it as the finite elements with all damping tell."""
    (mass, damping, stiffness), row = elements.matrices()
    frequencies, place = np.linspace(3.8, 4.0, 21), row(LENGTH / 2, 2)
    exact = [
        place @ spsolve((stiffness - w**2 * mass + 1j * w * damping).tocsc(), place)
        for w in 2 * np.pi * frequencies
    ]
    found = jb.frequency_response(
        bridge(jb.MovingForce(force=1.0, speed=1.0), modes=120), frequencies
    ).values[:, 0]
    assert np.max(np.abs(found)) == pytest.approx(np.max(np.abs(exact)), rel=0.01)


@pytest.mark.parametrize("body", [None, (2e4, 2e6, 4e4)], ids=["force", "oscillator"])
def test_crossings_agree_with_finite_elements_of_all_damping(elements, body):
    """The modes leave out damping between them: half a per cent of deflections at 90 modes."""
    weight = 2e5 if body is None else body[0] * 9.81
    times, deflection, acceleration, pressing = elements.run(
        weight, SPEED, 2.5e-4, 1.4, body, at=LENGTH / 2
    )
    load = jb.MovingForce(force=weight, speed=SPEED)
    if body is not None:
        load = jb.Oscillator(*body, 0.0, speed=SPEED)
    record = jb.simulate(bridge(load))
    without = jb.simulate(bridge(load, modes=12, track=None))
    for found, exact, share in (
        (record.deflection[:, 0], deflection, 0.008),
        (record.sensor_values[:, 1], acceleration, 0.02),
    ):
        difference = np.interp(times, record.times, found) - exact
        assert np.max(np.abs(difference)) < share * np.max(np.abs(exact))
    # The track matters: without it the largest acceleration is a tenth larger.
    assert np.max(np.abs(without.sensor_values[:, 1])) > 1.1 * np.max(np.abs(acceleration))
    if body is not None:
        on_rail = (times > 0.05) & (times < 1.15)
        forces = np.interp(times, record.times, record.contact_force[:, 0])
        assert np.max(np.abs(forces - pressing)[on_rail]) < 0.006 * weight
        # Of what the body's acceleration adds to the weight; sines are slow under a wheel.
        crossing = (times > 0.1) & (times < 1.1)
        added = np.max(np.abs(pressing - weight)[crossing])
        for modes, share in ((90, 0.055), (120, 0.03)):
            more = record if modes == 90 else jb.simulate(bridge(load, modes=modes))
            forces = np.interp(times, more.times, more.contact_force[:, 0])
            assert np.max(np.abs(forces - pressing)[crossing]) < share * added


def test_wagon_of_ttb_2d():
    """A Manchester wagon at 200 km/h: numbers of TTB-2D, run with the same beam and track.

    TTB-2D (Cantero, SoftwareX 20, 2022) has sleepers at places and ballast of two layers on the
    ground; its beam is by 0.4 % stiffer than the closed form under standing axles.
    """
    wagon = jb.vehicles.VehicleLoad(model="manchester-wagon", speed=200 / 3.6)
    case = bridge(wagon, modes=90, duration=2.0, track=track(30.0))
    record = jb.simulate(case)
    assert float(record.smallest[0]) == pytest.approx(-4.0583e-3, rel=0.006)
    assert float(record.largest[0]) == pytest.approx(0.79996e-3, rel=0.03)
    assert float(record.largest[2]) == pytest.approx(1.51012e6, rel=0.008)
    static = float(jb.statics.static_peak(case, LENGTH / 2))
    assert static == pytest.approx(3.0770e-3, rel=0.005)


RIG = dict(
    rail_rigidity=0.5,
    rail_mass=0.1,
    pad_stiffness=2e3,
    pad_damping=0.5,
    sleeper_mass=2e-3,
    ballast_stiffness=2e3,
    ballast_damping=0.3,
    sleeper_spacing=0.05,
    approach=0.2,
)


def rig(load, modes=12, **changes) -> jb.Case:
    parts = dict(
        sensors=[jb.Sensor(0.25), jb.Sensor(0.35, "moment")],
        loads=[load],
        track=jb.Track(**RIG),
        run=jb.Run(0.5, 400.0),
    )
    return jb.Case(jb.Beam(0.6, 11.68, 0.535, 0.03, modes=modes), **(parts | changes))


@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.sweeps.computation.TruncationWarning")
@pytest.mark.parametrize(
    "load",
    [jb.MovingForce(force=3.0, speed=2.4), jb.Oscillator(0.3, 300.0, 0.5, 0.02, speed=2.4)],
    ids=["force", "oscillator"],
)
def test_sweeps_and_runs_are_the_same(load):
    case = rig(load)
    runs = jb.sweep(case, {"loads.0.speed": [2.0, 2.4], "track.pad_stiffness": [2e3, 5e3]})
    for i, speed in enumerate((2.0, 2.4)):
        for j, pads in enumerate((2e3, 5e3)):
            own = jb.simulate(
                jb.replace(case, {"loads.0.speed": speed, "track.pad_stiffness": pads})
            )
            for k, name in enumerate(("peak_deflection", "peak_moment")):
                peak = max(own.largest[k], -own.smallest[k])
                assert float(runs[name].values[i, j].flat[k]) == pytest.approx(peak, rel=1e-5)


def test_a_slow_force_deflects_the_beam_as_it_does_at_rest():
    per_length = [tuple(np.array(pair) / 0.05) for pair in ((2e3, 0.5), (2e3, 0.3))]
    elements = TrackOnBeam(
        0.6, 0.2, (11.68, 0.535), (0.5, 0.1), 2e-3 / 0.05, *per_length, ratio=0.03, size=0.01
    )
    (_, _, stiffness), row = elements.matrices()
    at_rest = -3.0 * row(0.25, 2) @ spsolve(stiffness, row(0.3, 0))
    slow = jb.MovingForce(force=3.0, speed=0.05)
    record = jb.simulate(rig(slow, modes=60, run=jb.Run(16.0, 50.0)))
    found = np.interp(0.3, record.load_position[:-1, 0], record.deflection[:-1, 0])
    assert found == pytest.approx(at_rest, rel=1e-3)
    # A force that stands there, and one that comes from the right and stops there.
    stands = jb.VaryingForce(force=3.0, position=0.3)
    stops = jb.MovingForce(force=3.0, speed=-1.0, deceleration=1.0)
    for load in (stands, stops):
        record = jb.simulate(rig(load, modes=60, run=jb.Run(6.0, 50.0)))
        assert float(record.deflection[-1, 0]) == pytest.approx(at_rest, rel=1e-3)


FORCE = jb.MovingForce(force=3.0, speed=2.4)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"modes": 5}, "beam.modes is 5; a rail of this track and length needs 8 at least"),
        (
            {"absorbers": [jb.Absorber(0.3, 0.1, 10.0, 0.1)]},
            "track and absorbers cannot be together",
        ),
        ({"contact": jb.UnilateralContact()}, "contact.kind 'unilateral' cannot be together"),
        ({"supports": [jb.Support(0.3, settlement=1e-4)]}, "a settlement of supports cannot be"),
        (
            {"loads": [dataclasses.replace(FORCE, start_position=-0.1)]},
            "start_position is -0.1 m, where the load is on the rail already, which begins at -0.2",
        ),
        ({"track": jb.Track(**(RIG | {"sleeper_mass": None}))}, "track.sleeper_mass is missing"),
        ({"track": jb.Track(spread_length=0.1, rail_mass=0.1)}, "track.rail_mass would have no"),
        ({"track": jb.Track(**RIG, spread_length=0.1)}, "has both spread_length and rail_rigidity"),
    ],
)
def test_what_a_track_of_layers_refuses(changes, sentence):
    with pytest.raises(ValueError, match=sentence):
        jb.simulate(rig(FORCE, **changes))


def test_a_track_of_layers_in_a_case_file(tmp_path):
    case = rig(FORCE)
    jb.save_case(case, tmp_path / "case.toml")
    again = jb.load_case(tmp_path / "case.toml")
    assert all(getattr(again.track, name) == value for name, value in RIG.items())
    with pytest.raises(ValueError, match="trains of the code are forces on the beam"):
        jb.assess(again, "160 km/h")
    with pytest.raises(ValueError, match="several damping ratios"):
        beam = dataclasses.replace(case.beam, damping_ratio=np.full(12, 0.01))
        jb.simulate(dataclasses.replace(case, beam=beam))


def test_sleepers_may_be_damped_more_than_a_beam():
    beam = jb.Beam(LENGTH, RIGIDITY, MASS, material="steel", modes=90)
    assert jb.check(bridge(jb.MovingForce(force=1e5, speed=50.0), beam=beam)).warnings == ()


def test_a_load_that_stops_is_told_where():
    stops = jb.MovingForce(force=1e5, speed=-40.0, deceleration=20.0)
    (sentence,) = jb.check(bridge(stops, duration=6.0)).warnings
    # From 42 m it rolls 40 m; to the far end of the rail it would roll 60 m.
    assert "at 2 m; less than 13.3 m/s^2 let it leave" in sentence
