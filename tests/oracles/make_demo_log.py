"""Make the logs that `jaxbeam demo` identifies: python -m tests.oracles.make_demo_log

The case and its crossings are those of rig.toml and the files beside the logs, but for the values
that truth.toml gives at their addresses. The beam is the finite-element model with sixteen modes,
integrated by scipy; the readings get the sensors' offsets and white noise.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np

from tests.oracles.crossing import Load, respond
from tests.oracles.finite_elements import Beam, Suspension

DEMO = Path(__file__).parents[2] / "jaxbeam" / "case" / "library" / "demo"
NOISE = 3e-6  # m, standard deviation of a reading
SEED = 7
SAMPLING = {"log_1": (1.6, 1000.0), "log_2": (1.0, 1000.0), "log_3": (0.8, 2000.0)}  # s, Hz
MODES, ELEMENTS = 16, 48


def truth() -> tuple[dict, dict[str, dict]]:
    """The rig and the logs by name, with the true values at their addresses."""

    def read(name: str) -> dict:
        return tomllib.loads((DEMO / f"{name}.toml").read_text(encoding="utf-8"))

    rig, logs = read("rig"), {name: read(name) for name in SAMPLING}
    for address, value in read("truth").items():
        *path, last = address.split(".")
        part = rig | {"logs": list(logs.values())}
        for step in path:
            part = part[int(step) if step.isdigit() else step]
        part[last] = value
    return rig, logs


def measure(
    rig: dict, loads: list[dict], duration: float, rate: float, modes: int = MODES
) -> np.ndarray:
    """One run without noise: rows of time in s and the sensors' readings in m."""
    beam = {key: value for key, value in rig["beam"].items() if key != "modes"}
    keys = ("position", "stiffness", "damping")
    suspensions = [Suspension(**{key: a[key] for key in keys}) for a in rig["actuators"]]
    times = np.arange(round(duration * rate) + 1) / rate
    run = respond(
        Beam(**beam, suspensions=suspensions, elements=ELEMENTS),
        [Load(**load) for load in loads],
        [sensor["position"] for sensor in rig["sensors"]],
        times,
        modes=modes,
        rtol=1e-9,
        atol=1e-12,
    )
    offsets = [sensor["offset"] for sensor in rig["sensors"]]
    return np.column_stack([times, run.deflection + offsets])


def make() -> dict[str, np.ndarray]:
    """All logs by name: rows of time in s and noisy readings in mm."""
    rig, logs = truth()
    noise = np.random.default_rng(SEED)
    tables = {}
    for name, sampling in SAMPLING.items():
        table = measure(rig, logs[name]["loads"], *sampling)
        table[:, 1:] += NOISE * noise.standard_normal(table[:, 1:].shape)
        table[:, 1:] *= 1e3
        tables[name] = table
    return tables


def heading(table: np.ndarray) -> str:
    """The names and units of the columns."""
    return ",".join(["time [s]", *(f"d{i} [mm]" for i in range(1, table.shape[1]))])


if __name__ == "__main__":
    for name, table in make().items():
        formats = ["%.4f"] + ["%.4f"] * (table.shape[1] - 1)
        np.savetxt(
            DEMO / f"{name}.csv", table, formats, delimiter=",", header=heading(table), comments=""
        )
        print(f"wrote {DEMO / name}.csv: {len(table)} samples")
