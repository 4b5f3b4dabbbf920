"""The demonstration: a rig identified from three logged crossings, and how near it came.

The logs ship with jaxbeam (`jaxbeam/demo`); they were made by the finite elements of
`tests/oracles`, not by jaxbeam, with noise and offsets, and the case file beside them is wrong
on purpose. The truth is known, so the fit can be judged.
"""

import itertools
import json as text
import tomllib
from importlib import resources
from pathlib import Path

import jaxbeam as jb
import tuning

FOLDER = "out/demo"
LOGS = ("log_1.csv", "log_2.csv", "log_3.csv")


def run(folder: str | Path | None = None, json: bool = False) -> None:
    """Identify the demonstration rig; write figure, fitted case and a record to a folder.

    Prints the fitted numbers beside the truth, or everything as JSON. Without a folder a fresh
    one is made below `out`. Raises FileExistsError if a given folder is not empty.
    """
    target = _fresh() if folder is None else Path(folder)
    if target.exists() and any(target.iterdir()):
        raise FileExistsError(f"the folder {target} is not empty; choose another one with -o")
    with resources.as_file(resources.files("jaxbeam") / "demo") as data:
        case = jb.load_case(data / "rig.toml")
        logs = [tuning.read_log(data / name) for name in LOGS]
        truth = tomllib.loads((data / "truth.toml").read_text())
    if not json:
        print(f"{case.title}: {len(truth)} numbers from {len(logs)} logs; about half a minute ...")
    fit = tuning.identify(case, logs, dict.fromkeys(truth))
    target.mkdir(parents=True, exist_ok=True)
    fit.plot().savefig(target / "fit.png")
    jb.save_case(fit.case, target / "fit.toml")
    summary = fit.to_dict() | {"truth": truth}
    (target / "fit.json").write_text(text.dumps(summary, indent=2))
    record = jb.simulate(fit.cases[0])
    record.to_netcdf(target / "record.nc")
    if json:
        print(text.dumps(summary))
        return
    print(_table(fit, truth))
    print(f"\n{fit.verdict}; log 1 simulated with these numbers: {record.verdict}")
    print(f"written to {target}: fit.png, fit.toml, fit.json, record.nc")


def _fresh() -> Path:
    """A folder that does not exist yet: out/demo, out/demo-2, ..."""
    names = (FOLDER if i == 1 else f"{FOLDER}-{i}" for i in itertools.count(1))
    return next(Path(name) for name in names if not Path(name).exists())


def _table(fit: tuning.Fit, truth: dict[str, float]) -> str:
    """Fitted numbers with their 95 % intervals beside the truth."""
    width, hits = max(map(len, truth)), 0
    lines = [
        f"{'number':{width}}  {'start':>11}  {'fitted':>11}  {'95 % interval':^25}  {'truth':>10}"
    ]
    for i, address in enumerate(fit.addresses):
        low, high = fit.intervals[i]
        inside = low <= truth[address] <= high
        hits += inside
        note = "" if inside else "  outside"
        lines.append(
            f"{address:{width}}  {fit.starts[i]:11.5g}  {fit.values[i]:11.5g}  "
            f"{low:11.5g} to {high:<10.5g}  {truth[address]:10.5g}{note}"
        )
    lines.append(f"{hits} of {len(truth)} intervals hold the truth (95 % should)")
    return "\n".join(lines)


if __name__ == "__main__":
    run()
