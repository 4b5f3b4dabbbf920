"""Where the time of a sweep goes, by stages of the physics.

    python -m experiments.benchmarks.profile [--modes 3 12] [--keep FOLDER]

The sweep of the speed benchmark runs once under JAX's profiler, by XLA, each number of modes in its
own process. Each kernel that XLA makes counts for the innermost `jax.named_scope` of jaxbeam in
which it was written; loops and branches are left out, as they only contain others. Stages that are
never in a kernel take too little time to be seen. --keep saves the traces, a folder for each number
of modes, for https://ui.perfetto.dev.
"""

import argparse
import collections
import gzip
import json
import os
import re
import tempfile
from pathlib import Path

import jax

from experiments.benchmarks.common import (
    measure_in_subprocess,
    parser,
    print_row,
    print_table,
    without_native,
)
from experiments.benchmarks.sweep import sweep_peaks
from jaxbeam.simulation.sweeps.integration import integrate_block

STAGES = (
    "modes",
    "modal_model",
    "propagators",
    "load_path",
    "collocation",
    "propagation",
    "running_peaks",
    "peaks",
)
# Their time is that of the kernels they call; a call without kernels is a kernel itself.
CONTROL_FLOW = re.compile(r"(while|cond|conditional)[.\d]*$")


def stage_of(op_name: str) -> str:
    """The innermost stage in the name of an operation, such as jit(f)/load_path/while/dot."""
    named = [part for part in op_name.split("/") if part in STAGES]
    return named[-1] if named else "the rest"


def operation_stages(dump: Path, module: str) -> dict[str, str]:
    """The stage of every operation of a compiled module, from XLA's dump.

    XLA may make one kernel of a whole loop, a call; it counts for all stages of what it calls.
    """
    stages, calls = {}, {}
    within = collections.defaultdict(set)  # stages and computations named by each computation
    for path in dump.glob(f"*{module}*after_optimizations.txt"):
        computation = ""
        for line in path.read_text().splitlines():
            if begins := re.match(r"(?:ENTRY )?%?(\S+) \(.*{$", line):
                computation = begins[1]
            within[computation] |= set(re.findall(r"(?:to_apply|body|calls)=%([^\s,]+)", line))
            if named := re.match(r'\s+(?:ROOT )?%(\S+) = .*op_name="([^"]*)"', line):
                stages[named[1]] = stage_of(named[2])
                within[computation].add(stages[named[1]])
                if called := re.search(r" call\(.*to_apply=%([^\s,]+)", line):
                    calls[named[1]] = called[1]
    for name, computation in calls.items():
        inner, todo = set(), [computation]
        while todo:
            new = within[todo.pop()] - inner
            inner |= new
            todo += [part for part in new if part in within]
        stages[name] = " and ".join(sorted(inner & set(STAGES))) or stages[name]
    return stages


def stage_shares(trace: Path, stages: dict[str, str], module: str) -> dict[str, float]:
    """Fraction of each stage in the time of all kernels of a module, largest first."""
    (path,) = trace.rglob("*.trace.json.gz")
    with gzip.open(path) as file:
        events = json.load(file)["traceEvents"]
    times: collections.Counter[str] = collections.Counter()
    open_until: dict[tuple, list] = collections.defaultdict(list)  # ends and stages of events
    for event in sorted(events, key=lambda event: (event.get("ts", 0), -event.get("dur", 0))):
        arguments = event.get("args", {})
        name = arguments.get("hlo_op", "")
        if arguments.get("hlo_module") != module or CONTROL_FLOW.match(name):
            continue
        stage, duration = stages.get(name, "the rest"), event.get("dur", 0.0)
        enclosing = open_until[event["pid"], event["tid"]]
        while enclosing and enclosing[-1][0] <= event["ts"]:
            enclosing.pop()
        if enclosing:  # an event within another counts for its own stage alone
            times[enclosing[-1][1]] -= duration
        enclosing.append((event["ts"] + duration, stage))
        times[stage] += duration
    return {stage: time / times.total() for stage, time in times.most_common()}


def measure(modes: int, folder: Path) -> dict[str, float]:
    """Fraction of each stage in the time of a sweep, largest first; the trace stays in a folder."""
    flags = f"--xla_dump_to={folder / 'hlo'} --xla_dump_hlo_as_text"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flags}"
    jax.config.update("jax_enable_compilation_cache", False)  # cached programs are not dumped
    settings = jax.profiler.ProfileOptions()
    settings.python_tracer_level = 0
    with without_native():
        sweep_peaks(modes)
        with jax.profiler.trace(str(folder / "trace"), profiler_options=settings):
            sweep_peaks(modes)
    module = f"jit_{integrate_block.__name__}"
    return stage_shares(folder / "trace", operation_stages(folder / "hlo", module), module)


def main() -> None:
    """Profile the sweeps and print the table."""
    options = parser(__doc__, modes=[3, 12])
    options.add_argument("--keep", type=Path, help="folder for the traces")
    options.add_argument("--measure", nargs=2, help=argparse.SUPPRESS)
    arguments = options.parse_args()
    if arguments.measure:
        modes, folder = arguments.measure
        print(json.dumps(measure(int(modes), Path(folder))))
        return
    kept, shares = arguments.keep or Path(tempfile.mkdtemp()), []
    for modes in arguments.modes:
        folder = (kept / f"modes_{modes}").absolute()
        shares.append(measure_in_subprocess("experiments.benchmarks.profile", modes, folder))
    print_table(("share of the time of 4096 crossings", *(f"{n} modes" for n in arguments.modes)))
    for stage in dict.fromkeys(stage for found in shares for stage in found):
        cells = (f"{100 * found.get(stage, 0.0):.0f} %" for found in shares)
        print_row((stage, *cells))


if __name__ == "__main__":
    main()
