"""Trains, line loads and load models of the library."""

import functools
import tomllib
from importlib import resources
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

# Known trains that the library lacks, and why.
LEFT_OUT = {
    "HSLM-B": "its axles and spacings by span are curves of EN 1991-2 without open numbers",
    "FLM2-lorry-3": "one of its distances could not be confirmed",
    "FLM3": "its distances were found in pictures alone",
    "FLM4": "its distances were found in pictures alone",
}


class Train(NamedTuple):
    """Axles of a train: offsets behind the first axle (m), and forces (N) or masses (kg).

    `spacing` (m) is that from one vehicle to the next of its kind, None for a whole train.
    """

    offsets: Float[np.ndarray, " axle"]
    forces: Float[np.ndarray, " axle"] | None
    masses: Float[np.ndarray, " axle"] | None
    spacing: float | None
    source: str


@functools.cache
def trains() -> dict[str, Train]:
    """All trains of the library by name."""
    found = {}
    folder = resources.files(__package__) / "trains"
    for entry in sorted(folder.iterdir(), key=lambda entry: entry.name):
        if entry.name.endswith(".toml"):
            content = tomllib.loads(entry.read_text(encoding="utf-8"))
            layout = LAYOUTS[content["layout"]]
            for table in content["trains"]:
                found[table["name"]] = layout(content, table)
    return found


def _high_speed(content: dict[str, Any], table: dict[str, Any]) -> Train:
    """Power car, end coach, coaches on shared bogies, end coach, power car; symmetrical.

    A coach is coupled to the next above the middle of their bogie, and the end coach to the power
    car midway between their axles.
    """
    power_car = np.array(content["power_car"])
    coupling, axles = content["coupling"], table["bogie_axle_spacing"]
    first_coupling = power_car[-1] + coupling / 2
    coaches = table["coaches"] + 2
    length = 2 * first_coupling + coaches * table["coach_length"]
    outer = power_car[-1] + coupling + np.array([0.0, axles])
    shared = first_coupling + np.arange(1, coaches) * table["coach_length"]
    bogies = (shared[:, None] + np.array([-axles, axles]) / 2).ravel()
    front = np.concatenate([power_car, outer])
    offsets = np.concatenate([front, bogies, (length - front)[::-1]])
    return Train(offsets, np.full(len(offsets), table["axle_force"]), None, None, content["source"])


def _wagon(content: dict[str, Any], table: dict[str, Any]) -> Train:
    """Wagon with overhangs beyond its outer axles, by which the next one follows."""
    offsets = np.concatenate([[0.0], np.cumsum(table["axle_spacings"])])
    spacing = float(offsets[-1] + sum(table["overhangs"]))
    return Train(
        offsets, None, np.full(len(offsets), table["axle_mass"]), spacing, content["source"]
    )


def _axles(content: dict[str, Any], table: dict[str, Any]) -> Train:
    """Axles of a load model at their distances, the least ones of a `vehicle` of `load_models`."""
    if "vehicle" in table:
        model, name = table["vehicle"]
        vehicle = next(one for one in load_models()[model].vehicles if one.name == name)
        offsets, forces = vehicle.with_spacing(None), np.array(vehicle.axle_forces)
        return Train(offsets, forces, None, None, content["source"])
    offsets = np.concatenate([[0.0], np.cumsum(table["axle_spacings"])])
    return Train(offsets, np.array(table["axle_forces"]), None, None, content["source"])


LAYOUTS = {"high-speed": _high_speed, "wagon": _wagon, "axles": _axles}


class CodeLineLoad(NamedTuple):
    """Parts of a line load: N/m, lengths (m, 0 for a part without an end), gaps (m) before them.

    Axles are at offsets (m) behind the end of the first part, with forces in N.
    """

    force_per_length: Float[np.ndarray, " part"]
    lengths: Float[np.ndarray, " part"]
    gaps: Float[np.ndarray, " part"]
    axle_offsets: Float[np.ndarray, " axle"]
    axle_forces: Float[np.ndarray, " axle"]
    source: str


@functools.cache
def line_loads() -> dict[str, CodeLineLoad]:
    """All line loads of the library by name."""
    text = (resources.files(__package__) / "line_loads.toml").read_text(encoding="utf-8")
    content = tomllib.loads(text)
    names = ("force_per_length", "lengths", "gaps", "axle_offsets", "axle_forces")
    return {
        table["name"]: CodeLineLoad(
            source=content["source"],
            **{name: np.array(table.get(name, []), float) for name in names},
        )
        for table in content["loads"]
    }


class ModelVehicle(NamedTuple):
    """Vehicle of a load model: distances (m) and forces (N) of its axles, and its lane load (N/m).

    `spacings` are the distances (m) that the spacing number `varied` may have, None for one only.
    """

    name: str
    axle_spacings: Float[np.ndarray, " spacing"]
    axle_forces: Float[np.ndarray, " axle"]
    lane: float
    varied: int | None
    between: tuple[float, float] | None
    choices: tuple[float, ...]

    def with_spacing(self, value: float | None) -> Float[np.ndarray, " axle"]:
        """Offsets (m) of the axles behind the first, with a value of the varied spacing (m)."""
        spacings = np.array(self.axle_spacings, float)
        if value is not None:
            spacings[self.varied] = value
        return np.concatenate([[0.0], np.cumsum(spacings)])


class LoadModel(NamedTuple):
    """Load model of a code: its vehicles, and the `allowance` for dynamics of axles (1)."""

    vehicles: tuple[ModelVehicle, ...]
    allowance: float


@functools.cache
def load_models() -> dict[str, LoadModel]:
    """All load models of the library by name.

    >>> from jaxbeam.case.library.published import load_models
    >>> print(", ".join(load_models()))
    HL-93, HL-93-pair, LM1, M1600, S1600, CL-625, HB45
    """
    text = (resources.files(__package__) / "load_models.toml").read_text(encoding="utf-8")
    found = {}
    for table in tomllib.loads(text)["models"]:
        vehicles = tuple(
            ModelVehicle(
                one["name"],
                np.array(one["axle_spacings"]),
                np.array(one["axle_forces"]),
                one["lane"],
                one.get("varied"),
                tuple(one["between"]) if "between" in one else None,
                tuple(one.get("choices", ())),
            )
            for one in table["vehicles"]
        )
        found[table["name"]] = LoadModel(vehicles, table.get("allowance", 0.0))
    return found
