"""Count lines and files of the packages, and the files that a run enters, for CONTRIBUTING.

    python -m docs.count_files [--write]

A file is entered if one of its functions is called; what its import does is not counted.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "CONTRIBUTING.md"
BEGIN, END = "<!-- counts of files -->\n", "<!-- end of counts of files -->"
PACKAGES = ("jaxbeam", "tuning", "experiments", "tests")
SETUP = """
import dataclasses
import jaxbeam as jb, tuning
rig = jb.load_case("jaxbeam/case/library/demo/rig.toml")
log = tuning.read_log("jaxbeam/case/library/demo/log_1.csv")
strip = jb.load_case("examples/controlled_rig/case.toml")
case = dataclasses.replace(strip, controller=None)
loads = tuning.LoadCases(({"loads.0.mass": 0.25},), ({"loads.0.mass": 0.4},))
gains = {"controller.gains.0": (5e2, 5e4)}
from docs.count_files import record_files
"""
# What a user calls, at its smallest; cases and logs are read before.
RUNS = {
    "simulate": "jb.simulate(case)",
    "sweep": 'jb.sweep(case, {"loads.0.mass": [0.2, 0.3]}, progress=False)',
    "identify": 'tuning.identify(rig, log, ["beam.flexural_rigidity"])',
    "tune": "tuning.tune(strip, gains, loads, steps=1, progress=False)",
}


def entered_files(run: str) -> set[Path]:
    """Files of the packages whose functions a run calls, in a new process with empty caches."""
    with tempfile.TemporaryDirectory() as folder:
        code = f"{SETUP}record_files({run!r}, globals())"
        ended = subprocess.run(
            [sys.executable, "-c", code],
            cwd=ROOT,
            env=os.environ | {"XDG_CACHE_HOME": folder, "HOME": folder},
            check=True,
            stdout=subprocess.PIPE,
            text=True,
        )
    return {Path(line) for line in ended.stdout.splitlines() if line.endswith(".py")}


def record_files(run: str, names: dict) -> None:
    """Run a statement, and print the files of the packages whose functions it calls, one a line."""
    import threading

    codes = set()

    def profile(frame, event, argument):
        if event == "call" and frame.f_code not in codes and not _importing(frame):
            codes.add(frame.f_code)

    threading.setprofile(profile)
    sys.setprofile(profile)
    exec(run, names)
    sys.setprofile(None)
    called = {code.co_filename for code in codes.copy()}
    inside = {Path(name) for name in called if Path(name).is_relative_to(ROOT)}
    parts = sorted(path.relative_to(ROOT) for path in inside)
    print("\n".join(str(path) for path in parts if path.parts[0] in PACKAGES))


def _importing(frame) -> bool:
    """Whether a frame is that of a call by the import of a module."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def counts_table() -> str:
    """Lines and files of each package, and the files that each run enters, as two tables."""
    rows = ["| package | lines | files |", "| --- | ---: | ---: |"]
    for package in PACKAGES:
        paths = sorted((ROOT / package).rglob("*.py"))
        lines = sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)
        rows.append(f"| {package} | {lines} | {len(paths)} |")
    rows += ["", "| run | files entered |", "| --- | ---: |"]
    rows += [f"| {name} | {len(entered_files(run))} |" for name, run in RUNS.items()]
    return "\n".join(rows) + "\n"


def main() -> None:
    """Print the tables, or write them into CONTRIBUTING with --write."""
    table = counts_table()
    print(table)
    if "--write" in sys.argv[1:]:
        before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
        PAGE.write_text(before + BEGIN + table + END + rest.split(END)[1], encoding="utf-8")


if __name__ == "__main__":
    main()
