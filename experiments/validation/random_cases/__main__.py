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
"""

import argparse
import contextlib
import io
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.benchmarks.common import print_row, print_table
from experiments.validation.random_cases.checks import ROUNDING, Outcome, check

FRACTION = 0.999  # of the cases, whose true error is at most the stated one
QUANTILES = (0.5, 0.9, 0.99, 0.999, 1.0)
OUT = Path(__file__).parents[3] / "out"
PAGE = Path(__file__).parents[3] / "docs" / "_static" / "random_cases.md"


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
