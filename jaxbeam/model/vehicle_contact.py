"""Contact of vehicles with the beam: rows of forces, and the states of the vehicles.

With x the states of the modal model and then those of the vehicles, in the order of the integrator,
the law of `contact` is

    (1 + m S S') r = -W - V x - m S q_u'',     q = Y x,     z' = A z + B q  (`vehicle_system`),

for contact forces r (upwards on the beam), the mode shapes S at the wheels, the modal accelerations
q_u'' of the commands, and the forces q = k y + c y' that the beam exerts on springs of vehicles.
The profile and forces that vary in time add to W and q what `known_disturbance` returns.
"""

from jaxtyping import Bool, Float

from jaxbeam.model.contact import SurfaceRows, surface_rows
from jaxbeam.model.linear_system import Signal
from jaxbeam.model.load_set import LoadSet
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.runtime.arrays import Array, block_diag, set_at, xp
from jaxbeam.runtime.module import Module


class ContactRows(Module):
    """S, m (kg; zero off the beam), V and Y at some times; see the module. Y has no vehicle part.

    Without vehicles Y is None.
    """

    shape: Float[Array, "*time wheel mode"]
    mass: Float[Array, "*time wheel"]
    force: Float[Array, "*time wheel all"]
    surface: Float[Array, "*time wheel state"] | None


def contact_rows(model: ModalModel, loads: LoadSet, times: Float[Array, "*time"]) -> ContactRows:
    """Contact law at times (s); at those of entry and exit, that just after."""
    kinematics = (*loads.kinematics(times), loads.on_beam(times))
    position, speed, acceleration, active = (xp.moveaxis(part, 0, -1) for part in kinematics)
    wheels, springs = loads.wheels, bool(loads.wheels.vehicles)
    motion = position, speed, acceleration, active
    mass_rows, rows = _mass_rows(model, motion, loads.inertia[:, 0], springs)
    if not springs:
        return mass_rows
    shape, mass, force = mass_rows.shape, mass_rows.mass, mass_rows.force
    surface = wheels.stiffness * rows.deflection.reshape(force.shape)
    surface = surface + wheels.damping * rows.velocity.reshape(force.shape)
    of_vehicles = xp.where(active[..., None], vehicle_system(loads)[2], 0.0)
    return ContactRows(
        shape, mass, xp.concatenate([force + surface, -of_vehicles], axis=-1), surface
    )


def mass_contact_rows(
    model: ModalModel,
    position: Float[Array, "*time wheel"],
    speed: Float[Array, "*time wheel"],
    active: Bool[Array, "*time wheel"],
    mass: Float[Array, "*time wheel"],
) -> ContactRows:
    """Contact law of masses (kg) at positions (m) that travel at constant speeds (m/s).

    `active` ones are on the beam.
    """
    return _mass_rows(model, (position, speed, xp.zeros_like(speed), active), mass, False)[0]


def _mass_rows(model, motion, inertia, springs) -> tuple[ContactRows, SurfaceRows]:
    """Contact law of the masses (kg) alone, and the rows of the surface under the wheels."""
    position, speed, acceleration, active = motion
    rows = surface_rows(model, position, speed, acceleration, active, springs)
    shape = rows.shape.reshape(*position.shape, model.mode_count)
    of_acceleration = rows.acceleration.reshape(*position.shape, model.state_count)
    mass = xp.where(active, inertia, 0.0)
    return ContactRows(shape, mass, mass[..., None] * of_acceleration, None), rows


def vehicle_system(
    loads: LoadSet,
) -> tuple[
    Float[Array, "vehicle_state vehicle_state"],
    Float[Array, "vehicle_state wheel"],
    Float[Array, "wheel vehicle_state"],
]:
    """A, B and H of all vehicles as one system, z' = A z + B q, pressing with q - H z; one run."""
    states, wheels = loads.vehicle_states, loads.wheel_count
    blocks, B, H, first = [], xp.zeros((states, wheels)), xp.zeros((wheels, states)), 0
    for group in loads.wheels.vehicles:
        size, count = group.A.shape[0], group.wheels_per_vehicle
        for i in range(group.count):
            wheel = group.first_wheel + i * count
            own, under = slice(first, first + size), slice(wheel, wheel + count)
            blocks.append(group.A[..., 0])
            B, H = (
                set_at(B, (own, under), group.B[..., 0]),
                set_at(H, (under, own), group.H[..., 0]),
            )
            first += size
    return (block_diag(*blocks) if blocks else xp.zeros((0, 0))), B, H


def has_known_disturbance(loads: LoadSet) -> bool:
    """Whether anything but the static loads disturbs the beam: a profile, forces over time."""
    return loads.profile is not None or bool(loads.wheels.histories)


def known_disturbance(
    loads: LoadSet, times: Float[Array, "*time"]
) -> tuple[Float[Array, "*time wheel"], Float[Array, "*time wheel"]]:
    """What profile and forces over time add to the weights W and to the forces q (N).

    Before the start of a run vehicles stand where they are at t = 0.
    """
    weight = (loads.varying_weight(times) - loads.weight)[..., 0]
    if loads.profile is None:
        return weight, xp.zeros_like(weight)
    moves = xp.asarray(times) >= 0
    position, speed, acceleration = loads.kinematics(xp.maximum(times, 0.0))
    speed, acceleration = (xp.where(moves, part, 0.0) for part in (speed, acceleration))
    motion = loads.surface_motion(position, speed, acceleration)
    assert motion is not None
    height, rate, curvature = (xp.moveaxis(part, 0, -1) for part in motion)
    weight = weight + loads.inertia[:, 0] * curvature
    if not loads.wheels.vehicles:
        return weight, xp.zeros_like(weight)
    surface = loads.wheels.stiffness[:, 0] * height + loads.wheels.damping[:, 0] * rate
    return weight + surface, surface


def initial_vehicle_states(loads: LoadSet) -> Float[Array, "state batch"] | None:
    """States of all vehicles at t = 0: in equilibrium on the profile; None without any."""
    wheels = loads.wheels
    if not wheels.vehicles:
        return None
    surface = xp.zeros_like(wheels.stiffness)
    motion = loads.surface_motion(*loads.kinematics(xp.zeros(())))
    if motion is not None:
        surface = surface + wheels.stiffness * motion[0][:, None]
    states = [group.initial_state(surface[group.wheels]) for group in wheels.vehicles]
    return xp.concatenate([part.reshape(-1, part.shape[-1]) for part in states])


def vehicle_signals(loads: LoadSet) -> tuple[Signal, ...]:
    """Names and units of the states of all vehicles: heights and pitch angles, then their rates.

    That of a body of the first load is "load_0_body", in a row "load_0_vehicle_1_body", that of
    the first absorber "absorber_0_body".
    """
    of_wheel, signals, count = loads.load_of_wheel, [], len(loads.trajectories) - loads.absorbers
    for group in loads.wheels.vehicles:
        for i in range(group.count):
            vehicle = f"_vehicle_{i + 1}" if group.count > 1 else ""
            number = of_wheel[group.first_wheel]
            carried = f"load_{number}" if number < count else f"absorber_{number - count}"
            prefix = f"{carried}{vehicle}"
            names = [f"{prefix}_{name.replace(' ', '_')}" for name in group.names]
            units = ["rad" if name.endswith("pitch") else "m" for name in group.names]
            signals += [Signal(*pair) for pair in zip(names, units, strict=True)]
            signals += [
                Signal(f"{name}_rate", f"{unit}/s") for name, unit in zip(names, units, strict=True)
            ]
    return tuple(signals)
