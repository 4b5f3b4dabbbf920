"""States of vehicles: their values at the start of a run, and their names."""

from jaxtyping import Float

from jaxbeam.model.linear_system import Signal
from jaxbeam.model.load_set import LoadSet
from jaxbeam.runtime.arrays import Array, xp


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
