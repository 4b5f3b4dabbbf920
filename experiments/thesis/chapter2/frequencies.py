"""Natural frequencies and critical speeds: Tables 2.1 and 2.2, Fig. 2.4, eqs (2.38) and (2.39).

Modes of supported beams by the approximation of the thesis: springs in sine modes.

Kept to reproduce printed numbers and to compare with `jaxbeam.modes`, which is exact. A rigid
support becomes a stiff spring, and each such spring adds one spurious mode, the last of the list.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from experiments.thesis.cases import critical_speed, one_span, two_spans
from experiments.thesis.chapter2 import published
from experiments.thesis.chapter2.shaker import DENSER, beams_of_rig_a
from experiments.thesis.verdicts import Experiment, ExperimentResult, make_finding
from jaxbeam.case.case import Case
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.modes import Modes, mesh_layout, modes, normalised_modes
from jaxbeam.numerics.matrices import eigen
from jaxbeam.plot.style import colour, set_title, use_style

RIGID_SUPPORT_STIFFNESS = 3.21e10  # N/m, reproduces Table 2.2 of the thesis to all printed digits


def sine_basis_modes(case: Case, rigid_stiffness: float = RIGID_SUPPORT_STIFFNESS) -> Modes:
    """Modes of a supported beam in the first m modes of the same beam without its supports.

    [diag(w_1^2 ... w_m^2) + sum_i k_i psi(x_i) psi(x_i)^T - w^2] p = 0, shapes sum_k psi_k p_k,
    eqs (2.18) to (2.21) of the thesis; psi are sines if the ends are pinned, and m is
    `case.beam.modes`. Rigid supports are springs of `rigid_stiffness` in N/m; rotational springs
    enter alike, with slopes. Frequencies (Hz) and mass-normalised shapes are those of the result.
    """
    beam = case.beam
    unsupported = modes(dataclasses.replace(case, supports=()))
    stiffness = jnp.diag(unsupported.stiffness) + unsupported.coupling
    for support in case.supports:
        spring = rigid_stiffness if support.stiffness is None else support.stiffness
        shape, slope = unsupported.shape_derivatives(support.position, (0, 1))
        stiffness = stiffness + spring * jnp.outer(shape, shape)
        stiffness = stiffness + support.rotational_stiffness * jnp.outer(slope, slope)
    values, eigenvectors, coupling = eigen(
        stiffness / unsupported.stiffness_unit, jnp.eye(beam.modes)
    )
    series = unsupported.series @ eigenvectors
    return normalised_modes(
        beam,
        values * unsupported.stiffness_unit,
        coupling * unsupported.stiffness_unit,
        unsupported.nodes,
        series,
        unsupported.layout,
    )


BEAM_OF_2_1_3 = "11.68 N m^2 and 0.535 kg/m throughout, as in 2.1.3"
SUPPORT_SPRING = "a support of 3.21e10 N/m"
DAMPED = "damped frequencies, 3500 N/m and 80 N s/m"
TABLE_2_2_BEAM = {"beam.flexural_rigidity": 12.11, "beam.mass_per_length": 0.5411}  # Table 2.2


def run(load_rig) -> ExperimentResult:
    """Frequencies of two spans, exact and by sine modes, and the critical speeds that follow."""
    one, two = one_span(load_rig), two_spans(load_rig)
    table_2_2_case = jb.replace(two, TABLE_2_2_BEAM)
    exact, printed_exact = (
        np.asarray(jb.modes(case).frequencies) for case in (two, table_2_2_case)
    )
    scale = (two.beam.bending_stiffness / two.beam.linear_density) ** 0.25 / one.beam.length
    lambdas = np.sqrt(2 * np.pi * exact) / scale

    stiff = 1e5 * float(table_2_2_case.beam.bending_stiffness) / float(one.beam.length)
    approximate = np.asarray(sine_basis_modes(two).frequencies)
    errors = 100 * (approximate / exact - 1)

    span = float(one.beam.length)
    first = 2 * np.pi * float(jb.modes(one).frequencies[0])
    angular = 2 * np.pi * exact[:2]
    speeds = _critical_speeds(span, first, angular)
    beams = list(beams_of_rig_a(one.beam).items())[1:]
    active = jb.replace(
        load_rig("A"), {"actuators.0.stiffness": 3500.0, "actuators.0.damping": 0.0}
    )
    with_shaker = {k: _frequencies_on_suspension(active, k) for k in (3500.0, 12000.0)}
    bare = np.asarray(jb.modes(one).frequencies)
    mass = float(one.beam.linear_density) * span
    one_span_alone = np.repeat(np.arange(1, 5), 2)
    printed_span = jb.modes(jb.replace(one, TABLE_2_2_BEAM)).frequencies[0] * one_span_alone**2
    findings = (
        make_finding(
            published.FREQUENCY_PARAMETERS,
            lambdas,
            null=("one pinned span", np.pi * one_span_alone),
        ),
        make_finding(
            published.ANALYTICAL_FREQUENCIES,
            printed_exact,
            {BEAM_OF_2_1_3: exact},
            null=("one pinned span of the numbers beside the table", printed_span),
        ),
        make_finding(
            published.APPROXIMATE_FREQUENCIES,
            sine_basis_modes(table_2_2_case, stiff).frequencies,
            {
                BEAM_OF_2_1_3: sine_basis_modes(two, stiff).frequencies,
                SUPPORT_SPRING: sine_basis_modes(table_2_2_case).frequencies,
                (BEAM_OF_2_1_3, SUPPORT_SPRING): approximate,
            },
            null=("the exact frequencies, 11.68 N m^2 and 0.535 kg/m", exact),
            fitted={SUPPORT_SPRING: "8"},
        ),
        make_finding(
            published.FREQUENCY_ERRORS,
            errors[[1, 3, 5, 7]],
            null=("exact modes", 0.0),
        ),
        make_finding(
            published.CRITICAL_SPEED,
            speeds[0],
            {name: critical_speed(dataclasses.replace(one, beam=beam)) for name, beam in beams},
            null=("static", 0.0),
            fitted={DENSER: "one-span"},
        ),
        make_finding(
            published.TWO_SPAN_CRITICAL_SPEEDS,
            speeds[1:],
            null=("one pinned span for all", speeds[0] * np.array([2, 1])),
        ),
        make_finding(
            published.SPEED_RATIOS,
            np.array([0.9, 1.5, 3.0]) / speeds[[0, 2, 2]],
            null=("static", 0.0),
        ),
        make_finding(published.ANGULAR_FREQUENCIES, angular, null=("one pinned span", first)),
        make_finding(published.MASS_RATIO, np.array([0.26, 0.5]) / mass, null=("no load", 0.0)),
        make_finding(
            published.SHAKER_MODES,
            with_shaker[3500.0],
            {
                "stiffness 12000 N/m": with_shaker[12000.0],
                DAMPED: damped_frequencies(load_rig("A"), 3500.0, 80.0),
            },
            null=("beam without shaker", bare),
        ),
    )
    return ExperimentResult(findings, {"modes": _draw(two)})


def _critical_speeds(span, one_span_frequency, two_span_frequencies):
    """Critical speeds (m/s) from angular frequencies (rad/s): of one span, and of two by mode."""
    return np.array(
        [
            span * one_span_frequency / np.pi,
            2 * span * two_span_frequencies[0] / np.pi,
            2 * span * two_span_frequencies[1] / (2 * np.pi),
        ]
    )


def _frequencies_on_suspension(case, stiffness):
    """Natural frequencies (Hz) of the beam on its shaker with a suspension stiffness (N/m)."""
    case = jb.replace(case, {"actuators.0.stiffness": stiffness})
    return (
        np.sqrt(np.linalg.eigvalsh(np.asarray(modal_model(case, mesh_layout(case)).stiffness())))
        / 2
        / np.pi
    )


def damped_frequencies(case: jb.Case, stiffness: float, damping: float) -> np.ndarray:
    """Frequencies (Hz) of the damped beam on the suspension of its shaker, (mode,), ascending.

    They are the imaginary parts of the poles of the bare beam with a spring of `stiffness` (N/m)
    and a dashpot of `damping` (N s/m) where the shaker is. Damping lowers them.
    """
    suspension = {"actuators.0.stiffness": stiffness, "actuators.0.damping": damping}
    case = jb.replace(case, suspension)
    plant = jb.state_space(case).unloaded
    poles = np.linalg.eigvals(np.asarray(plant.A))
    return np.sort(poles.imag[poles.imag > 0]) / (2 * np.pi)


@use_style
def _draw(two: jb.Case) -> Figure:
    """Fig. 2.4: eight mode shapes, exact and by eight sine modes on a stiff spring."""
    x = np.linspace(0, float(two.beam.length), 400)
    figure = Figure(figsize=(7.2, 6.4))
    panels = figure.subplots(4, 2, sharex=True)
    shapes = [np.asarray(basis.shapes(x, 0)) for basis in (jb.modes(two), sine_basis_modes(two))]
    labels = "exact", "8 sine modes"
    for i, axes in enumerate(panels.flat):
        for j, dashes in ((1, "-"), (0, "--")):  # the exact ones dashed on top
            shape = shapes[j][:, i] / np.abs(shapes[j][:, i]).max()
            axes.plot(x, shape, dashes, color=colour(1 - j), label=labels[j])
        axes.plot([0, x[-1] / 2, x[-1]], [0, 0, 0], "^", color="k", markersize=4, clip_on=False)
        axes.set(title=f"mode {i + 1}", ylim=(-1.15, 1.15), yticks=(-1, 0, 1), xlim=(0, x[-1]))
    for axes in panels[-1]:
        axes.set_xlabel("x (m)")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    set_title(figure, "Modes of two equal spans, largest value one (Fig. 2.4)")
    return figure


EXPERIMENT = Experiment(
    "frequencies",
    "Tables 2.1, 2.2, Fig. 2.4, critical speeds",
    "Two equal spans have the printed frequencies; eight sine modes on a stiff spring approximate"
    " all but the last.",
    run,
)
