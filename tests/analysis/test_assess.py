"""Code checks of railway bridges against hand-computed values and an independent program."""

import dataclasses
import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.assessment.assessment import (
    frequency_limits,
    irregularity_factor,
    running_factor,
    static_dynamic_factor,
)
from jaxbeam.analysis.assessment.checks import (
    CheckedSection,
    checked_sections,
    largest_under_lm71,
    largest_under_train,
    reaction_peaks,
    tabulated_line,
    train_response,
)
from jaxbeam.analysis.sections import characteristic_points
from jaxbeam.case.library.published import trains
from jaxbeam.model.output_rows import counted_frequency
from tests.modules import ROOT

DATA = json.loads((ROOT / "tests" / "data" / "railway_code.json").read_text())
BRIDGE = jb.Case(jb.Beam(25.0, 3e10, 15000.0, damping_ratio=0.01), title="25 m")
TWO_SPANS = jb.Case(jb.Beam(40.0, 3e10, 15000.0), supports=[jb.Support(20.0)])


def outcome(assessment, start):
    return next(check for check in assessment.checks if check.subject.startswith(start))


def test_increments_of_annex_c():
    length, frequency = DATA["annex_c"]["L_phi"], DATA["annex_c"]["n0"]
    for row in DATA["annex_c"]["cases"]:
        speed = row["v_kmh"] / 3.6
        first = running_factor(speed, length, frequency)
        second = irregularity_factor(speed, length, frequency)
        assert_allclose([first, second], [row["phi1"], row["phi2"]], rtol=1e-7)
    assert running_factor(2 * length * frequency * 0.8, length, frequency) == 1.325
    assert irregularity_factor(30.0, 20.0, 1.0) == pytest.approx(0.0)  # 50 (1/4 - 1) / e < 0


def test_limits_of_the_first_frequency_and_dynamic_factors():
    """94.76 / 25^0.748, 23.58 / 25^0.592, 80 / 10; 2.16 / 4.8 + 0.73, 1.44 / 4.8 + 0.82."""
    assert_allclose(frequency_limits(25.0), [3.507222, 8.530332], rtol=1e-5)
    assert_allclose(frequency_limits(10.0), [8.0, 16.928756], rtol=1e-5)
    assert_allclose(static_dynamic_factor([1.0, 25.0, 100.0], "standard"), [2.0, 1.18, 1.0])
    assert_allclose(static_dynamic_factor([1.0, 25.0, 100.0], "maintained"), [1.67, 1.12, 1.0])


@pytest.mark.parametrize(
    ("frequencies", "expected"),
    [([3.5, 14.2, 32.0], 32.0), ([5.0, 8.0, 9.0], 30.0), ([24.0, 25.0, 26.0], 36.0), ([2.0], 30.0)],
)
def test_modes_that_count(frequencies, expected):
    assert_allclose(counted_frequency(np.array(frequencies)), expected, rtol=1e-8)


def test_lm71_at_midspan_of_one_span():
    """Axles at 0, +-1.6 and 3.2 m of midspan, line loads outside a block of 6.4 m."""
    line = tabulated_line(BRIDGE, CheckedSection("", "moment", 12.5))
    axles = 250e3 * (4 * 12.5 - 6.4) / 2
    lines = 80e3 * (25.0**2 / 8 - (6.4 * 12.5 - (2.4**2 + 4.0**2) / 2) / 2)
    assert_allclose(largest_under_lm71(line), axles + lines, rtol=1e-5)


def test_lm71_over_the_inner_support():
    """Against sums over a fine grid of the closed form, -a (l^2 - a^2) / (4 l^2), of both spans."""
    s = np.linspace(0.0, 40.0, 40001)
    a = np.minimum(s, 40.0 - s)
    moment = a * (20.0**2 - a**2) / (4 * 20.0**2)
    first = np.linspace(-5.0, 41.0, 461)
    best = 0.0
    for x in first:
        outside = (s < x - 0.8) | (s > x + 5.6)
        axles = np.interp(x + 1.6 * np.arange(4), s, moment, left=0, right=0).sum()
        best = max(best, 250e3 * axles + 80e3 * np.trapezoid(moment * outside, s))
    line = tabulated_line(TWO_SPANS, CheckedSection("", "moment", 20.0))
    assert_allclose(largest_under_lm71(line), best, rtol=2e-3)


def test_static_train():
    train, expected = trains()["HSLM-A1"], DATA["hslm_a1"]["static"]
    for quantity, value in (("moment", expected["M_max"]), ("deflection", -expected["w_min"])):
        line = tabulated_line(BRIDGE, CheckedSection("", quantity, 12.5))
        found = largest_under_train(line, train.offsets, train.forces)
        assert_allclose(found, value, rtol=1e-4)


def test_characteristic_points():
    names = [point.name for point in characteristic_points(TWO_SPANS)]
    assert names == [
        *("support 1", "quarter 1", "midspan 1", "three quarters 1", "support 2"),
        *("quarter 2", "midspan 2", "three quarters 2", "support 3"),
    ]
    hinged = dataclasses.replace(TWO_SPANS.beam, hinges=[jb.Hinge(26.0)])
    hinged = dataclasses.replace(TWO_SPANS, beam=hinged)
    points = {point.name: point.x for point in characteristic_points(hinged)}
    assert points["hinge 1"] == 26.0 and len(points) == len(names) + 1
    overhang = dataclasses.replace(TWO_SPANS, beam=jb.Beam(40.0, 3e10, 15e3, ends="pinned-free"))
    assert [p.name for p in characteristic_points(overhang)][-2:] == [
        "three quarters 2",
        "right end",
    ]


def test_peaks_over_speed_are_found_and_refined():
    """Three modes around the resonance of HSLM-A1 at 230 km/h; the reference samples 2.5 km/h."""
    beam = dataclasses.replace(BRIDGE.beam, modes=3)
    sensors = (jb.Sensor(12.5, "acceleration"), jb.Sensor(12.5))
    case = dataclasses.replace(BRIDGE, beam=beam)
    found = train_response(case, "HSLM-A1", sensors, 225 / 3.6, 235 / 3.6)
    expected = DATA["hslm_a1"]
    assert found.change < 0.01
    assert 1.0 <= found.peaks[:, 0].max() / max(expected["a_max_abs_3modes"]) < 1.01
    assert 1.0 <= found.peaks[:, 1].max() / -min(expected["w_min"]) < 1.01
    whole = jb.assess(
        BRIDGE, 235 / 3.6 / 1.2, lowest_speed="225 km/h", trains=["HSLM-A1"], dynamic=True
    )
    deck = outcome(whole, "deck acceleration")
    assert deck.outcome == "not satisfied" and "3 modes count" in deck.remark
    factor = 1 + DATA["annex_c"]["cases"][-1]["phi2"]
    assert_allclose(deck.value, factor * found.peaks[:, 0].max(), rtol=1e-3)
    moment = outcome(whole, "trains against LM71, moment")
    assert 1.0 <= moment.value / factor / max(expected["M_max"]) < 1.01
    assert moment.outcome == "LM71 governs" and whole.governed_by_trains == ()


@pytest.mark.parametrize(("track", "part"), [("standard", 1.0), ("maintained", 0.5)])
def test_calculated_effects_hold_the_state_of_the_track(track, part):
    """A composite bridge of 15 m and 6.530 Hz; phi'' of annex C by hand: 0.1230."""
    beam = jb.Beam(15.0, 10.5e9, 12000.0, damping_ratio=0.01125)
    bridge = jb.Case(beam)
    relative = 15.0 * 6.530 / 80 - 1
    phi = 0.56 * np.exp(-((15 / 10) ** 2)) + 0.5 * relative * np.exp(-((15 / 20) ** 2))
    given = dict(lowest_speed=84.0, trains=["HSLM-A10"], dynamic=True)
    found = jb.assess(bridge, 72.0, track=track, **given)
    sensors = (jb.Sensor(7.5, "acceleration"), jb.Sensor(7.5), jb.Sensor(7.5, "moment"))
    counted = dataclasses.replace(beam, modes=3)  # f_3 is above 30 Hz
    assert "3 modes count" in outcome(found, "deck acceleration").remark
    case = dataclasses.replace(bridge, beam=counted)
    bare = train_response(case, "HSLM-A10", sensors, 84.0, 86.4)
    curve, names = found.effects.curves[0], found.effects.names
    for i, name in enumerate(("deck acceleration at", "deflection at", "moment at")):
        column = names.index(f"{name} midspan 1")
        largest = curve.values[:, column].max()
        assert_allclose(largest, (1 + part * phi) * bare.peaks[:, i].max(), rtol=1e-3)
    assert f"for the {track} track" in outcome(found, "deck acceleration").remark
    assert "as commonly stated, for the dynamic analysis" in found.sources
    assert found.inputs["track"] == track


def test_effects_of_a_train_are_those_of_its_runs():
    """Shear forces on both sides of supports, reactions and rotations against recorded runs."""
    bridge = dataclasses.replace(TWO_SPANS, beam=jb.Beam(40.0, 3e10, 15000.0, 0.01, modes=6))
    sections = checked_sections(bridge)
    assert [s.name for s in sections if s.quantity in ("shear", "rotation", "reaction")] == [
        *("shear right of support 1", "end rotation at support 1"),
        *("shear left of support 2", "shear right of support 2"),
        *("shear left of support 3", "end rotation at support 3"),
        *(f"reaction at support {i}" for i in (1, 2, 3)),
    ]
    train = jb.Axles(speed=60.0, offsets=np.arange(8) * 4.0, forces=[2e5] * 8)
    run = jb.Run(1.5, sample_rate=2000.0)
    loaded = dataclasses.replace(bridge, loads=[train], run=run)
    values = np.array([[60.0, 1.5], [45.0, 1.5]])
    found = reaction_peaks(loaded, (0.0, 20.0, 40.0), ("loads.0.speed", "run.duration"), values)
    for row, speed in zip(found, (60.0, 45.0), strict=True):
        record = jb.simulate(jb.replace(loaded, {"loads.0.speed": speed}))
        sampled = np.abs(record.reactions).max(axis=0)
        assert np.all(row >= sampled * (1 - 1e-6))
        assert_allclose(row, sampled, rtol=5e-3)
    for section in (s for s in sections if s.quantity == "shear"):
        line = tabulated_line(bridge, section)
        exact = jb.influence_line(bridge, section.x, 7.0, quantity="shear", side=section.side)
        assert_allclose(line.at(np.array([7.0]))[0], exact, rtol=1e-3)


def test_reactions_of_a_critically_damped_beam():
    """Its poles are double; the reaction at an end is the shear force there, and no other."""
    case = jb.Case(jb.Beam(10.0, 3e9, 8000.0, damping_ratio=1.0, modes=3))
    sensors, train = (jb.Sensor(0.0, "shear"), jb.Sensor(0.6, "shear")), trains()["HL93-tandem"]
    load = jb.Axles(speed=30.0, offsets=train.offsets, forces=train.forces)
    loaded = dataclasses.replace(case, loads=(load,), run=jb.Run(0.6, sample_rate=2000.0))
    assert reaction_peaks(loaded, (0.0,), ("loads.0.speed",), np.array([[30.0]])) is None
    found = train_response(case, "HL93-tandem", sensors, 30.0, 30.01, reactions=(0.0,))
    sampled = np.abs(jb.simulate(loaded).reactions[:, 0]).max()
    assert_allclose(found.peaks[found.speeds == 30.0, -1], sampled, rtol=5e-3)


def test_trains_that_govern_are_a_finding():
    """HSLM-A10 in resonance on 15 m: above LM71, and named, but only the acceleration fails."""
    bridge = jb.Case(jb.Beam(15.0, 10.5e9, 12000.0, damping_ratio=0.01125))
    given = dict(lowest_speed=87.0, trains=["HSLM-A10"], dynamic=True)
    found = jb.assess(bridge, 74.0, **given)
    assert "moment at midspan 1" in found.governed_by_trains
    assert [check.subject for check in found.failed] == ["deck acceleration, ballasted track"]
    assert "the trains govern the design of moment at midspan 1" in found.verdict
    effects = found.effects
    at = effects.names.index("moment at midspan 1")
    moments = (effects.limits[at], effects.curves[0].values[:, at].max())
    row = f"| moment at midspan 1 | MN m | {moments[0] / 1e6:.4g} | {moments[1] / 1e6:.4g} |"
    assert (
        row in found.to_markdown() and "| end rotation at support 1 | mrad |" in found.to_markdown()
    )
    assert json.dumps(found.to_dict()["effects"])
    figure = found.plot()
    assert len(figure.axes) == 6 and figure.axes[0].get_ylim()[1] > 3.5
    with pytest.raises(ValueError, match="no effects over speed: ask for the dynamic analysis"):
        jb.assess(bridge, 40.0, dynamic=False).plot()


def test_flow_of_the_report(tmp_path):
    slow, fast = jb.assess(BRIDGE, "160 km/h"), jb.assess(BRIDGE, "250 km/h", dynamic=False)
    assert outcome(slow, "dynamic analysis").outcome == "not required"
    assert outcome(fast, "dynamic analysis").outcome == "required"
    limp = dataclasses.replace(BRIDGE, beam=jb.Beam(25.0, 1e10, 15e3, damping_ratio=0.01))
    assert "outside the limits" in outcome(jb.assess(limp, 40.0, dynamic=False), "dynamic").remark
    damped = jb.assess(BRIDGE, 40.0, added_damping=0.004)
    assert_allclose(outcome(damped, "damping").value, 0.014)
    assert "no certificate" in slow.verdict and "skew" in " ".join(slow.not_in_model)
    for text in (str(slow), slow.to_markdown()):
        assert "EN 1991-2, 6.4.4, figure 6.10" in text and "limits 3.507 and 8.53 Hz" in text
    slow.save(tmp_path / "report.md")
    assert "## Sources of the numbers" in (tmp_path / "report.md").read_text()
    with pytest.raises(FileExistsError, match="exists already"):
        slow.save(tmp_path / "report.md")


def test_refusals():
    with pytest.raises(ValueError, match="the beam has 2 spans; give their determinant length"):
        jb.assess(TWO_SPANS, 40.0)
    assert jb.assess(TWO_SPANS, 40.0, determinant_length="24 m").inputs["determinant length"]
    with pytest.raises(ValueError, match="deck cannot be 'ballast'; did you mean 'ballasted'"):
        jb.assess(BRIDGE, 40.0, deck="ballast")
    with pytest.raises(ValueError, match="standard or maintained; 'slab' is the deck"):
        jb.assess(BRIDGE, 40.0, track="slab")
    with pytest.raises(ValueError, match="'HSLM-A11' is no train of forces; did you mean"):
        jb.assess(BRIDGE, 40.0, trains=["HSLM-A11"])
    with pytest.raises(ValueError, match="line_speed must be positive"):
        jb.assess(BRIDGE, -1.0)
    with pytest.raises(ValueError, match="900 km/h, faster than any train: .*write '250 km/h'"):
        jb.assess(BRIDGE, 250)
    free = dataclasses.replace(BRIDGE, beam=jb.Beam(25.0, 3e10, 15e3, ends="free-free"))
    with pytest.raises(ValueError, match="can move as a rigid body"):
        jb.assess(free, 40.0)
    rayleigh = dataclasses.replace(BRIDGE.beam, damping_ratio=[0.01, 0.02], modes=2)
    with pytest.raises(ValueError, match="set beam.modes to 3 or more"):
        jb.assess(dataclasses.replace(BRIDGE, beam=rayleigh), 40.0)
    stiff = dataclasses.replace(BRIDGE, beam=jb.Beam(1.0, 3e10, 15e3))
    with pytest.raises(ValueError, match="first frequency of 2221 Hz"):
        jb.assess(stiff, 40.0, dynamic=True, progress=False)
    controlled = dataclasses.replace(
        BRIDGE,
        actuators=[jb.PointForce(12.5)],
        sensors=[jb.Sensor(12.5)],
        controller=jb.Feedback(gains=[1.0]),
    )
    with pytest.raises(ValueError, match="active control cannot be certified"):
        jb.assess(controlled, 40.0)


def test_peaks_after_the_last_axle_count():
    """Two axles above the critical speed: the largest deflection is in free vibration.

    One mode q'' + 2 z w q' + w^2 q = 2 F / (m L) sin(v t pi / L), in closed form; the sine goes on
    after the exit, and one that begins there takes it back.
    """
    length, mass, ratio, speed = 25.0, 15e3, 0.01, 250.0
    case = jb.Case(jb.Beam(length, 3e10, mass, damping_ratio=ratio, modes=1))
    w, train = (np.pi / length) ** 2 * np.sqrt(3e10 / mass), trains()["HL93-tandem"]
    drive, damped = np.pi * speed / length, w * np.sqrt(1 - ratio**2)
    size = (w**2 - drive**2) ** 2 + (2 * ratio * w * drive) ** 2
    sine, cosine = (w**2 - drive**2) / size, -2 * ratio * w * drive / size

    def response(s):
        s = np.maximum(s, 0.0)
        other = -(sine * drive + ratio * w * cosine) / damped
        free = -cosine * np.cos(damped * s) + other * np.sin(damped * s)
        forced = sine * np.sin(drive * s) + cosine * np.cos(drive * s)
        return forced + np.exp(-ratio * w * s) * free

    last = (length + train.offsets[-1]) / speed
    t = np.linspace(0.0, last + 0.6, 40001)
    q = sum(
        2 * force / (mass * length) * (response(t - d / speed) + response(t - (d + length) / speed))
        for d, force in zip(
            train.offsets, np.broadcast_to(train.forces, train.offsets.shape), strict=True
        )
    )
    before, after = np.abs(q[t <= last]).max(), np.abs(q[t > last]).max()
    assert after > 1.05 * before
    found = train_response(
        case, "HL93-tandem", (jb.Sensor(length / 2),), speed, speed * 1.001
    )  # fmt: skip
    assert_allclose(found.peaks[found.speeds == speed, 0], after, rtol=1e-3)


def test_largest_moments_of_spans_are_checked():
    """Those of all positions of LM71 on a fine grid; within 0.01 % of them, above midspan's."""
    for case, a, b in ((TWO_SPANS, 0.0, 20.0), (BRIDGE, 0.0, 25.0)):
        named = [s for s in checked_sections(case) if s.name.endswith("its largest in span 1")]
        grid = np.linspace(a, b, 26)[1:-1]
        moments = []
        for x in (*grid, *(s.x for s in named), (a + b) / 2):
            line = tabulated_line(case, CheckedSection("", "moment", float(x)))
            sagging = line._replace(values=np.maximum(line.values, 0.0))
            moments.append(largest_under_lm71(sagging))
        assert len(named) == 1
        assert moments[-2] > max(moments[:-2]) * (1 - 1e-4)
        assert moments[-2] > moments[-1]
    (section,) = (s for s in checked_sections(TWO_SPANS) if s.name.endswith("in span 1"))
    assert 0.38 * 20.0 < section.x < 0.45 * 20.0
