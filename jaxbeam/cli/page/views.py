"""Drawings of the page as data: parts of a case, and arrays of a record for the animation."""

from typing import Any

import numpy as np

import jaxbeam as jb
from jaxbeam.case.beam import END_CONDITIONS
from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.case.loads.vehicles import vehicle_names
from jaxbeam.case.sensors import sensor_labels
from jaxbeam.model.along_beam import positions_along
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.plot.drawing import DrawnVehicle, actuator_positions, drawn_vehicle, surface_height
from jaxbeam.simulation.record import Record
from jaxbeam.simulation.views import wheel_labels

MAX_FRAMES, MAX_SAMPLES = 400, 4000  # of a moving picture, of a history on the screen
MAX_WHEELS = 12  # with a history of the contact force each
BEAM_POINTS = 81
APPROACH = 0.15  # of the length of the beam, of the surface shown before and behind it


def scene(case: Case) -> dict[str, Any]:
    """Parts of a case with their addresses and positions (m), as a schematic has them."""
    length = float(concrete(case.beam.length))
    ends = (case.beam.left_end, case.beam.right_end)
    surface = np.linspace(-APPROACH * length, (1 + APPROACH) * length, 241)
    labels = sensor_labels(case.sensors)
    return {
        "length": length,
        "duration": float(concrete(case.run.duration)),
        "ends": [
            {"name": end} | dict(zip(("held", "clamped"), END_CONDITIONS[end], strict=True))
            for end in ends
        ],
        "endNames": list(END_CONDITIONS),
        "supports": [
            {"position": float(concrete(one.position)), "elastic": one.stiffness is not None}
            for one in case.supports
        ],
        "hinges": [float(concrete(one.position)) for one in case.beam.hinges],
        "absorbers": [{"position": float(concrete(one.position))} for one in case.absorbers],
        "actuators": [
            {"kind": one.kind, "unit": one.command_unit, "positions": actuator_positions(one)}
            for one in case.actuators
        ],
        "sensors": [
            {
                "label": label,
                "quantity": one.quantity,
                "unit": one.unit,
                "position": float(concrete(one.position)),
            }
            for label, one in zip(labels, case.sensors, strict=True)
        ],
        "loads": _loads(case),
        "controller": None if case.controller is None else case.controller.kind,
        "surface": None
        if case.profile is None
        else {"x": surface.tolist(), "height": surface_height(case, surface).tolist()},
    }


def _loads(case: Case) -> list[dict[str, Any]]:
    """Loads: the indices of their wheels, and the vehicles on them."""
    loads = load_set(case)
    groups = {loads.load_of_wheel[one.first_wheel]: one for one in loads.wheels.vehicles}
    found, first_body = [], 0
    for i, load in enumerate(case.loads):
        wheels = [w for w, owner in enumerate(loads.load_of_wheel) if owner == i]
        entry: dict[str, Any] = {"kind": load.kind, "wheels": wheels, "vehicle": None}
        if i in groups:
            drawn, group = drawn_vehicle(load), groups[i]
            entry["vehicle"] = _vehicle(drawn, len(group.names))
            entry["vehicle"] |= {"count": group.count, "firstBody": first_body}
            first_body += group.count * len(group.names)
        found.append(entry)
    return found


def vehicles() -> list[dict[str, Any]]:
    """Vehicles of the library: names, masses (kg), and parts to draw."""
    found = []
    for name in vehicle_names():
        load = jb.vehicles.VehicleLoad(model=name, speed=1.0)
        drawn = drawn_vehicle(load)
        model = load.vehicle(np.float64(9.81))
        entry = {"name": name, "positions": drawn.wheels.tolist()}
        mass = float(np.sum(np.asarray(concrete(model.static_loads)))) / 9.81
        found.append(entry | {"mass": mass, "vehicle": _vehicle(drawn, len(model.names))})
    return found


def _vehicle(drawn: DrawnVehicle, dofs: int) -> dict[str, Any]:
    """Parts and springs of a vehicle with so many degrees of freedom."""
    return {
        "wheels": drawn.wheels.size,
        "dofs": dofs,
        "parts": [
            {
                "position": part.position,
                "height": part.height.tolist(),
                "pitch": part.pitch.tolist(),
                "level": part.level,
                "ends": list(part.ends),
            }
            for part in drawn.parts
        ],
        "springs": [list(spring) for spring in drawn.springs],
    }


def _spread(count: int, most: int) -> np.ndarray:
    """Indices of at most `most` of `count` samples, evenly spaced, with both ends."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def _wheel_positions(loads: LoadSet, record: Record, chosen) -> np.ndarray:
    """Positions (frame, wheel) in m; NaN where a wheel is not seen."""
    x = np.asarray(concrete(loads.kinematics(np.asarray(record.times)[chosen])[0])).T
    on_beam = np.isfinite(np.asarray(record.load_position)[chosen])
    return np.where(on_beam | loads.on_ground, x, np.nan)


def pictures(record: Record) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Words and numbers of a record, and its arrays by name, reduced to a screen.

    `beam` (frame, x) is the deflection (m) at `x` (m) and `frameTimes` (s), `wheelPositions`
    (frame, wheel) and `bodies` (frame, dof) are those of the loads; `sensors` (time, sensor),
    `contact` (time, wheel) of the first wheels whose force follows from the motion, `strokes`
    (time, absorber) and `commands` (time, actuator) are histories over `times`, in SI units. Only
    so many samples as a screen can show are among them.
    """
    case, loads = record.case, record.loads
    frames = _spread(record.times.size, MAX_FRAMES)
    samples = _spread(record.times.size, MAX_SAMPLES)
    x = np.asarray(concrete(positions_along(case, BEAM_POINTS)))
    limits = [one.command_limits() for one in case.actuators]
    lost = np.asarray(record.contact_lost_time), np.asarray(record.contact_lost_position)
    diverged = float(record.diverged_time)
    wheels = [w for w, load in enumerate(loads.load_of_wheel) if load < len(case.loads)]
    moved = [w for w in wheels if not loads.prescribed[w]]
    shown = moved[:MAX_WHEELS]
    words = {
        "verdict": record.verdict,
        "steps": int(record.steps),
        "diverged": diverged if np.isfinite(diverged) else None,
        "wheels": wheel_labels(loads).tolist(),
        "bodies": record.bodies,
        "shownWheels": shown,
        "hiddenWheels": len(moved) - len(shown),
        "lost": [
            {"wheel": int(i), "time": float(lost[0][i]), "position": float(lost[1][i])}
            for i in np.flatnonzero(np.isfinite(lost[0]))
            if i in wheels
        ],
        "limits": [None if one is None else [float(v) for v in one] for one in limits],
        "extremes": {
            name: np.asarray(values).tolist() for name, values in record.extremes._asdict().items()
        },
        "crossing": np.asarray(concrete(loads.entry_exit_times()))[wheels].tolist(),
    }
    arrays = {
        "times": record.times[samples],
        "sensors": record.sensor_values[samples],
        "contact": record.contact_force[samples][:, shown],
        "strokes": record.stroke[samples],
        "commands": record.command[samples],
        "saturated": record.saturated[samples],
        "frameTimes": record.times[frames],
        "x": x,
        "beam": record.at(x)[frames],
        "wheelPositions": _wheel_positions(loads, record, frames),
        "bodies": record.body_displacement[frames],
    }
    return words, {name: np.asarray(values) for name, values in arrays.items()}


def envelopes(record: Record) -> dict[str, Any]:
    """Smallest and largest moment (N m) and shear force (N) along the beam."""
    found = {}
    for quantity in ("moment", "shear"):
        one = record.envelope(quantity)
        parts = (one.positions, one.smallest, one.largest)
        found[quantity] = [np.asarray(part).tolist() for part in parts]
    return found
