"""Which states are fed back (Figs 5.14, 5.15), and the gains of both methods of chapter 3.

The thesis draws the theoretical peaks with one state to all states fed back, under constant and
under time-varying gains, and says which is better; and it calls the gains of the finite-time and of
the step-by-step method identical for its beam.
"""

import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from experiments.thesis.cases import with_duration
from experiments.thesis.chapter5 import published
from experiments.thesis.chapter5.regulators import (
    ALL_STATES,
    COMMAND_WEIGHT,
    FIRST_MODE,
    MASSES,
    NO_CONTROL,
    PRINTED_STATES,
    SPEEDS,
    STATE_WEIGHTS,
    WEAK_SHAKER,
    RegulatorRuns,
    interpreted_rigs,
)
from experiments.thesis.verdicts import LITERAL, Experiment, ExperimentResult, Finding, make_finding
from jaxbeam.plot.style import colour, set_title, use_style

SAMPLE_RATE = 200.0  # Hz
LAWS = ("time-invariant", "time-varying")
COMBINATIONS = {
    "q1": FIRST_MODE,
    "q1 q2": [1.0, 1.0, 0, 0, 0, 0, 0],
    "q1 q1'": [1.0, 0, 0, 1.0, 0, 0, 0],
    "q1 q2 q1'": PRINTED_STATES,
    "q1 q2 q3": [1.0, 1.0, 1.0, 0, 0, 0, 0],
    "q1 q2 q3 q1'": [1.0, 1.0, 1.0, 1.0, 0, 0, 0],
    "all": ALL_STATES,
}
BUT_FOR_THE_END = "but for the last tenth of the crossing"
FRACTIONS = np.linspace(0.0, 1.0, 401)[1:-1]  # of the crossing, at which gains are compared
LAST_DRAWN = 0.95  # fraction up to which axes are scaled
FED_BACK = np.array([0, 1, 3])  # q1, q2 and the rate of q1 among the states
POINTS = 800  # intervals of the tables of gains


def run(load_rig) -> ExperimentResult:
    """Peaks by the states fed back, and both gains, for rig A."""
    rig = load_rig("A")
    speed, mass = SPEEDS[1], MASSES[0]
    rig = with_duration(rig, float(rig.beam.length) / speed + 0.3, SAMPLE_RATE)
    ratios = peak_ratios(rig, speed, mass)
    gains = {name: gains_over_crossing(rig, horizon, mass) for name, horizon in HORIZONS.items()}
    findings = claims(ratios), identical_gains(gains)
    figures = {"states": draw_states(ratios), "gains": draw_gains(gains)}
    return ExperimentResult(findings, figures)


def peak_ratios(rig: jb.Case, speed: float, mass: float) -> dict[str, dict[str, np.ndarray]]:
    """Peaks at 0.25 m in percent of no control, by interpretation, law and combination."""
    runs, ratios = RegulatorRuns(rig), {}
    for name in (LITERAL, WEAK_SHAKER):
        case = interpreted_rigs(rig)[name]
        plant = name, case, case.actuators[0]
        uncontrolled = runs.peak(*plant, NO_CONTROL, speed, mass)
        ratios[name] = {
            law: np.array(
                [
                    100 * runs.peak(*plant, law, speed, mass, feedback=states) / uncontrolled
                    for states in COMBINATIONS.values()
                ]
            )
            for law in LAWS
        }
    return ratios


def claims(ratios) -> Finding:
    """Finding on the claims of the thesis about Figs 5.14 and 5.15, 1 where one holds."""
    names = list(COMBINATIONS)
    first, both, printed, all_states = (
        names.index(key) for key in ("q1", "q1 q2", "q1 q2 q1'", "all")
    )

    def holds(by_law):
        varying, invariant = by_law["time-varying"], by_law["time-invariant"]
        return np.array(
            [
                varying[printed] < varying[first],
                varying[both] < varying[first],
                not invariant[all_states] < 100,  # NaN where the response grows without bound
            ],
            float,
        )

    values = {name: holds(by_law) for name, by_law in ratios.items()}
    literal = values.pop(LITERAL)
    shown = [
        f"{by_law['time-varying'][first]:.1f}, {by_law['time-varying'][both]:.1f},"
        f" {by_law['time-varying'][printed]:.1f} and {by_law['time-invariant'][all_states]:.1f} %"
        for by_law in ratios.values()
    ]
    return make_finding(
        published.FED_BACK_STATES,
        literal,
        values,
        null=("no control, all peaks equal", 0.0),
        remark="with q1, q1 q2 and q1 q2 q1' under varying gains, and all states under constant"
        f" ones, the peak is {'; '.join(shown)} of that without control, reading by reading",
    )


HORIZONS = {"finite-time": "crossing", "step-by-step": "frozen", "constant": "infinite"}


def gains_over_crossing(rig: jb.Case, horizon: str, mass: float) -> np.ndarray:
    """Gains (fraction, state) of q1, q2 and rate of q1 along a crossing, in V/m and V s/m.

    They are those of the slow crossing of Fig. 5.16.
    """
    changes = {"loads.0.mass": mass, "loads.0.speed": SPEEDS[0]}
    plant = jb.state_space(jb.replace(rig, changes), "sine")
    weights = STATE_WEIGHTS, [COMMAND_WEIGHT]
    if horizon == "infinite":
        law = jb.LQR(*weights, coordinates="sine")
        constant = np.asarray(law.time_invariant_gain(plant))[0, FED_BACK]
        return np.tile(constant, (FRACTIONS.size, 1))
    law = jb.LQR(*weights, coordinates="sine", horizon=horizon, points=POINTS)
    table = law.gain_table(plant)
    return np.stack([np.asarray(table(fraction)) for fraction in FRACTIONS])[:, 0, FED_BACK]


def identical_gains(gains) -> Finding:
    """Largest difference of the gains of both methods, in percent of the largest of each state."""

    def difference(name, shares):
        chosen = shares(FRACTIONS)
        expected, found = gains["finite-time"][chosen], gains[name][chosen]
        return [100 * np.max(np.abs(found - expected) / np.abs(gains["finite-time"]).max(axis=0))]

    return make_finding(
        published.IDENTICAL_GAINS,
        difference("step-by-step", lambda share: share <= 1),
        {BUT_FOR_THE_END: difference("step-by-step", lambda share: share < 0.9)},
        null=("constant gains", difference("constant", lambda share: share < 0.9)),
    )


@use_style
def draw_states(ratios) -> Figure:
    """Fig. 5.14: peaks by the states fed back, under both laws, by every interpretation."""
    figure = Figure(figsize=(7.2, 3.4))
    panels = figure.subplots(1, 2, sharey=True)
    places = np.arange(len(COMBINATIONS))
    for axes, law in zip(panels, LAWS, strict=True):
        for i, (name, by_law) in enumerate(ratios.items()):
            axes.plot(places, by_law[law], "o", color=colour(i), label=name)
        axes.axhline(100.0, color="k", linewidth=0.8)
        axes.set_xticks(places, list(COMBINATIONS), rotation=60)
        axes.set(title=law, xlabel="states fed back", ylim=(0, 120))
    panels[0].set(ylabel="peak (% of no control)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    set_title(figure, "0.261 kg at 0.55 m/s by the states fed back (Fig. 5.14)")
    return figure


@use_style
def draw_gains(gains) -> Figure:
    """Gains of q1, q2 and the rate of q1 along the crossing, by each method (Fig. 5.16)."""
    figure = Figure(figsize=(7.2, 3.2))
    panels = figure.subplots(1, FED_BACK.size)
    for axes, label, column in zip(panels, ("q1", "q2", "q1'"), range(FED_BACK.size), strict=True):
        for i, (name, values) in enumerate(gains.items()):
            axes.plot(FRACTIONS, values[:, column], color=colour(i), label=name)
        # At the very end gains are many times as large.
        drawn = np.stack([values[FRACTIONS < LAST_DRAWN, column] for values in gains.values()])
        low, high = drawn.min(), drawn.max()
        margin = 0.1 * (high - low)
        axes.set(title=f"gain of {label}", xlabel="share of the crossing")
        axes.set_ylim(low - margin, high + margin)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    set_title(figure, f"Gains of both methods of chapter 3, axes by shares below {LAST_DRAWN:g}")
    return figure


EXPERIMENT = Experiment(
    "fed-back-states",
    "sections 3.2 and 5.1, Figs 5.14 to 5.16",
    "With time-varying gains q2 and the rate of q1 reduce the peak further, with constant gains all"
    " states increase it; both methods of chapter 3 give the same gains.",
    run,
)
