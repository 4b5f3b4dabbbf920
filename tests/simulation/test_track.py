"""Axles that a track spreads: against axles split by hand, closed forms, refusals."""

import dataclasses

import numpy as np
import pytest
import scipy

import jaxbeam as jb
from jaxbeam.analysis.assessment.checks import (
    CheckedSection,
    largest_under_train,
    tabulated_line,
    train_response,
)
from jaxbeam.case.library import published
from jaxbeam.case.track import SLEEPER_FRACTIONS
from jaxbeam.numerics.polynomials import gauss_nodes, gauss_weights

SLEEPERS = jb.Track(spread="3 sleepers")
UNEVEN = jb.Track(spread_offsets=[-0.9, 0.2, 1.1], spread_shares=[2.0, 5.0, 3.0])
ONE_SPAN = jb.Beam(15.0, 10.5e9, 12e3, damping_ratio=0.01125, modes=5)
HAUNCHED = jb.Beam(
    40.0,
    segments=[
        jb.Segment(18.0, flexural_rigidity=20e9, mass_per_length=14e3),
        jb.Segment(4.0, flexural_rigidity=45e9, mass_per_length=18e3),
        jb.Segment(18.0, flexural_rigidity=20e9, mass_per_length=14e3),
    ],
    damping_ratio=0.01,
    modes=6,
)
SENSORS = (
    jb.Sensor(5.0),
    jb.Sensor(5.0, "acceleration"),
    jb.Sensor(7.5, "moment"),
    jb.Sensor(0.0, "shear"),
    jb.Sensor(5.0, "shear", side="left"),
    jb.Sensor(0.0, "rotation"),
)
OFFSETS, FORCES = np.array([0.0, 2.5, 11.0, 13.5]), np.array([150e3, 180e3, 170e3, 160e3])
SPANS = {
    "one span": (ONE_SPAN, ()),
    "two spans": (dataclasses.replace(ONE_SPAN, length=30.0), (jb.Support(14.4),)),
    "haunched": (HAUNCHED, (jb.Support(20.0, stiffness=4e8, damping=1e5),)),
}


def case_of(spans="one span", track: jb.Track | None = SLEEPERS, **motion):
    beam, supports = SPANS[spans]
    load = jb.Axles(offsets=OFFSETS, forces=FORCES, **({"speed": 50.0} | motion))
    run = jb.Run(1.4, sample_rate=400.0)
    return jb.Case(beam, supports, sensors=SENSORS, loads=[load], run=run, track=track)


def split(case):
    """The same with a force for each share of each axle, and without a track."""
    kernel, load = case.track.kernel(), case.loads[0]
    leftwards = load.speed is not None and load.speed < 0
    offsets, shares = np.asarray(kernel.offsets), np.asarray(kernel.weights)
    ahead = -offsets if leftwards else offsets
    behind = (np.asarray(load.offsets)[:, None] - ahead + ahead.max()).reshape(-1)
    forces = (np.asarray(load.forces)[:, None] * shares).reshape(-1)
    order = np.argsort(behind)
    axles = dataclasses.replace(load, offsets=behind[order], forces=forces[order])
    if load.times is not None:
        axles = dataclasses.replace(axles, positions=load.positions + ahead.max())
    return dataclasses.replace(case, loads=[axles], track=None)


def assert_same(record, expected):
    names = ("smallest", "largest", "deflection")
    for name in names:
        found, wanted = np.asarray(getattr(record, name)), np.asarray(getattr(expected, name))
        largest = np.abs(wanted).max(axis=0)
        np.testing.assert_allclose(found / largest, wanted / largest, rtol=0, atol=1e-9)


@pytest.mark.parametrize("track", [SLEEPERS, UNEVEN], ids=["sleepers", "uneven"])
@pytest.mark.parametrize("spans", SPANS)
def test_axles_split_by_hand(spans, track):
    case = case_of(spans, track)
    assert_same(jb.simulate(case), jb.simulate(split(case)))


@pytest.mark.parametrize(
    "motion",
    [
        {"speed": -50.0},
        {"deceleration": 12.0},
        {"speed": None, "times": [0.0, 0.3, 1.0], "positions": [-2.0, 8.0, 40.0]},
    ],
    ids=["leftwards", "braking", "table"],
)
def test_motions(motion):
    """Those that do not brake or follow a table are in closed form, these are integrated."""
    case = case_of(track=UNEVEN, **motion)
    assert_same(jb.simulate(case, tolerance=1e-11), jb.simulate(split(case), tolerance=1e-11))


def test_static_peaks_and_reactions():
    for track in (SLEEPERS, UNEVEN):
        case = case_of("two spans", track, speed=47.3)  # no share at an end at a sample
        by_hand = split(case)
        for quantity, x in [
            ("deflection", 7.0),
            ("moment", 14.4),
            ("shear", 5.0),
            ("reaction", 0.0),
        ]:
            found, expected = (
                jb.statics.static_peak(one, x, quantity=quantity) for one in (case, by_hand)
            )
            assert found == pytest.approx(float(expected), rel=1e-9)
        found, expected = (np.asarray(jb.simulate(one).reactions) for one in (case, by_hand))
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8 * np.abs(expected).max())


def test_even_length_on_the_sine_modes():
    """q'' + 2 zeta w q' + w^2 q = -F (cos k a - cos k b) / (k s) sqrt(2 / m L), solved by scipy."""
    length, mass, rigidity, ratio, modes = 20.0, 10e3, 12e9, 0.02, 4
    spread, speed, force = 2.4, 40.0, 250e3
    case = jb.Case(
        jb.Beam(length, rigidity, mass, damping_ratio=ratio, modes=modes),
        sensors=[jb.Sensor(6.0), jb.Sensor(6.0, "acceleration")],
        loads=[jb.MovingForce(force=force, speed=speed)],
        track=jb.Track(spread_length=spread),
        run=jb.Run(0.8, sample_rate=100.0),
    )
    record = jb.simulate(case)
    k = np.arange(1, modes + 1) * np.pi / length
    natural, scale = k**2 * np.sqrt(rigidity / mass), np.sqrt(2 / (mass * length))

    def rates(t, state):
        q, velocity = np.split(state, 2)
        middle = speed * t - spread / 2
        a, b = (np.clip(middle + side * spread / 2, 0.0, length) for side in (-1, 1))
        push = -force * scale * (np.cos(k * a) - np.cos(k * b)) / (k * spread)
        return np.concatenate([velocity, push - 2 * ratio * natural * velocity - natural**2 * q])

    passages = np.array([0.0, spread, length, length + spread]) / speed
    stops = np.append(passages, record.times[-1])
    state, found = np.zeros(2 * modes), np.zeros((record.times.size, 2 * modes))
    for start, end in zip(stops[:-1], stops[1:], strict=True):
        here = (record.times >= start) & (record.times <= end)
        solved = scipy.integrate.solve_ivp(
            rates, (start, end), state, "DOP853", rtol=1e-11, atol=1e-14, dense_output=True
        )
        found[here], state = solved.sol(record.times[here]).T, solved.y[:, -1]
    shape = scale * np.sin(k * 6.0)
    deflection = found[:, :modes] @ shape
    assert_allclose = np.testing.assert_allclose
    assert_allclose(record.deflection[:, 0], deflection, atol=1e-9 * np.abs(deflection).max())
    instants = zip(record.times, found, strict=True)
    acceleration = np.stack([rates(t, z)[modes:] @ shape for t, z in instants])
    atol = 1e-8 * np.abs(acceleration).max()
    assert_allclose(record.acceleration[:, 0], acceleration, atol=atol)


def test_even_length_as_many_axles():
    """Moments and shear forces of two spans, by forces at the nodes of Gauss's rule."""
    even = case_of("two spans", jb.Track(spread_length=1.8))
    count = 40
    many = jb.Track(
        spread_offsets=1.8 * (gauss_nodes(count) - 0.5), spread_shares=gauss_weights(count)
    )
    found, expected = (
        jb.simulate(dataclasses.replace(even, track=one)) for one in (even.track, many)
    )
    for name in ("smallest", "largest"):
        wanted = np.asarray(getattr(expected, name))
        np.testing.assert_allclose(np.asarray(getattr(found, name)), wanted, rtol=4e-3)
    found, expected = (
        float(jb.statics.static_peak(dataclasses.replace(even, track=one), 7.0))
        for one in (even.track, many)
    )
    assert found == pytest.approx(expected, rel=1e-3)


def test_sweeps_by_both_runners():
    """Trains of forces in closed form, and forces over time by the integrators."""
    speeds = np.array([38.0, 52.0, 67.0])
    case = case_of("two spans")
    by_hand = split(case)
    over = {"loads.0.speed": speeds}
    found, expected = (jb.sweep(one, over, progress=False) for one in (case, by_hand))
    for name in found.data_vars:
        if name.startswith("peak_") and not name.endswith("time"):
            np.testing.assert_allclose(found[name], expected[name], rtol=1e-6)
    shaking = jb.VaryingForce(force=1e5, frequencies=[6.0], amplitudes=[3e4], speed=40.0)
    shaken = dataclasses.replace(case, loads=[shaking])
    swept = jb.sweep(shaken, over, progress=False)
    for i, speed in enumerate(speeds):
        record = jb.simulate(jb.replace(shaken, {"loads.0.speed": speed}))
        peaks = np.maximum(np.abs(record.smallest), np.abs(record.largest))
        found = [swept[f"peak_{s.quantity}"].to_numpy()[i, n] for n, s in enumerate(SENSORS)]
        np.testing.assert_allclose(found, peaks, rtol=1e-5)


def test_three_sleepers_under_hslm():
    """The composite bridge of 15 m at 250 km/h; both numbers from an independent report."""
    case = jb.Case(
        dataclasses.replace(ONE_SPAN, modes=3),
        sensors=[jb.Sensor(7.5, "acceleration")],
        loads=[jb.Axles(train="HSLM-A1", speed="250 km/h")],
        run=jb.Run(8.0, sample_rate=200.0),
    )
    peaks = [
        max(abs(record.smallest[0]), record.largest[0])
        for record in map(jb.simulate, (case, dataclasses.replace(case, track=SLEEPERS)))
    ]
    assert np.round(peaks, 3).tolist() == [2.693, 2.376]


def test_response_of_a_train_in_an_assessment():
    """All effects, with the reactions, of HSLM-A1 against a train of 150 forces."""
    train = published.trains()["HSLM-A1"]
    bridge = jb.Case(dataclasses.replace(ONE_SPAN, modes=3), track=SLEEPERS)
    found = train_response(bridge, "HSLM-A1", SENSORS[:4], 60.0, 61.0, (0.0, 15.0))
    for i in (0,):
        load = jb.Axles(offsets=train.offsets, forces=train.forces, speed=found.speeds[i])
        case = jb.Case(bridge.beam, sensors=SENSORS[:4], loads=[load], track=SLEEPERS)
        case = split(dataclasses.replace(case, run=jb.Run(7.5, sample_rate=2000.0)))
        record = jb.simulate(case)
        peaks = np.maximum(np.abs(record.smallest), np.abs(record.largest))
        np.testing.assert_allclose(found.peaks[i, :4], peaks, rtol=1e-4)
        sampled = np.abs(np.asarray(record.reactions)).max(axis=0)
        np.testing.assert_allclose(found.peaks[i, 4:], sampled, rtol=5e-3)


def test_static_train_of_an_assessment():
    train, bridge = published.trains()["HSLM-A1"], jb.Case(ONE_SPAN)
    for quantity in ("moment", "shear"):
        line = tabulated_line(bridge, CheckedSection("", quantity, 6.0))
        spread = line.spread(SLEEPERS.kernel())
        found = largest_under_train(spread, train.offsets, train.forces)
        load = jb.Axles(offsets=train.offsets, forces=train.forces, speed=1.0)
        case = dataclasses.replace(bridge, loads=[load], track=SLEEPERS)
        expected = max(
            float(jb.statics.static_peak(case, 6.0, quantity=quantity, side=side))
            for side in (("left", "right") if quantity == "shear" else ("right",))
        )
        assert found == pytest.approx(expected, rel=2e-3)


def test_assessment_with_a_spread():
    bridge = jb.Case(ONE_SPAN)
    options = dict(trains=("HSLM-A1",), lowest_speed="295 km/h")
    plain, spread = (
        jb.assess(bridge, "250 km/h", spread=one, **options) for one in (None, "3 sleepers")
    )
    values = [
        next(check.value for check in found.checks if check.subject.startswith("deck"))
        for found in (plain, spread)
    ]
    assert values[1] < values[0]
    assert plain.inputs["spread of axles"] == "none"
    assert "3 sleepers" in spread.inputs["spread of axles"]


def test_shares_of_the_rule():
    assert sum(SLEEPER_FRACTIONS) == 1.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"track": jb.Track()}, "track spreads nothing"),
        ({"track": jb.Track(spread="3 sleepers", spread_length=2.0)}, "leave one out"),
        ({"track": jb.Track(spread_offsets=[0.0, 1.0])}, "track.spread_shares is missing"),
        (
            {"track": jb.Track(spread_offsets=[0.0, 1.0], spread_shares=[0.0, 0.0])},
            "one of them must be positive",
        ),
        ({"track": jb.Track(spread_length=16.0)}, "less than the length of the beam"),
        ({"loads": [jb.MovingMass(mass=100.0, speed=10.0)]}, "loads.0 has mass"),
        (
            {"loads": [jb.MovingForce(force=1e3, speed=10.0, start_position=-0.3)]},
            "first force enters at -0.6 m",
        ),
        (
            {"absorbers": [jb.Absorber(7.5, mass=1e3, frequency=6.0, damping_ratio=0.1)]},
            "absorbers",
        ),
    ],
)
def test_refusals(change, words):
    with pytest.raises(ValueError, match=words):
        jb.simulate(dataclasses.replace(case_of(), **change))


def test_case_file(tmp_path):
    case, path = case_of(track=UNEVEN), tmp_path / "case.toml"
    jb.save_case(case, path)
    assert "\nspread_offsets = [-0.9, 0.2, 1.1]  # m" in path.read_text()
    assert_same(jb.simulate(jb.load_case(path)), jb.simulate(case))
