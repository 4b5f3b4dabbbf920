"""Tuned laws on the patch rigs, beside the hand-set ones of chapter 6 and what is possible at all.

One table of commands over the way of the load (`jaxbeam.control.feedforward`) for all masses and
speeds, tuned by gradients (`experiments.studies.tune_feedforward`), is proven on loads that it was not tuned
on:

- ideal: no delay;
- bench: 20 ms of delay, which the law knows and makes up for; then also 10 ms more, of which it
  does not, or a beam that is 10 % stiffer or softer than believed.

Commands are sampled every 10 ms in steps of 10 mV (2 V at the patch); loads enter between ticks.

Mass and speed are unknown beforehand: the speed is measured by two gates on the ramp, as in the
thesis, the mass not at all. As no reading of the beam is fed back, noise and filters of its sensors
do not matter, and there is no loop that could become unstable.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
import tuning
from experiments.studies.tune_feedforward import FOLDER
from experiments.thesis.chapter6.feedback import ONE_SPAN_CUTOFF, TWO_SPAN_CUTOFF, with_feedback
from experiments.thesis.verdicts import Experiment, ExperimentResult
from jaxbeam.plot.style import GREY, INK, colour, set_title, use_style
from tuning.control.load_cases import AddressValues
from tuning.control.run_set import RunSet, make_run_set

# Not among those tuned on:
MASSES = (0.322, 0.42)  # kg
SPEEDS = {"B": (0.35, 0.55, 0.95), "C": (0.45, 0.95)}  # m/s
ENTRY_TIME = 0.054  # s: between two ticks, and late enough for commands to begin before
DELAY, EXTRA_DELAY = 0.02, 0.01  # s
RIGIDITY_ERRORS = {"10 % stiffer": 1.1, "10 % softer": 0.9}
RIGIDITY = "beam.flexural_rigidity"
CUBIC_FEEDBACK, TUNED_IDEAL, TUNED_BENCH, EXTRA_DELAY_LAW = (
    "hand-set, cubic",
    "tuned, ideal",
    "tuned, bench",
    "10 ms later",
)
DRAWN_LAWS = (CUBIC_FEEDBACK, TUNED_BENCH, EXTRA_DELAY_LAW)
CUTOFFS = {"B": ONE_SPAN_CUTOFF, "C": TWO_SPAN_CUTOFF}


@dataclasses.dataclass(frozen=True, eq=False)
class HeldOutStudy:
    """What laws do to the held-out loads of a rig: least reductions and, by law, those attained.

    All are shares of the peak without control (run); `records` are those of the last run.
    """

    title: str
    loads: tuple[AddressValues, ...]
    attainable: np.ndarray
    reductions: dict[str, np.ndarray]
    records: dict[str, jb.Record]

    def shares(self, law: str) -> np.ndarray:
        """Shares of the attainable reduction that a law achieves."""
        return self.reductions[law] / self.attainable


def run(load_rig) -> ExperimentResult:
    """Shares of the attainable reduction on rigs B and C, for loads held out."""
    studies = {rig: run_study(rig, load_rig(rig)) for rig in ("B", "C")}
    remarks = tuple(line for one in studies.values() for line in study_remarks(one))
    title = "One tuned table for all loads, proven on loads held out"
    return ExperimentResult(
        (), {"shares": draw(list(studies.values()), DRAWN_LAWS, title)}, remarks
    )


def run_study(rig: str, case: jb.Case) -> HeldOutStudy:
    """Run all laws on the held-out loads of a rig."""
    duration = float(case.beam.length) / min(SPEEDS[rig]) + ENTRY_TIME + 0.1
    case = dataclasses.replace(case, run=jb.Run(duration=duration, sample_rate=200.0))
    loads = tuning.full_grid(
        {"loads.0.mass": MASSES, "loads.0.speed": SPEEDS[rig], "loads.0.entry_time": [ENTRY_TIME]}
    )
    ideal = jb.load_case(FOLDER / f"{rig}.toml").controller
    ideal_runs = make_run_set(dataclasses.replace(case, controller=ideal), loads, least_peaks=True)
    late_runs = make_run_set(
        dataclasses.replace(case, controller=with_bench_delay(ideal, EXTRA_DELAY)), loads
    )
    bench_runs = make_run_set(dataclasses.replace(case, controller=with_bench_delay(ideal)), loads)
    feedback_runs = make_run_set(with_feedback(case, 3, CUTOFFS[rig]), loads)
    records = {
        law: bench.records({})
        for law, bench in (
            (CUBIC_FEEDBACK, feedback_runs),
            (TUNED_IDEAL, ideal_runs),
            (TUNED_BENCH, bench_runs),
            (EXTRA_DELAY_LAW, late_runs),
        )
    }
    reductions = {
        law: 1 - peaks(found) / ideal_runs.uncontrolled["peak"] for law, found in records.items()
    }
    for word, factor in RIGIDITY_ERRORS.items():
        changed = {RIGIDITY: factor * float(case.beam.flexural_rigidity)}
        reductions[word] = 1 - peaks(bench_runs.records(changed)) / uncontrolled_peaks(
            bench_runs, changed
        )
    return HeldOutStudy(
        title=case.title,
        loads=loads,
        attainable=1 - ideal_runs.uncontrolled["least"] / ideal_runs.uncontrolled["peak"],
        reductions=reductions,
        records={law: found[-1] for law, found in records.items()},
    )


def with_bench_delay(law: jb.Passage, extra_delay: float = 0.0) -> jb.Passage:
    """The law as it runs on the bench: it knows the delay and reads its table so much earlier.

    Of `extra_delay` delay (s) it knows nothing.
    """
    return dataclasses.replace(law, lead=law.lead + DELAY, delay=np.asarray(DELAY + extra_delay))


def peaks(records: list[jb.Record]) -> np.ndarray:
    """The largest deflection (m) at any sensor, run by run."""
    return np.array([float(np.max(record.peak_deflection)) for record in records])


def uncontrolled_peaks(run_set: RunSet, changed: dict[str, float]) -> np.ndarray:
    """Peaks (m) without control of the runs of a bench with other numbers."""
    plain = [dataclasses.replace(jb.replace(c, changed), controller=None) for c in run_set.cases]
    return peaks([jb.simulate(one, tolerance=1e-4) for one in plain])


def study_remarks(
    held_out_study: HeldOutStudy, laws: Sequence[str] = (CUBIC_FEEDBACK, TUNED_IDEAL, TUNED_BENCH)
) -> list[str]:
    """The result in lines: load by load for some laws, and the worst and the mean of all."""
    lines = [held_out_study.title + ", held-out loads: peaks below no control"]
    for i, load in enumerate(held_out_study.loads):
        words = ", ".join(f"{law} {held_out_study.reductions[law][i]:.1%}" for law in laws)
        lines.append(
            f"{load['loads.0.mass']:g} kg at {load['loads.0.speed']:g} m/s: {words};"
            f" at most {held_out_study.attainable[i]:.1%}"
        )
    for law in held_out_study.reductions:
        shares = held_out_study.shares(law)
        lines.append(
            f"{law}: at least {shares.min():.1%} of the attainable, {shares.mean():.1%} in the mean"
        )
    return lines


@use_style
def draw(studies: list[HeldOutStudy], laws: Sequence[str], title: str) -> Figure:
    """For each rig: shares of the attainable by load, and deflection and commands of one run."""
    figure = Figure(figsize=(5.2 * len(studies), 8.0))
    grid = figure.subplots(3, len(studies), squeeze=False, height_ratios=[1.2, 1, 1])
    for (top, middle, below), one in zip(grid.T, studies, strict=True):
        _draw_shares(top, one, laws)
        _draw_run(middle, below, one, laws)
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    set_title(figure, title)
    return figure


def _draw_shares(axes, one: HeldOutStudy, laws: Sequence[str]):
    rows = np.arange(len(one.loads))
    for i, law in enumerate(laws):
        axes.plot(100 * one.shares(law), rows, "o", color=colour(i), label=law)
    axes.axvline(100, color=INK, linewidth=1.0)
    words = [f"{x['loads.0.mass']:g} kg, {x['loads.0.speed']:g} m/s" for x in one.loads]
    axes.set_yticks(rows, words)
    axes.invert_yaxis()
    axes.set(xlabel="share of the attainable reduction (%)", xlim=(0, 105), title=one.title)


def _draw_run(upper, lower, one: HeldOutStudy, laws: Sequence[str]):
    """The last of the runs: deflection where it is largest, and all commands."""
    free = dataclasses.replace(one.records[laws[-1]].case, controller=None)
    uncontrolled_record = jb.simulate(free, tolerance=1e-4)
    upper.plot(
        uncontrolled_record.times,
        1e3 * uncontrolled_record.deflection[:, 0],
        color=GREY,
        label="no control",
    )
    for i, law in enumerate(laws):
        record = one.records[law]
        upper.plot(record.times, 1e3 * record.deflection[:, 0], color=colour(i))
        for j, command in enumerate(np.asarray(record.command).T):
            lower.plot(
                record.times, command, ("-", "--")[j], color=colour(i), drawstyle="steps-post"
            )
    mass, speed = one.loads[-1]["loads.0.mass"], one.loads[-1]["loads.0.speed"]
    end = ENTRY_TIME + float(free.beam.length) / speed + 0.1
    upper.set(
        title=f"{mass:g} kg at {speed:g} m/s; no control grey",
        ylabel="deflection at first sensor (mm)",
        xlim=(0, end),
    )
    lower.set(xlabel="time (s)", ylabel="command (V), second dashed", xlim=(0, end))


EXPERIMENT = Experiment(
    "tuned",
    "beyond Table 8.1: controllers tuned by gradients",
    "One table of commands, tuned for all masses and speeds, comes close to what is possible.",
    run,
)
