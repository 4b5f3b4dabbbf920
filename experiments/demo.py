"""The demonstration: identification, sweep and control of one rig, in a row.

    python -m experiments.demo

A rig is identified from three logged crossings, swept over loads of other masses and speeds, and
given a controller whose gains are tuned by gradients, beside the hand-set gains and the least
achievable peak.

The logs are in `jaxbeam/case/library/demo`; they were made by the finite elements of
`tests/oracles`, not by jaxbeam, with noise and offsets, and the start values in the case file
beside them are wrong. The true values are known, and the fit is compared with them.
"""

import dataclasses
import itertools
import json as json_text
import tomllib
from importlib import resources
from pathlib import Path

import numpy as np
import xarray

import jaxbeam as jb
import tuning
from jaxbeam.files.report import check_report_folder
from jaxbeam.plot import plot_sweep
from jaxbeam.runtime.printer import text_table

FOLDER = "out/demo"
LOGS = ("log_1.csv", "log_2.csv", "log_3.csv")
MASS, SPEED = "loads.0.mass", "loads.0.speed"
SWEPT_VALUES = {MASS: np.linspace(0.05, 0.6, 45), SPEED: np.linspace(0.5, 6.0, 45)}  # kg, m/s
SLOWEST, FREE_VIBRATION = 0.5, 0.3  # m/s; s after the slowest crossing
# Gains that an engineer would start with, and the bounds of tuning.
HAND_SET = jb.PD(gains=[300.0], rate_gains=[3.0], lag=[0.002], period=0.004)
FREE_GAINS = {"controller.gains.0": (0.0, 3000.0), "controller.rate_gains.0": (0.0, 20.0)}
MODES = 3  # of the model in tuning
LOAD_CASES = tuning.LoadCases(
    training=tuning.full_grid({MASS: [0.2, 0.4], SPEED: [1.5, 2.0]}),
    held_out=tuning.full_grid({MASS: [0.25, 0.35], SPEED: [1.6, 1.9]}),
)
STEPS = 30


def run(folder: str | Path | None = None, json: bool = False) -> None:
    """Identify, sweep and control the demonstration rig; write all results to a folder.

    Prints the results as text, or with `json` as JSON. Without a folder a new one is made below
    `out`. Raises FileExistsError if the folder is not empty.
    """
    target = _new_folder() if folder is None else Path(folder)
    check_report_folder(target, overwrite=False)

    def print_progress(text: str) -> None:
        if not json:
            print(text, flush=True)

    with resources.as_file(resources.files("jaxbeam.case.library") / "demo") as data:
        case = jb.load_case(data / "rig.toml")
        logs = [tuning.read_log(data / name) for name in LOGS]
        truth = tomllib.loads((data / "truth.toml").read_text())
    print_progress(
        f"1. {case.title}: {len(truth)} parameters from {len(logs)} logs; about half a minute ..."
    )
    fit = tuning.identify(case, logs, dict.fromkeys(truth))
    print_progress(f"{_fit_table(fit, truth)}\n{fit.verdict}")
    target.mkdir(parents=True, exist_ok=True)
    fit.plot().savefig(target / "fit.png")
    jb.save_case(fit.case, target / "fit.toml")
    jb.simulate(fit.cases[0]).to_netcdf(target / "record.nc")

    runs = np.prod([values.size for values in SWEPT_VALUES.values()])
    print_progress(f"\n2. The identified rig under {runs} loads of other masses and speeds ...")
    results = jb.sweep(with_one_mass(fit.case, SLOWEST), SWEPT_VALUES, progress=False)
    plot_sweep(results).savefig(target / "map.png")
    results.to_netcdf(target / "map.nc")
    print_progress(_worst_run_text(fit.case, results))

    print_progress(
        "\n3. A controller tuned by gradients on four loads, and compared on four others ..."
    )
    tuned = tuning.tune(
        with_initial_controller(fit.case), FREE_GAINS, LOAD_CASES, steps=STEPS, progress=False
    )
    tuned.plot().savefig(target / "tuned.png")
    jb.save_case(tuned.case, target / "tuned.toml")
    print_progress(str(tuned))

    summary = fit.to_dict() | {"truth": truth, "tuned": tuned.to_dict()}
    (target / "demo.json").write_text(json_text.dumps(summary, indent=2))
    if json:
        print(json_text.dumps(summary))
    files = ", ".join(sorted(path.name for path in target.iterdir()))
    print_progress(f"\nwritten to {target}: {files}")
    print_progress(f"see it move in the browser: jaxbeam app {target / 'tuned.toml'}")


def with_one_mass(case: jb.Case, slowest: float) -> jb.Case:
    """The case under one mass, with a duration for its slowest crossing (m/s)."""
    duration = float(case.beam.length) / slowest + FREE_VIBRATION
    return dataclasses.replace(
        case, loads=(jb.MovingMass(mass=0.3, speed=slowest),), run=jb.Run(duration, 200.0)
    )


def with_initial_controller(case: jb.Case) -> jb.Case:
    """The case with the hand-set loop from the sensor at midspan to the shaker."""
    left, middle, right = case.sensors
    return dataclasses.replace(
        with_one_mass(case, min(run[SPEED] for run in LOAD_CASES.training)),
        beam=dataclasses.replace(case.beam, modes=MODES),
        sensors=(middle, left, right),
        controller=HAND_SET,
    )


def _worst_run_text(case: jb.Case, results: xarray.Dataset) -> str:
    """Sentence on the largest deflection of the sweep, and the runs that lose contact."""
    peaks = results.peak_deflection
    place = peaks.argmax(list(peaks.dims))
    worst, sensor = peaks.isel(place), case.sensors[int(place["sensor"])]
    lost_contact_share = results.contact_lost_time.notnull().any("load").mean()
    return (
        f"largest deflection {1e3 * float(worst):.3g} mm, at {float(sensor.position):g} m, under"
        f" {float(worst[MASS]):.3g} kg at {float(worst[SPEED]):.3g} m/s;"
        f" in {float(lost_contact_share):.0%} of the runs the load would lift off"
    )


def _new_folder() -> Path:
    """A folder that does not exist yet: out/demo, out/demo-2, ..."""
    names = (FOLDER if i == 1 else f"{FOLDER}-{i}" for i in itertools.count(1))
    return next(Path(name) for name in names if not Path(name).exists())


def _fit_table(fit: tuning.Fit, truth: dict[str, float]) -> str:
    """Fitted values with their 95 % intervals beside the true values."""
    rows, hits = [], 0
    for i, address in enumerate(fit.addresses):
        low, high = fit.intervals[i]
        inside = low <= truth[address] <= high
        hits += inside
        values = (fit.start_values[i], fit.values[i], low, high, truth[address])
        rows.append((address, *(f"{v:.5g}" for v in values), "" if inside else "outside"))
    header = ("parameter", "start", "fitted", "95 % from", "to", "truth", "")
    lines = text_table(header, rows, alignment="<>>>>><")
    lines.append(f"{hits} of {len(truth)} intervals contain the true value (95 % should)")
    return "\n".join(lines)


if __name__ == "__main__":
    run()
