"""What finite elements were made of comes back: more modes, yielding supports, coloured noise.

The plant is the finite-element beam with twelve modes, integrated by scipy; the model that is
fitted to its readings keeps six or eight. Numbers are fitted alone, the others known, and all
together. A model that is wrong must say so.
"""

import dataclasses

import numpy as np
import pytest
import scipy.signal
import scipy.stats

import jaxbeam as jb
from jaxbeam.case import replace
from tests.oracles import crossing, finite_elements
from tests.oracles.loads import Load
from tuning import Log
from tuning.campaign import prepare
from tuning.free import free_numbers
from tuning.identify import fit_of
from tuning.search import Search
from tuning.uncertainty import reach

RATE, NOISE, MEMORY = 100.0, 1e-5, 0.5  # Hz, m, correlation from sample to sample
YIELDING, SAGGING = 1e6, 4e4  # N/m: under 0.5 kg by half the noise, and by twelve times the noise
MOMENT, AMPLIFIER = 8.292e-4, 200.0  # N m/V
WIDE = 3 / 1.96  # half widths in three standard errors
FEWEST = 4  # numbers of the smallest rig
SHAKER = {"position": 0.5, "stiffness": 3500.0, "damping": 80.0, "force_per_volt": 4.6}
LAG = 1e-4  # s, of the force behind the voltage: the first order of its lag


@dataclasses.dataclass(frozen=True)
class Plant:
    """A rig as finite elements, its load and commands, and the case with the true numbers."""

    beam: finite_elements.Beam
    case: jb.Case
    truth: dict[str, float]

    def readings(self, times, commands):
        """Deflections (time, sensor) in m; commands (time, actuator) are joined by lines."""
        model = finite_elements.assemble(self.beam)
        rows = [self._row(model, actuator) for actuator in self.case.actuators]

        def force(t):
            columns = zip(rows, commands.T, strict=True)
            return sum(row * np.interp(t - late, times, column) for (row, late), column in columns)

        (load,) = self.case.loads
        run = crossing.respond(
            self.beam,
            [Load(float(load.mass), float(load.speed), float(load.entry_time))],
            [float(sensor.position) for sensor in self.case.sensors],
            times,
            modes=12,
            force=force,
            rtol=1e-7,
            atol=1e-10,
        )
        return run.deflection

    def _row(self, model, actuator):
        """Nodal forces per volt, and how late (s) they are."""
        if isinstance(actuator, jb.Shaker):
            return float(actuator.force_per_volt) * model.shape(float(actuator.position)), LAG
        moment = MOMENT * float(actuator.correction) * AMPLIFIER
        return moment * model.patch_row(float(actuator.start), float(actuator.end)), 0.0


def patch(start: float, correction: float) -> jb.Patch:
    return jb.Patch(
        start,
        start + 0.085,
        moment_per_volt=MOMENT,
        correction=correction,
        amplifier_gain=AMPLIFIER,
    )


def plant(spans, rigidity, density, actuators, suspensions, supports, places, modes) -> Plant:
    """A beam over spans of 0.6 m, crossed by 0.5 kg at 2 m/s."""
    length, damping = 0.6 * spans, 0.03
    ends = "free-free" if spans == 1 else "pinned-pinned"
    beam = finite_elements.Beam(
        length,
        rigidity,
        density,
        ends=ends,
        supports=[finite_elements.Support(*support) for support in supports.items()],
        suspensions=suspensions,
        damping_ratio=damping,
        elements=24 * spans,
    )
    case = jb.Case(
        jb.Beam(
            length=length,
            flexural_rigidity=rigidity,
            mass_per_length=density,
            damping_ratio=damping,
            ends=ends,
            modes=modes,
        ),
        supports=[jb.Support(x, stiffness=stiffness) for x, stiffness in supports.items()],
        actuators=actuators,
        sensors=[jb.Sensor(x) for x in places],
        loads=[jb.MovingMass(mass=0.5, speed=2.0, entry_time=0.02)],
    )
    truth = {
        "beam.flexural_rigidity": rigidity,
        "beam.mass_per_length": density,
        "beam.damping_ratio": damping,
    }
    for i, stiffness in enumerate(supports.values()):
        truth |= {f"supports.{i}.stiffness": stiffness} if stiffness == SAGGING else {}
    for i, actuator in enumerate(actuators):
        names = ("correction",) if isinstance(actuator, jb.Patch) else tuple(SHAKER)[1:]
        truth |= {f"actuators.{i}.{name}": float(getattr(actuator, name)) for name in names}
    return Plant(beam, case, truth)


PLANTS = {
    "one span, shaker": plant(
        1,
        11.68,
        0.535,
        [jb.Shaker(**SHAKER)],
        [finite_elements.Suspension(*list(SHAKER.values())[:3])],
        {0.0: YIELDING, 0.6: YIELDING},
        (0.15, 0.35),
        modes=6,
    ),
    "one span, patch": plant(
        1,
        13.211,
        0.812,
        [patch(0.2575, 0.32)],
        [],
        {0.0: YIELDING, 0.6: YIELDING},
        (0.2, 0.3),
        modes=6,
    ),
    "two spans, patches": plant(
        2,
        12.277,
        0.7924,
        [patch(0.2575, 0.39), patch(0.8575, 0.68)],
        [],
        {0.6: SAGGING},
        (0.3, 0.9),
        modes=8,
    ),
}


def coloured(shape, seed):
    """First-order noise (time, sensor) of standard deviation `NOISE`."""
    white = np.random.default_rng(seed).normal(size=shape)
    filtered = scipy.signal.lfilter([np.sqrt(1 - MEMORY**2)], [1, -MEMORY], white, axis=0)
    return NOISE * np.asarray(filtered)


class Rehearsal:
    """Readings of a plant, and one compiled search for all its numbers."""

    def __init__(self, made: Plant):
        self.truth, count = made.truth, len(made.case.actuators)
        times = np.arange(round(0.8 * RATE)) / RATE
        phases = 90.0 * np.arange(count)
        commands = np.stack(
            [2.0 * scipy.signal.chirp(times, 2.0, times[-1], 30.0, phi=phi) for phi in phases], 1
        )
        self.clean = made.readings(times, commands)
        sensors = self.clean.shape[1]
        log = Log(
            times,
            np.column_stack([self.clean, commands]),
            tuple(f"c{i}" for i in range(sensors + count)),
            ("deflection",) * sensors + ("voltage",) * count,
            ("m",) * sensors + ("V",) * count,
            actuators=(None,) * sensors + tuple(range(count)),
        )
        start = {address: 1.06 * value for address, value in made.truth.items()}
        campaign = prepare(replace(made.case, start), [log])
        scale = np.ptp(self.clean)
        self.numbers = free_numbers(campaign.cases, dict.fromkeys(made.truth), scale)
        self.search = Search(campaign, self.numbers)
        self.known = np.array([n.inward(made.truth[n.address]) for n in self.numbers])

    def fit(self, noise, free, held=None):
        """A fit of what is free, the other numbers `held`, or known."""
        measured = (self.clean + noise)[None]
        start = np.where(free, self.search.start, self.known if held is None else held)
        return self.search.estimate(measured, start=start, free=free)

    def errors(self, found, free):
        """Errors of what was free, in half widths of the stated intervals."""
        halves = reach(found.freedom) * found.uncertainty.errors[free]
        return (found.values[free] - np.array(list(self.truth.values()))[free]) / halves

    def account(self, noise, found):
        """What is said of the fit."""
        campaign = self.search.campaign
        fit = fit_of(campaign.cases[0], self.search, found)
        noisy = dataclasses.replace(campaign, measured=(self.clean + noise)[None])
        return str(dataclasses.replace(fit, campaign=noisy))


@pytest.fixture(scope="module", params=PLANTS)
def rehearsal(request) -> Rehearsal:
    return Rehearsal(PLANTS[request.param])


@pytest.mark.slow
def test_all_together_lie_within_their_intervals(rehearsal):
    """None further off than three standard errors, nor all together than one fit in a thousand."""
    free = np.ones(len(rehearsal.truth), bool)
    found = rehearsal.fit(coloured(rehearsal.clean.shape, seed=0), free)
    assert found.converged
    errors = rehearsal.errors(found, free)
    said = dict(zip(rehearsal.truth, errors, strict=True))
    assert np.all(np.abs(errors) < WIDE), said
    distance = errors @ np.linalg.solve(found.uncertainty.correlation, errors) * 1.96**2
    assert distance < scipy.stats.chi2.ppf(0.999, errors.size), said


@pytest.mark.slow
def test_each_alone_lies_within_its_interval(rehearsal):
    """Those of the beam, which all rigs have, on the rig with one patch only."""
    names = list(rehearsal.truth)
    own = ("actuators", "supports")
    wanted = [n for n in names if n.startswith(own) or len(names) == FEWEST]
    for seed, name in enumerate(wanted):
        free = np.array([n == name for n in names])
        found = rehearsal.fit(coloured(rehearsal.clean.shape, seed + 1), free)
        assert found.converged
        (error,) = rehearsal.errors(found, free)
        assert abs(error) < WIDE, (name, error)


@pytest.mark.slow
@pytest.mark.parametrize("rehearsal", ["one span, patch"], indirect=True)
def test_intervals_of_a_wrong_model_are_called_unreliable(rehearsal):
    """A beam taken for a tenth stiffer than it is puts the other numbers off; the fit says so."""
    noise = NOISE * np.random.default_rng(0).normal(size=rehearsal.clean.shape)
    free = np.array([name != "beam.flexural_rigidity" for name in rehearsal.truth])
    right = rehearsal.fit(noise, free)
    assert np.all(np.abs(rehearsal.errors(right, free)) < WIDE)
    assert right.converged and "unreliable" not in rehearsal.account(noise, right)
    known = np.array(list(rehearsal.truth.values()))
    stiffer = [n.inward(1.1 * value) for n, value in zip(rehearsal.numbers, known, strict=True)]
    wrong = rehearsal.fit(noise, free, np.array(stiffer))
    assert np.any(np.abs(rehearsal.errors(wrong, free)) > WIDE)
    assert "unreliable" in rehearsal.account(noise, wrong)
