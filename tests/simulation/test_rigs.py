"""Cases of many parts against finite elements, mirror images and the reference implementation."""

import dataclasses
import json
import tomllib

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.files.case_file import case_from_dict
from tests.differences import assert_close, load_of, plan_of
from tests.modules import DATA
from tests.oracles import crossing, finite_elements
from tests.oracles.crossing import GRAVITY, Load

pytestmark = pytest.mark.filterwarnings(  # the model is bilateral, the oracles too
    "ignore::jaxbeam.simulation.simulate.ContactLossWarning"
)

REFERENCE = json.loads((DATA / "reference_cases.json").read_text("utf-8"))


@pytest.mark.parametrize("reference", REFERENCE, ids=lambda reference: reference["title"])
def test_reference_cases(reference):
    record = jb.simulate(case_from_dict(tomllib.loads(reference["case_toml"])))
    assert_allclose(record.modes.frequencies, reference["natural_frequencies_hz"], rtol=1e-9)
    deflection = record.deflection[np.array(reference["sample_index"])]
    assert_close(deflection, reference["deflection_m"], 1e-7)
    largest = reference["largest_sampled_abs_deflection_m"]
    assert_allclose(np.max(np.abs(record.deflection), axis=0), largest, rtol=1e-6)
    assert np.all(record.peak_deflection >= np.array(largest) * (1 - 1e-9))


GENERAL = finite_elements.Beam(
    length=1.3,
    flexural_rigidity=12.0,
    mass_per_length=0.7,
    ends="guided-free",
    supports=[
        finite_elements.Support(0.3, 5000.0, 6.0, 3.0),
        finite_elements.Support(0.78),
        finite_elements.Support(1.1, 2000.0, 4.0),
    ],
    patches=[finite_elements.Patch(0.4, 0.6, 5.0, 0.4)],
    suspensions=[finite_elements.Suspension(0.52, 3000.0, 25.0)],
    damping_ratio=[0.01, 0.03, 0.02, 0.01],
    elements=130,
)


def case_on(beam: finite_elements.Beam, loads: list[Load], modes: int, sensors) -> jb.Case:
    """Case of a finite-element beam."""
    return jb.Case(
        jb.Beam(
            beam.length,
            beam.flexural_rigidity,
            beam.mass_per_length,
            beam.damping_ratio,
            beam.ends,
            modes,
        ),
        supports=[jb.Support(**vars(support)) for support in beam.supports],
        actuators=[
            *(
                jb.Patch(
                    p.start,
                    p.end,
                    1e-3,
                    added_mass=p.mass_per_length,
                    added_rigidity=p.flexural_rigidity,
                )
                for p in beam.patches
            ),
            *(jb.Shaker(s.position, s.stiffness, s.damping) for s in beam.suspensions),
        ],
        sensors=[jb.Sensor(x) for x in sensors],
        loads=[load_of(load) for load in loads],
        run=jb.Run(1.0, gravity=GRAVITY),
    )


def mirrored(beam: finite_elements.Beam) -> finite_elements.Beam:
    """Mirror image of the beam."""

    def flip(parts, *names):
        positions = [{n: beam.length - getattr(part, n) for n in names} for part in parts]
        return [dataclasses.replace(p, **x) for p, x in zip(parts, positions, strict=True)]

    return dataclasses.replace(
        beam,
        ends="-".join(reversed(beam.ends.split("-"))),
        supports=flip(beam.supports, "position"),
        patches=[
            dataclasses.replace(p, start=beam.length - p.end, end=beam.length - p.start)
            for p in beam.patches
        ],
        suspensions=flip(beam.suspensions, "position"),
    )


def test_general_case_agrees_with_finite_elements_and_mirror_image():
    """Unequal spans, elastic and damped supports, patch, suspension; masses in both directions."""
    loads = [Load(0.3, 2.5, 0.02, deceleration=4.0), Load(0.2, -3.0, 0.1, deceleration=-1.0)]
    times, sensors = np.linspace(0.0, 0.8, 81), np.array([0.2, 0.6, 1.3])
    case = case_on(GENERAL, loads, 4, sensors)
    record = jb.simulate(case, jnp.asarray(times), plan_of(case))
    expected = crossing.respond(GENERAL, loads, sensors, times, modes=4, rtol=1e-9)
    assert_close(record.deflection, expected.deflection, 2e-6)
    assert_close(record.velocity, expected.velocity, 1e-4)
    assert_close(record.contact_force, expected.contact_force, 1e-4)

    reversed_loads = [dataclasses.replace(load, speed=-load.speed) for load in loads]
    other = case_on(mirrored(GENERAL), reversed_loads, 4, GENERAL.length - sensors)
    image = jb.simulate(other, jnp.asarray(times), plan_of(other))
    assert_close(image.deflection, record.deflection, 1e-9)
    assert_close(image.contact_force, record.contact_force, 1e-8)
    assert_allclose(image.load_position, GENERAL.length - record.load_position, rtol=1e-12)


SPRINGS = [finite_elements.Support(x, 3000.0, 5.0) for x in (0.2, 0.9)]


@pytest.mark.parametrize(
    ("ends", "supports", "speed"),
    [
        ("clamped-free", [], 4.0),  # exit at the free end
        ("clamped-free", [], -4.0),  # entry at the free end
        ("free-free", SPRINGS, 3.0),
        ("clamped-guided", [], 5.0),
        ("free-pinned", [SPRINGS[0]], -3.0),
    ],
)
def test_all_end_conditions_agree_with_finite_elements(ends, supports, speed):
    """Deflection and contact force."""
    beam = finite_elements.Beam(
        1.2, 12.0, 0.7, ends, supports=supports, damping_ratio=0.02, elements=100
    )
    loads, times, sensors = [Load(0.3, speed, 0.02)], np.linspace(0.0, 0.8, 81), [0.5, 1.2]
    case = case_on(beam, loads, 3, sensors)
    record = jb.simulate(case, jnp.asarray(times), plan_of(case))
    expected = crossing.respond(beam, loads, sensors, times, modes=3, rtol=1e-9)
    assert_close(record.deflection, expected.deflection, 2e-6)
    assert_close(record.contact_force, expected.contact_force, 1e-4)
