"""Moving masses and moving forces: Figs 2.23 to 2.27.

Amplification is the largest dynamic over the largest static deflection at a midspan; free vibration
after the exit counts. The maps show where a mass would have to pull on the beam to stay on it.
"""

import dataclasses
import warnings
from typing import NamedTuple

import numpy as np

import jaxbeam as jb
from experiments.thesis.cases import (
    as_moving_force,
    critical_speed,
    one_span,
    two_spans,
    with_modes,
    with_sensors,
)
from experiments.thesis.chapter2 import published
from experiments.thesis.chapter2.amplification_figures import draw_curves, draw_histories, draw_map
from experiments.thesis.verdicts import Experiment, ExperimentResult, make_finding
from jaxbeam.model.statics import static_peak
from jaxbeam.simulation.simulate import ContactLossWarning

MASSES = np.append(np.linspace(0.05, 0.6, 18), [0.26, 0.261, 0.5])  # kg; also those printed
ONE_RATIOS = np.append(np.geomspace(0.05, 0.2, 9)[:-1], np.linspace(0.2, 1.2, 21))
TWO_RATIOS = np.append(np.geomspace(0.05, 0.2, 9)[:-1], np.linspace(0.2, 2.0, 37))
DURATION = 1.0  # s: the slowest crossing, and free vibration after all others
TOLERANCE = 1e-4  # relative, of peaks
MODE_SENSITIVITY = (
    0.02  # by so much must twice the modes change an amplification that means nothing
)
WHILE_LOADED = "while the load is on the beam"
SHAKER_POSITION, SHAKER_STIFFNESS = (
    0.5,
    12000.0,
)  # m and N/m: the shaker that section 2.3 names, without current
ON_SHAKER_SPRING = (
    f"on the spring of the shaker, {SHAKER_STIFFNESS:g} N/m, in ratios to its own critical speed"
)
DAMPING = 0.03
SINE_FREQUENCIES, SINE_AMPLITUDES = (2.0, 4.0), (0.0, 1.0, 2.0)


class AmplificationSweep(NamedTuple):
    """Amplification (mass, speed, place), and the lowest contact force in weights (mass, speed).

    `amplification_on_beam` is the amplification until the load leaves.
    """

    masses: np.ndarray
    speed_ratios: np.ndarray
    amplification: np.ndarray
    amplification_on_beam: np.ndarray
    contact_force_ratio: np.ndarray

    def at(self, mass: float, ratio: float, sensor: int = 0) -> np.ndarray:
        """Amplification in the whole run and until the load leaves, at values swept over."""
        i, j = np.argmin(np.abs(self.masses - mass)), np.argmin(np.abs(self.speed_ratios - ratio))
        return np.array(
            [values[i, j, sensor] for values in (self.amplification, self.amplification_on_beam)]
        )


def sweep_amplification(case: jb.Case, masses, ratios) -> AmplificationSweep:
    """Amplification at the sensors over masses (kg) and speeds, in ratios to the critical one."""
    masses, ratios = np.sort(masses), np.asarray(ratios)
    speeds = critical_speed(case) * ratios
    mass, speed, on_beam_only = (
        part.ravel() for part in np.meshgrid(masses, speeds, [False, True], indexing="ij")
    )
    crossing = float(case.beam.length) / speed
    axes = {
        "loads.0.mass": mass,
        "loads.0.speed": speed,
        "run.duration": np.where(on_beam_only, crossing, np.maximum(DURATION, crossing)),
    }
    results = jb.sweep(case, axes, paired=True, progress=False, tolerance=TOLERANCE)
    positions = np.array([float(sensor.position) for sensor in case.sensors])
    static = np.asarray(static_peak(jb.replace(case, {"loads.0.mass": 1.0}), positions))
    peaks = results.peak_deflection.values.reshape(masses.size, ratios.size, 2, positions.size)
    ratio = peaks / (static * masses[:, None, None, None])
    contact = results.lowest_contact_force.values.reshape(masses.size, ratios.size, 2).min(axis=2)
    weights = masses[:, None] * float(case.run.gravity)
    return AmplificationSweep(masses, ratios, ratio[:, :, 0], ratio[:, :, 1], contact / weights)


def run(load_rig) -> ExperimentResult:
    """Amplifications of one and two spans by masses and forces, and their histories."""
    one = with_sensors(one_span(load_rig), 0.3, duration=DURATION)
    two = with_sensors(two_spans(load_rig), 0.3, 0.9, duration=DURATION)
    undamped = jb.replace(two, {"beam.damping_ratio": 0.0})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)  # the maps show it
        mass_one, mass_two = (
            sweep_amplification(one, MASSES, ONE_RATIOS),
            sweep_amplification(two, MASSES, TWO_RATIOS),
        )
        force_one, force_two = (
            sweep_amplification(as_moving_force(case), [1.0], ratios)
            for case, ratios in ((one, ONE_RATIOS), (two, TWO_RATIOS))
        )
        yang = sweep_amplification(as_moving_force(undamped), [1.0], TWO_RATIOS[:24])
        more_modes = sweep_amplification(with_modes(two, 16), [0.261], [0.45, 1.75])
        on_spring = _on_spring(one)
        history, figures = _histories(load_rig)
    yang = np.array(
        [values[0].max(axis=0) for values in (yang.amplification, yang.amplification_on_beam)]
    )
    single = [force_one.at(1.0, 0.7), mass_one.at(0.26, 0.5), mass_one.at(0.5, 0.75)]
    points = [(0.261, 0.45, 0), (0.261, 0.45, 1), (0.261, 1.75, 1)]
    double, fine = ([found.at(*point) for point in points] for found in (mass_two, more_modes))
    whole, on = _with_interpretations(single)
    findings = (
        *history,
        make_finding(
            published.ONE_SPAN_AMPLIFICATION,
            whole,
            on | {ON_SHAKER_SPRING: on_spring},
            _inconsistency_fig_2_25([whole, on[WHILE_LOADED], on_spring]),
        ),
        *(
            make_finding(printed, *_with_interpretations(values), obstacle)
            for printed, values, obstacle in (
                (published.YANG_AMPLIFICATION, yang.T, ""),
                (
                    published.TWO_SPAN_AMPLIFICATION,
                    double,
                    _mode_dependence(more_modes, double, fine),
                ),
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
    return ExperimentResult(findings, figures)


def _on_spring(bare: jb.Case) -> np.ndarray:
    """Amplifications of Fig. 2.25 with the spring of the shaker below the beam."""
    case = dataclasses.replace(
        bare, supports=(jb.Support(SHAKER_POSITION, stiffness=SHAKER_STIFFNESS),)
    )
    force = sweep_amplification(as_moving_force(case), [1.0], [0.7])
    mass = sweep_amplification(case, [0.26, 0.5], [0.5, 0.75])
    found = force.amplification[0, 0], mass.amplification[0, 0], mass.amplification[1, 1]
    return np.array([value[0] for value in found])


def _inconsistency_fig_2_25(interpretations) -> str:
    """Why no reading meets all numbers of Fig. 2.25, if each is met by one."""
    printed = published.ONE_SPAN_AMPLIFICATION
    near = np.abs(np.array(interpretations) - printed.numbers) <= printed.allowed_error
    if not near.any(axis=0).all() or near.all(axis=1).any():
        return ""
    return (
        "it is not told whether the beam had the shaker on it, nor until when peaks count: each"
        " number is met by one of these readings, but all by none"
    )


def _with_interpretations(values):
    whole, on = np.array(values).T
    return whole, {WHILE_LOADED: on}


def _mode_dependence(more_modes: AmplificationSweep, coarse, fine) -> str:
    """Why amplifications say nothing: the mass has left the beam, and the modes kept matter."""
    change = np.max(np.abs(np.array(fine) / np.array(coarse) - 1))
    if more_modes.contact_force_ratio.max() > 0 or change < MODE_SENSITIVITY:
        return ""
    worst = " and ".join(f"{-force:.0f}" for force in more_modes.contact_force_ratio[0])
    return (
        f"the mass would have to pull with {worst} times its weight to stay on the beam, which the"
        f" model lets it do; with 16 modes instead of 8 the amplification changes by {change:.0%}"
    )


def _histories(load_rig):
    """Rig D and slow crossings, by a mass and by a force: Figs 2.23, 2.24 and 2.26."""
    rig_d = load_rig("D")
    ratio, between, mass, force = _free_vibration(rig_d)
    damped, _, _, _ = _free_vibration(jb.replace(rig_d, {"beam.damping_ratio": DAMPING}))
    reversed_by = 180.0 * (between > 90)

    shaker_case = with_sensors(load_rig("A"), 0.25, duration=1.0)
    shaker_case = jb.replace(shaker_case, {"loads.0.mass": 0.509, "loads.0.speed": 0.9})
    peak_differences = [_peak_difference(shaker_case, volts) for volts in SINE_AMPLITUDES]
    fast = with_sensors(two_spans(load_rig), 0.75, duration=0.8)
    fast = jb.replace(fast, {"loads.0.mass": 0.261, "loads.0.speed": 3.0})
    pairs = {
        "rig D, midspan (Fig. 2.23)": (mass, force),
        "two spans at 0.75 m, 0.261 kg at 3 m/s (Fig. 2.26)": (
            jb.simulate(fast),
            jb.simulate(as_moving_force(fast)),
        ),
    }
    findings = (
        make_finding(
            published.FREE_AMPLITUDE_RATIO,
            ratio,
            {f"damping ratio {DAMPING:g}, as for all rigs of the thesis": damped},
        ),
        make_finding(
            published.FREE_PHASE_DIFFERENCE, between, {"in phase or opposed, no more": reversed_by}
        ),
        make_finding(
            published.FORCE_MASS_DIFFERENCE,
            peak_differences[0],
            inconsistency=_unknown_voltage(peak_differences),
        ),
    )
    return findings, {"histories": draw_histories(pairs)}


def _free_vibration(case: jb.Case):
    """Free vibration after the exit: amplitude of a force over that of a mass, and the phase
    (degree) between both; and the runs, of the mass and of the force."""
    mass, force = (jb.simulate(one) for one in (case, as_moving_force(case)))
    after = np.asarray(mass.times) > float(case.beam.length / case.loads[0].speed)
    free = [np.abs(np.asarray(run.deflection)[after]).max() for run in (force, mass)]
    omega = 2 * np.pi * float(mass.modes.frequencies[0])
    phases = [
        np.angle(float(run.coordinates[-1, 0]) - 1j * float(run.rates[-1, 0]) / omega)
        for run in (force, mass)
    ]
    between = np.degrees(np.abs(np.angle(np.exp(1j * (phases[0] - phases[1])))))
    return free[0] / free[1], between, mass, force


def _peak_difference(case: jb.Case, volts: float) -> float:
    """By how much (mm) the peaks of a mass and of a force differ while the shaker is driven."""
    prescribed = jb.Prescribed(
        offsets=[0.0], amplitudes=[[volts, volts]], frequencies=SINE_FREQUENCIES
    )
    driven = dataclasses.replace(case, controller=prescribed)
    peaks = [
        float(jb.simulate(one).peak_deflection[0]) for one in (driven, as_moving_force(driven))
    ]
    return 1e3 * abs(peaks[0] - peaks[1])


def _unknown_voltage(peak_differences) -> str:
    """Why a difference says nothing that any voltage could have made; empty if none could."""
    if not peak_differences[0] < published.FORCE_MASS_DIFFERENCE.numbers[0] < max(peak_differences):
        return ""
    return (
        f"the voltage is not printed, and a mass that the shaker moves pushes back: sines of"
        f" {SINE_FREQUENCIES[0]:g} and {SINE_FREQUENCIES[1]:g} Hz (Fig. 2.22) of 0 to {SINE_AMPLITUDES[-1]:g} V each make the"
        f" difference {peak_differences[0]:.3f} to {max(peak_differences):.3f} mm"
    )


EXPERIMENT = Experiment(
    "amplification",
    "Figs 2.23 to 2.27",
    "Beyond a tenth of the critical speed a moving mass does more than a moving force, and the more"
    " the heavier it is.",
    run,
)
