"""What the low-pass filter does to cubic feedback of one span, and its gain margin: Fig. 6.4."""

import dataclasses
from collections.abc import Callable

import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from experiments.thesis import published
from experiments.thesis.verdicts import Finding, finding
from jaxbeam.model.statics import static_lift
from jaxbeam.plot.style import colour, name, styled

SPEED, MASS = 0.28, 0.509  # m/s, kg
CUTOFFS, DAMPING = (10.0, 5.0), (0.03, 0.01)  # Hz; 1, the second as in Fig. 6.10
SLOW = 0.1  # s, the period of the oscillation: what changes more slowly is the load passing
SEEN = 0.1  # mm from crest to trough: what the supports yield by, and is called visible
RATE = 500.0  # samples per second


def rippled(case: jb.Case, run_all: Callable) -> tuple[list[Finding], Figure]:
    """Whether a slow, heavy load makes the loop oscillate, and how fast, by cutoff and damping.

    `run_all` runs the case under the cubic law with several changes of its numbers.
    """
    duration = float(case.beam.length) / SPEED
    run = dataclasses.replace(case.run, duration=np.asarray(duration), sample_rate=np.asarray(RATE))
    case = dataclasses.replace(case, run=run)
    load = {"loads.0.mass": MASS, "loads.0.speed": SPEED}
    changes = [
        load | {"sensors.0.filter.cutoff": cutoff, "beam.damping_ratio": ratio}
        for ratio in DAMPING
        for cutoff in CUTOFFS
    ]
    records = run_all(case, changes)
    sizes, rates = np.transpose([_ripple(record) for record in records])
    oscillates = (sizes > SEEN).astype(float).reshape(len(DAMPING), -1)
    words = [
        f"damping {ratio:g}, {few:.2f} and {less:.2f} mm from crest to trough"
        for ratio, (few, less) in zip(DAMPING, sizes.reshape(len(DAMPING), -1), strict=True)
    ]
    findings = [
        finding(published.OSCILLATES, oscillates[0], {words[1]: oscillates[1]}),
        finding(
            published.OSCILLATION, rates[0], {f"damping {DAMPING[1]:g}": rates[len(CUTOFFS), None]}
        ),
    ]
    return findings, _draw(records[-len(CUTOFFS) :])


def _ripple(record: jb.Record) -> tuple[float, float]:
    """What oscillates at the middle while the load is on the beam: crest to trough (mm), and Hz."""
    history = 1e3 * np.asarray(record.deflection)[:, 0]
    width = round(SLOW * RATE)
    mean = np.convolve(history, np.ones(width) / width, "valid")
    rest = history[width // 2 :][: mean.size] - mean
    share = np.abs(np.fft.rfft(rest * np.hanning(rest.size), 16 * rest.size))
    crest = np.lib.stride_tricks.sliding_window_view(rest, width)
    frequency = np.fft.rfftfreq(16 * rest.size, 1 / RATE)[np.argmax(share)]
    return float(np.max(np.ptp(crest, axis=1))), float(frequency)


def gain_margin(case: jb.Case, corrections) -> Finding:
    """The gain (V/m at the patch) at which static feedback alone has the pole at zero."""
    place, amplifier = case.sensors[0].position, float(case.actuators[0].amplifier_gain)
    margins = {
        f"c_p {share:g}": amplifier
        / static_lift(jb.replace(case, {"actuators.0.correction": share}), place)
        for share in corrections
    }
    first, *others = margins.items()
    return finding(published.GAIN_MARGIN, first[1], {k: np.atleast_1d(v[0]) for k, v in others})


@styled
def _draw(records) -> Figure:
    """Fig. 6.4: the deflection under both filters."""
    figure = Figure(figsize=(7.2, 3.0))
    axes = figure.subplots()
    for i, (record, cutoff) in enumerate(zip(records, CUTOFFS, strict=True)):
        history = 1e3 * np.asarray(record.deflection)[:, 0]
        axes.plot(record.times, history, color=colour(i), label=f"filter of {cutoff:g} Hz")
    axes.set(xlabel="time (s)", ylabel="deflection at 0.3 m (mm)", xlim=(0, record.times[-1]))
    axes.legend(loc="lower right")
    name(figure, "One span, cubic law, 0.509 kg at 0.28 m/s, damping 0.01 (Fig. 6.4)")
    return figure
