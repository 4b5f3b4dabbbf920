"""Checks of beams and crossings: frequencies, statics, deflections, energy and derivatives.

The closed forms, finite elements and scipy solutions of `tests/oracles` share no code with jaxbeam.
"""

import dataclasses
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

import jaxbeam as jb
from experiments.validation.check import Check, max_entrywise_error, max_relative_error
from jaxbeam.model.statics import static_peak
from jaxbeam.simulation.integration_plan import integration_plan
from tests.adaptive_reference import simulate_adaptive
from tests.as_oracle import as_oracle
from tests.differences import central
from tests.oracles import crossing, modal_equations
from tests.oracles.closed_forms import (
    CHARACTERISTIC,
    critical_speed,
    influence_line,
    moving_force,
    single_span_parameters,
    two_span_parameters,
)
from tests.oracles.exact_frequencies import exact_frequencies
from tests.oracles.loads import GRAVITY, Load
from tests.oracles.modal_equations import Span

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
    adaptive = simulate_adaptive(case, jnp.asarray(times))
    yield Check(
        "moving mass, deflection",
        "mass-matrix form in the modes of jaxbeam, scipy DOP853",
        max_relative_error(record.deflection, adaptive.deflection),
        1e-6,
    )
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
