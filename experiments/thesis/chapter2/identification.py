"""Damping, suspension and patch factors that the thesis fitted by hand, identified from logs.

The measured logs are not available. Those in `logs` were made by finite elements with the numbers
fitted by hand (python -m tests.tuning.make_rig_logs); the fits start a quarter above them.
"""

from pathlib import Path

from matplotlib.figure import Figure

import jaxbeam as jb
import tuning
from experiments.thesis.cases import with_modes
from experiments.thesis.verdicts import Experiment, ExperimentResult
from jaxbeam.plot.style import colour, set_title, use_style

LOGS = Path(__file__).parent / "logs"
START_FACTOR = 1.25  # start values over the values fitted by hand
MODES = 12  # of the finite elements; eight leave an error of half the noise on two spans
DAMPING = "beam.damping_ratio"
PATCH_FACTORS = "actuators.0.correction", "actuators.1.correction"
HAND_FITTED = {
    "A": {DAMPING: 0.03, "actuators.0.stiffness": 3500.0, "actuators.0.damping": 80.0},
    "B": {DAMPING: 0.03, PATCH_FACTORS[0]: 0.32},
    "C": {PATCH_FACTORS[0]: 0.39, PATCH_FACTORS[1]: 0.68},
}


def with_log_modes(case: jb.Case) -> jb.Case:
    """A published rig with as many modes as the finite elements of its log."""
    return with_modes(case, MODES)


def fit_rig(rig: str, load_rig) -> tuning.Fit:
    """Fit of the parameters of a rig that were fitted by hand, from its log."""
    start = {address: START_FACTOR * value for address, value in HAND_FITTED[rig].items()}
    case = jb.replace(with_log_modes(load_rig(rig)), start)
    return tuning.identify(case, tuning.read_log(LOGS / f"{rig}.csv"), list(start))


def run(load_rig) -> ExperimentResult:
    """Fit of rig B, with 95 % intervals as remarks; those of rigs A and C take a minute."""
    fits = {rig: fit_rig(rig, load_rig) for rig in ("B",)}
    remarks = [
        "A test of the method, not of the thesis: the measured logs are not available, and these"
        " were made by finite elements with the very numbers that the thesis fitted by hand."
    ]
    for rig, fit in fits.items():
        for address, value, (low, high) in zip(
            fit.addresses, fit.values, fit.intervals, strict=True
        ):
            remarks.append(
                f"rig {rig}, {address}: {value:.4g}, 95 % {low:.4g} to {high:.4g}; logs made with"
                f" {HAND_FITTED[rig][address]:g}"
            )
    return ExperimentResult((), {"logs": _draw(fits)}, tuple(remarks))


@use_style
def _draw(fits) -> Figure:
    """Logged and fitted deflections above, residuals below; a column for each rig."""
    figure = Figure(figsize=(7.2, 5.6))
    columns = figure.subplots(2, len(fits), sharex="col", squeeze=False).T
    for (above, below), (rig, fit) in zip(columns, fits.items(), strict=True):
        times, last = fit.dataset.times[0], fit.fitted.shape[2] - 1
        above.plot(times, 1e3 * fit.dataset.measured[0, :, last], color="0.6", label="log")
        above.plot(times, 1e3 * fit.fitted[0, :, last], color=colour(0), lw=1, label="fitted")
        below.plot(times, 1e6 * fit.residuals[0, :, last], color=colour(1), lw=1)
        above.set_title(f"rig {rig}")
        below.set_xlabel("time (s)")
    figure.axes[0].set_ylabel("deflection (mm)")
    figure.axes[len(fits)].set_ylabel("residual (µm)")
    figure.axes[0].legend()
    set_title(figure, "Log of rig B, and the model identified from it")
    return figure


EXPERIMENT = Experiment(
    "identification",
    "hand fits of damping, shaker and patches: 2.1.2, 2.2.4, 2.4.2",
    "Identification finds the numbers that logs of such rigs were made with; the thesis is not"
    " tested by that.",
    run,
)
