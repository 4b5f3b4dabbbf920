"""Histories that follow from a record: statically corrected deflection, and those of coils.

With an inner loop the amplifier of a shaker sets the voltage of its coil, which nothing bounds in
the model; here it can be compared with what the amplifier has.
"""

from typing import NamedTuple

from jaxtyping import Float

from jaxbeam.case.actuators.electrodynamic import Electrodynamic, PortSignal
from jaxbeam.case.case import Case
from jaxbeam.model.static_correction import corrected_history
from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.simulation.integration_plan import TOLERANCE, integration_plan, sample_times
from jaxbeam.simulation.record import Record
from jaxbeam.simulation.simulate import run_integration


def corrected_deflection(record: Record, x, derivative: int = 0) -> Float[Array, "time *position"]:
    """Statically corrected history of a record's deflection at x (m), in m.

    Sum of the modes, plus the residual of the modes under the forces of each instant (see
    `corrected_history`); `derivative` (up to 3) gives that x-derivative instead. Accurate where
    forces and commands change slowly compared with the first truncated mode.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> case = jb.Case(
    ...     beam, sensors=[jb.Sensor(0.3)], loads=[jb.MovingMass(mass=0.5, speed=2.0)]
    ... )
    >>> print(jb.sections.corrected_deflection(jb.simulate(case), 0.3).shape)
    (1001,)
    """
    return corrected_history(record.case, record.modes, record.motion, x, derivative)


class CoilHistory(NamedTuple):
    """Current (A), voltage (V), and force on the beam (N) at times (s)."""

    times: Float[Array, " time"]
    current: Float[Array, " time"]
    voltage: Float[Array, " time"]
    force: Float[Array, " time"]


def coil_history(
    case: Case,
    actuator: int = 0,
    times: Float[Array, " time"] | None = None,
    tolerance: float = TOLERANCE,
) -> CoilHistory:
    """Current and voltage of the shaker with an index, and its force on the beam, over a run.

    At the sample times of the run, or at others (s), ascending; the run is simulated anew. Between
    samples of a controller the voltage may be larger: sample finely enough.

    Raises ValueError as `simulate` does, and if the actuator is no electrodynamic shaker.

    >>> import jaxbeam as jb
    >>> from jaxbeam.simulation.derived_histories import coil_history
    >>> loop = jb.actuators.CurrentLoop(bandwidth=2e3)
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.2, modes=2),
    ...     actuators=[jb.Electrodynamic(0.3, 3.0, 1e-3, 8.0, inner_loop=loop)],
    ...     controller=jb.Prescribed(offsets=[0.5], period=0.01),
    ...     run=jb.Run(0.4, sample_rate=200.0),
    ... )
    >>> coil = coil_history(case)
    >>> print(f"{coil.current[-1]:.3f} A, {coil.voltage[-1]:.2f} V, {coil.force[-1]:.2f} N")
    0.500 A, 1.50 V, 4.00 N
    """
    device = case.actuators[actuator] if actuator < len(case.actuators) else None
    if not isinstance(device, Electrodynamic):
        raise ValueError(f"actuators.{actuator} is no electrodynamic shaker, and has no coil")
    times = sample_times(case) if times is None else xp.asarray(times, float)
    integration = run_integration(case, integration_plan(case, times, tolerance), times, None)
    motion, model, port = integration.outputs.motion, integration.model, device.coil_port()
    sizes = [one.attachment().state_matrix.shape[0] for one in case.actuators]
    first = 2 * model.mode_count + sum(sizes[:actuator])
    states = integration.sampled_states[:, first : first + sizes[actuator]]
    shape = model.modes.fields(device.position, (0,))[0]
    at_port = xp.stack(
        [part @ shape for part in (motion.coordinates, motion.rates, motion.accelerations)], axis=-1
    )

    def history(signal: PortSignal):
        return (
            states @ signal.states
            + signal.command * motion.command[:, actuator]
            + at_port @ signal.port
        )

    current = history(port.current)
    suspension = xp.stack([device.stiffness, device.damping, device.mass])
    force = device.force_constant * current - at_port @ suspension
    return CoilHistory(times, current, history(port.voltage), force)
