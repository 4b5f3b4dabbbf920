"""Loads of a run: trajectories of their wheels, numbers of the wheels, vehicles above them."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.case.absorbers import Absorber
from jaxbeam.case.case import Case
from jaxbeam.case.loads.base import (
    AbstractLoad,
    ForceHistory,
    VehicleModel,
    wheel_distances,
)
from jaxbeam.case.track import Track, windows
from jaxbeam.case.trajectory import AbstractTrajectory, has_come
from jaxbeam.model.elements import Layout
from jaxbeam.model.transfer_matrices import surface
from jaxbeam.runtime.arrays import Array, Module, add_at, is_numpy, xp


class VehicleGroup(Module):
    """Vehicles of one load, all alike, as linear systems driven by the surface under their wheels.

    With the states z = (u, u') of a vehicle, and q = k y + c y' from the heights y of the surface
    under its wheels, z' = A z + B q, and its springs press on the surface with q - H z in addition
    to the static loads. The wheels of the first of `count` vehicles begin at `first_wheel`.
    """

    A: Float[Array, "state state batch"]
    B: Float[Array, "state wheel batch"]
    H: Float[Array, "wheel state batch"]
    names: tuple[str, ...] = eqx.field(static=True)
    first_wheel: int = eqx.field(static=True)
    count: int = eqx.field(static=True)

    @property
    def wheels_per_vehicle(self) -> int:
        """Number of wheels of one vehicle."""
        return self.H.shape[0]

    @property
    def wheels(self) -> slice:
        """Index of the wheels of all its vehicles."""
        return slice(self.first_wheel, self.first_wheel + self.count * self.wheels_per_vehicle)

    @property
    def state_count(self) -> int:
        """Number of states of all its vehicles."""
        return self.count * self.A.shape[0]

    def initial_state(
        self, surface: Float[Array, "wheel batch"]
    ) -> Float[Array, "vehicle state batch"]:
        """States at rest in static equilibrium on surfaces of some heights times stiffness (N)."""
        forces = surface.reshape(self.count, self.wheels_per_vehicle, -1)
        A, B = (xp.moveaxis(part, -1, 0) for part in (self.A, self.B))
        right = B @ xp.moveaxis(forces, (0, 1, 2), (2, 1, 0))  # batch, state, vehicle
        return -xp.moveaxis(xp.linalg.solve(A, right), (0, 1, 2), (2, 1, 0))

    def accelerations(
        self,
        states: Float[Array, "*time vehicle state batch"],
        surface: Float[Array, "*time wheel batch"],
    ) -> Float[Array, "*time vehicle dof batch"]:
        """Accelerations u'' of the degrees of freedom for q of the wheels (N)."""
        dofs = self.A.shape[0] // 2
        forces = surface.reshape(*surface.shape[:-2], self.count, self.wheels_per_vehicle, -1)
        return xp.einsum("ijb,...vjb->...vib", self.A[dofs:], states) + xp.einsum(
            "iwb,...vwb->...vib", self.B[dofs:], forces
        )

    def spring_forces(
        self,
        states: Float[Array, "*time vehicle state batch"],
        surface: Float[Array, "*time wheel batch"],
    ) -> Float[Array, "*time wheel batch"]:
        """Forces q - H z of the springs on the surface beyond the static loads (N)."""
        pulled = xp.einsum("wjb,...vjb->...vwb", self.H, states)
        return surface - pulled.reshape(surface.shape)


class WheelSet(Module):
    """Masses, weights, springs and vehicles of all wheels; the runs of a batch may differ in them.

    Inertia (kg) and weight (N, the static load), contact stiffness (N/m) and damping (N s/m) of the
    springs between surface and vehicle, and the vehicles. Without vehicles there are no springs.
    `histories` are forces over time in addition to the weight, by the index of their wheel. The
    force of a wheel is `prescribed` if it certainly has neither inertia nor a spring.
    """

    inertia: Float[Array, "wheel batch"]
    weight: Float[Array, "wheel batch"]
    prescribed: tuple[bool, ...] = eqx.field(static=True)
    stiffness: Float[Array, "wheel batch"] | None = None
    damping: Float[Array, "wheel batch"] | None = None
    vehicles: tuple[VehicleGroup, ...] = ()
    histories: dict[int, ForceHistory] = eqx.field(default_factory=dict)

    @property
    def massless(self) -> bool:
        """Whether all wheels certainly have no inertia or springs: forces are weights."""
        return all(self.prescribed)

    def scaled(self, factor: Float[Array, ""]) -> "WheelSet":
        """Wheels and vehicles of similar loads, with all masses, springs and dampers in proportion.

        The frequencies of the vehicles stay. Forces over time stay as they are.
        """
        groups = tuple(
            dataclasses.replace(group, B=group.B / factor, H=group.H * factor)
            for group in self.vehicles
        )
        stiffness, damping = (
            part if part is None else part * factor for part in (self.stiffness, self.damping)
        )
        inertia, weight = self.inertia * factor, self.weight * factor
        return dataclasses.replace(
            self,
            inertia=inertia,
            weight=weight,
            stiffness=stiffness,
            damping=damping,
            vehicles=groups,
        )


class LoadSet(Module):
    """All loads of a run: trajectories, distances of wheels behind the first (m), wheels.

    The runs of a batch share everything but the numbers of the wheels. `profile` is that of the
    surface, if it has one. The last wheels are those of `absorbers`, which are fixed to the beam.
    `eccentricity` (m) is that of each wheel, None where all are on the axis.
    """

    trajectories: tuple[AbstractTrajectory, ...]
    wheels: WheelSet
    behind: tuple[Float[Array, " _"], ...]
    profile: Module | None = None
    absorbers: int = eqx.field(static=True, default=0)
    track: Track | None = None
    eccentricity: Float[Array, " wheel"] | None = None

    @property
    def inertia(self) -> Float[Array, "wheel batch"]:
        """Masses (kg) that follow the surface."""
        return self.wheels.inertia

    @property
    def weight(self) -> Float[Array, "wheel batch"]:
        """Static wheel loads (N)."""
        return self.wheels.weight

    @property
    def wheel_count(self) -> int:
        """Number of wheels of all loads."""
        return self.wheels.inertia.shape[0]

    @property
    def on_ground(self) -> Bool[np.ndarray, " wheel"]:
        """Whether each wheel presses on the ground off the beam too: those of vehicles."""
        on_ground = np.zeros(self.wheel_count, bool)
        for group in self.wheels.vehicles:
            on_ground[group.wheels] = True
        return on_ground

    @property
    def fixed(self) -> Bool[np.ndarray, " wheel"]:
        """Whether each wheel is an absorber's, which is fixed to the beam and may pull."""
        return np.arange(self.wheel_count) >= self.wheel_count - self.absorbers

    @property
    def prescribed(self) -> Bool[np.ndarray, " wheel"]:
        """Whether the force of each wheel is given: neither mass nor spring can change it."""
        return np.array(self.wheels.prescribed, bool)

    @property
    def solved_count(self) -> int:
        """Number of wheels whose forces are solved for."""
        return self.wheels.prescribed.count(False)

    @property
    def load_of_wheel(self) -> list[int]:
        """Index of the load of each wheel."""
        return [i for i, (_, behind) in enumerate(self._paths()) for _ in range(behind.shape[0])]

    @property
    def vehicle_states(self) -> int:
        """Number of states of all vehicles."""
        return sum(group.state_count for group in self.wheels.vehicles)

    def _paths(self):
        """Pairs of a load's trajectory and the distances (m) of its wheels behind the first."""
        return zip(self.trajectories, self.behind, strict=True)

    def kinematics(self, times: Float[Array, "*time"]) -> tuple[Float[Array, "wheel *time"], ...]:
        """Positions (m), speeds (m/s) and accelerations (m/s^2) of the wheels at times (s)."""
        times = xp.asarray(times)
        if not self.trajectories:
            return (xp.zeros((0, *times.shape)),) * 3
        parts = []
        for path, behind in self._paths():
            first = path.kinematics(times)
            distance = path.direction() * behind.reshape(-1, *(1,) * times.ndim)
            position = first[0] - distance
            rates = (xp.broadcast_to(part, position.shape) for part in first[1:])
            parts.append((position, *rates))
        position, speed, acceleration = (xp.concatenate(part) for part in zip(*parts, strict=True))
        return position, speed, acceleration

    def surface_motion(
        self, position: Float[Array, "*wheel"], speed, acceleration
    ) -> tuple[Float[Array, "..."], ...] | None:
        """Height r (m) of the profile under wheels, and its rates: v r', v^2 r'' + a r'.

        Profiles of the runs of a batch give a last axis of runs.
        """
        if self.profile is None:
            return None
        height, slope, curvature = self.profile.heights(position)
        if xp.ndim(height) > xp.ndim(position):  # concrete profiles of many runs: changed in place
            curvature *= speed[..., None] ** 2
            if np.any(acceleration):
                curvature += acceleration[..., None] * slope
            slope *= speed[..., None]
            return height, slope, curvature
        return height, speed * slope, speed**2 * curvature + acceleration * slope

    def cubics(self) -> tuple[Float[Array, "wheel piece"], Float[Array, "wheel piece 4"]]:
        """Start times (s) and coefficients of the cubic pieces of the paths of the wheels.

        Padded to the same number of pieces; for trajectories of the kind
        `AbstractPiecewiseTrajectory`, which those of cases are.
        """
        if not self.trajectories:
            return xp.zeros((0, 1)), xp.zeros((0, 1, 4))
        all_times, all_cubics = [], []
        pieces = [path.cubics() for path in self.trajectories]
        max_pieces = max(times.shape[0] for times, _ in pieces)
        for (path, behind), (times, cubics) in zip(self._paths(), pieces, strict=True):
            more = (0, max_pieces - times.shape[0])
            times = xp.pad(times, more, constant_values=np.inf)
            shift = -path.direction() * behind[:, None, None] * np.array([1.0, 0.0, 0.0, 0.0])
            all_times.append(xp.broadcast_to(times, (behind.shape[0], max_pieces)))
            all_cubics.append(xp.pad(cubics, [more, (0, 0)]) + shift)
        return xp.concatenate(all_times), xp.concatenate(all_cubics)

    def varying_weight(self, times: Float[Array, "*time"]) -> Float[Array, "*time wheel batch"]:
        """Weights (N) at times (s), with the forces of wheels that vary in time."""
        weight = xp.broadcast_to(self.weight, (*xp.shape(times), *self.weight.shape))
        for wheel, history in self.wheels.histories.items():
            weight = add_at(weight, np.s_[..., wheel, :], history.at(times))
        return weight

    @property
    def massless(self) -> bool:
        """Whether all wheels certainly have no inertia or springs: forces are weights."""
        return self.wheels.massless

    def entry_exit_times(self) -> Float[Array, "wheel 2"]:
        """Times (s) at which wheels enter and leave the beam; `NEVER` for what does not happen."""
        found = [xp.stack(windows(self.track, *each), -1) for each in self._paths()]
        return xp.concatenate(found) if found else xp.zeros((0, 2))

    def events(
        self, places: Float[Array, " place"]
    ) -> tuple[Float[Array, "wheel 2"], Float[Array, " event"]]:
        """Entry and exit of each wheel, and all times at which its motion is not smooth, in s.

        These include the passage of some places (m), and of kinks of the profile.
        """
        if self.profile is not None:
            places = xp.concatenate([places, self.profile.kinks()])
        ends = self.entry_exit_times()
        return ends, xp.concatenate([ends.reshape(-1), self.passage_times(places)])

    def passages(
        self, positions: Float[Array, " position"]
    ) -> Float[Array, "wheel {positions.shape[0]}"]:
        """Times (s) at which each wheel passes each position (m); `NEVER` if it does not."""
        count, times = positions.shape[0], [xp.zeros((0, positions.shape[0]))]
        for path, behind in self._paths():
            passages = path.passage_times(positions, behind)[: behind.shape[0] * count]
            times.append(passages.reshape(-1, count))
        return xp.concatenate(times)

    def rest_times(self) -> Float[Array, " wheel"]:
        """Times (s) from which wheels stand for good; for trajectories as those of `cubics`."""
        rest = [
            xp.broadcast_to(path.cubics()[0][-1], behind.shape) for path, behind in self._paths()
        ]
        return xp.concatenate([xp.zeros(0), *rest])

    def passage_times(self, positions: Float[Array, " position"]) -> Float[Array, " time"]:
        """Times (s) at which the motion or force of a wheel is not smooth, in no order.

        Wheels pass the positions (m), jump in speed or acceleration, or have a kink in their table
        of forces.
        """
        times = [path.passage_times(positions, behind) for path, behind in self._paths()]
        times += [history.times[:, 0] for history in self.wheels.histories.values()]
        return xp.concatenate(times) if times else xp.zeros(0)

    def on_beam(self, times: Float[Array, "*time"]) -> Bool[Array, "wheel *time"]:
        """Whether each wheel is on the beam at given times (s), from entry until before exit."""
        entry, leave = self.entry_exit_times().T.reshape(2, -1, *(1,) * xp.ndim(times))
        return has_come(entry, times) & ~has_come(leave, times)


def load_set(case: Case, layout: Layout | None = None) -> LoadSet:
    """Loads and absorbers of a case, as a batch of one run, on the surface of settled supports.

    This needs a `layout` (from `mesh_layout`) where the numbers of the case are traced.
    """
    trajectories = tuple(map(case.trajectory, case.carried))
    vehicles = [load.vehicle(case.run.gravity) for load in case.carried]
    return LoadSet(
        trajectories,
        _wheels(case.carried, vehicles),
        tuple(map(wheel_distances, case.carried, vehicles)),
        surface(case, layout),
        len(case.absorbers),
        case.track,
        _eccentricities(case, vehicles),
    )


def _eccentricities(case: Case, vehicles: Sequence[VehicleModel]) -> Float[Array, " wheel"] | None:
    """Eccentricity (m, left of the axis) of each wheel; None where no load has one."""
    arms = [getattr(load, "eccentricity", None) for load in case.carried]
    if all(arm is None for arm in arms):
        return None
    parts = []
    for load, vehicle, arm in zip(case.carried, vehicles, arms, strict=True):
        count = load.spacings().shape[0] * vehicle.offsets.shape[0]
        parts.append((0.0 if arm is None else arm) * xp.ones(count))
    return xp.concatenate(parts)


def wheel_set(case: Case) -> WheelSet:
    """Wheels of the loads and absorbers of a case, as a batch of one run."""
    return _wheels(case.carried, [load.vehicle(case.run.gravity) for load in case.carried])


def _wheels(loads: Sequence[AbstractLoad | Absorber], vehicles: Sequence[VehicleModel]) -> WheelSet:
    """`wheel_set`, given the vehicle model of each load."""
    counts = [load.spacings().shape[0] for load in loads]

    def of_all_wheels(name):
        parts = [xp.tile(getattr(v, name), n) for v, n in zip(vehicles, counts, strict=True)]
        return (xp.concatenate(parts) if parts else xp.zeros(0))[:, None]

    groups, histories, prescribed, first_wheel = [], {}, [], 0
    for load, vehicle, count in zip(loads, vehicles, counts, strict=True):
        for wheel, history in load.force_histories().items():
            histories[first_wheel + wheel] = jax.tree.map(lambda part: part[..., None], history)
        masses = vehicle.wheel_masses
        massless = masses == 0 if is_numpy(masses) else np.zeros(masses.shape, bool)
        prescribed += (massless & (not vehicle.names)).tolist() * count
        if vehicle.names:
            groups.append(_vehicle_group(vehicle, first_wheel, count))
        first_wheel += count * vehicle.offsets.shape[0]
    inertia, weight = of_all_wheels("wheel_masses"), of_all_wheels("static_loads")
    if not groups:
        return WheelSet(inertia, weight, tuple(prescribed), histories=histories)
    springs = of_all_wheels("contact_stiffness"), of_all_wheels("contact_damping")
    return WheelSet(inertia, weight, tuple(prescribed), *springs, tuple(groups), histories)


def _vehicle_group(vehicle: VehicleModel, first_wheel: int, count: int) -> VehicleGroup:
    """State matrices of the `count` equal vehicles of one load, as a batch of one run."""
    dofs, wheel_map = vehicle.mass.shape[0], vehicle.wheel_map
    right = -vehicle.full_stiffness, -vehicle.full_damping, wheel_map.T
    rates = xp.linalg.solve(vehicle.mass, xp.concatenate(right, axis=1))
    identity = np.concatenate([np.zeros((dofs, dofs)), np.eye(dofs)], axis=1)
    A = xp.concatenate([identity, rates[:, : 2 * dofs]])
    B = xp.concatenate([np.zeros(wheel_map.T.shape), rates[:, 2 * dofs :]])
    springs = vehicle.contact_stiffness, vehicle.contact_damping
    H = xp.concatenate([part[:, None] * wheel_map for part in springs], axis=1)
    A, B, H = (part[..., None] for part in (A, B, H))
    return VehicleGroup(A, B, H, vehicle.names, first_wheel, count)
