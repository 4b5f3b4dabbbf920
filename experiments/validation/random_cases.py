"""Check random valid cases; exit with 1 if a law of them does not hold.

    python -m experiments.validation.random_cases 10000 --seed 3 [--plain] [--longest 60]

Laws: no number is NaN unless the verdict says why, no verdict is wrong, and the stated error is at
least the true one in 99.9 % of the cases. The true error of each is that beside a run of tighter
tolerance, of a random sample (500 of 10 000) also that beside the modal equations integrated by
scipy. With `--plain` there is only that: numbers are finite, and verdicts agree with them and with
scipy. Each outcome is a line of `random_cases_SEED.jsonl` in `--folder`: an interrupted check
continues, and `--anew` begins again. Cases that take longer than `--longest` are left and counted;
a later check with a longer limit takes them up again. Nothing is compiled. With `--page` what is
printed is written to `docs/_static`, too, which a page of the site shows.

Checks of random cases: finite numbers, true verdicts, stated errors that hold.

Draws of random valid cases: heavy and fast loads, many modes, events that coincide.

Masses are 1e-3 to 100 times that of the beam, speeds 0.05 to 10 times the critical one, modes 1 to
60. Loads enter together, meet, leave at once, or stop on the beam and stay. Frequencies are those
of a span on two pins, of two equal clamped spans (in pairs), or of a free beam (two are zero).
"""

import argparse
import contextlib
import dataclasses
import functools
import io
import json
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

import jaxbeam as jb
from experiments.benchmarks.common import print_row, print_table
from jaxbeam.model.modal_model import modal_model
from jaxbeam.simulation.integration_plan import TOLERANCE, integration_plan
from jaxbeam.simulation.integrator.step_size import UNSAMPLED
from jaxbeam.simulation.record import Record
from jaxbeam.simulation.simulate import ContactLossWarning
from tests.oracles import modal_equations
from tests.oracles.crossing import Load
from tests.oracles.modal_equations import KnownModes, Span

LENGTH, RIGIDITY, MASS_PER_LENGTH = 2.0, 50.0, 1.5  # m, N m^2, kg/m
CRITICAL_SPEED = np.pi / LENGTH * np.sqrt(RIGIDITY / MASS_PER_LENGTH)  # of a span on pins, m/s
PERIOD = 2 * LENGTH / CRITICAL_SPEED  # of its first mode, s
MAX_MODES = 60
SAMPLES = 60  # of a run
SENSORS = np.array([0.37, 0.5]) * LENGTH  # positions, m
CLAMP = 1e10 * RIGIDITY / LENGTH  # rotational stiffness between two equal spans, N m/rad


class Drawn(NamedTuple):
    """A case, and its loads, modes and damping for another integrator."""

    case: jb.Case
    loads: list[Load]
    span: Span | KnownModes
    duration: float  # s


def draw(seed: int, index: int) -> Drawn:
    """The case of an index, the same each time."""
    rng = np.random.default_rng([seed, index])
    modes = round(10 ** rng.uniform(0.0, np.log10(MAX_MODES)))
    damping = float(rng.choice([0.0, 0.01, 0.1]))
    beam = str(rng.choice(["pinned", "pinned", "pinned", "paired", "free"]))
    loads = _loads(rng)
    ends = [min(load.time_at(LENGTH), load.stop_time) for load in loads]
    duration = float(max(ends) + rng.choice([0.1, 2.0]) * PERIOD)
    case = _case(beam, modes, damping, loads, duration)
    if beam == "pinned":
        span = Span(LENGTH, RIGIDITY, MASS_PER_LENGTH, modes, damping)
    else:
        model = modal_model(case)
        span = KnownModes(LENGTH, model.modes.stiffness, damping, model.shapes)
    return Drawn(case, loads, span, duration)


def _loads(rng: np.random.Generator) -> list[Load]:
    """One to three loads; one may enter with the one before, at its speed or against it."""
    loads: list[Load] = []
    for _ in range(rng.integers(1, 4)):
        speed = 10 ** rng.uniform(np.log10(0.05), 1.0) * CRITICAL_SPEED
        entry = rng.choice([0.0, 0.0, 0.1, 0.7]) * PERIOD
        if loads and rng.random() < 0.5:
            speed, entry = abs(loads[-1].speed), loads[-1].entry_time
        stop = rng.choice([np.inf, np.inf, np.inf, 0.3, 0.5, 0.9])  # fraction of the beam
        loads.append(
            Load(
                mass=float(10 ** rng.uniform(-3.0, 2.0) * MASS_PER_LENGTH * LENGTH),
                speed=float(speed * rng.choice([1, -1])),
                entry_time=float(entry),
                deceleration=float(speed**2 / (2 * stop * LENGTH)),
                kind=str(rng.choice(["mass", "mass", "force"])),
            )
        )
    return loads


def _case(beam: str, modes: int, damping: float, loads: list[Load], duration: float) -> jb.Case:
    ends = {"pinned": "pinned-pinned", "paired": "clamped-clamped", "free": "free-free"}[beam]
    clamp = [jb.Support(LENGTH / 2, rotational_stiffness=CLAMP)]
    kinds = {"mass": jb.MovingMass, "force": jb.MovingForce}
    return jb.Case(
        jb.Beam(LENGTH, RIGIDITY, MASS_PER_LENGTH, damping_ratio=damping, modes=modes, ends=ends),
        supports=clamp if beam == "paired" else [],
        sensors=[jb.Sensor(float(x)) for x in SENSORS],
        loads=[
            kinds[load.kind](
                mass=load.mass,
                speed=load.speed,
                entry_time=load.entry_time,
                deceleration=load.deceleration,
            )
            for load in loads
        ],
        run=jb.Run(duration, sample_rate=SAMPLES / duration),
    )


TIGHT = 1e-10  # tolerance of the run beside which the errors of each case are measured
ROUNDING = 1e-9  # of the largest deflection; neither scipy nor the tight run are more accurate
PLACES = np.linspace(0.0, LENGTH, 34)[1:-1]  # m
SCIPY_FRACTION = 0.08  # of the cases that scipy integrates in seconds: 500 of 10 000
MAX_PHASE = 3000.0  # rad; scipy takes seconds for as much of the highest mode, loads on the beam
SCIPY_LONGEST = 10.0  # s of the processor, of an integration by scipy


class Outcome(NamedTuple):
    """Result of the checks of a case; errors are relative to the largest deflection."""

    index: int
    modes: int
    steps: int = 0
    stated: float = 0.0  # error
    true: float | None = None  # error beside a run of tighter tolerance, None where there is none
    by_scipy: float | None = None  # error beside scipy, None where that was not asked
    faults: tuple[str, ...] = ()
    refusal: str = ""  # message of a case that no step integrates
    seconds: float = 0.0  # of the processor
    force: float = 0.0  # error of the lowest contact forces, relative to the largest force
    unfinished: bool = False  # whether it took too long, and was left
    left_by_scipy: bool = False  # whether scipy took too long

    @property
    def tried(self) -> float:
        """Processor time (s) after which it was left; infinite if it was not."""
        return self.seconds if self.unfinished else np.inf

    @property
    def largest(self) -> float | None:
        """Largest true error; None where nothing was compared."""
        return max((e for e in (self.true, self.by_scipy) if e is not None), default=None)

    @property
    def exceeds(self) -> bool:
        """Whether a true error is larger than the stated one, and than rounding."""
        return (self.largest or 0.0) > max(self.stated, ROUNDING)


class Errors(NamedTuple):
    """Differences that are errors of the steps: of forces (N), and of times of loss (s)."""

    force: float
    time: float


class TooLongError(Exception):
    """A case took longer than it may."""


@contextlib.contextmanager
def at_most(seconds: float) -> Iterator[None]:
    """A context that ends after some processor time (s) of this process; never if it is infinite.

    Raises TooLongError then.
    """

    expired = False

    def stop(*_):
        """Handler of the signal; raises TooLongError."""
        nonlocal expired
        expired = True
        raise TooLongError

    former = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds if np.isfinite(seconds) else 0.0)
    try:
        yield
    except Exception:
        if expired:  # code that catches what it does not know may raise something else instead
            raise TooLongError from None
        raise
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, former)


def check(seed: int, index: int, longest: float = np.inf, plain: bool = False) -> Outcome:
    """Outcome of a drawn case, checked for at most `longest` (s) of processor time.

    A `plain` check has no run of tighter tolerance: numbers are finite, the verdict agrees with
    them, and the sample that is integrated by scipy agrees with that.
    """
    start, drawn = time.process_time(), draw(seed, index)
    outcome = Outcome(index, drawn.case.beam.modes)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)
        try:
            with at_most(longest):
                outcome, record = _checked(outcome, drawn, plain)
        except TooLongError:
            outcome, record = outcome._replace(unfinished=True), None
        if record is not None:
            outcome = _beside_scipy(seed, outcome, drawn, record)
    return outcome._replace(seconds=time.process_time() - start)


def _checked(outcome: Outcome, drawn: Drawn, plain: bool) -> tuple[Outcome, Record | None]:
    """Outcome of a case without scipy and its time, and its run unless that is refused."""
    try:
        record = jb.simulate(drawn.case)
    except RuntimeError as error:
        return outcome._replace(refusal=str(error)), None
    faults = [
        *nan_faults(record),
        *beyond_errors(lambda errors: consistency_faults(drawn, record, errors), drawn, record),
    ]
    outcome = outcome._replace(steps=record.steps, stated=float(record.error_estimate))
    tight = None if plain else _tight(drawn.case)
    if tight is not None:
        outcome = outcome._replace(
            true=relative_error(*(_along(each) for each in (record, tight))),
            force=relative_error(
                *(np.nan_to_num(each.lowest_contact_force, posinf=0.0) for each in (record, tight)),
                size=largest_force(tight),
            ),
        )
        faults += beyond_errors(lambda errors: verdict_faults(record, tight, errors), drawn, record)
    return outcome._replace(faults=tuple(faults)), record


def _beside_scipy(seed: int, outcome: Outcome, drawn: Drawn, record: Record) -> Outcome:
    """Outcome of a case with that of scipy, if it is in the sample."""
    sampled = np.random.default_rng([seed, outcome.index, 1]).random() < SCIPY_FRACTION
    if not sampled or highest_phase(drawn) >= MAX_PHASE:
        return outcome
    try:
        with at_most(SCIPY_LONGEST):
            by_scipy, wrong = beside_scipy(drawn, record)
    except TooLongError:
        return outcome._replace(left_by_scipy=True)
    return outcome._replace(by_scipy=by_scipy, faults=(*outcome.faults, *wrong))


def _tight(case: jb.Case) -> Record | None:
    """The run at a tighter tolerance; None where rounding is larger than that."""
    try:
        return jb.simulate(case, tolerance=TIGHT)
    except RuntimeError:
        return None


def _along(record: Record) -> np.ndarray:
    """Deflections (m) at SENSORS and PLACES: errors are relative to the largest of the beam."""
    x = np.concatenate([SENSORS, PLACES])
    return np.asarray(record.coordinates) @ np.asarray(record.modes.shapes(x)).T


def nan_faults(record: Record) -> list[str]:
    """Lines on numbers that are not finite in a record whose verdict does not say so."""
    if "diverges" in record.verdict:
        return []
    may_be_nan = {"load_position", "contact_lost_time", "contact_lost_position"}
    faults = []
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        if field.name in {"case", "modes", *may_be_nan} or value is None:
            continue
        if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(value)):
            faults.append(f"{field.name} is not finite: {record.verdict}")
    return faults


def beyond_errors(
    faults_of: Callable[[Errors], list[str]], drawn: Drawn, record: Record
) -> list[str]:
    """Faults of a run at differences of contact forces and their losses that no steps explain.

    Those beyond rounding are looked at again with the errors of the steps.
    """
    return faults_of(step_errors(drawn)) if faults_of(rounding(drawn, record)) else []


def rounding(drawn: Drawn, record: Record) -> Errors:
    """Differences that are rounding."""
    return Errors(ROUNDING * largest_force(record), ROUNDING * drawn.duration)


def step_errors(drawn: Drawn) -> Errors:
    """Twice the largest change of contact forces, and of losses, as steps of a run are halved.

    Of the forces at samples and the lowest of each load, of losses in both runs.
    """
    plan = integration_plan(drawn.case)
    coarse = jb.simulate(drawn.case, plan=plan)
    finer = jb.simulate(drawn.case, plan=dataclasses.replace(plan, substeps=2 * plan.substeps))

    def change(name):
        difference = np.nan_to_num(getattr(coarse, name) - getattr(finer, name))
        return UNSAMPLED * float(np.abs(difference).max(initial=0.0))

    force = max(change("contact_force"), change("lowest_contact_force"))
    return Errors(*map(max, (force, change("contact_lost_time")), rounding(drawn, finer)))


def consistency_faults(drawn: Drawn, record: Record, errors: Errors) -> list[str]:
    """Numbers of a record that contradict each other, or its verdict, beyond its errors."""
    if "diverges" in record.verdict:
        return []
    faults = []
    if not record.error_estimate <= TOLERANCE:
        faults.append(f"the stated error is {record.error_estimate:.1e}")
    deflection = np.abs(record.deflection).max(axis=0)
    rounding = ROUNDING * np.abs(_along(record)).max()
    if (deflection > record.peak_deflection + rounding).any():
        faults.append(f"a sample of {deflection} m exceeds the peaks {record.peak_deflection} m")
    extremes = np.maximum(-np.asarray(record.smallest), record.largest)
    if not np.allclose(extremes, record.peak_deflection, rtol=0.0, atol=rounding):
        faults.append(f"peaks are {record.peak_deflection}, extremes {extremes} m")
    lost, lowest = np.asarray(record.contact_lost_time), np.asarray(record.lowest_contact_force)
    forces, on_beam = np.asarray(record.contact_force), np.isfinite(record.load_position)
    for i, load in enumerate(drawn.loads):
        leaves = min(load.time_at(drawn.span.length), drawn.duration)
        pulls = on_beam[:, i] & (forces[:, i] < -errors.force)
        if np.isfinite(lost[i]) != (lowest[i] < 0):
            faults.append(f"the lowest force of load {i} is {lowest[i]:.6g} N: {record.verdict}")
        if np.isfinite(lost[i]) and not load.entry_time <= lost[i] <= leaves * (1 + 1e-9):
            faults.append(f"load {i} leaves at {leaves:.6g} s: {record.verdict}")
        first = np.nan_to_num(lost[i], nan=np.inf) - errors.time
        if (np.asarray(record.times)[pulls] < first).any():
            faults.append(f"load {i} pulls before its contact is lost: {record.verdict}")
        if forces[on_beam[:, i], i].min(initial=np.inf) < lowest[i] - errors.force:
            faults.append(f"load {i} has forces below the lowest, {lowest[i]:.6g} N")
    if ("loses contact" in record.verdict) != np.isfinite(lost).any():
        faults.append(f"contact is lost at {lost} s: {record.verdict}")
    return faults


def largest_force(record: Record) -> float:
    """Largest contact force (N) of a run, at its samples or the lowest of a load."""
    lowest = np.nan_to_num(record.lowest_contact_force, posinf=0.0)
    return max(np.abs(part).max(initial=0.0) for part in (record.contact_force, lowest))


def relative_error(found, expected, size: float | None = None) -> float:
    """Largest difference relative to a size, by default the largest of the expected numbers."""
    size = np.abs(expected).max() if size is None else size
    return float(np.abs(np.asarray(found) - expected).max() / size) if size else 0.0


def verdict_faults(record: Record, tight: Record, errors: Errors) -> list[str]:
    """Smallest contact forces in which two runs differ by more than the errors."""
    lowest, exact = (np.asarray(each.lowest_contact_force) for each in (record, tight))
    wrong = (np.abs(lowest - exact) > errors.force) & ~np.isnan(exact)
    return [
        f"the lowest force of load {i} is {lowest[i]:.6g} N, not {exact[i]:.6g}"
        for i in np.flatnonzero(wrong)
    ]


def highest_phase(drawn: Drawn) -> float:
    """Phase (rad) of the highest mode while loads are on the beam."""
    ends = [min(load.time_at(drawn.span.length), drawn.duration) for load in drawn.loads]
    last = max(end - load.entry_time for end, load in zip(ends, drawn.loads, strict=True))
    return float(drawn.span.frequencies[-1] * last)


def beside_scipy(drawn: Drawn, record: Record) -> tuple[float, list[str]]:
    """Error of the deflections beside scipy, and verdicts that are wrong."""
    samples, lost = np.asarray(record.times), np.asarray(record.contact_lost_time)
    places = np.concatenate([SENSORS, PLACES])

    @functools.cache
    def found(margin):
        """Times of samples, and those of each loss, before it and after it, and the run there."""
        sides = [t + side * margin for t in lost[np.isfinite(lost)] for side in (-1, 0, 1)]
        times = np.unique(np.clip([*samples, *sides], 0.0, samples[-1]))
        return times, modal_equations.respond(drawn.span, drawn.loads, places, times)

    times, run = found(rounding(drawn, record).time)
    error = relative_error(_along(record), run.deflection[np.searchsorted(times, samples)])

    def faults_of(errors):
        times, run = found(errors.time)
        return contact_faults(record, times, run.contact_force, errors)

    return error, beyond_errors(faults_of, drawn, record)


def contact_faults(
    record: Record,
    times: Float[np.ndarray, " time"],
    forces: Float[np.ndarray, "time load"],
    errors: Errors,
) -> list[str]:
    """Verdicts that contradict forces (N) at times (s) by another integrator, beyond errors."""
    faults, lost = [], np.asarray(record.contact_lost_time)
    for i, (force, lost_time) in enumerate(zip(forces.T, lost, strict=True)):
        # At a first time of negative force one is, within errors; before it none is.
        before = force[times <= np.nan_to_num(lost_time, nan=np.inf) - errors.time]
        last = np.searchsorted(times, lost_time + errors.time)
        about = force[: last + 1][times[: last + 1] >= lost_time - errors.time]
        if before.min(initial=0.0) < -errors.force:
            faults.append(f"load {i} pulls by {-before.min():.6g} N: {record.verdict}")
        if about.size and about.min() > errors.force:
            faults.append(f"load {i} presses with {about.min():.6g} N: {record.verdict}")
        pressing = force[force != 0.0]  # on the beam
        if pressing.min(initial=np.inf) < record.lowest_contact_force[i] - errors.force:
            faults.append(f"load {i} has a force of {force.min():.6g} N: {record.verdict}")
    return faults


FRACTION = 0.999  # of the cases, whose true error is at most the stated one
QUANTILES = (0.5, 0.9, 0.99, 0.999, 1.0)
OUT = Path(__file__).parents[2] / "out"
PAGE = Path(__file__).parents[2] / "docs" / "_static" / "random_cases.md"


def stored_outcomes(file: Path) -> dict[int, Outcome]:
    """Outcomes in a file, by index; a last line that is cut off is left out."""
    outcomes = {}
    for line in file.read_text(encoding="utf-8").splitlines() if file.exists() else []:
        try:
            outcome = Outcome(**json.loads(line))
        except ValueError:
            continue
        outcomes[outcome.index] = outcome._replace(faults=tuple(outcome.faults))
    return outcomes


def outcomes_of(
    seed: int,
    count: int,
    file: Path,
    seconds: float = np.inf,
    longest: float = np.inf,
    plain: bool = False,
) -> list[Outcome]:
    """Outcomes of the first `count` cases, or of as many as are checked in some seconds.

    Those that take longer than `longest`, in seconds of the processor, are left.
    """
    outcomes, start = stored_outcomes(file), time.perf_counter()
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("a", encoding="utf-8") as lines:
        for index in range(count):
            if index in outcomes and not (longest > outcomes[index].tried):
                continue
            if time.perf_counter() - start > seconds:
                break
            outcomes[index] = check(seed, index, longest, plain)
            lines.write("\n" + json.dumps(outcomes[index]._asdict()))
            lines.flush()
    return [outcomes[index] for index in sorted(outcomes) if index < count]


def broken_laws(outcomes: Sequence[Outcome]) -> list[str]:
    """Lines on broken laws: one for each fault, and one for errors above the stated."""
    lines = [f"case {one.index}: {fault}" for one in outcomes for fault in one.faults]
    above = [one.index for one in outcomes if one.exceeds]
    compared = [one for one in outcomes if one.largest is not None]
    if len(above) > (1 - FRACTION) * len(compared):
        lines.append(f"the true error exceeds the stated one in cases {', '.join(map(str, above))}")
    return lines


def print_outcomes(outcomes: Sequence[Outcome]) -> None:
    """Print counts, and a table of the quantiles of errors."""
    refused = [o for o in outcomes if o.refusal]
    left = [o for o in outcomes if o.unfinished]
    by_scipy = [o for o in outcomes if o.by_scipy is not None]
    compared = [o for o in outcomes if o.largest is not None]
    above = sum(one.exceeds for one in compared)
    faults = sum(len(one.faults) for one in outcomes)
    modes = [one.modes for one in left] or [0]
    too_long = sum(one.left_by_scipy for one in outcomes)
    print(
        f"{len(outcomes)} random cases, of which {len(left)} took too long and were left"
        f" ({min(modes)} to {max(modes)} modes): {faults} faults of numbers or verdicts,"
        f" {len(refused)} refused. {len(by_scipy)} were integrated by scipy, too, and {too_long}"
        f" took too long there. The true error exceeds the stated one in {above} of {len(compared)}"
        " cases.\n"
    )
    for message in sorted({one.refusal for one in refused}):
        print(f"- {sum(one.refusal == message for one in refused)}: {message}")
    finished = [one for one in outcomes if not one.unfinished]
    known = [o for o in outcomes if o.true is not None]
    rows = {
        "stated error": [o.stated for o in finished],
        "true error, by shorter steps": [o.true for o in known],
        "true error, by scipy": [o.by_scipy for o in by_scipy],
        "true over stated error, above rounding": [
            o.largest / max(o.stated, 1e-16) for o in compared if o.largest > ROUNDING
        ],
        "error of the lowest contact force": [o.force for o in known],
        "processor time (s)": [o.seconds for o in finished],
    }
    print_table(("quantile", "cases", *(f"{100 * q:g} %" for q in QUANTILES)))
    for name, values in rows.items():
        if values:
            quantiles = (f"{x:.1e}" for x in np.quantile(values, QUANTILES))
            print_row((name, str(len(values)), *quantiles))


def write_page(outcomes: Sequence[Outcome]) -> None:
    """Write what is printed of the outcomes for a page of the site."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        print_outcomes(outcomes)
    PAGE.write_text(printed.getvalue(), encoding="utf-8")


def main() -> int:
    """Check the cases; return 1 if a law does not hold, else 0."""
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("count", type=int, nargs="?", default=10_000)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--seconds", type=float, default=np.inf, help="end after so many")
    options.add_argument("--longest", type=float, default=np.inf, help="seconds of a case")
    options.add_argument("--plain", action="store_true", help="no tighter run beside each")
    options.add_argument("--folder", type=Path, default=OUT, help="of the outcomes")
    options.add_argument("--page", action="store_true", help="write what is printed to the docs")
    options.add_argument("--anew", action="store_true", help="forget the outcomes of before")
    arguments = options.parse_args()
    name = f"random_cases_{arguments.seed}{'_plain' if arguments.plain else ''}.jsonl"
    file = arguments.folder / name
    if arguments.anew:
        file.unlink(missing_ok=True)
    limits = arguments.seconds, arguments.longest
    outcomes = outcomes_of(arguments.seed, arguments.count, file, *limits, arguments.plain)
    print_outcomes(outcomes)
    if arguments.page:
        write_page(outcomes)
    broken = broken_laws(outcomes)
    print("\n".join(broken))
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
