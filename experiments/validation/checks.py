"""Checks of the validation page: crossings and loops against closed forms, scipy and oracles.

Checks of control: sampled loops, gains of regulators and filters, and the least peak.

The event-by-event loop of `tests/oracles`, scipy's equations and Clarabel's linear program share no
code with jaxbeam.

Checks of beams and crossings: frequencies, statics, deflections, energy and derivatives.

The closed forms, finite elements and scipy solutions of `tests/oracles` share no code with jaxbeam.

The validation page: errors of jaxbeam against independent sources, computed when written.
"""

import dataclasses
import platform
from collections.abc import Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import clarabel
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.signal
import scipy.sparse

import jaxbeam as jb
from jaxbeam.analysis.bound.bound import Bound, input_influence
from jaxbeam.case.library import rigs
from jaxbeam.case.sensors import filter_history, second_order_sections, steady_filter_state
from jaxbeam.control.estimation.observer import kalman_gain, sampled_kalman_gain
from jaxbeam.files.report import ReportSection, ReportTable, markdown
from jaxbeam.model.statics import static_peak
from jaxbeam.simulation.integration_plan import integration_plan
from tests import loop_as_oracle
from tests.differences import central
from tests.loop_as_oracle import as_oracle
from tests.oracles import crossing, modal_equations
from tests.oracles.closed_forms import (
    CHARACTERISTIC,
    critical_speed,
    exact_frequencies,
    influence_line,
    moving_force,
    single_span_parameters,
    two_span_parameters,
)
from tests.oracles.crossing import GRAVITY, Load
from tests.oracles.modal_equations import Span

PAGE_FILE = Path(__file__).parents[2] / "VALIDATION.md"
INTRODUCTION = """Each row compares jaxbeam with a reference that shares no code with it: closed
forms, finite elements, scipy, another solver. Errors are relative, and were computed when this page
was written, by

    .venv/bin/uv run python -m experiments.validation

which fails if an error exceeds its tolerance. The references are in `tests/oracles`; the tests
compare many more cases with them."""


class Check(NamedTuple):
    """A quantity computed by jaxbeam, a reference, and the relative error beside its tolerance."""

    quantity: str
    reference: str
    error: float
    tolerance: float

    @property
    def passed(self) -> bool:
        """Whether the error is within the tolerance; NaN is not."""
        return self.error <= self.tolerance


def max_relative_error(computed, expected) -> float:
    """Largest difference over the largest expected value."""
    computed, expected = np.asarray(computed), np.asarray(expected)
    return float(np.max(np.abs(computed - expected)) / np.max(np.abs(expected)))


def max_entrywise_error(computed, expected) -> float:
    """Largest difference of any entry over that entry."""
    return float(np.max(np.abs(np.asarray(computed) / np.asarray(expected) - 1)))


def validation_page(groups: Sequence[tuple[str, Sequence[Check]]]) -> str:
    """The page in Markdown: a table for each group of checks."""
    checks = [check for _, group in groups for check in group]
    passed = sum(check.passed for check in checks)
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in ("jaxbeam", "jax", "scipy"))
    summary = (
        f"**{passed} of {len(checks)} errors are within their tolerances**"
        f" ({versions}, Python {platform.python_version()})."
    )
    sections = [ReportSection("", [INTRODUCTION, summary])]
    for title, group in groups:
        rows = [
            (
                check.quantity,
                check.reference,
                f"{check.error:.1e}",
                f"{check.tolerance:.0e}",
                "within" if check.passed else "**above**",
            )
            for check in group
        ]
        header = ("quantity", "reference", "error", "tolerance", "")
        sections.append(ReportSection(title, [ReportTable(header, rows)]))
    return markdown("Validation", sections)


def loops() -> Iterator[Check]:
    """Sampled closed loops, their gains and filters."""
    case = rigs.load("B")
    feedback = jb.Feedback(gains=[1e10], power=3, period=0.002, delay=0.001)
    case = dataclasses.replace(case, controller=feedback)
    case = jb.replace(case, {"loads.0.speed": 1.5, "run.duration": 0.5})
    times = np.linspace(0, 0.5, 126)[:-1] + 1e-4  # between the sampling instants
    deflection = jb.simulate(case, jnp.asarray(times)).deflection
    yield Check(
        "cubic feedback, sampled, delayed, saturated: deflection",
        "event by event with scipy DOP853",
        max_relative_error(deflection, loop_as_oracle.expected(case, times).deflection),
        1e-5,
    )
    plant = jb.state_space(dataclasses.replace(case, controller=None))
    A, B = np.asarray(plant.unloaded.A), np.asarray(plant.unloaded.B)
    Q, R = np.diag([1e6] * 3 + [1.0] * 3), np.array([[1e-4]])
    P = scipy.linalg.solve_continuous_are(A, B, Q, R)
    gain = jb.LQR(state_weight=np.diag(Q), command_weight=np.diag(R)).time_invariant_gain(plant)
    yield Check(
        "gain of the regulator",
        "scipy, algebraic Riccati equation",
        max_relative_error(gain, np.linalg.solve(R, B.T @ P)),
        1e-6,
    )
    noise, C = np.diag([0.0] * 3 + [0.01, 0.02, 0.03]), np.eye(1, 6) * 1e3
    P = scipy.linalg.solve_continuous_are(A.T, C.T, noise, R)
    filter_gain = kalman_gain(*map(jnp.asarray, (A, C, noise, R)))[0]
    yield Check(
        "gain of the Kalman filter",
        "scipy, algebraic Riccati equation",
        max_relative_error(filter_gain, P @ C.T / R),
        1e-6,
    )
    sampled_A = scipy.signal.cont2discrete((A, B, C, np.zeros((1, 1))), 0.002)[0]
    yield Check(
        "plant sampled at 500 Hz",
        "scipy cont2discrete",
        max_relative_error(plant.unloaded.discretize(0.002).A, sampled_A),
        1e-9,
    )
    P = scipy.linalg.solve_discrete_are(sampled_A.T, C.T, noise, R)
    filter_gain = sampled_kalman_gain(*map(jnp.asarray, (sampled_A, C, noise, R)))[0]
    yield Check(
        "gain of the sampled Kalman filter",
        "scipy, discrete Riccati equation",
        max_relative_error(filter_gain, P @ C.T / (C @ P @ C.T + R)),
        1e-6,
    )
    signal = np.random.default_rng(7).normal(size=(2000, 1)).cumsum(axis=0)
    sections = second_order_sections(jb.Filter(40.0, 5), 1e-3)
    start = steady_filter_state(sections, np.zeros(1))
    butter = scipy.signal.butter(5, 40.0, fs=1000.0, output="sos")
    yield Check(
        "Butterworth filter of order 5, output",
        "scipy butter and sosfilt",
        max_relative_error(
            filter_history(sections, start, jnp.asarray(signal)),
            scipy.signal.sosfilt(butter, signal, axis=0),
        ),
        1e-9,
    )


def bounds() -> Iterator[Check]:
    """The least achievable peak."""
    case = jb.replace(rigs.load("B"), {"loads.0.speed": 1.0, "run.duration": 0.8})
    best = jb.bound(case)
    yield Check(
        "least peak of rig B",
        "the whole linear program, by Clarabel",
        max_entrywise_error(best.peak, least_peak_by_clarabel(case, best)),
        1e-6,
    )
    record = jb.simulate(dataclasses.replace(case, controller=best.controller()))
    yield Check(
        "least peak of rig B",
        "a run with the optimal commands",
        max_entrywise_error(np.max(np.abs(record.deflection)), best.peak),
        1e-4,
    )


def least_peak_by_clarabel(case: jb.Case, best: Bound) -> float:
    """The least peak (m): minimise p subject to |w(t)| <= p at all times, and command limits."""
    influence = input_influence(case, best.positions, best.period, best.spacing)
    row = influence.deflection_rows[0]
    uncontrolled = influence.unforced @ row
    response = np.einsum("m,tmk->tk", row, influence.response[..., 0])
    count, scale = response.shape[1], 1e3  # scale: deflections in mm
    ones = np.ones((uncontrolled.size, 1))
    peaks = np.block([[scale * response, -ones], [-scale * response, -ones]])
    zeros = np.zeros((count, 1))
    box = np.block([[np.eye(count), zeros], [-np.eye(count), zeros]])
    low, high = map(float, case.actuators[0].limits)
    limits = np.full(count, high), np.full(count, -low)
    right = np.concatenate([-scale * uncontrolled, scale * uncontrolled, *limits])
    options = clarabel.DefaultSettings()
    options.verbose = False
    solver = clarabel.DefaultSolver(
        scipy.sparse.csc_matrix((count + 1, count + 1)),
        np.append(np.zeros(count), 1.0),
        scipy.sparse.csc_matrix(np.concatenate([peaks, box])),
        right,
        [clarabel.NonnegativeConeT(right.size)],
        options,
    )
    return solver.solve().x[-1] / scale


SPAN = Span(0.6, 11.68, 0.535, 4, 0.03)
SENSORS = np.array([0.15, 0.25, 0.35])
LOAD = jb.MovingMass(mass=0.4, speed=2.0)


def single_span_case(load=LOAD, span: Span = SPAN, duration: float = 0.6) -> jb.Case:
    """One pinned span with three sensors, crossed by a load."""
    beam = jb.Beam(
        span.length,
        span.flexural_rigidity,
        span.mass_per_length,
        damping_ratio=span.damping_ratio,
        modes=span.modes,
    )
    sensors = [jb.Sensor(x) for x in SENSORS]
    return jb.Case(beam, sensors=sensors, loads=[load], run=jb.Run(duration, gravity=GRAVITY))


def frequencies() -> Iterator[Check]:
    """Natural frequencies of spans, with all ends and supports."""
    unit = np.sqrt(11.68 / 0.535) / 0.6**2 / (2 * np.pi)
    ends = {"-".join(sorted(pair) * (3 - len(pair))) for pair in CHARACTERISTIC}
    worst = 0.0
    for name in sorted(ends):
        parameters = single_span_parameters(name, 8)
        bending = parameters > 0
        computed = jb.modes(jb.Case(jb.Beam(0.6, 11.68, 0.535, ends=name, modes=8))).frequencies
        worst = max(worst, max_entrywise_error(computed[bending], unit * parameters[bending] ** 2))
        worst = max(worst, float(np.max(computed[~bending], initial=0.0)))
    yield Check(
        f"8 frequencies of one span, {len(ends)} pairs of ends",
        "roots of the characteristic equations",
        worst,
        1e-9,
    )
    errors = []
    for ratio in (0.37, 0.45):
        case = jb.Case(jb.Beam(0.6, 11.68, 0.535, modes=8), [jb.Support(0.6 * ratio)])
        errors.append(
            max_entrywise_error(
                jb.modes(case).frequencies, unit * two_span_parameters(ratio, 8) ** 2
            )
        )
    yield Check(
        "8 frequencies of two unequal spans",
        "roots of the three-moment condition",
        max(errors),
        1e-9,
    )
    supports = [jb.Support(0.3, stiffness=8000.0, rotational_stiffness=3.0), jb.Support(0.8)]
    patch = jb.Patch(0.45, 0.6, 1e-3, added_mass=0.1, added_rigidity=3.0)
    case = jb.Case(jb.Beam(1.2, 12.0, 0.7, ends="clamped-free", modes=8), supports, [patch])
    exact = exact_frequencies(as_oracle(case), 8) / (2 * np.pi)
    yield Check(
        "8 frequencies of a stepped beam with an elastic and a rigid support",
        "dynamic stiffness matrix, counted by Wittrick and Williams",
        max_entrywise_error(jb.modes(case).frequencies, exact),
        1e-9,
    )


def statics() -> Iterator[Check]:
    """Static deflection under travelling weights."""
    case = single_span_case()
    load_positions = np.linspace(0, SPAN.length, 6001)
    line = [influence_line(SPAN.length, 11.68, "pinned-pinned", x, load_positions) for x in SENSORS]
    expected = 0.4 * GRAVITY * np.max(np.abs(line), axis=1)
    yield Check(
        "largest static deflection at three sensors",
        "Macaulay's method",
        max_entrywise_error(static_peak(case, SENSORS), expected),
        1e-6,  # the reference has 6001 positions of the load
    )


def crossings() -> Iterator[Check]:
    """Crossings: deflection and contact force."""
    undamped = dataclasses.replace(SPAN, damping_ratio=0.0)
    case = single_span_case(jb.MovingForce(force=3.0, speed=1.0), undamped)
    errors = []
    for ratio in (0.05, 0.3, 1.0, 2.0, 3.7):
        speed = ratio * critical_speed(undamped)
        times = np.linspace(0, 2 * SPAN.length / speed, 201)
        one = jb.replace(case, {"loads.0.speed": speed, "run.duration": times[-1]})
        record = jb.simulate(one, jnp.asarray(times))
        q, _ = moving_force(undamped, 3.0, speed, times)
        errors.append(max_relative_error(record.deflection, q @ undamped.shapes(SENSORS).T))
    yield Check(
        "moving force, 5 speeds from 0.05 to 3.7 times the critical one, which is included",
        "closed form",
        max(errors),
        1e-7,
    )
    times = np.linspace(0, 0.6, 301)
    case = single_span_case()
    record = jb.simulate(case, jnp.asarray(times))
    solved = modal_equations.respond(SPAN, [Load(0.4, 2.0)], SENSORS, times)
    reference = "modal equations with the full mass matrix, scipy DOP853"
    for name in ("deflection", "contact_force"):
        error = max_relative_error(getattr(record, name), getattr(solved, name))
        yield Check(f"moving mass, {name.replace('_', ' ')}", reference, error, 1e-5)
    beam = jb.Beam(1.2, 12.0, 0.7, ends="clamped-free", modes=4, damping_ratio=0.02)
    supports = [jb.Support(0.4, stiffness=3000.0, damping=5.0), jb.Support(0.9)]
    sensors = [jb.Sensor(x) for x in (0.2, 0.6, 1.15)]
    loads = [
        jb.MovingMass(mass=0.3, speed=2.5, entry_time=0.02, deceleration=2.0),
        jb.MovingMass(mass=0.2, speed=-3.0, entry_time=0.1),
    ]
    case = jb.Case(beam, supports, (), sensors, loads, run=jb.Run(0.8, gravity=GRAVITY))
    times = np.linspace(0, 0.8, 161)
    oracle_loads = [Load(0.3, 2.5, 0.02, 2.0), Load(0.2, -3.0, 0.1)]
    elements = as_oracle(case, elements=80)
    elements = dataclasses.replace(elements, damping_ratio=0.02)
    sensor_positions = [0.2, 0.6, 1.15]
    solved = crossing.respond(elements, oracle_loads, sensor_positions, times, modes=4, rtol=1e-9)
    yield Check(
        "two masses at once, one braking, one from the right, over an elastic support and a tip",
        "80 Hermite elements, scipy DOP853",
        max_relative_error(jb.simulate(case, jnp.asarray(times)).deflection, solved.deflection),
        1e-4,
    )


def energy() -> Iterator[Check]:
    """Energy balance of a crossing."""
    # 12 nodes in each interval integrate squares of the highest mode.
    intervals = np.linspace(0, 0.3, 121)
    nodes, weights = np.polynomial.legendre.leggauss(12)
    half = np.diff(intervals) / 2
    inner = (intervals[:-1] + half)[:, None] + half[:, None] * nodes
    times = np.concatenate([[0.0], inner.ravel(), [0.3 - 1e-12]])
    quadrature = np.concatenate([[0.0], np.outer(half, weights).ravel(), [0.0]])
    record = jb.simulate(single_span_case(duration=0.3), jnp.asarray(times), tolerance=1e-9)
    q, u = np.asarray(record.coordinates), np.asarray(record.rates)
    stored = np.sum(u**2 + SPAN.frequencies**2 * q**2, axis=1)[-1] / 2
    contact_velocity = np.sum(u * record.modes.shapes(record.load_position[:, 0]), axis=1)
    work = quadrature @ (-record.contact_force[:, 0] * contact_velocity)
    dissipated = quadrature @ np.sum(2 * SPAN.damping_ratio * SPAN.frequencies * u**2, axis=1)
    yield Check(
        f"stored and dissipated energy of a crossing (dissipated: {dissipated / work:.0%})",
        "work of the contact force, by Gauss quadrature",
        max_entrywise_error(stored + dissipated, work),
        1e-7,
    )


def gradients() -> Iterator[Check]:
    """Derivatives of peaks by numbers of the beam, the load and a sensor."""
    case = single_span_case()
    free = (
        "beam.flexural_rigidity",
        "beam.damping_ratio",
        "loads.0.mass",
        "loads.0.speed",
        "sensors.0.position",
    )
    scales = jnp.array([jb.addresses(case)[address] for address in free])
    plan = integration_plan(case, None, 1e-9)

    @jax.jit
    def peaks(point):
        changed = jb.replace(case, dict(zip(free, point * scales, strict=True)))
        return jb.simulate(changed, plan=plan).peak_deflection

    one = jnp.ones(len(free))
    expected = central(peaks, one)
    for mode, jacobian in (("forward", jax.jacfwd), ("reverse", jax.jacrev)):
        yield Check(
            f"derivatives of 3 peaks by 5 numbers, {mode} mode",
            "central differences of order 6",
            max_relative_error(jax.jit(jacobian(peaks))(one), expected),
            1e-6,
        )
