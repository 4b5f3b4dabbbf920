"""Paths of forces that move at constant speeds, in many runs of one case."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.case.case import Case, replace
from jaxbeam.case.fields import concrete
from jaxbeam.case.joint_addresses import ALL
from jaxbeam.case.loads.base import wheel_distances
from jaxbeam.case.trajectory import NEVER
from jaxbeam.model.load_set import LoadSet, load_set


class ForcePaths(NamedTuple):
    """Forces upwards (N) at x = origin + speed t (m, m/s) until the `duration` (s) of each run."""

    origin: Float[np.ndarray, "run wheel"]
    speed: Float[np.ndarray, "run wheel"]
    force: Float[np.ndarray, " wheel"]
    duration: Float[np.ndarray, " run"]

    def passages(
        self, places: Float[np.ndarray, " place"]
    ) -> tuple[Float[np.ndarray, "run wheel place"], Bool[np.ndarray, "run wheel place"]]:
        """Times (s) at which the forces pass places, within the run, and whether they do in it."""
        times = (places - self.origin[..., None]) / self.speed[..., None]
        end = self.duration[:, None, None]
        return np.clip(times, 0.0, end), (times >= 0) & (times < end)

    def windows(self, left: float, right: float) -> tuple[np.ndarray, np.ndarray]:
        """Times (s) from and until which the forces (run, wheel) are between two ends (m)."""
        times, _ = self.passages(np.array([left, right]))
        return times.min(axis=-1), times.max(axis=-1)


def constant_speeds(loads: LoadSet) -> bool:
    """Whether all loads are forces that move at constant speeds."""
    if not loads.massless or loads.wheels.histories or not loads.trajectories:
        return False
    times, cubics = (np.asarray(part) for part in loads.cubics())
    straight = not np.any(cubics[:, 0, 2:]) and np.all(cubics[:, 0, 1])
    return bool(straight and np.all(times[:, 1:] >= NEVER))


class ForceWheels(NamedTuple):
    """What the wheels of all runs share: forces upwards (N), distances behind the first (m)."""

    force: Float[np.ndarray, " wheel"]
    behind: tuple[Float[np.ndarray, " wheel_of_load"], ...]


def force_wheels(case: Case) -> ForceWheels:
    """Wheels of the loads of a case; once for all runs, as it takes longer than their paths."""
    behind = tuple(_distances(case, i) for i in range(len(case.loads)))
    return ForceWheels(-np.asarray(load_set(case).weight)[:, 0], behind)


def _distances(case: Case, load: int) -> Float[np.ndarray, " wheel"]:
    """Distances (m) of the wheels of a load behind its first."""
    vehicle = case.loads[load].vehicle(case.run.gravity)
    return np.asarray(concrete(wheel_distances(case.loads[load], vehicle)))


def force_paths(
    case: Case,
    wheels: ForceWheels,
    addresses: Sequence[str],
    values: Float[np.ndarray, "run address"],
) -> ForcePaths:
    """Paths in runs of a case of constant speeds that differ in the values at some addresses.

    These are speeds, entry times, start positions and spacings of loads, and the duration.
    """
    runs, length = len(values), float(case.beam.length)
    column = dict(zip(addresses, values.T, strict=True))
    origins, speeds = [], []
    for i, load in enumerate(case.loads):

        def of_load(name, default=0.0, i=i, load=load):
            for address in (f"loads.{i}.{name}", f"loads.{ALL}.{name}"):
                if address in column:
                    return column[address]
            given = getattr(load, name)
            return np.broadcast_to(default if given is None else concrete(given), runs)

        speed, entry = of_load("speed"), of_load("entry_time")
        start = of_load("start_position", np.where(speed < 0, length, 0.0))
        behind = wheels.behind[i]
        if {f"loads.{i}.spacing", f"loads.{ALL}.spacing"} & set(addresses):
            spacings, index = np.unique(of_load("spacing"), return_inverse=True)
            own = [replace(case, {f"loads.{i}.spacing": one}) for one in spacings]
            behind = np.stack([_distances(one, i) for one in own])[index]
        first = (start - speed * entry)[:, None]
        origins.append(first - np.sign(speed)[:, None] * behind)
        speeds.append(np.broadcast_to(speed[:, None], origins[-1].shape))
    duration = column.get("run.duration", np.full(runs, float(case.run.duration)))
    return ForcePaths(np.concatenate(origins, 1), np.concatenate(speeds, 1), wheels.force, duration)
