"""What the low-pass filter does to cubic feedback of one span, and its gain margin: Fig. 6.4."""

import dataclasses
from collections.abc import Callable

import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from experiments.thesis.chapter6 import published
from experiments.thesis.verdicts import Finding, make_finding
from jaxbeam.model.statics import static_lift
from jaxbeam.plot.style import colour, set_title, use_style

SPEED, MASS = 0.28, 0.509  # m/s, kg
CUTOFFS, DAMPING_RATIOS = (10.0, 5.0), (0.03, 0.01)  # Hz; 1, the second as in Fig. 6.10
AVERAGING_PERIOD = (
    0.1  # s, the period of the oscillation: what changes more slowly is the load passing
)
VISIBLE_AMPLITUDE = (
    0.1  # mm from crest to trough: what the supports yield by, and is called visible
)
RATE = 500.0  # samples per second


def oscillation_findings(case: jb.Case, simulate_changes: Callable) -> tuple[list[Finding], Figure]:
    """Whether a slow, heavy load makes the loop oscillate, and how fast, by cutoff and damping.

    `simulate_changes` runs the case under the cubic law with several changes of its numbers.
    """
    duration = float(case.beam.length) / SPEED
    run = dataclasses.replace(case.run, duration=np.asarray(duration), sample_rate=np.asarray(RATE))
    case = dataclasses.replace(case, run=run)
    load = {"loads.0.mass": MASS, "loads.0.speed": SPEED}
    changes = [
        load | {"sensors.0.filter.cutoff": cutoff, "beam.damping_ratio": ratio}
        for ratio in DAMPING_RATIOS
        for cutoff in CUTOFFS
    ]
    records = simulate_changes(case, changes)
    sizes, rates = np.transpose([_oscillation(record) for record in records])
    oscillates = (sizes > VISIBLE_AMPLITUDE).astype(float).reshape(len(DAMPING_RATIOS), -1)
    words = [
        f"damping {ratio:g}, {few:.2f} and {less:.2f} mm from crest to trough"
        for ratio, (few, less) in zip(
            DAMPING_RATIOS, sizes.reshape(len(DAMPING_RATIOS), -1), strict=True
        )
    ]
    findings = [
        make_finding(published.OSCILLATES, oscillates[0], {words[1]: oscillates[1]}),
        make_finding(
            published.OSCILLATION_FREQUENCY,
            rates[0],
            {f"damping {DAMPING_RATIOS[1]:g}": rates[len(CUTOFFS), None]},
        ),
    ]
    return findings, _draw(records[-len(CUTOFFS) :])


def _oscillation(record: jb.Record) -> tuple[float, float]:
    """What oscillates at the middle while the load is on the beam: crest to trough (mm), and Hz."""
    history = 1e3 * np.asarray(record.deflection)[:, 0]
    width = round(AVERAGING_PERIOD * RATE)
    mean = np.convolve(history, np.ones(width) / width, "valid")
    oscillating_part = history[width // 2 :][: mean.size] - mean
    amplitude_spectrum = np.abs(
        np.fft.rfft(
            oscillating_part * np.hanning(oscillating_part.size), 16 * oscillating_part.size
        )
    )
    windows = np.lib.stride_tricks.sliding_window_view(oscillating_part, width)
    frequency = np.fft.rfftfreq(16 * oscillating_part.size, 1 / RATE)[np.argmax(amplitude_spectrum)]
    return float(np.max(np.ptp(windows, axis=1))), float(frequency)


def gain_margin_finding(case: jb.Case, corrections) -> Finding:
    """The gain (V/m at the patch) at which static feedback alone has the pole at zero."""
    position, amplifier = case.sensors[0].position, float(case.actuators[0].amplifier_gain)
    margins = {
        f"c_p {share:g}": amplifier
        / static_lift(jb.replace(case, {"actuators.0.correction": share}), position)
        for share in corrections
    }
    first, *others = margins.items()
    return make_finding(
        published.GAIN_MARGIN, first[1], {k: np.atleast_1d(v[0]) for k, v in others}
    )


@use_style
def _draw(records) -> Figure:
    """Fig. 6.4: the deflection under both filters."""
    figure = Figure(figsize=(7.2, 3.0))
    axes = figure.subplots()
    for i, (record, cutoff) in enumerate(zip(records, CUTOFFS, strict=True)):
        history = 1e3 * np.asarray(record.deflection)[:, 0]
        axes.plot(record.times, history, color=colour(i), label=f"filter of {cutoff:g} Hz")
    axes.set(xlabel="time (s)", ylabel="deflection at 0.3 m (mm)", xlim=(0, record.times[-1]))
    axes.legend(loc="lower right")
    set_title(figure, "One span, cubic law, 0.509 kg at 0.28 m/s, damping 0.01 (Fig. 6.4)")
    return figure
