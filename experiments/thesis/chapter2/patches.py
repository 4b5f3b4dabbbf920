"""What the patch rigs and the first-order shaker are made of: 2.2.3, 2.4.2 and eq. (2.43)."""

import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from experiments.thesis import published
from experiments.thesis.verdicts import Experiment, Outcome, finding
from jaxbeam.model.statics import static_lift
from jaxbeam.plot.style import colour, name, styled

WIDTH, MODULUS, DENSITY = 0.1, 65e9, 2800.0  # m, Pa, kg/m^3
HEIGHT, FITTING = 2.83e-3, 2.9e-3  # m: as printed, and the one that the printed section has
VOLTS = 1500.0  # at the patch


def run(load) -> Outcome:
    """Constants of patch, section and shaker from what the thesis makes them of."""
    made = jb.Patch(
        0.2575,
        0.3425,
        d33=460e-12,
        modulus=30.336e9,
        electrode_spacing=407.18e-6,
        beam_height=HEIGHT,
        patch_height=0.3e-3,
        patch_width=57e-3,
    )
    findings = (
        finding(published.MOMENT, made.moment),
        finding(published.SECTION, _section(HEIGHT), {"h = 2.9 mm": _section(FITTING)}),
        finding(published.CUTOFF, load("A").actuators[0].bandwidth / (2 * np.pi)),
    )
    return Outcome(findings, {"lift": _draw(load)})


def _section(height):
    beam = jb.Beam(0.6, width=WIDTH, height=height, youngs_modulus=MODULUS, density=DENSITY)
    return [beam.rigidity, beam.linear_density]


@styled
def _draw(load) -> Figure:
    """How far each patch lifts the beams of rigs B and C, statically."""
    figure = Figure(figsize=(7.2, 2.8))
    for axes, rig in zip(figure.subplots(1, 2, sharey=True), "BC", strict=True):
        case = load(rig)
        x = np.linspace(0, float(case.beam.length), 241)
        lifted = np.asarray(static_lift(case, x))
        for i, actuator in enumerate(case.actuators):
            volts = VOLTS / float(actuator.amplifier_gain)
            axes.plot(x, 1e3 * volts * lifted[i], color=colour(i), label=f"patch {i + 1}")
            axes.axvspan(actuator.start, actuator.end, color=colour(i), alpha=0.15, linewidth=0)
        axes.set(title=f"rig {rig}", xlabel="x (m)", xlim=(0, x[-1]))
        axes.legend()
    figure.axes[0].set_ylabel("deflection (mm)")
    name(figure, f"Static lift by {VOLTS:.0f} V at a patch")
    return figure


EXPERIMENT = Experiment(
    "patches",
    "constants of patch, section and shaker",
    "The constants printed for the patch rigs and the first-order shaker follow from their parts.",
    run,
)
