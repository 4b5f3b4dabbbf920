"""Record of one simulated run: histories, peaks, error estimate; stored as xarray and netCDF."""

import json
import os
from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.case.aliases import renamed_property
from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.files.case_file import case_from_dict, case_to_dict
from jaxbeam.files.netcdf import write_netcdf
from jaxbeam.model.load_set import load_set
from jaxbeam.model.measurement import sensor_readings
from jaxbeam.model.modes import Modes
from jaxbeam.model.output_rows import quantity_history
from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.simulation.labels import contact_sentence, wheel_labels
from jaxbeam.simulation.result_variables import MODE_FIELDS, MODE_VARIABLES, VARIABLES

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX


class Record(eqx.Module):
    """Record of one simulated run.

    Deflection is positive upwards. Samples at an entry or exit of a load are those just after.
    Loads are counted by their wheels. `load_position` (m) is NaN while a wheel is off the beam,
    `contact_force` (N, positive under compression) zero, unless it is the wheel of a vehicle, which
    presses on the ground. The `bodies` of vehicles have displacements in m (or rad) from static
    equilibrium, positive upwards. Peaks are those in continuous time. `contact_lost_time` (s) and
    `contact_lost_position` (m) are those of the first negative contact force, which the bilateral
    model allows; NaN without one. `command` is that of the actuators, within their limits; at a
    change, the one just after. `failures` counts the steps of the controller so far without a
    solution of its optimisation. If the closed loop diverges the samples are NaN from then on, and
    so are the peaks. `error_estimate` is relative to the largest deflection. `controller_readings`
    are the readings that a sampled controller has received, None without one.
    """

    case: Case
    modes: Modes
    times: Float[Array, " time"]
    coordinates: Float[Array, "time mode"]
    rates: Float[Array, "time mode"]
    accelerations: Float[Array, "time mode"]
    load_position: Float[Array, "time load"]
    contact_force: Float[Array, "time load"]
    command: Float[Array, "time actuator"]
    failures: Float[Array, " time"]
    peak_deflection: Float[Array, " sensor"]
    peak_time: Float[Array, " sensor"]
    lowest_contact_force: Float[Array, " load"]
    contact_lost_time: Float[Array, " load"]
    contact_lost_position: Float[Array, " load"]
    body_displacement: Float[Array, "time body"]
    body_velocity: Float[Array, "time body"]
    body_acceleration: Float[Array, "time body"]
    error_estimate: Float[Array, ""]
    steps: int = eqx.field(static=True)
    controller_readings: Float[Array, "time sensor"] | None = None

    shown = renamed_property("shown", "controller_readings")

    @property
    def bodies(self) -> list[str]:
        """Names of the degrees of freedom of all vehicles, as in "loads.0 vehicle 2 body"."""
        loads, names = load_set(self.case), []
        for group in loads.wheels.vehicles:
            load = f"loads.{loads.load_of_wheel[group.first_wheel]}"
            for i in range(group.count):
                vehicle = load if group.count == 1 else f"{load} vehicle {i}"
                names += [f"{vehicle} {name}" for name in group.names]
        return names

    def at(self, x, quantity: str = "deflection", fibre_distance=None) -> Float[Array, "time ..."]:
        """History of a quantity at positions x (m) of any shape: (time, *shape of x), in SI units.

        Strain is that of the fibre at `fibre_distance` z (m) above the neutral axis, -z w_xx.
        Raises ValueError for an unknown quantity, or strain without a fibre distance.
        """
        coordinates = self.coordinates, self.rates, self.accelerations
        return quantity_history(self.modes, coordinates, x, quantity, fibre_distance)

    def _at_sensors(self, quantity: str) -> Float[Array, "time sensor"]:
        return self.at(self.case.sensor_positions, quantity)

    @property
    def deflection(self) -> Float[Array, "time sensor"]:
        """Deflection at the positions of the sensors in m."""
        return self._at_sensors("deflection")

    @property
    def velocity(self) -> Float[Array, "time sensor"]:
        """Velocity at the sensors in m/s."""
        return self._at_sensors("velocity")

    @property
    def acceleration(self) -> Float[Array, "time sensor"]:
        """Acceleration at the sensors in m/s^2."""
        return self._at_sensors("acceleration")

    @property
    def slope(self) -> Float[Array, "time sensor"]:
        """Slope at the sensors in rad."""
        return self._at_sensors("slope")

    @property
    def strain(self) -> Float[Array, "time sensor"]:
        """Bending strain at the sensors; NaN at those without a fibre distance."""
        columns = [
            self.at(s.position, "strain", xp.nan if s.fibre_distance is None else s.fibre_distance)
            for s in self.case.sensors
        ]
        return xp.array(columns).reshape(-1, self.times.shape[0]).T

    @property
    def measured(self) -> Float[Array, "time sensor"]:
        """Readings of the sensors in the SI units of their quantities, with filters and noise.

        With a sampled controller these are its readings; otherwise sensors without a sampling
        period of their own sample at `times`.

        Raises ValueError if these times do not suit a filter (see `sensor_readings`).
        """
        if self.controller_readings is not None:
            return self.controller_readings
        coordinates = self.coordinates, self.rates, self.accelerations
        return sensor_readings(self.case, self.modes, *coordinates, self.times, noisy=True)

    @property
    def saturated(self) -> Bool[Array, "time actuator"]:
        """Whether each command is at a limit of its actuator, to 1e-9 of its range."""
        columns = [xp.zeros(self.times.shape, bool) for _ in self.case.actuators]
        for i, actuator in enumerate(self.case.actuators):
            limits, command = actuator.command_limits(), self.command[:, i]
            if limits is not None:
                rounding = 1e-9 * (limits[1] - limits[0])
                columns[i] = (command <= limits[0] + rounding) | (command >= limits[1] - rounding)
        return xp.array(columns).reshape(len(columns), -1).T

    @property
    def peak_command(self) -> Float[Array, " actuator"]:
        """Largest absolute command among the samples."""
        return xp.max(xp.abs(self.command), axis=0, initial=0.0)

    @property
    def effort(self) -> Float[Array, " actuator"]:
        """Integral of the squared command over the run (command^2 s), by the trapezoidal rule."""
        return xp.trapezoid(self.command**2, self.times, axis=0)

    @property
    def diverged_time(self) -> Float[Array, ""]:
        """Time (s) of the first sample after the closed loop diverged, NaN if it did not."""
        diverged = xp.any(xp.isnan(self.coordinates), axis=1)
        return xp.where(xp.any(diverged), self.times[xp.argmax(diverged)], xp.nan)

    @property
    def verdict(self) -> str:
        """Sentence on divergence, contact, controller steps without a solution, and the error."""
        diverged = float(concrete(self.diverged_time))
        if np.isfinite(diverged):
            return (
                f"the control loop diverges: the deflection has grown beyond all bounds by"
                f" t = {diverged:.4g} s; lower the gains, or shorten period and delay"
            )
        contact = self.contact_lost_time, self.contact_lost_position, self.lowest_contact_force
        parts = [contact_sentence(self.case, *(np.asarray(concrete(part)) for part in contact))]
        failures = int(concrete(self.failures)[-1])
        if failures:
            parts.append(f"the controller found no solution in {failures} of its steps")
        parts.append(f"estimated error {float(concrete(self.error_estimate)):.1e} of the peak")
        return "; ".join(parts)

    def _dataset_parts(self) -> tuple[dict, dict, dict]:
        """Variables, coordinates and attributes of the labelled dataset."""
        variables = {
            name: (dims, np.asarray(getattr(self, name)), {"units": unit, "long_name": words})
            for name, (dims, unit, words) in VARIABLES.items()
        }
        # Modes of repeated frequencies are not unique, so they are stored.
        variables |= {
            f"mode_{name}": (
                dims,
                np.asarray(getattr(self.modes, MODE_FIELDS.get(name, name))),
                {"units": unit, "long_name": words},
            )
            for name, (dims, unit, words) in MODE_VARIABLES.items()
        }
        coordinates = {
            "time": ("time", np.asarray(self.times), {"units": "s"}),
            "sensor": ("sensor", sensor_labels(self.case)),
            "load": ("load", wheel_labels(self.case)),
            "body": ("body", np.array(self.bodies, dtype=str)),
            "frequency": ("mode", np.asarray(self.modes.frequencies), {"units": "Hz"}),
        }
        attributes = {
            "title": self.case.title,
            "case": json.dumps(case_to_dict(self.case)),
            "error_estimate": float(self.error_estimate),
            "steps": self.steps,
            "verdict": self.verdict,
        }
        return variables, coordinates, attributes

    def to_xarray(self) -> "xarray.Dataset":
        """Labelled dataset with units; `record_from_xarray` restores the record exactly."""
        import xarray

        return xarray.Dataset(*self._dataset_parts())

    def to_netcdf(self, path: str | os.PathLike, overwrite: bool = False) -> None:
        """Write the labelled dataset to a netCDF file.

        Raises FileExistsError if the file exists, without `overwrite`.
        """
        if not overwrite and os.path.exists(path):
            raise FileExistsError(f"{path} exists already; choose another name, or overwrite it")
        write_netcdf(path, *self._dataset_parts())


_STORED_VARIABLES = [name for name in VARIABLES if name in Record.__annotations__]


def record_from_xarray(dataset: "xarray.Dataset") -> Record:
    """Record from a dataset of `Record.to_xarray`, or read from its file.

    Raises ValueError if the dataset is not that of a record.
    """
    if "case" not in dataset.attrs:
        raise ValueError("not a record of jaxbeam: it lacks its case")
    case = case_from_dict(json.loads(dataset.attrs["case"]))
    # Without sensors or loads a file lacks their variables.
    sizes = {
        "sensor": len(case.sensors),
        "load": load_set(case).wheel_count,
        "actuator": len(case.actuators),
        **dataset.sizes,
    }
    may_be_empty = *_STORED_VARIABLES, "measured"
    shapes = {name: [sizes.get(d, 0) for d in VARIABLES[name][0]] for name in may_be_empty}
    empty = {
        name: (VARIABLES[name][0], np.zeros(shape))
        for name, shape in shapes.items()
        if 0 in shape and name not in dataset.variables
    }
    dataset = dataset.assign(empty)
    mode_variables = {name: f"mode_{name}" for name in MODE_VARIABLES}
    required = (*_STORED_VARIABLES, *mode_variables.values(), "time")
    missing = [name for name in required if name not in dataset.variables]
    if missing:
        raise ValueError(f"not a record of jaxbeam: it lacks {', '.join(missing)}")
    values = {name: xp.asarray(dataset[name].values) for name in _STORED_VARIABLES}
    return Record(
        case=case,
        modes=Modes(
            **{
                MODE_FIELDS.get(name, name): xp.asarray(dataset[label].values)
                for name, label in mode_variables.items()
            }
        ),
        times=xp.asarray(dataset["time"].values),
        error_estimate=xp.asarray(float(dataset.attrs["error_estimate"])),
        steps=int(dataset.attrs["steps"]),
        controller_readings=xp.asarray(dataset["measured"].values) if _is_sampled(case) else None,
        **values,
    )


def _is_sampled(case: Case) -> bool:
    return case.controller is not None and case.controller.period is not None


def read_record(path: str | os.PathLike) -> Record:
    """Record from a netCDF file written by `Record.to_netcdf`.

    Raises OSError if the file cannot be read, ValueError if it is not that of a record.
    """
    import xarray

    with xarray.open_dataset(path, engine="scipy") as dataset:
        return record_from_xarray(dataset.load())


def sensor_labels(case: Case) -> np.ndarray:
    """Labels of the sensors: number and quantity, as in "0: deflection"."""
    return np.array([f"{i}: {s.quantity}" for i, s in enumerate(case.sensors)], dtype=str)
