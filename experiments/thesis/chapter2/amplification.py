"""Moving masses and moving forces: Figs 2.23 to 2.27.

Amplification is the largest dynamic over the largest static deflection at a midspan; free vibration
after the exit counts. The maps show where a mass would have to pull on the beam to stay on it.
"""

import dataclasses
import warnings
from typing import NamedTuple

import numpy as np

import jaxbeam as jb
from experiments.thesis import published
from experiments.thesis.beams import (
    as_force,
    critical_speed,
    one_span,
    two_spans,
    watched,
    with_modes,
)
from experiments.thesis.chapter2.amplification_plot import draw_curves, draw_histories, draw_map
from experiments.thesis.verdicts import Experiment, Outcome, finding
from jaxbeam.model.statics import static_peak
from jaxbeam.simulation.simulate import ContactLossWarning

MASSES = np.append(np.linspace(0.05, 0.6, 18), [0.26, 0.261, 0.5])  # kg; also those printed
ONE_RATIOS = np.append(np.geomspace(0.05, 0.2, 9)[:-1], np.linspace(0.2, 1.2, 21))
TWO_RATIOS = np.append(np.geomspace(0.05, 0.2, 9)[:-1], np.linspace(0.2, 2.0, 37))
DURATION = 1.0  # s: the slowest crossing, and free vibration after all others
TOLERANCE = 1e-4  # relative, of peaks
MATTERS = 0.02  # by so much must twice the modes change an amplification that means nothing
ON = "while the load is on the beam"
SHAKER, SPRING = 0.5, 12000.0  # m and N/m: the shaker that section 2.3 names, without current
SPRUNG = f"on the spring of the shaker, {SPRING:g} N/m, in ratios to its own critical speed"
DAMPING = 0.03
HERTZ, VOLTS = (2.0, 4.0), (0.0, 1.0, 2.0)


class Sweep(NamedTuple):
    """Amplification (mass, speed, place), and the lowest contact force in weights (mass, speed).

    `on_beam` is the amplification until the load leaves.
    """

    masses: np.ndarray
    ratios: np.ndarray
    amplification: np.ndarray
    on_beam: np.ndarray
    contact: np.ndarray

    def at(self, mass: float, ratio: float, place: int = 0) -> np.ndarray:
        """Amplification in the whole run and until the load leaves, at values swept over."""
        i, j = np.argmin(np.abs(self.masses - mass)), np.argmin(np.abs(self.ratios - ratio))
        return np.array([values[i, j, place] for values in (self.amplification, self.on_beam)])


def swept(case: jb.Case, masses, ratios) -> Sweep:
    """Amplification at the sensors over masses (kg) and speeds, in ratios to the critical one."""
    masses, ratios = np.sort(masses), np.asarray(ratios)
    speeds = critical_speed(case) * ratios
    mass, speed, on = (
        part.ravel() for part in np.meshgrid(masses, speeds, [False, True], indexing="ij")
    )
    crossing = float(case.beam.length) / speed
    axes = {
        "loads.0.mass": mass,
        "loads.0.speed": speed,
        "run.duration": np.where(on, crossing, np.maximum(DURATION, crossing)),
    }
    found = jb.sweep(case, axes, paired=True, progress=False, tolerance=TOLERANCE)
    places = np.array([float(sensor.position) for sensor in case.sensors])
    static = np.asarray(static_peak(jb.replace(case, {"loads.0.mass": 1.0}), places))
    peaks = found.peak_deflection.values.reshape(masses.size, ratios.size, 2, places.size)
    ratio = peaks / (static * masses[:, None, None, None])
    contact = found.lowest_contact_force.values.reshape(masses.size, ratios.size, 2).min(axis=2)
    weights = masses[:, None] * float(case.run.gravity)
    return Sweep(masses, ratios, ratio[:, :, 0], ratio[:, :, 1], contact / weights)


def run(load) -> Outcome:
    """Amplifications of one and two spans by masses and forces, and their histories."""
    one = watched(one_span(load), 0.3, duration=DURATION)
    two = watched(two_spans(load), 0.3, 0.9, duration=DURATION)
    undamped = jb.replace(two, {"beam.damping_ratio": 0.0})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)  # the maps show it
        mass_one, mass_two = swept(one, MASSES, ONE_RATIOS), swept(two, MASSES, TWO_RATIOS)
        force_one, force_two = (
            swept(as_force(case), [1.0], ratios)
            for case, ratios in ((one, ONE_RATIOS), (two, TWO_RATIOS))
        )
        yang = swept(as_force(undamped), [1.0], TWO_RATIOS[:24])
        finer = swept(with_modes(two, 16), [0.261], [0.45, 1.75])
        sprung = _on_spring(one)
        history, figures = _histories(load)
    yang = np.array([values[0].max(axis=0) for values in (yang.amplification, yang.on_beam)])
    single = [force_one.at(1.0, 0.7), mass_one.at(0.26, 0.5), mass_one.at(0.5, 0.75)]
    points = [(0.261, 0.45, 0), (0.261, 0.45, 1), (0.261, 1.75, 1)]
    double, fine = ([found.at(*point) for point in points] for found in (mass_two, finer))
    whole, on = _readings(single)
    findings = (
        *history,
        finding(
            published.ONE_SPAN, whole, on | {SPRUNG: sprung}, _scattered([whole, on[ON], sprung])
        ),
        *(
            finding(printed, *_readings(values), obstacle)
            for printed, values, obstacle in (
                (published.YANG, yang.T, ""),
                (published.TWO_SPANS, double, _meaningless(finer, double, fine)),
            )
        ),
    )
    two_words = "first midspan", "second midspan"
    figures |= {
        "fig-2-25": draw_curves(
            force_one, mass_one, ((0.26, 0, "0.26 kg"), (0.5, 0, "0.5 kg")), "Fig. 2.25"
        ),
        "fig-2-27": draw_curves(
            force_two,
            mass_two,
            [(0.261, i, word) for i, word in enumerate(two_words)],
            "Fig. 2.27, 0.261 kg",
        ),
        "map-one-span": draw_map(mass_one, ("midspan",), "one span, 3 modes"),
        "map-two-spans": draw_map(mass_two, two_words, "two spans, 8 modes"),
    }
    return Outcome(findings, figures)


def _on_spring(bare: jb.Case) -> np.ndarray:
    """Amplifications of Fig. 2.25 with the spring of the shaker below the beam."""
    case = dataclasses.replace(bare, supports=(jb.Support(SHAKER, stiffness=SPRING),))
    force = swept(as_force(case), [1.0], [0.7])
    mass = swept(case, [0.26, 0.5], [0.5, 0.75])
    found = force.amplification[0, 0], mass.amplification[0, 0], mass.amplification[1, 1]
    return np.array([value[0] for value in found])


def _scattered(readings) -> str:
    """Why no reading meets all numbers of Fig. 2.25, if each is met by one."""
    printed = published.ONE_SPAN
    near = np.abs(np.array(readings) - printed.numbers) <= printed.allowed
    if not near.any(axis=0).all() or near.all(axis=1).any():
        return ""
    return (
        "it is not told whether the beam had the shaker on it, nor until when peaks count: each"
        " number is met by one of these readings, but all by none"
    )


def _readings(values):
    whole, on = np.array(values).T
    return whole, {ON: on}


def _meaningless(finer: Sweep, coarse, fine) -> str:
    """Why amplifications say nothing: the mass has left the beam, and the modes kept matter."""
    change = np.max(np.abs(np.array(fine) / np.array(coarse) - 1))
    if finer.contact.max() > 0 or change < MATTERS:
        return ""
    worst = " and ".join(f"{-force:.0f}" for force in finer.contact[0])
    return (
        f"the mass would have to pull with {worst} times its weight to stay on the beam, which the"
        f" model lets it do; with 16 modes instead of 8 the amplification changes by {change:.0%}"
    )


def _histories(load):
    """Rig D and slow crossings, by a mass and by a force: Figs 2.23, 2.24 and 2.26."""
    literature = load("D")
    ratio, between, mass, force = _afterwards(literature)
    damped, _, _, _ = _afterwards(jb.replace(literature, {"beam.damping_ratio": DAMPING}))
    reversed_by = 180.0 * (between > 90)

    shaken = watched(load("A"), 0.25, duration=1.0)
    shaken = jb.replace(shaken, {"loads.0.mass": 0.509, "loads.0.speed": 0.9})
    apart = [_apart(shaken, volts) for volts in VOLTS]
    fast = watched(two_spans(load), 0.75, duration=0.8)
    fast = jb.replace(fast, {"loads.0.mass": 0.261, "loads.0.speed": 3.0})
    pairs = {
        "rig D, midspan (Fig. 2.23)": (mass, force),
        "two spans at 0.75 m, 0.261 kg at 3 m/s (Fig. 2.26)": (
            jb.simulate(fast),
            jb.simulate(as_force(fast)),
        ),
    }
    findings = (
        finding(
            published.FREE_RATIO,
            ratio,
            {f"damping ratio {DAMPING:g}, as for all rigs of the thesis": damped},
        ),
        finding(published.FREE_PHASE, between, {"in phase or opposed, no more": reversed_by}),
        finding(published.FORCE_LESS, apart[0], obstacle=_unknown_voltage(apart)),
    )
    return findings, {"histories": draw_histories(pairs)}


def _afterwards(case: jb.Case):
    """Free vibration after the exit: amplitude of a force over that of a mass, and the phase
    (degree) between both; and the runs, of the mass and of the force."""
    mass, force = (jb.simulate(one) for one in (case, as_force(case)))
    after = np.asarray(mass.times) > float(case.beam.length / case.loads[0].speed)
    free = [np.abs(np.asarray(run.deflection)[after]).max() for run in (force, mass)]
    omega = 2 * np.pi * float(mass.modes.frequencies[0])
    phases = [
        np.angle(float(run.coordinates[-1, 0]) - 1j * float(run.rates[-1, 0]) / omega)
        for run in (force, mass)
    ]
    between = np.degrees(np.abs(np.angle(np.exp(1j * (phases[0] - phases[1])))))
    return free[0] / free[1], between, mass, force


def _apart(case: jb.Case, volts: float) -> float:
    """By how much (mm) the peaks of a mass and of a force differ while the shaker is driven."""
    sines = jb.Prescribed(offsets=[0.0], amplitudes=[[volts, volts]], frequencies=HERTZ)
    driven = dataclasses.replace(case, controller=sines)
    peaks = [float(jb.simulate(one).peak_deflection[0]) for one in (driven, as_force(driven))]
    return 1e3 * abs(peaks[0] - peaks[1])


def _unknown_voltage(apart) -> str:
    """Why a difference says nothing that any voltage could have made; empty if none could."""
    if not apart[0] < published.FORCE_LESS.numbers[0] < max(apart):
        return ""
    return (
        f"the voltage is not printed, and a mass that the shaker moves pushes back: sines of"
        f" {HERTZ[0]:g} and {HERTZ[1]:g} Hz (Fig. 2.22) of 0 to {VOLTS[-1]:g} V each make the"
        f" difference {apart[0]:.3f} to {max(apart):.3f} mm"
    )


EXPERIMENT = Experiment(
    "amplification",
    "Figs 2.23 to 2.27",
    "Beyond a tenth of the critical speed a moving mass does more than a moving force, and the more"
    " the heavier it is.",
    run,
)
