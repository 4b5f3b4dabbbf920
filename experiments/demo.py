"""The demonstration: the three jobs of jaxbeam in a row, on one rig.

A rig is identified from three logged crossings; crossed by thousands of loads of other masses and
speeds; and given a controller whose gains are tuned by gradients, beside the hand-set ones and the
least peak that is possible at all.

The logs ship with jaxbeam (`jaxbeam/demo`); they were made by the finite elements of
`tests/oracles`, not by jaxbeam, with noise and offsets, and the case file beside them is wrong
on purpose. The truth is known, so the fit can be judged.
"""

import dataclasses
import itertools
import json as text
import tomllib
from importlib import resources
from pathlib import Path

import numpy as np

import jaxbeam as jb
import tuning
from jaxbeam.plot import plot_sweep

FOLDER = "out/demo"
LOGS = ("log_1.csv", "log_2.csv", "log_3.csv")
MASS, SPEED = "loads.0.mass", "loads.0.speed"
SWEPT_VALUES = {MASS: np.linspace(0.05, 0.6, 45), SPEED: np.linspace(0.5, 6.0, 45)}  # kg, m/s
SLOWEST, FREE_VIBRATION = 0.5, 0.3  # m/s; s of free vibration
# Rate and proportional gain of a loop that an engineer would begin with, and where they may go.
HAND_SET = jb.PD(gains=[300.0], rate_gains=[3.0], lag=[0.002], period=0.004)
FREE_GAINS = {"controller.gains.0": (0.0, 3000.0), "controller.rate_gains.0": (0.0, 20.0)}
MODES = 3  # of the model that the controller is tuned on
LOAD_CASES = tuning.LoadCases(
    training=tuning.full_grid({MASS: [0.2, 0.4], SPEED: [1.5, 2.0]}),
    held_out=tuning.full_grid({MASS: [0.25, 0.35], SPEED: [1.6, 1.9]}),
)
STEPS = 30


def run(folder: str | Path | None = None, json: bool = False) -> None:
    """Identify, sweep and control the demonstration rig; write all there is to a folder.

    Prints what was found, or everything as JSON. Without a folder a fresh one is made below `out`.
    Raises FileExistsError if a given folder is not empty.
    """
    target = _new_folder() if folder is None else Path(folder)
    if target.exists() and any(target.iterdir()):
        raise FileExistsError(f"the folder {target} is not empty; choose another one with -o")

    def print_progress(words: str) -> None:
        if not json:
            print(words, flush=True)

    with resources.as_file(resources.files("jaxbeam") / "demo") as data:
        case = jb.load_case(data / "rig.toml")
        logs = [tuning.read_log(data / name) for name in LOGS]
        truth = tomllib.loads((data / "truth.toml").read_text())
    print_progress(
        f"1. {case.title}: {len(truth)} numbers from {len(logs)} logs; about half a minute ..."
    )
    fit = tuning.identify(case, logs, dict.fromkeys(truth))
    print_progress(f"{_fit_table(fit, truth)}\n{fit.verdict}")
    target.mkdir(parents=True, exist_ok=True)
    fit.plot().savefig(target / "fit.png")
    jb.save_case(fit.case, target / "fit.toml")
    record = jb.simulate(fit.cases[0])
    record.to_netcdf(target / "record.nc")

    runs = np.prod([values.size for values in SWEPT_VALUES.values()])
    print_progress(f"\n2. The identified rig under {runs} loads of other masses and speeds ...")
    sweep_results = jb.sweep(with_one_mass(fit.case, SLOWEST), SWEPT_VALUES, progress=False)
    plot_sweep(sweep_results).savefig(target / "map.png")
    sweep_results.to_netcdf(target / "map.nc")
    print_progress(_worst_run_text(sweep_results))

    print_progress(
        "\n3. A controller for it, tuned by gradients on four loads, proven on four others ..."
    )
    tuned = tuning.tune(
        with_initial_controller(fit.case), FREE_GAINS, LOAD_CASES, steps=STEPS, progress=False
    )
    tuned.plot().savefig(target / "tuned.png")
    jb.save_case(tuned.case, target / "tuned.toml")
    print_progress(str(tuned))

    summary = fit.to_dict() | {"truth": truth, "tuned": tuned.to_dict()}
    (target / "demo.json").write_text(text.dumps(summary, indent=2))
    if json:
        print(text.dumps(summary))
    print_progress(
        f"\nwritten to {target}: {', '.join(sorted(path.name for path in target.iterdir()))}"
    )


def with_one_mass(case: jb.Case, slowest: float) -> jb.Case:
    """The identified rig under one mass, long enough for a slow one (m/s)."""
    duration = float(case.beam.length) / slowest + FREE_VIBRATION
    return dataclasses.replace(
        case, loads=(jb.MovingMass(mass=0.3, speed=slowest),), run=jb.Run(duration, 200.0)
    )


def with_initial_controller(case: jb.Case) -> jb.Case:
    """The identified rig with the hand-set loop from the sensor at midspan to the shaker."""
    left, middle, right = case.sensors
    return dataclasses.replace(
        with_one_mass(case, min(run[SPEED] for run in LOAD_CASES.training)),
        beam=dataclasses.replace(case.beam, modes=MODES),
        sensors=(middle, left, right),
        controller=HAND_SET,
    )


def _worst_run_text(sweep_results) -> str:
    """The largest deflection of the map, in words."""
    peaks = sweep_results.peak_deflection
    at = peaks.isel(peaks.argmax(list(peaks.dims)))
    lift_off_share = (sweep_results.contact_lost_time.notnull().any("load")).mean()
    return (
        f"largest deflection {1e3 * float(at):.3g} mm, at {str(at.sensor.values)}, under"
        f" {float(at[MASS]):.3g} kg at {float(at[SPEED]):.3g} m/s;"
        f" in {float(lift_off_share):.0%} of the runs the load would lift off"
    )


def _new_folder() -> Path:
    """A folder that does not exist yet: out/demo, out/demo-2, ..."""
    names = (FOLDER if i == 1 else f"{FOLDER}-{i}" for i in itertools.count(1))
    return next(Path(name) for name in names if not Path(name).exists())


def _fit_table(fit: tuning.Fit, truth: dict[str, float]) -> str:
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
            f"{address:{width}}  {fit.start_values[i]:11.5g}  {fit.values[i]:11.5g}  "
            f"{low:11.5g} to {high:<10.5g}  {truth[address]:10.5g}{note}"
        )
    lines.append(f"{hits} of {len(truth)} intervals hold the truth (95 % should)")
    return "\n".join(lines)


if __name__ == "__main__":
    run()
