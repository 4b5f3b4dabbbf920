"""Stated errors of time steps against runs of much shorter steps, for every quantity."""

import dataclasses

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.case.sensors import QUANTITIES
from jaxbeam.integrator.discrete_model import PEAK_NODES
from jaxbeam.integrator.peaks import RunningPeaks
from jaxbeam.integrator.step_size import UNSAMPLED, trial_positions
from jaxbeam.model.modal_model import modal_model
from jaxbeam.simulation.errors import interpolation_errors
from jaxbeam.simulation.integration_plan import AMPLIFICATION

TIGHT = 1e-9
TWISTING = (3, 5)  # seeds of a beam that twists


def sensors(length: float, twists: bool) -> list[jb.Sensor]:
    return [
        jb.Sensor(
            (0.21 + 0.06 * i) * length,
            name,
            fibre_distance=1e-3 if entry.at_fibre else None,
            section_modulus=1e-6 if entry.over_modulus else None,
        )
        for i, (name, entry) in enumerate(QUANTITIES.items())
        if twists or not entry.of_twist
    ]


def random_case(seed: int) -> jb.Case:
    """A mass and a vehicle on one or two spans; few samples, so that errors decide the steps."""
    rng, twists = np.random.default_rng(seed), seed in TWISTING
    length = rng.uniform(0.8, 1.5)
    beam = jb.Beam(
        length,
        flexural_rigidity=12.0,
        mass_per_length=0.5,
        damping_ratio=rng.uniform(0.0, 0.05),
        modes=5 if twists else 3,
        torsional_rigidity=1.0 if twists else None,
        polar_inertia=2e-4 if twists else None,
    )
    car = jb.QuarterCar(
        body_mass=0.3,
        axle_mass=0.05,
        suspension_stiffness=60.0,
        suspension_damping=0.4,
        tyre_stiffness=900.0,
        tyre_damping=0.1,
        speed=-rng.uniform(2.0, 6.0),
        eccentricity=0.01 if twists else None,
    )
    mass = jb.MovingMass(mass=rng.uniform(0.1, 0.6), speed=rng.uniform(2.0, 6.0))
    return jb.Case(
        beam,
        supports=[jb.Support(0.45 * length)] if seed % 2 else [],
        sensors=sensors(length, twists),
        loads=[mass, car],
        run=jb.Run(0.4, sample_rate=20.0),
    )


def with_feedback(case: jb.Case) -> jb.Case:
    gain = np.zeros((1, len(case.sensors)))
    gain[0, 0] = 30.0
    shaker = jb.Shaker(0.4, stiffness=0.0, damping=0.0, bandwidth=500.0)
    law = jb.OutputFeedback(gains=gain, period=0.005)
    return dataclasses.replace(case, actuators=(shaker,), controller=law)


def true_errors(coarse: jb.Record, fine: jb.Record) -> np.ndarray:
    """Errors of the samples and of the extremes of each sensor, relative to its largest value."""
    errors = []
    for i, sensor in enumerate(coarse.case.sensors):
        own = sensor.position, sensor.quantity, sensor.fibre_distance, sensor.section_modulus
        values = [
            np.array([*record.at(*own), record.smallest[i], record.largest[i]])
            for record in (coarse, fine)
        ]
        errors.append(np.max(np.abs(values[0] - values[1])) / np.max(np.abs(values[1])))
    return np.array(errors)


def error_along(coarse: jb.Record, fine: jb.Record) -> float:
    """Error of the samples along the beam, relative to the largest deflection."""
    rows = coarse.modes.shapes(np.linspace(0.0, 1.0, 41) * float(coarse.case.beam.length))
    known, exact = (np.asarray(each.coordinates) @ np.asarray(rows).T for each in (coarse, fine))
    return float(np.max(np.abs(known - exact)) / np.max(np.abs(exact)))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
def test_stated_errors_are_no_smaller_than_the_true_ones(seed):
    case = random_case(seed)
    coarse, fine = jb.simulate(case, tolerance=1e-4), jb.simulate(case, tolerance=TIGHT)
    found, stated = true_errors(coarse, fine), np.asarray(coarse.step_errors)
    assert np.all(found <= stated + 100 * TIGHT)
    # No bound so wide that it says nothing: the steps are those of the trial. It had been 1500.
    assert np.all(stated < 0.05)
    assert np.median(stated / np.maximum(found, TIGHT)) < 20


# Heavy masses that enter at 15 times the critical speed and brake to a stop on the beam.
SHARP = {
    "span": jb.Case(
        jb.Beam(2.0, 50.0, 1.5, damping_ratio=0.1, modes=2),
        sensors=[jb.Sensor(1.0)],
        loads=[
            jb.MovingForce(
                mass=73.6230365, speed=7.66807974, entry_time=0.0441063116, deceleration=29.3997234
            ),
            jb.MovingMass(mass=18.2445724, speed=-83.7432456, deceleration=3506.46559),
        ],
        run=jb.Run(0.5576913, sample_rate=107.58),
    ),
    "free beam": jb.Case(
        jb.Beam(2.0, 50.0, 1.5, damping_ratio=0.01, modes=4, ends="free-free"),
        sensors=[jb.Sensor(1.94)],
        loads=[
            jb.MovingMass(mass=14.4509708, speed=-1.67806957, deceleration=2.3465979),
            jb.MovingForce(mass=0.382539621, speed=-1.67806957, deceleration=1.40795874),
            jb.MovingMass(
                mass=179.594903, speed=-81.3974196, entry_time=0.308744181, deceleration=1840.42775
            ),
        ],
        run=jb.Run(1.235952, sample_rate=48.54),
    ),
    # Two steps between entry and stop in the trial, one of nearly the same length per sample.
    "samples that are far apart": jb.Case(
        jb.Beam(2.0, 50.0, 1.5, damping_ratio=0.01, modes=3, ends="free-free"),
        sensors=[jb.Sensor(0.12)],
        loads=[
            jb.MovingForce(mass=9.7021, speed=-8.195374, deceleration=33.58208),
            jb.MovingMass(mass=0.3657084, speed=72.732108, deceleration=1469.4332),
            jb.MovingForce(mass=2.555675, speed=-72.732108, deceleration=2644.97976),
        ],
        run=jb.Run(1.12616635, sample_rate=53.278),
    ),
    # One step between entry and stop, in the trial as in the run, whose other steps are shorter.
    "one step for both": jb.Case(
        jb.Beam(2.0, 50.0, 1.5, modes=1, ends="free-free"),
        sensors=[jb.Sensor(1.0)],
        loads=[jb.MovingMass(mass=18.2395, speed=-84.4264, deceleration=5939.85)],
        run=jb.Run(4.636, sample_rate=12.943),
    ),
}


@pytest.mark.parametrize("name", SHARP)
@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
def test_a_change_that_is_small_by_chance_is_not_the_stated_error(name):
    """Stated errors had been a fifth to a fourteenth: the steps of a run begin elsewhere."""
    record, exact = (jb.simulate(SHARP[name], tolerance=t) for t in (1e-7, 1e-10))
    assert np.all(true_errors(record, exact) <= record.step_errors)
    # As each of these is that of the steps of the run itself, it is no wider than it must be.
    assert error_along(record, exact) <= record.error_estimate <= 1e-7
    assert record.error_estimate <= 4 * error_along(record, exact)


@pytest.mark.parametrize(
    ("name", "tolerance", "amplification"),
    [
        ("one step for both", 1e-3, AMPLIFICATION),  # one trial, of the commands of the loop
        ("one step for both", 1e-5, 1.0),
        ("samples that are far apart", 1e-7, 1.0),
        ("span", 1e-7, 1.0),
    ],
)
@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
def test_the_stated_error_of_a_run_under_commands(name, tolerance, amplification):
    """That of its own steps, at most twice as wide again, and what a law may make of it."""
    command = jb.Prescribed([3.0], period=0.02)
    case = dataclasses.replace(SHARP[name], actuators=(jb.PointForce(0.4),), controller=command)
    record, exact = (jb.simulate(case, tolerance=t) for t in (tolerance, 1e-10))
    stated = record.error_estimate / amplification
    assert error_along(record, exact) <= stated <= 2.5 * error_along(record, exact)


@pytest.mark.parametrize("ends", ["pinned-pinned", "free-free", "clamped-free"])
@pytest.mark.parametrize("modes", [1, 4, 24])
def test_a_deflection_that_is_large_in_one_place_is_seen_by_a_trial(modes, ends):
    """Such errors of higher modes, where a mass leaves, had been twice the stated ones."""
    beam = jb.Beam(2.0, 50.0, 1.5, modes=modes, ends=ends)
    case = jb.Case(beam, loads=[jb.MovingMass(mass=1.0, speed=1.0)])
    shapes = modal_model(case).modes.shapes
    trial, places = shapes(trial_positions(case)), shapes(np.linspace(0.01, 1.99, 397))
    seen, largest = (np.max(np.abs(rows @ places.T), axis=0) for rows in (trial, places))
    assert np.all(UNSAMPLED * seen >= largest)


@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
def test_errors_of_a_sampled_loop():
    case = with_feedback(random_case(2))
    coarse, fine = jb.simulate(case, tolerance=1e-4), jb.simulate(case, tolerance=TIGHT)
    assert np.abs(coarse.command).max() > 0
    found, stated = true_errors(coarse, fine), np.asarray(coarse.step_errors)
    assert np.all(found <= stated + 100 * TIGHT)


@pytest.mark.parametrize("half_phase", [0.5, 1.0, 2.0, 4.0])
def test_errors_of_interpolants_are_stated_at_1_4_to_2_8_of_their_size(half_phase):
    """Of cos(z s + c), a mode that turns by 2 z in a step, by its interpolant at 2001 positions."""
    model = modal_model(jb.Case(jb.Beam(0.6, 11.68, 0.535, modes=1)))
    length = 2 * half_phase / float(model.modes.angular_frequencies[0])
    nodes, c = 2 * np.array(PEAK_NODES) - 1, np.linspace(0.0, np.pi, 37)
    samples = np.cos(half_phase * nodes[:, None] + c)
    none, alone = np.zeros((1, 37)), np.zeros((0, 37))
    found = RunningPeaks(
        *(none, samples[:, None], none, np.full((1, 37), length)),
        *(alone, alone, np.ones(37, bool), abs),
    )
    s = np.linspace(-1.0, 1.0, 2001)
    polynomials = np.linalg.solve(np.vander(nodes), samples)
    true = np.max(
        np.abs(np.vander(s, nodes.size) @ polynomials - np.cos(half_phase * s[:, None] + c)), axis=0
    )
    ratios = np.asarray(interpolation_errors(model, found))[0] / true
    assert np.min(ratios) >= 1.4 and np.max(ratios) <= 2.8
