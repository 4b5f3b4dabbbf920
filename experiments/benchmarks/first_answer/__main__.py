"""Time to the first answer: fresh processes with empty caches, beside a script with scipy.

    python -m experiments.benchmarks.first_answer [--only TEXT] [--repeat 3] [--quick]

Wall and processor seconds, medians, of commands from start to end, and of calls in a session that
has imported jaxbeam. Each runs in a process of its own with an empty folder of caches and without
compiled C; rows that begin with "..." and say so find the cache of the one before. Beside them
`import jax` alone, and the same run by a script of numpy and scipy, whose frequencies and peaks are
compared. Goals are wall seconds, with "+" beyond `import jax`; a star marks a goal missed.
"""

import compileall
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from experiments.benchmarks.first_answer.rows import ROWS, SETUP, TWO_SPANS, Row

ROOT = Path(__file__).parents[3]
SCRIPT = ROOT / "experiments/benchmarks/rivals/two_spans_script.py"
AGREEMENT = 1e-6  # relative, of frequencies and peaks
HEADER = ("from a fresh process, empty caches", "wall (s)", "processor (s)", "goal, wall (s)")
RULER = ("---", "---:", "---:", "---:")


class Seconds(NamedTuple):
    """Wall and processor time in s."""

    wall: float
    processor: float


def run_process(arguments: Sequence[str], folder: Path, fails: bool = False) -> tuple[Seconds, str]:
    """Times of a Python process in a folder, which holds its caches too, and what it prints.

    Raises RuntimeError, with what it prints, unless it ends as expected.
    """
    environment = os.environ | {"XDG_CACHE_HOME": str(folder / "cache"), "PYTHONPATH": str(ROOT)}
    # Modules are compiled to bytecode, as pip does when it installs them; `main` does so first.
    unset = "JAX_COMPILATION_CACHE_DIR", "JAXBEAM_CACHE_SIZE", "PYTHONDONTWRITEBYTECODE"
    for name in unset:
        environment.pop(name, None)
    with open(folder / "printed", "w+") as printed:
        start = time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, *arguments],
            cwd=folder,
            env=environment,
            stdout=printed,
            stderr=subprocess.STDOUT,
        )
        _, status, usage = os.wait4(process.pid, 0)
        wall = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        printed.seek(0)
        text = printed.read()
    if bool(process.returncode) != fails:
        raise RuntimeError(f"{' '.join(arguments)[:200]}: {text[-2000:]}")
    return Seconds(wall, usage.ru_utime + usage.ru_stime), text


def measure_row(row: Row, folder: Path) -> Seconds:
    """Times of a row in a folder, empty unless it follows from the row before."""
    case = folder / "case.toml"
    case.write_text(row.case)
    if row.command:
        words = [word.replace("{case}", str(case)) for word in row.command]
        return run_process(["-m", "jaxbeam", *words], folder, row.fails)[0]
    lines = [
        SETUP.replace("{case}", str(case)),
        row.setup,
        "import json, time",
        "start = time.perf_counter(), time.process_time()",
        row.code,
        "end = time.perf_counter(), time.process_time()",
        "print(json.dumps([end[0] - start[0], end[1] - start[1]]))",
    ]
    return Seconds(*json.loads(run_process(["-c", "\n".join(lines)], folder)[1].splitlines()[-1]))


def measure_script(folder: Path) -> tuple[Seconds, dict[str, list[float]]]:
    """Times of the script with scipy, and its frequencies (Hz) and peaks (m)."""
    seconds, printed = run_process([str(SCRIPT)], folder)
    return seconds, json.loads(printed)


def check_script(found: dict[str, list[float]]) -> float:
    """Largest relative difference of frequencies and peaks between the script and jaxbeam.

    Raises ValueError if it is above AGREEMENT.
    """
    import numpy as np

    import jaxbeam as jb

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "case.toml")
        path.write_text(TWO_SPANS)
        case = jb.load_case(path)
    pairs = (
        (found["frequencies"], jb.modes(case).frequencies),
        (found["peaks"], jb.simulate(case).peak_deflection),
    )
    difference = max(float(np.max(np.abs(np.divide(a, b) - 1))) for a, b in pairs)
    if not difference < AGREEMENT:
        raise ValueError(f"the script and jaxbeam differ by {difference:.1e}")
    return difference


def median(measured: Sequence[Seconds]) -> Seconds:
    """Medians of wall and of processor times."""
    return Seconds(*map(statistics.median, zip(*measured, strict=True)))


def measure_rows(rows: Sequence[Row], repeat: int) -> list[Seconds]:
    """Medians of the times of a row and of those that follow from it, in as many new folders."""
    measured = []
    for _ in range(1 if rows[0].slow else repeat):
        with tempfile.TemporaryDirectory() as folder:
            measured.append([measure_row(row, Path(folder)) for row in rows])
    return [median(times) for times in zip(*measured, strict=True)]


def groups(rows: Sequence[Row]) -> list[list[Row]]:
    """Rows, each with those that follow from it."""
    grouped: list[list[Row]] = []
    for row in rows:
        if row.again:
            grouped[-1].append(row)
        else:
            grouped.append([row])
    return grouped


def table_line(row: Row, seconds: Seconds, jax_import: Seconds) -> tuple[str, ...]:
    """Cells of a row: a star marks a goal missed."""
    limit = row.goal + (jax_import.wall if row.beyond_jax else 0.0)
    star = "" if seconds.wall <= limit else " *"
    goal = f"{'+ ' if row.beyond_jax else ''}{row.goal:g}{star}"
    return row.name, f"{seconds.wall:.2f}", f"{seconds.processor:.2f}", goal


def main() -> None:
    """Measure the rows and print the table."""
    from experiments.benchmarks.common import parser, print_row

    options = parser(__doc__)
    options.add_argument("--only", default="", help="only rows whose names have this text")
    options.add_argument("--repeat", type=int, default=3, help="processes of each row")
    options.add_argument("--quick", action="store_true", help="once each, without the slow rows")
    arguments = options.parse_args()
    repeat = 1 if arguments.quick else arguments.repeat
    for package in ("jaxbeam", "tuning", "experiments"):
        compileall.compile_dir(ROOT / package, quiet=1)
    print_row(HEADER)
    print_row(RULER)
    with tempfile.TemporaryDirectory() as folder:
        jax_import = median(
            [run_process(["-c", "import jax"], Path(folder))[0] for _ in range(repeat)]
        )
        print_row(("`import jax`", *(f"{s:.2f}" for s in jax_import), ""))
        scripts = [measure_script(Path(folder)) for _ in range(repeat)]
        script = median([seconds for seconds, _ in scripts])
        print_row(("modes and run by scipy, a script", *(f"{s:.2f}" for s in script), ""))
    for rows in groups(ROWS):
        if arguments.only not in rows[0].name or (arguments.quick and rows[0].slow):
            continue
        for row, seconds in zip(rows, measure_rows(rows, repeat), strict=True):
            print_row(table_line(row, seconds, jax_import))
    print(f"\nthe script and jaxbeam agree to {check_script(scripts[0][1]):.0e}")


if __name__ == "__main__":
    main()
