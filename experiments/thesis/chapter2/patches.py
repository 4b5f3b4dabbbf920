"""Constants of patches and beam sections: 2.4.2, eq. (2.43)."""

import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from experiments.thesis.chapter2 import published
from experiments.thesis.verdicts import Experiment, ExperimentResult, make_finding
from jaxbeam.model.deflection_lines import static_deflection_per_command
from jaxbeam.plot.style import colour, set_title, use_style

WIDTH, MODULUS, DENSITY = 0.1, 65e9, 2800.0  # m, Pa, kg/m^3
HEIGHT, SECTION_HEIGHT = 2.83e-3, 2.9e-3  # m: as printed, and by 0.812 kg/m
PATCH_VOLTAGE = 1500.0  # V at the patch


def run(load_rig) -> ExperimentResult:
    """Constants of patch and section, from the printed numbers behind them."""
    patch = jb.Patch(
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
        make_finding(published.PATCH_MOMENT, patch.moment_constant, null=("no patch", 0.0)),
        make_finding(
            published.PATCH_SECTION,
            _rigidity(HEIGHT),
            {"h = 2.9 mm, which makes the printed 0.812 kg/m": _rigidity(SECTION_HEIGHT)},
            null=("the beam of rig A", float(load_rig("A").beam.flexural_rigidity)),
        ),
    )
    return ExperimentResult(findings, {"lift": _draw(load_rig)})


def _rigidity(height: float) -> float:
    """Flexural rigidity (N m^2) of a section of some height (m)."""
    beam = jb.Beam(0.6, width=WIDTH, height=height, youngs_modulus=MODULUS, density=DENSITY)
    return float(beam.bending_stiffness)


@use_style
def _draw(load_rig) -> Figure:
    """Static deflection of rigs B and C by each patch."""
    figure = Figure(figsize=(7.2, 2.8))
    for axes, rig in zip(figure.subplots(1, 2, sharey=True), "BC", strict=True):
        case = load_rig(rig)
        x = np.linspace(0, float(case.beam.length), 241)
        static_deflection = np.asarray(static_deflection_per_command(case, x))
        for i, actuator in enumerate(case.actuators):
            volts = PATCH_VOLTAGE / float(actuator.amplifier_gain)
            axes.plot(
                x, 1e3 * volts * static_deflection[i], color=colour(i), label=f"patch {i + 1}"
            )
            axes.axvspan(actuator.start, actuator.end, color=colour(i), alpha=0.15, linewidth=0)
        axes.set(title=f"rig {rig}", xlabel="x (m)", xlim=(0, x[-1]))
        axes.legend()
    figure.axes[0].set_ylabel("deflection (mm)")
    set_title(figure, f"Static lift by {PATCH_VOLTAGE:.0f} V at a patch")
    return figure


EXPERIMENT = Experiment(
    "patches",
    "constants of patch and section",
    "The printed constants of the patch rigs follow from the printed dimensions and material"
    " constants.",
    run,
)
