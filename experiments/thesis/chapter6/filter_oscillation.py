"""Oscillation of cubic feedback through a low-pass filter, and its gain margin: Fig. 6.4."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from experiments.thesis.cases import with_duration
from experiments.thesis.chapter6 import published
from experiments.thesis.chapter6.patch_rigs import simulate_changes
from experiments.thesis.figures import plot_deflections
from experiments.thesis.verdicts import Finding, make_finding
from jaxbeam.model.deflection_lines import static_deflection_per_command
from jaxbeam.plot.style import set_title, use_style

SPEED, MASS = 0.28, 0.509  # m/s, kg
CUTOFFS = 10.0, 5.0  # Hz
# s, the period of the oscillation: the mean over it is the quasi-static deflection by the load
AVERAGING_PERIOD = 0.1
# mm from crest to trough, by which the supports yield: called visible in the thesis
VISIBLE_AMPLITUDE = 0.1
SAMPLE_RATE = 500.0  # Hz


def oscillation_findings(
    case: jb.Case, answers: Mapping[tuple[str, ...], Mapping[str, float]]
) -> tuple[list[Finding], Figure]:
    """Findings on the oscillation of the loop under a slow, heavy load (yes or no, Hz); Fig. 6.4.

    `case` is rig B under the cubic law; the cutoff of the filter is varied, for all `answers`, of
    which the last has the damping of the figure.
    """
    case = with_duration(case, float(case.beam.length) / SPEED, SAMPLE_RATE)
    load = {"loads.0.mass": MASS, "loads.0.speed": SPEED}
    changes = [
        load | {"sensors.0.filter.cutoff": cutoff} | change
        for change in answers.values()
        for cutoff in CUTOFFS
    ]
    records = simulate_changes(case, changes)
    shape = len(answers), len(CUTOFFS)
    sizes, frequencies = np.transpose([_oscillation(one) for one in records]).reshape(2, *shape)
    oscillates = dict(zip(answers, (sizes > VISIBLE_AMPLITUDE).astype(float), strict=True))
    frequency = dict(zip(answers, frequencies[:, 0], strict=True))
    first, second = sizes[-1]
    findings = [
        make_finding(
            published.OSCILLATES,
            oscillates.pop(()),
            oscillates,
            null=("no control", 0.0),
            remark=f"by {', '.join(list(answers)[-1])} the oscillations are {first:.2f} and"
            f" {second:.2f} mm from crest to trough",
        ),
        make_finding(
            published.OSCILLATION_FREQUENCY,
            frequency.pop(()),
            frequency,
            null=("no control, the mass at rest at midspan", _loaded_frequency(case)),
        ),
    ]
    return findings, _draw(records[-len(CUTOFFS) :])


def _oscillation(record: jb.Record) -> tuple[float, float]:
    """Oscillation at midspan while loaded: crest to trough (mm) and frequency (Hz)."""
    history = 1e3 * np.asarray(record.deflection)[:, 0]
    width = round(AVERAGING_PERIOD * SAMPLE_RATE)
    mean = np.convolve(history, np.ones(width) / width, "valid")
    oscillation = history[width // 2 :][: mean.size] - mean
    count = 16 * oscillation.size  # zeros interpolate the spectrum
    spectrum = np.abs(np.fft.rfft(oscillation * np.hanning(oscillation.size), count))
    windows = np.lib.stride_tricks.sliding_window_view(oscillation, width)
    frequency = np.fft.rfftfreq(count, 1 / SAMPLE_RATE)[np.argmax(spectrum)]
    return float(np.max(np.ptp(windows, axis=1))), float(frequency)


def _loaded_frequency(case: jb.Case) -> float:
    """First frequency (Hz) of the beam with the mass at rest at the first sensor."""
    shape = np.asarray(jb.modes(case).shapes(np.atleast_1d(case.sensors[0].position), 0))[0]
    inertia = np.eye(shape.size) + MASS * np.outer(shape, shape)
    values = np.linalg.eigvals(np.linalg.solve(inertia, np.diag(jb.modes(case).stiffness)))
    return float(np.sqrt(values.real.min())) / (2 * np.pi)


def gain_margin(case: jb.Case, correction: float) -> float:
    """The gain (V/m at the patch) at which static feedback has a pole at zero, by c_p."""
    amplifier = float(case.actuators[0].amplifier_gain)
    case = jb.replace(case, {"actuators.0.correction": correction})
    return amplifier / float(static_deflection_per_command(case, case.sensors[0].position)[0])


def fitted_correction(case: jb.Case) -> float:
    """The factor c_p for which the printed gain margin is that of static feedback."""
    return gain_margin(case, 1.0) / published.GAIN_MARGIN.numbers[0]


@use_style
def _draw(records) -> Figure:
    """Fig. 6.4: the deflection with either filter."""
    figure = Figure(figsize=(7.2, 3.0))
    axes = figure.subplots()
    labels = [f"filter of {cutoff:g} Hz" for cutoff in CUTOFFS]
    plot_deflections(axes, dict(zip(labels, records, strict=True)))
    last = float(records[-1].times[-1])
    axes.set(xlabel="time (s)", ylabel="deflection at 0.3 m (mm)", xlim=(0, last))
    axes.legend(loc="lower left")
    set_title(figure, "One span, cubic law, 0.509 kg at 0.28 m/s, damping 0.01 (Fig. 6.4)")
    return figure
