"""Tuned laws on the patch rigs, beside the hand-set ones of chapter 6 and what is possible at all.

One table of commands over the way of the load (`jaxbeam.control.feedforward`) for all masses and
speeds, tuned by gradients (`experiments.studies.tuned_search`), is proven on loads that it was not tuned
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
from experiments.studies.tuned_search import FOLDER
from experiments.thesis.chapter6.feedback import ONE_CUTOFF, TWO_CUTOFF, controlled
from experiments.thesis.verdicts import Experiment, Outcome
from jaxbeam.plot.style import GREY, INK, colour, name, styled
from tuning.control.load_cases import Values
from tuning.control.run_set import Bench, make_bench

# Not among those tuned on:
MASSES = (0.322, 0.42)  # kg
SPEEDS = {"B": (0.35, 0.55, 0.95), "C": (0.45, 0.95)}  # m/s
ENTRY = 0.054  # s: between two ticks, and late enough for commands to begin before
DELAY, MORE_DELAY = 0.02, 0.01  # s
STIFFER = {"10 % stiffer": 1.1, "10 % softer": 0.9}
RIGIDITY = "beam.flexural_rigidity"
CUBIC, IDEAL, BENCH, LATE = "hand-set, cubic", "tuned, ideal", "tuned, bench", "10 ms later"
DRAWN = (CUBIC, BENCH, LATE)
CUTOFFS = {"B": ONE_CUTOFF, "C": TWO_CUTOFF}


@dataclasses.dataclass(frozen=True, eq=False)
class Study:
    """What laws do to the held-out loads of a rig: least reductions and, by law, those attained.

    All are shares of the peak without control (run); `records` are those of the last run.
    """

    title: str
    loads: tuple[Values, ...]
    attainable: np.ndarray
    reductions: dict[str, np.ndarray]
    records: dict[str, jb.Record]

    def shares(self, law: str) -> np.ndarray:
        """Shares of the attainable reduction that a law achieves."""
        return self.reductions[law] / self.attainable


def run(load) -> Outcome:
    """Shares of the attainable reduction on rigs B and C, for loads held out."""
    studies = {rig: study(rig, load(rig)) for rig in ("B", "C")}
    remarks = tuple(line for one in studies.values() for line in told(one))
    title = "One tuned table for all loads, proven on loads held out"
    return Outcome((), {"shares": draw(list(studies.values()), DRAWN, title)}, remarks)


def study(rig: str, case: jb.Case) -> Study:
    """Run all laws on the held-out loads of a rig."""
    duration = float(case.beam.length) / min(SPEEDS[rig]) + ENTRY + 0.1
    case = dataclasses.replace(case, run=jb.Run(duration=duration, sample_rate=200.0))
    loads = tuning.grid(
        {"loads.0.mass": MASSES, "loads.0.speed": SPEEDS[rig], "loads.0.entry_time": [ENTRY]}
    )
    ideal = jb.load_case(FOLDER / f"{rig}.toml").controller
    best = make_bench(dataclasses.replace(case, controller=ideal), loads, bounds=True)
    late = make_bench(dataclasses.replace(case, controller=on_bench(ideal, MORE_DELAY)), loads)
    real = make_bench(dataclasses.replace(case, controller=on_bench(ideal)), loads)
    hand = make_bench(controlled(case, 3, CUTOFFS[rig]), loads)
    records = {
        law: bench.records({})
        for law, bench in ((CUBIC, hand), (IDEAL, best), (BENCH, real), (LATE, late))
    }
    reductions = {law: 1 - peaks(found) / best.free["peak"] for law, found in records.items()}
    for word, factor in STIFFER.items():
        changed = {RIGIDITY: factor * float(case.beam.flexural_rigidity)}
        reductions[word] = 1 - peaks(real.records(changed)) / uncontrolled(real, changed)
    return Study(
        title=case.title,
        loads=loads,
        attainable=1 - best.free["least"] / best.free["peak"],
        reductions=reductions,
        records={law: found[-1] for law, found in records.items()},
    )


def on_bench(law: jb.Passage, more: float = 0.0) -> jb.Passage:
    """The law as it runs on the bench: it knows the delay and reads its table so much earlier.

    Of `more` delay (s) it knows nothing.
    """
    return dataclasses.replace(law, lead=law.lead + DELAY, delay=np.asarray(DELAY + more))


def peaks(records: list[jb.Record]) -> np.ndarray:
    """The largest deflection (m) at any sensor, run by run."""
    return np.array([float(np.max(record.peak_deflection)) for record in records])


def uncontrolled(bench: Bench, changed: dict[str, float]) -> np.ndarray:
    """Peaks (m) without control of the runs of a bench with other numbers."""
    plain = [dataclasses.replace(jb.replace(c, changed), controller=None) for c in bench.cases]
    return peaks([jb.simulate(one, tolerance=1e-4) for one in plain])


def told(one: Study, laws: Sequence[str] = (CUBIC, IDEAL, BENCH)) -> list[str]:
    """The result in lines: load by load for some laws, and the worst and the mean of all."""
    lines = [one.title + ", held-out loads: peaks below no control"]
    for i, load in enumerate(one.loads):
        words = ", ".join(f"{law} {one.reductions[law][i]:.1%}" for law in laws)
        lines.append(
            f"{load['loads.0.mass']:g} kg at {load['loads.0.speed']:g} m/s: {words};"
            f" at most {one.attainable[i]:.1%}"
        )
    for law in one.reductions:
        shares = one.shares(law)
        lines.append(
            f"{law}: at least {shares.min():.1%} of the attainable, {shares.mean():.1%} in the mean"
        )
    return lines


@styled
def draw(studies: list[Study], laws: Sequence[str], title: str) -> Figure:
    """For each rig: shares of the attainable by load, and deflection and commands of one run."""
    figure = Figure(figsize=(5.2 * len(studies), 8.0))
    grid = figure.subplots(3, len(studies), squeeze=False, height_ratios=[1.2, 1, 1])
    for (top, middle, below), one in zip(grid.T, studies, strict=True):
        _shares(top, one, laws)
        _run(middle, below, one, laws)
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    name(figure, title)
    return figure


def _shares(axes, one: Study, laws: Sequence[str]):
    rows = np.arange(len(one.loads))
    for i, law in enumerate(laws):
        axes.plot(100 * one.shares(law), rows, "o", color=colour(i), label=law)
    axes.axvline(100, color=INK, linewidth=1.0)
    words = [f"{x['loads.0.mass']:g} kg, {x['loads.0.speed']:g} m/s" for x in one.loads]
    axes.set_yticks(rows, words)
    axes.invert_yaxis()
    axes.set(xlabel="share of the attainable reduction (%)", xlim=(0, 105), title=one.title)


def _run(upper, lower, one: Study, laws: Sequence[str]):
    """The last of the runs: deflection where it is largest, and all commands."""
    free = dataclasses.replace(one.records[laws[-1]].case, controller=None)
    plain = jb.simulate(free, tolerance=1e-4)
    upper.plot(plain.times, 1e3 * plain.deflection[:, 0], color=GREY, label="no control")
    for i, law in enumerate(laws):
        record = one.records[law]
        upper.plot(record.times, 1e3 * record.deflection[:, 0], color=colour(i))
        for j, sent in enumerate(np.asarray(record.command).T):
            lower.plot(record.times, sent, ("-", "--")[j], color=colour(i), drawstyle="steps-post")
    mass, speed = one.loads[-1]["loads.0.mass"], one.loads[-1]["loads.0.speed"]
    end = ENTRY + float(free.beam.length) / speed + 0.1
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
