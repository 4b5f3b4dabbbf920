"""Displacement feedback of two spans: the oracle against a reference, and runs against both."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.simulation.closed_loop import loop_schedule
from jaxbeam.simulation.integration_plan import IntegrationPlan, static_shapes
from tests.loop_as_oracle import expected, parts_of
from tests.modules import DATA
from tests.oracles import closed_loop
from tests.oracles.two_spans import ProjectedSines, TwoSpans

REFERENCE = json.loads((DATA / "two_spans.json").read_text())
STARTS = (0.2575, 0.8575)


def beam_case(
    controller=None, cutoff=None, modes=7, speed=0.4, rigidity=12.11, density=0.5411, **run
):
    """Two spans, each with a patch and a sensor in the middle, and the heaviest mass."""
    filter = None if cutoff is None else jb.Filter(cutoff, 10, realisation="analogue")
    moment = REFERENCE["moment_per_volt"]
    return jb.Case(
        jb.Beam(1.2, rigidity, density, 0.03, modes=modes),
        [jb.Support(0.6)],
        [jb.Patch(x, x + 0.085, moment, amplifier_gain=200.0) for x in STARTS],
        [jb.Sensor(0.3, filter=filter), jb.Sensor(0.9, filter=filter)],
        [jb.MovingMass(mass=0.509, speed=speed)],
        controller,
        jb.Run(**({"duration": 3.0, "sample_rate": 100.0} | run)),
    )


CUBIC = jb.Feedback([2e9, 2e9], 3)


def by_sines(case, times):
    """Motion of a case by the oracle in the basis of the reference, in continuous time."""
    sines = ProjectedSines(1.2, 12.11, 0.5411, 8, 0.03)
    _, loads, actuators, sensors = parts_of(case)

    def law(readings, *_):
        return np.zeros(2) if case.controller is None else -2e9 * readings**3

    return closed_loop.respond(sines, loads, actuators, sensors, law, times)


def test_modes_of_the_oracle():
    sines = ProjectedSines(1.2, 12.11, 0.5411, 8)
    assert_allclose(sines.frequencies / (2 * np.pi), REFERENCE["frequencies_hz"], rtol=1e-10)
    force_shapes = [sines.shapes(x, 1) - sines.shapes(x + 0.085, 1) for x in STARTS]
    compliance = [sines.shapes(x) / sines.frequencies**2 for x in (0.3, 0.9)]
    lift = REFERENCE["moment_per_volt"] * np.array(compliance) @ np.array(force_shapes).T
    assert_allclose(lift, REFERENCE["static_m_per_V"], rtol=1e-10)
    exact = TwoSpans(1.2, 12.11, 0.5411, 7)
    points, weights = np.polynomial.legendre.leggauss(80)
    halves = [0.3 * (points + 1), 0.6 + 0.3 * (points + 1)]
    for order, size in ((0, 0.5411), (2, 12.11)):  # orthonormal in mass, and stiffness is omega^2
        shapes = np.array([[exact.shapes(x, order) for x in half] for half in halves])
        found = size * 0.3 * np.einsum("hxm,x,hxn->mn", shapes, weights, shapes)
        expected_product = np.eye(7) if order == 0 else np.diag(exact.frequencies**2)
        tolerance = 1e-9 * np.max(expected_product)
        assert_allclose(found, expected_product, rtol=1e-9, atol=tolerance)
    # Slope and curvature are continuous at the support.
    for order in (0, 1, 2):
        left, right = (exact.shapes(0.6 + d, order) for d in (-1e-12, 1e-12))
        assert_allclose(left, right, atol=1e-6 * np.max(np.abs(exact.shapes(0.3, order))))


@pytest.mark.parametrize("name", ["open loop", "filtered cubic law"])
def test_oracle_against_the_reference(name):
    reference = REFERENCE[name]
    case = beam_case() if name == "open loop" else beam_case(CUBIC, 20.0)
    found = by_sines(case, np.append(0.0, reference["t"]))
    assert_allclose(1e3 * found.deflection[1:], reference["w_mm"], rtol=0, atol=1e-8)
    assert_allclose(200 * found.command[1:], reference["V_patch"], rtol=0, atol=1e-5)


@pytest.fixture(scope="module")
def filtered():
    return jb.simulate(beam_case(CUBIC, 20.0), tolerance=1e-6)


def test_runs_against_the_reference(filtered):
    """To 4e-3: modes are exact, those of the reference projected sines, up to 5e-3 stiffer."""
    reference, uncontrolled_reference = REFERENCE["filtered cubic law"], REFERENCE["open loop"]
    largest = max(reference["peak_down_mm"])
    samples = np.round(np.array(reference["t"]) * 100).astype(int)
    assert_allclose(
        1e3 * filtered.deflection[samples], reference["w_mm"], rtol=0, atol=4e-3 * largest
    )
    assert_allclose(1e3 * filtered.peak_deflection, reference["peak_down_mm"], rtol=4e-3)
    assert_allclose(200 * np.max(filtered.command, axis=0), reference["V_max"], rtol=0.015)
    uncontrolled = 1e3 * np.asarray(jb.simulate(beam_case(), tolerance=1e-6).peak_deflection)
    assert_allclose(uncontrolled, uncontrolled_reference["peak_down_mm"], rtol=4e-3)
    # The reductions are closer, as both peaks have the same error.
    reduction, reference_reduction = (
        1 - np.divide(*pair)
        for pair in (
            (1e3 * np.asarray(filtered.peak_deflection), uncontrolled),
            (reference["peak_down_mm"], uncontrolled_reference["peak_down_mm"]),
        )
    )
    assert_allclose(reduction, reference_reduction, atol=2e-3)


@pytest.mark.parametrize("sampled", [False, True])
def test_loops_of_two_spans_against_the_oracle(sampled):
    """Each sensor to its patch, with filters; if sampled, with delay and active limits."""
    law = CUBIC
    if sampled:
        law = jb.Feedback([4e3, 3e3], higher_gains=[[4e9, 2e9]], period=0.01, delay=0.003)
    case = beam_case(law, 20.0, modes=5, speed=2.0, duration=0.7)
    if sampled:
        patches = tuple(
            dataclasses.replace(patch, limits=jnp.array([-1.0, 3.0])) for patch in case.actuators
        )
        case = dataclasses.replace(case, actuators=patches)
    times = np.arange(71) / 100
    plan = IntegrationPlan(static_shapes(case), 16, 0, False, 0.0, loop_schedule(case, times))
    record = jb.simulate(case, jnp.asarray(times), plan)
    truth = expected(case, times)
    if sampled:
        assert np.max(truth.command) == 3.0
    for found, true in ((record.deflection, truth.deflection), (record.command, truth.command)):
        assert_allclose(found, true, rtol=0, atol=1e-7 * np.max(np.abs(true)))
