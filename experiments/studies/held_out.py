"""Performance of control laws on held-out loads, beside the least achievable peak.

Loads on the patch rigs B and C: those that laws are tuned on, and those held out.

Loads enter at sampling instants and between them.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
import tuning
from experiments.thesis.cases import (
    ONE_SPAN_CUTOFF,
    PEAK_TOLERANCE,
    TWO_SPAN_CUTOFF,
    simulate_cases,
    simulate_changes,
)
from experiments.thesis.report import plot_commands, plot_deflections
from jaxbeam.model.modes import mesh_layout
from jaxbeam.plot.style import GREY, INK, colour, set_title, use_style
from tuning.control.objective import with_fixed_design
from tuning.control.run_set import AddressValues, make_run_set

PERIOD = 0.01  # s, of sampling
MASSES, ENTRY_TIME = (0.261, 0.509), 0.05  # kg, s: training
HELD_OUT_MASSES = (0.322, 0.42)  # kg
HELD_OUT_SPEEDS = {"B": (0.35, 0.55, 0.95), "C": (0.45, 0.95)}  # m/s
HELD_OUT_ENTRY_TIME = 0.054  # s: between sampling instants, after the first command
FREE_VIBRATION = 0.1  # s after the slowest held-out crossing


def training_loads(
    speeds: Sequence[float] | np.ndarray, changes: Sequence[Mapping[str, float]] = ({},)
) -> tuple[AddressValues, ...]:
    """The lightest and the heaviest load at all speeds (m/s), as numbers by address.

    Each also with every one of the `changes` of the plant.
    """
    return tuple(
        {
            "loads.0.mass": mass,
            "loads.0.speed": float(speed),
            "loads.0.entry_time": ENTRY_TIME + PERIOD * ((2 * i + j) % 4) / 4,
        }
        | dict(change)
        for i, speed in enumerate(speeds)
        for j, mass in enumerate(MASSES)
        for change in changes
    )


def held_out_loads(rig: str) -> tuple[AddressValues, ...]:
    """Loads of rig B or C that no law is tuned on, as numbers by address."""
    return tuning.full_grid(
        {
            "loads.0.mass": HELD_OUT_MASSES,
            "loads.0.speed": HELD_OUT_SPEEDS[rig],
            "loads.0.entry_time": [HELD_OUT_ENTRY_TIME],
        }
    )


def with_held_out_duration(rig: str, case: jb.Case) -> jb.Case:
    """The case with a duration for the slowest of the held-out loads."""
    slowest = float(case.beam.length) / min(HELD_OUT_SPEEDS[rig])
    duration = slowest + HELD_OUT_ENTRY_TIME + FREE_VIBRATION
    return dataclasses.replace(case, run=jb.Run(duration=duration, sample_rate=200.0))


CUBIC_FEEDBACK = "hand-set, cubic"  # the law of chapter 6 that others are compared with
CUBIC_CUTOFFS = {"B": ONE_SPAN_CUTOFF, "C": TWO_SPAN_CUTOFF}  # Hz
EXTRA_DELAY, EXTRA_DELAY_LAW = 0.01, "10 ms later"  # s, unknown to the law
RIGIDITY = "beam.flexural_rigidity"
RIGIDITY_ERRORS = {"10 % stiffer": 1.1, "10 % softer": 0.9}  # of the plant over the design


@dataclasses.dataclass(frozen=True, eq=False)
class HeldOutStudy:
    """Reductions of the peak for the held-out loads of a rig, achievable and by law.

    Reductions are fractions of the peak without control, (run,). `records` has that of the last
    run of each law.
    """

    title: str
    loads: tuple[AddressValues, ...]
    achievable: np.ndarray
    reductions: dict[str, np.ndarray]
    records: dict[str, jb.Record]

    def shares(self, law: str) -> np.ndarray:
        """Reductions of a law over the achievable ones, (run,)."""
        return self.reductions[law] / self.achievable

    def remarks(self, laws: Sequence[str]) -> list[str]:
        """Lines of text: reductions of some laws by load, and least and mean share of all laws."""
        lines = [f"{self.title}, held-out loads: peaks below no control"]
        for i, load in enumerate(self.loads):
            reductions = ", ".join(f"{law} {self.reductions[law][i]:.1%}" for law in laws)
            at_most = f"at most {self.achievable[i]:.1%}"
            lines.append(f"{load_label(load, ' at')}: {reductions}; {at_most}")
        for law in self.reductions:
            shares = self.shares(law)
            lines.append(
                f"{law}: at least {shares.min():.1%} of the achievable, {shares.mean():.1%} in the"
                " mean"
            )
        return lines


def load_label(load: AddressValues, separator: str = ",") -> str:
    """Mass and speed of a load."""
    return f"{load['loads.0.mass']:g} kg{separator} {load['loads.0.speed']:g} m/s"


def with_rigidity(case: jb.Case, factor: float) -> jb.Case:
    """The case with a factor on the rigidity of the plant, of which the law does not know."""
    design = {RIGIDITY: float(case.beam.flexural_rigidity)}
    plant = jb.replace(case, {RIGIDITY: factor * design[RIGIDITY]})
    return with_fixed_design(plant, design, mesh_layout(plant))


def peaks(records: Sequence[jb.Record]) -> np.ndarray:
    """The largest deflection (m) at any sensor, (run,)."""
    return np.array([float(np.max(record.peak_deflection)) for record in records])


def held_out_study(
    controlled_cases: Mapping[str, jb.Case], loads: tuple[AddressValues, ...], tuned: str
) -> HeldOutStudy:
    """Runs of cases of one rig, by law, with all loads; of the `tuned` one off its design, too.

    Each law takes one step in each interval between events, as the search for steps finds.
    """
    case = controlled_cases[tuned]
    uncontrolled = make_run_set(case, loads, least_peaks=True).uncontrolled
    records = {name: simulate_changes(one, loads) for name, one in controlled_cases.items()}
    reductions = {name: 1 - peaks(found) / uncontrolled["peak"] for name, found in records.items()}
    for name, factor in RIGIDITY_ERRORS.items():
        plants = [with_rigidity(jb.replace(case, load), factor) for load in loads]
        free = [dataclasses.replace(one, controller=None) for one in plants]
        free_peaks = peaks([jb.simulate(one, tolerance=PEAK_TOLERANCE) for one in free])
        reductions[name] = 1 - peaks(simulate_cases(plants)) / free_peaks
    return HeldOutStudy(
        title=case.title,
        loads=loads,
        achievable=1 - uncontrolled["least"] / uncontrolled["peak"],
        reductions=reductions,
        records={name: found[-1] for name, found in records.items()},
    )


@use_style
def draw(studies: Sequence[HeldOutStudy], laws: Sequence[str], title: str) -> Figure:
    """Shares of the achievable reduction by load, and one run; a column for each rig."""
    figure = Figure(figsize=(5.2 * len(studies), 8.0))
    grid = figure.subplots(3, len(studies), squeeze=False, height_ratios=[1.2, 1, 1])
    for (top, middle, below), study in zip(grid.T, studies, strict=True):
        _draw_shares(top, study, laws)
        _draw_last_run(middle, below, study, laws)
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    set_title(figure, title)
    return figure


def _draw_shares(axes, study: HeldOutStudy, laws: Sequence[str]) -> None:
    rows = np.arange(len(study.loads))
    for i, law in enumerate(laws):
        axes.plot(100 * study.shares(law), rows, "o", color=colour(i), label=law)
    axes.axvline(100, color=INK, linewidth=1.0)
    axes.set_yticks(rows, [load_label(load) for load in study.loads])
    axes.invert_yaxis()
    axes.set(xlabel="share of the achievable reduction (%)", xlim=(0, 105), title=study.title)


def _draw_last_run(upper, lower, study: HeldOutStudy, laws: Sequence[str]) -> None:
    """Deflection at the first sensor, and all commands, for the last of the loads."""
    records = {law: study.records[law] for law in laws}
    uncontrolled_case = dataclasses.replace(records[laws[-1]].case, controller=None)
    uncontrolled = jb.simulate(uncontrolled_case, tolerance=1e-4)
    plot_deflections(upper, {"no control": uncontrolled}, colours=[GREY])
    plot_deflections(upper, records)
    plot_commands(lower, records, range(len(uncontrolled_case.actuators)), held=True)
    load = study.loads[-1]
    crossing = float(uncontrolled_case.beam.length) / load["loads.0.speed"]
    end = HELD_OUT_ENTRY_TIME + crossing + 0.1
    upper.set(
        title=f"{load_label(load, ' at')}; no control grey",
        ylabel="deflection at first sensor (mm)",
        xlim=(0, end),
    )
    lower.set(xlabel="time (s)", ylabel="command (V), second dashed", xlim=(0, end))
