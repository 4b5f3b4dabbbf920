"""The oracles against printed numbers, an independent implementation, and each other."""

import json
import tomllib

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.modules import DATA
from tests.oracles import crossing, make_demo_log, modal_equations
from tests.oracles.closed_forms import (
    cancellation_speed,
    critical_speed,
    exact_frequencies,
    influence_line,
    moving_force,
    single_span_parameters,
    two_span_parameters,
    wavenumbers,
)
from tests.oracles.crossing import Load
from tests.oracles.finite_elements import (
    Beam,
    Patch,
    Support,
    Suspension,
    assemble,
    natural_frequencies,
    static_deflection,
)
from tests.oracles.make_demo_log import DEMO, NOISE, SAMPLING, measure, truth
from tests.oracles.modal_equations import Span

NAMES = ("pinned", "clamped", "free", "guided")
REFERENCE = json.loads((DATA / "reference_cases.json").read_text(encoding="utf-8"))


def equal_spans(count: int, ends: str = "pinned-pinned") -> Beam:
    """A beam of unit spans, rigidity and mass."""
    return Beam(float(count), 1.0, 1.0, ends, [Support(float(i)) for i in range(1, count)])


# Natural frequencies


@pytest.mark.parametrize("ends", [f"{a}-{b}" for a in NAMES for b in NAMES])
def test_single_span_frequencies_are_the_roots_of_the_characteristic_equation(ends):
    found = wavenumbers(Beam(1.0, 1.0, 1.0, ends), 12)
    assert_allclose(found, single_span_parameters(ends, 12), rtol=1e-12)


@pytest.mark.parametrize("ratio", [0.5, 0.37, 0.6, 2**-0.5, 0.9])
def test_two_span_frequencies_are_the_roots_of_the_three_moment_condition(ratio):
    found = wavenumbers(Beam(1.0, 1.0, 1.0, supports=[Support(ratio)]), 12)
    assert_allclose(found, two_span_parameters(ratio, 12), rtol=1e-12)


@pytest.mark.parametrize(
    ("spans", "ends", "parameters"),
    [  # k times the length of a span; source: independent reference tables
        (1, "clamped-free", [1.8751041, 4.6940911, 7.8547574, 10.9955407, 14.1371684]),
        (1, "clamped-clamped", [4.730040744862704, 7.8532046, 10.9956078, 14.1371655, 17.2787597]),
        (1, "free-free", [0.0, 0.0, 4.730040744862704, 7.8532046, 10.9956078]),
        (1, "clamped-pinned", [3.9266023, 7.0685827, 10.2101761, 13.3517688, 16.4933614]),
        (1, "clamped-guided", [2.3650204, 5.4978039, 8.6393798]),
        (1, "pinned-guided", [1.5707963, 4.7123890, 7.8539816]),
        (2, "pinned-pinned", [3.141593, 3.926602, 6.283185, 7.068583]),
        (3, "pinned-pinned", [3.141593, 3.556408, 4.297530, 6.283185, 6.707596, 7.429541]),
        (4, "pinned-pinned", [3.141593, 3.393231, 3.926602, 4.463324, 6.283185]),
        (5, "pinned-pinned", [3.141593, 3.309052, 3.700360, 4.152944, 4.550434]),
        (6, "pinned-pinned", [3.141593, 3.260535, 3.556408, 3.926602, 4.297530, 4.601418]),
        (2, "clamped-clamped", [3.926602, 4.730041]),
        (2, "clamped-pinned", [3.393231, 4.463324]),
        (3, "clamped-clamped", [3.556408, 4.297530, 4.730041]),
        (3, "clamped-pinned", [3.260535, 3.926602, 4.601418]),
    ],
)
def test_frequencies_agree_with_printed_tables(spans, ends, parameters):
    found = wavenumbers(equal_spans(spans, ends), len(parameters))
    assert_allclose(found, parameters, rtol=0.0, atol=6e-7)


@pytest.mark.parametrize("spans", [2, 3, 4, 5])
def test_clamped_spans_share_the_frequencies_of_twice_as_many_pinned_spans(spans):
    clamped = wavenumbers(equal_spans(spans, "clamped-pinned"), 2 * spans)
    pinned = wavenumbers(equal_spans(2 * spans), 4 * spans)
    assert_allclose(clamped, pinned[1::2], rtol=1e-12)


def test_a_spring_support_spans_the_range_from_none_to_a_rigid_one():
    none, soft, stiff, rigid = (
        exact_frequencies(Beam(1.0, 1.0, 1.0, supports=[Support(0.4, k)]), 12)
        for k in (0.0, 1e-6, 1e15, None)
    )
    assert_allclose(soft, none, rtol=1e-7)
    assert_allclose(stiff, rigid, rtol=1e-9)
    assert np.all(none < rigid * (1 + 1e-12))


GENERAL = Beam(
    length=1.3,
    flexural_rigidity=2.0,
    mass_per_length=0.7,
    ends="guided-free",
    supports=[Support(0.3, 500.0, 0.4, 3.0), Support(0.91), Support(1.3, 20.0, 0.2)],
    patches=[Patch(0.2, 0.45, 1.0, 0.4), Patch(0.4, 0.7, 0.5, 0.1)],
    suspensions=[Suspension(0.7, 300.0, 1.2, 0.05)],
)


def refined(beam: Beam, elements: int) -> Beam:
    return Beam(**(vars(beam) | {"elements": elements}))


def test_finite_elements_converge_to_the_exact_frequencies_at_fourth_order():
    exact = exact_frequencies(GENERAL, 8) / (2 * np.pi)
    coarse, fine = (natural_frequencies(refined(GENERAL, n), 8) / exact - 1 for n in (26, 52))
    assert np.all(fine > -1e-9)  # from above
    assert_allclose(coarse[3:] / fine[3:], 16.0, rtol=0.1)
    k_h = (0.7 / 2.0) ** 0.25 * np.sqrt(2 * np.pi * exact) * 1.3 / 52
    assert np.all(fine < k_h**4 / 1440)  # a uniform beam's leading error


# Statics


@pytest.mark.parametrize(
    ("ends", "at", "deflection"),  # of a unit span under 1 N at `at`, in 1 / EI; textbook
    [
        ("pinned-pinned", 0.5, -1 / 48),
        ("clamped-free", 1.0, -1 / 3),
        ("clamped-clamped", 0.5, -1 / 192),
        ("clamped-pinned", 0.5, -7 / 768),
        ("clamped-guided", 1.0, -1 / 12),
    ],
)
def test_influence_lines_have_the_textbook_values(ends, at, deflection):
    assert_allclose(influence_line(1.0, 1.0, ends, at, np.array([at])), deflection, rtol=1e-12)


@pytest.mark.parametrize(
    "ends", ["pinned-pinned", "free-clamped", "clamped-pinned", "guided-pinned"]
)
def test_finite_elements_have_the_exact_influence_line(ends):
    beam, positions = Beam(1.7, 3.0, 1.0, ends), np.linspace(0.0, 1.7, 7)
    found = [static_deflection(beam, [0.6], forces=[(x, -1.0)])[0] for x in positions]
    assert_allclose(found, influence_line(1.7, 3.0, ends, 0.6, positions), rtol=1e-9, atol=1e-15)


def test_finite_elements_have_the_textbook_statics_of_spans_springs_and_patches():
    two = static_deflection(equal_spans(2), [0.5, 1.5], forces=[(0.5, -1.0)])
    assert_allclose(two, [-23 / 1536, 9 / 1536], rtol=1e-9)
    sprung = Beam(1.0, 1.0, 1.0, suspensions=[Suspension(0.5, stiffness=48.0)])
    assert_allclose(static_deflection(sprung, [0.5], forces=[(0.5, -1.0)]), -1 / 96, rtol=1e-9)
    patched = static_deflection(Beam(0.6, 13.0, 1.0), [0.3], patch_moments=[(0.25, 0.35, 0.4)])
    assert_allclose(patched, 0.4 * 0.1 * (2 * 0.6 - 0.1) / (8 * 13.0), rtol=1e-9)


# A moving force

SPAN = Span(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, modes=5)


@pytest.mark.parametrize("ratio", [0.1, 0.5, 1.0, 1.0 + 1e-9, 2.0, 3.7])
def test_modal_equations_give_the_closed_form_of_a_moving_force(ratio):
    """Ratios to the critical speed; 1 and 2 are resonances of the first and second mode."""
    speed = ratio * critical_speed(SPAN)
    times = np.linspace(0.0, 2.0 * SPAN.length / speed, 101)
    load = Load(mass=0.3, speed=speed, kind="force")
    found = modal_equations.respond(SPAN, [load], [0.2], times)
    q, u = moving_force(SPAN, 0.3 * 9.81, speed, times)
    assert_allclose(found.modal, q, rtol=0.0, atol=1e-10 * np.abs(q).max())
    assert_allclose(found.modal_rate, u, rtol=0.0, atol=1e-10 * np.abs(u).max())
    assert_allclose(found.contact_force[1:50], 0.3 * 9.81)


@pytest.mark.parametrize(
    ("ratio", "largest", "free"),  # first mode, over its static value; independent tables
    [
        (1 / 5, 1.0825318, 0.0),
        (1 / 3, 1.5, 0.0),
        (1 / 2, 3**0.5, 4 / 3),
        (1.0, np.pi / 2, np.pi / 2),
        (3 / 2, None, 6 / 5),
        (2.0, None, 2 * 2**0.5 / 3),
    ],
)
def test_the_closed_form_has_the_printed_amplifications(ratio, largest, free):
    speed = ratio * critical_speed(SPAN)
    crossing_time = SPAN.length / speed
    times = np.linspace(0.0, crossing_time, 20001)
    q, u = (np.array(c)[:, 0] for c in moving_force(SPAN, 1.0, speed, times))
    static = SPAN.shapes(0.3)[0] / SPAN.frequencies[0] ** 2
    if largest is not None:
        assert_allclose(np.abs(q).max() / static, largest, rtol=1e-7)
    amplitude = np.hypot(q[-1], u[-1] / SPAN.frequencies[0])
    assert_allclose(amplitude / static, free, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("mode", "order"), [(1, 1), (1, 3), (2, 1), (3, -1), (4, 2)])
def test_a_mode_stays_at_rest_after_a_crossing_at_its_cancellation_speed(mode, order):
    speed = cancellation_speed(SPAN, mode, order)
    exit_time = SPAN.length / speed
    q, u = (
        c[:, mode - 1] for c in moving_force(SPAN, 1.0, speed, np.linspace(0, 2, 200) * exit_time)
    )
    assert np.abs(q[101:]).max() < 1e-12 * np.abs(q).max()
    assert np.abs(u[101:]).max() < 1e-11 * np.abs(u).max()


# Crossings


def reference_run(case: dict) -> tuple[dict, list[Load], list[float], np.ndarray]:
    """Tables, loads, sensor positions (m) and sample times (s) of a reference case."""
    tables = tomllib.loads(case["case_toml"])
    loads = [Load(**load) for load in tables["loads"]]
    samples = round(tables["run"]["duration"] * tables["run"]["sample_rate"])
    times = np.arange(samples + 1) / tables["run"]["sample_rate"]
    return tables, loads, [s["position"] for s in tables["sensors"]], times


def assert_reference_deflection(case: dict, deflection: np.ndarray, tolerance: float) -> None:
    """Deflections at the samples and their largest values, relative to the largest of all."""
    largest = np.abs(deflection).max()
    assert_allclose(
        deflection[case["sample_index"]], case["deflection_m"], rtol=0, atol=tolerance * largest
    )
    peaks = np.abs(deflection).max(axis=0)
    expected = case["largest_sampled_abs_deflection_m"]
    assert_allclose(peaks, expected, rtol=0, atol=tolerance * largest)


@pytest.mark.parametrize(
    "case", [c for c in REFERENCE if "supports" not in c["case_toml"]], ids=lambda c: c["title"]
)
def test_modal_equations_agree_with_the_reference_implementation(case):
    tables, loads, sensors, times = reference_run(case)
    keys = ("length", "flexural_rigidity", "mass_per_length", "modes", "damping_ratio")
    span = Span(**{key: tables["beam"][key] for key in keys})
    found = modal_equations.respond(span, loads, sensors, times)
    assert_allclose(span.frequencies / (2 * np.pi), case["natural_frequencies_hz"], rtol=1e-12)
    assert_reference_deflection(case, found.deflection, 1e-12)


@pytest.mark.parametrize("index", [1, 4, 6], ids=lambda i: REFERENCE[i]["title"])
def test_finite_elements_agree_with_the_reference_implementation(index):
    case = REFERENCE[index]
    tables, loads, sensors, times = reference_run(case)
    supports = [Support(**support) for support in tables.get("supports", [])]
    beam = Beam(
        **{k: v for k, v in tables["beam"].items() if k != "modes"}, supports=supports, elements=120
    )
    found = crossing.respond(beam, loads, sensors, times, modes=tables["beam"]["modes"])
    assert_reference_deflection(case, found.deflection, 2e-7)


@pytest.mark.parametrize("speed", [1.5, -1.5])
def test_the_two_solvers_agree_on_masses_and_a_force_that_stop_speed_up_and_leave(speed):
    """Two masses and a force, at once on the beam, one of them braking to a stop; both ways."""
    loads = [
        Load(0.4, speed, deceleration=3.0),
        Load(0.2, speed, entry_time=0.1, deceleration=-2.0),
        Load(0.3, 2.0, entry_time=0.15, kind="force"),
    ]
    times, sensors = np.linspace(0.0, 0.8, 161), [0.15, 0.4]
    span = Span(0.6, 11.68, 0.535, modes=4, damping_ratio=0.02)
    expected = modal_equations.respond(span, loads, sensors, times)
    beam = Beam(0.6, 11.68, 0.535, damping_ratio=0.02, elements=80)
    found = crossing.respond(beam, loads, sensors, times, modes=4)
    size = np.abs(expected.deflection).max()
    assert_allclose(found.deflection, expected.deflection, rtol=0, atol=2e-6 * size)
    assert_allclose(found.contact_force, expected.contact_force, rtol=0, atol=0.01)
    assert expected.contact_force[-1, 0] == pytest.approx(0.4 * 9.81, rel=0.05)  # it stays
    assert np.all(expected.contact_force[-1, 1:] == 0.0)


def test_all_finite_element_modes_agree_with_many_sine_modes():
    load, times = Load(0.261, 3.0), np.linspace(0.0, 0.3, 61)
    beam = Beam(0.6, 11.68, 0.535, damping_ratio=0.03, elements=12)
    full = crossing.respond(beam, [load], [0.25], times, rtol=1e-8, atol=1e-12)
    sines = modal_equations.respond(Span(0.6, 11.68, 0.535, 12, 0.03), [load], [0.25], times)
    size = np.abs(sines.deflection).max()
    assert_allclose(full.deflection, sines.deflection, rtol=0, atol=5e-4 * size)


def test_a_suspension_of_all_modes_is_an_elastic_support():
    """As a coupling of the modes of the pinned beam, and as part of the modes."""
    plain = Beam(0.6, 11.68, 0.535, elements=6)
    spring = {"position": 0.5, "stiffness": 3500.0, "damping": 20.0}
    times, load = np.linspace(0.0, 0.1, 21), Load(0.5, 8.0)
    first, second = (
        crossing.respond(Beam(**(vars(plain) | extra)), [load], [0.2], times, rtol=1e-9).deflection
        for extra in ({"suspensions": [Suspension(**spring)]}, {"supports": [Support(**spring)]})
    )
    assert_allclose(first, second, rtol=0, atol=1e-7 * np.abs(first).max())


def test_energy_lost_in_free_vibration_is_the_work_of_the_dampers():
    """Energy of the supported, suspended beam against the work of its two dampers."""
    beam = refined(GENERAL, 13)
    model = assemble(beam)
    n = len(model.free)
    start = np.zeros(n), np.append([0.3, -0.2, 0.1], np.zeros(n - 3))
    times = np.linspace(0.0, 0.5, 20001)
    damper_positions = [0.3, 1.3, 0.7]  # two support dampers and the suspension
    motion = crossing.respond(beam, [], damper_positions, times, initial=start)
    omega, _ = model.modes()
    energy = 0.5 * np.sum(motion.modal_rate**2 + (omega * motion.modal) ** 2, axis=1)
    energy += 0.5 * 0.05 * motion.velocity[:, 2] ** 2 + 0.5 * 300.0 * motion.deflection[:, 2] ** 2
    power = motion.velocity**2 @ np.array([0.4, 0.2, 1.2])
    work = np.trapezoid(power, times)
    assert work > 0.2 * energy[0]
    assert_allclose(energy[0] - energy[-1], work, rtol=1e-4)


# The committed demo logs are those that the finite-element model makes.


@pytest.mark.parametrize("name", SAMPLING)
def test_a_demo_log_is_small_and_has_units(name):
    path = DEMO / f"{name}.csv"
    assert path.stat().st_size < 60_000
    first = path.read_text(encoding="utf-8").splitlines()[0]
    assert first == "time [s],d1 [mm],d2 [mm],d3 [mm]"


def test_making_the_demo_logs_again_gives_the_committed_numbers():
    for name, table in make_demo_log.make().items():
        committed = np.loadtxt(DEMO / f"{name}.csv", delimiter=",", skiprows=1)
        # Printed digits, and a little for another platform's last bits.
        np.testing.assert_allclose(table, committed, rtol=0, atol=0.51e-4)


def test_the_nominal_number_of_modes_is_enough_for_the_noise():
    """The error of the modes that the model neglects is far below the noise of a reading."""
    rig, logs = truth()
    few, many = (
        measure(rig, logs["log_2"]["loads"], *SAMPLING["log_2"], modes=modes)
        for modes in (rig["beam"]["modes"], make_demo_log.MODES)
    )
    assert np.abs(few - many).max() < 0.2 * NOISE
