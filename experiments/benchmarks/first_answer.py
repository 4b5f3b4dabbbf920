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

# Six modes on two spans, two loads, 2 s at 1 kHz; `rivals/two_spans_script.py` has the same.
TWO_SPANS = """
[beam]
length = 1.2
flexural_rigidity = 11.68
mass_per_length = 0.535
damping_ratio = 0.03
ends = "clamped-pinned"
modes = 6
[[supports]]
position = 0.5
[[sensors]]
position = 0.2
[[sensors]]
position = 0.8
[[loads]]
kind = "mass"
mass = 0.3
speed = 1.0
[[loads]]
kind = "force"
force = 3.0
speed = 1.3
entry_time = 0.3
[run]
duration = 2.0
sample_rate = 1000
"""
PATCHES = "".join(
    f"""
[[actuators]]
kind = "patch"
start = {start}
end = {start + 0.085}
moment_per_volt = 8.292e-4
amplifier_gain = 200.0
limits = [-2.5, 7.5]
"""
    for start in (0.16, 0.76)
)
WEIGHTS = f"""
state_weight = {[1e6] * 12}
command_weight = [1.0, 1.0]
period = 0.001
"""
KALMAN = """
[controller.estimator]
kind = "kalman"
process_noise = 0.02
measurement_noise = 1e-5
loads = "known"
"""
CONTROLLERS = {
    "feedback": 'kind = "feedback"\ngains = [2e3, 2e3]\nperiod = 0.001\n',
    "LQR": f'kind = "lqr"\nsampling = "exact"{WEIGHTS}',
    "LQR with Kalman filter": f'kind = "lqr"\nsampling = "exact"{WEIGHTS}{KALMAN}',
    "MPC": 'kind = "mpc"\nhorizon = 6\nmoves = 4\nmove_weight = 1e-11\nloads = "known"\n'
    "period = 0.001\n",
}

# Axles of the train HSLM-A1 of EN 1991-2: 50 of 170 kN, the first at 0 (m).
POWER_CAR, BOGIE = (0.0, 3.0, 14.0, 17.0), (0.0, 2.0)
AXLES = [
    *POWER_CAR,
    *(20.525 + x for x in BOGIE),
    *(35.7625 + 18.0 * i + x for i in range(19) for x in BOGIE),
    *(375.0 + x for x in BOGIE),
    *(380.525 + x for x in POWER_CAR),
]
SPAN, TRAIN_SPEED = 25.0, 64.5  # m, m/s
SPEEDS = [40.0 + 0.5 * i for i in range(101)]  # m/s


def train(axles: int, kind: str = 'force"\nforce = 170e3', speed: float = TRAIN_SPEED) -> str:
    """Case file of a bridge under the first axles of the train."""
    loads = [
        f'[[loads]]\nkind = "{kind}\nspeed = {speed}\nentry_time = {x / speed}\n'
        for x in AXLES[:axles]
    ]
    return f"""
[beam]
length = {SPAN}
flexural_rigidity = 3.05e10
mass_per_length = 15000.0
damping_ratio = 0.01
modes = 6
[[sensors]]
position = {SPAN / 2}
{"".join(loads)}
[run]
duration = {(AXLES[axles - 1] + SPAN) / speed + 1.0}
sample_rate = 1000
"""


def over_speeds() -> tuple[str, ...]:
    """Options of `jaxbeam sweep` for the whole train at all speeds."""
    values = {f"loads.{i}.speed": SPEEDS for i in range(len(AXLES))}
    values |= {f"loads.{i}.entry_time": [x / v for v in SPEEDS] for i, x in enumerate(AXLES)}
    options = [f"--over={a}={','.join(map(repr, numbers))}" for a, numbers in values.items()]
    return (*options, "--paired")


# A wagon of 10 degrees of freedom on the bridge, without a profile.
WAGON = f"""
[beam]
length = {SPAN}
flexural_rigidity = 3.05e10
mass_per_length = 15000.0
damping_ratio = 0.01
modes = 5
[[sensors]]
position = {SPAN / 2}
[[loads]]
kind = "wagon"
speed = 50.0
body_mass = 32000.0
body_inertia = 1.97e6
bogie_mass = 2615.0
bogie_inertia = 1476.0
wheelset_mass = 1813.0
primary_stiffness = 2.4e6
primary_damping = 8.0e3
secondary_stiffness = 8.6e5
secondary_damping = 4.0e4
bogie_distance = 19.0
wheelset_distance = 2.56
[run]
duration = 2.0
sample_rate = 1000
"""


class Row(NamedTuple):
    """A row of the table.

    Either `command`, arguments of `jaxbeam` in a process of its own, or `code` in a process that
    has run SETUP and `setup`; `{case}` stands for the case file, of text `case`. The `goal` (s) is
    of processor time; with `beyond_jax` it is beyond `import jax`. Rows that follow from the one
    before (`again`) find its cache and files. `slow` rows are measured once.
    """

    name: str
    goal: float
    command: tuple[str, ...] = ()
    code: str = ""
    setup: str = ""
    case: str = TWO_SPANS
    beyond_jax: bool = False
    again: bool = False
    slow: bool = False
    fails: bool = False


SETUP = """
import dataclasses, numpy as np, jaxbeam as jb
jb.modes, jb.simulate, jb.sweep, jb.state_space, jb.frequency_response, jb.bound
jb.statics.static_peak
from jaxbeam.analysis.linearised_loop import linearised_loop
from jaxbeam.analysis.stability import margins
from jaxbeam.analysis.stability import frozen_poles, growth
case = jb.load_case("{case}")
"""
SWEPT = "loads.0.mass", "loads.0.speed"
OVER = f"over = dict(zip({SWEPT}, (np.linspace(0.1, 0.5, 64), np.linspace(0.7, 3, 64))))"
RECORD = ("simulate", "{case}", "-o", "run.nc", "--plot", "--overwrite")
DEMO = """
import tomllib, tuning
from importlib import resources
data = resources.files("jaxbeam.case.library") / "demo"
case, truth = jb.load_case(data / "rig.toml"), tomllib.loads((data / "truth.toml").read_text())
logs = [tuning.read_log(data / f"log_{i}.csv") for i in (1, 2, 3)]
"""
CONTROLLED = {name: f"{TWO_SPANS}{PATCHES}[controller]\n{c}" for name, c in CONTROLLERS.items()}
ROWS = (
    Row("help of the command line", 0.4, ("--help",)),
    Row("a wrong argument", 0.4, ("simulate", "{case}", "--plott"), fails=True),
    Row("`jaxbeam modes`", 0.5, ("modes", "{case}"), beyond_jax=True),
    Row("`jaxbeam simulate`, record and picture", 1.0, RECORD, beyond_jax=True),
    Row(
        "... after a changed number",
        1.0,
        (*RECORD, "--set", "loads.0.mass=0.31"),
        beyond_jax=True,
        again=True,
    ),
    *(
        Row(f"... with {name}", 3.0, RECORD, case=case, beyond_jax=True)
        for name, case in CONTROLLED.items()
    ),
    Row("`jb.modes`", 0.05, code="jb.modes(case)"),
    Row("`jb.simulate`", 0.3, code="jb.simulate(case)"),
    Row(
        "... after a changed number",
        0.3,
        setup="jb.simulate(case)\nbeam = dataclasses.replace(case.beam, flexural_rigidity=12.0)",
        code="jb.simulate(dataclasses.replace(case, beam=beam))",
    ),
    *(
        Row(f"... with {name}", 3.0, code="jb.simulate(case)", case=case)
        for name, case in CONTROLLED.items()
    ),
    *(
        Row(f"a train of {axles} forces", goal, code="jb.simulate(case)", case=train(axles))
        for axles, goal in ((4, 0.5), (16, 1.0), (50, 3.0))
    ),
    Row(
        "a train of 50 masses",
        3.0,
        code="jb.simulate(case)",
        case=train(50, 'mass"\nmass = 17000.0'),
    ),
    Row("a wagon", 1.0, code="jb.simulate(case)", case=WAGON),
    Row(
        "HSLM-A1, 50 forces x 101 speeds, command",
        10.0,
        ("sweep", "{case}", *over_speeds(), "-o", "speeds.zarr"),
        case=train(len(AXLES), speed=SPEEDS[0]),
        slow=True,
    ),
    Row(
        "... again",
        3.0,
        ("sweep", "{case}", *over_speeds(), "-o", "again.zarr"),
        case=train(len(AXLES), speed=SPEEDS[0]),
        again=True,
        slow=True,
    ),
    Row("`jb.state_space`", 0.3, code="jb.state_space(case).at(0.5).A"),
    Row(
        "`jb.frequency_response`",
        0.3,
        code='jb.frequency_response(case, np.geomspace(1, 400, 2000), [("force@0.3", '
        '"deflection@0.8")])',
    ),
    Row("`jb.statics.static_peak`", 0.3, code="jb.statics.static_peak(case, [0.2, 0.8])"),
    Row("`jb.influence_line`", 0.3, code="jb.influence_line(case, 0.8, np.linspace(0, 1.2, 101))"),
    Row("`jb.bound`, commands every 10 ms", 2.0, code="jb.bound(case)", case=TWO_SPANS + PATCHES),
    Row(
        "stability: margins, poles, growth",
        0.3,
        code="margins(linearised_loop(case, -1.0), 0), frozen_poles(case), growth(case)",
        case=CONTROLLED["feedback"],
    ),
    Row(
        "`jaxbeam sweep`, 4096 runs",
        2.5,
        (
            "sweep",
            "{case}",
            *(f"--over={SWEPT[i]}={limits}:64" for i, limits in enumerate(("0.1:0.5", "0.7:3"))),
            "-o",
            "runs.zarr",
        ),
        beyond_jax=True,
    ),
    Row(
        "`jb.sweep`, 4096 runs",
        1.0,
        code="jb.sweep(case, over, progress=False)",
        setup=OVER,
    ),
    Row(
        "... of another structure, C compiled",
        1.0,
        code="jb.sweep(case, over, progress=False)",
        case=TWO_SPANS.replace("modes = 6", "modes = 5"),
        setup=OVER,
        again=True,
    ),
    Row(
        "`tuning.identify` of the demo",
        10.0,
        code="tuning.identify(case, logs, dict.fromkeys(truth))",
        setup=DEMO,
        slow=True,
    ),
    Row("`jaxbeam demo`", 30.0, ("demo",), slow=True),
)


ROOT = Path(__file__).parents[2]
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
