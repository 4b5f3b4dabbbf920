"""Streams of masses that overlap on the beam, and what it costs if their prediction is wrong.

Beyond the thesis, whose augmented regulator (5.8) knows one mass. Here it is designed for three,
and runs by the clock of what is predicted of them: the times at which they enter, or their masses,
are wrong by some error, the same for all three. Masses believed to be heavier are answered by
higher voltage: the peak is lower then, though not the cost that the regulator minimises.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from experiments.thesis.verdicts import Experiment, ExperimentResult
from jaxbeam.case.controller import AbstractController
from jaxbeam.control.design_model import DesignModel
from jaxbeam.plot.style import GREY, colour, set_title, use_style

MASS, SPEED, ENTRY_TIMES = 0.371, 1.0, np.array([0.0, 0.25, 0.5])  # kg, m/s, s
WEIGHTS = {
    "state_weight": [1000.0, 100.0, 10.0, 0.1, 0.01, 0.01, 0.0],
    "command_weight": [9e-5],
    "coordinates": "sine",
    "points": 300,
    "period": 2e-3,
}
ENTRY_TIME_ERRORS = np.array([-0.1, -0.05, -0.025, 0.0, 0.025, 0.05, 0.1])  # s
MASS_ERRORS = np.array([-0.4, -0.2, 0.0, 0.2, 0.4])  # share of the mass
SENSOR, TOLERANCE = 1, 1e-4


def three_mass_case(load_rig) -> jb.Case:
    """The one-span rig with its shaker, crossed by three masses, two or three of them at once."""
    rig = load_rig("A")
    masses = tuple(jb.MovingMass(mass=MASS, speed=SPEED, entry_time=t) for t in ENTRY_TIMES)
    run = dataclasses.replace(rig.run, duration=np.asarray(1.2), sample_rate=np.asarray(400.0))
    return dataclasses.replace(rig, loads=masses, run=run)


def regulator(entry_time_error: float = 0.0, mass_error: float = 0.0) -> AbstractController:
    """The regulator that believes in a stream so late (s), and by such a share heavier."""
    design_model = DesignModel(
        mass=[MASS * (1 + mass_error)] * 3, entry_time=ENTRY_TIMES + entry_time_error
    )
    return jb.AugmentedLQR(**WEIGHTS, design=design_model, entries="predicted")


def run(load_rig) -> ExperimentResult:
    """Peaks at 0.25 m under the regulator for what is predicted, over the error of that."""
    rig = three_mass_case(load_rig)

    def simulated(law) -> jb.Record:
        return jb.simulate(dataclasses.replace(rig, controller=law), tolerance=TOLERANCE)

    free = simulated(None)
    uncontrolled_peak = float(free.peak_deflection[SENSOR])
    without_feedforward = simulated(jb.FiniteLQR(**WEIGHTS))

    def reduction(record) -> float:
        return 100 * (1 - float(record.peak_deflection[SENSOR]) / uncontrolled_peak)

    by_time = {late: simulated(regulator(entry_time_error=late)) for late in ENTRY_TIME_ERRORS}
    by_mass = {share: simulated(regulator(mass_error=share)) for share in MASS_ERRORS}
    entries = [reduction(record) for record in by_time.values()]
    masses = [reduction(record) for record in by_mass.values()]
    remarks = (
        "Three masses of 0.371 kg at 1 m/s, 0.25 s apart; peak at 0.25 m below no control:"
        f" {reduction(by_time[0.0]):.1f} % predicted rightly, {reduction(without_feedforward):.1f} % with weights unknown.",
        _remark("Entries predicted late", 1e3 * ENTRY_TIME_ERRORS, "ms", entries),
        _remark("Masses predicted heavier", 100 * MASS_ERRORS, "%", masses),
    )
    drawn_records = {
        "no control": free,
        "loads not fed forward": without_feedforward,
        "predicted rightly": by_time[0.0],
        f"{1e3 * ENTRY_TIME_ERRORS[-1]:g} ms late": by_time[ENTRY_TIME_ERRORS[-1]],
    }
    return ExperimentResult(
        (),
        {"errors": _draw(entries, masses, reduction(without_feedforward), drawn_records)},
        remarks,
    )


def _remark(label: str, errors: np.ndarray, unit: str, found: Sequence[float]) -> str:
    pairs = zip(errors, found, strict=True)
    return f"{label} by: " + "; ".join(
        f"{error:+g} {unit}: {value:.1f} %" for error, value in pairs
    )


@use_style
def _draw(entries, masses, without_feedforward: float, records) -> Figure:
    """Reductions over both errors above, deflections and voltages below."""
    figure = Figure(figsize=(8.0, 6.4))
    (left, right), (low, volts) = figure.subplots(2, 2)
    left.plot(1e3 * ENTRY_TIME_ERRORS, entries, "o-", color=colour(2))
    left.set(xlabel="entries predicted late by (ms)", ylabel="peak below no control (%)")
    right.plot(100 * MASS_ERRORS, masses, "o-", color=colour(2))
    right.set(xlabel="masses predicted heavier by (%)")
    for axes in (left, right):
        axes.axhline(without_feedforward, color=GREY, linestyle="--", label="loads not fed forward")
        axes.set_ylim(0, 100)
    left.legend(loc="lower center")
    for i, (word, record) in enumerate(records.items()):
        times, line = np.asarray(record.times), GREY if i == 0 else colour(i)
        low.plot(times, 1e3 * np.asarray(record.deflection)[:, SENSOR], color=line, label=word)
        if record.case.controller is not None:
            volts.plot(times, np.asarray(record.command)[:, 0], color=line)
    low.set(xlabel="time (s)", ylabel="deflection at 0.25 m (mm)")
    volts.set(xlabel="time (s)", ylabel="voltage (V)")
    figure.legend(*low.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    set_title(figure, "Three masses at once: what a wrong prediction costs")
    return figure


EXPERIMENT = Experiment(
    "streams",
    "beyond eq. (5.8): several masses at once, whose entries are predicted",
    "The regulator that knows its loads works for streams; entries 50 ms off cost little.",
    run,
)
