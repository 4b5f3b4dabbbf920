"""Electrodynamic shakers, and the inner loops of current and force around them.

The amplifier sets the voltage u of the coil from the error e of what it measures,

    u = P e + Q integral of e dt,      L I' = u - R I - K_v s',
    F = K_f I - m s'' - c s' - k s,

with e = command - I, or e = command - F of the force on the beam as a sensor shows it. Where the
amplifier has limits, the coil gets u* = clip(u), and the integral does not wind up: its rate is
e + (u* - u) / P, which takes it to where u is u* in the time P / Q (back-calculation with the
tracking time of the integral action; Åström and Hägglund 2006, section 3.5).
"""

import abc
from typing import ClassVar, NamedTuple

import equinox as eqx
from jaxtyping import Float

from jaxbeam.case.actuators.base import AbstractActuator, Attachment
from jaxbeam.case.display import ReprWithUnits
from jaxbeam.case.fields import INCREASING, NOT_NEGATIVE, ON_BEAM, POSITIVE, number, part
from jaxbeam.runtime.arrays import Array, Number, xp


class Coil(NamedTuple):
    """Constants of a coil (ohm, H, N/A, V s/m) and of its moving mass (kg, N s/m, N/m)."""

    resistance: Float[Array, ""]
    inductance: Float[Array, ""]
    force_constant: Float[Array, ""]
    back_emf: Float[Array, ""]
    mass: Float[Array, ""]
    damping: Float[Array, ""]
    stiffness: Float[Array, ""]


class PortSignal(NamedTuple):
    """Signal of a device: a z + b u + (g_0 s + g_1 s' + g_2 s'') of its port, g in `port`.

    z are the states of its attachment, u its command, s the displacement at its port.
    """

    states: Float[Array, " state"]
    command: Float[Array, ""]
    port: Float[Array, "3"]


class LoopPort(NamedTuple):
    """Attachment of a coil with its inner loop, its current (A) and the voltage across it (V).

    `on_missing` are the rates of the states per voltage that is missing to the one asked for.
    """

    attachment: Attachment
    current: PortSignal
    voltage: PortSignal
    on_missing: Float[Array, " state"]


class AbstractInnerLoop(ReprWithUnits):
    """Interface of inner loops: proportional and integral gains, or a bandwidth."""

    kind: ClassVar[str]
    command_unit: ClassVar[str]
    bandwidth: eqx.AbstractVar[Float[Array, ""] | None]
    proportional: eqx.AbstractVar[Float[Array, ""] | None]
    integral: eqx.AbstractVar[Float[Array, ""] | None]
    limits: eqx.AbstractVar[Float[Array, "2"] | None]

    @property
    def voltage_follows_states(self) -> bool:
        """Whether no acceleration of the moving mass enters the voltage at once."""
        return True

    @abc.abstractmethod
    def port(self, coil: Coil) -> LoopPort:
        """Linear model from the command and the displacement to the force on the beam."""

    def validate(self) -> str | None:
        """Error of the gains, as "key must ...", or None."""
        if self.bandwidth is None and self.proportional is None:
            return "proportional is missing; give it, or a bandwidth from which both gains follow"
        if self.bandwidth is not None:
            for name in ("proportional", "integral"):
                if getattr(self, name) is not None:
                    return f"{name} contradicts bandwidth, from which it follows; leave one out"
        return None


class CurrentLoop(AbstractInnerLoop):
    """Current feedback: the command is a current in A, which the amplifier holds in the coil.

    Its gains follow from the `bandwidth` b as P = L b and Q = R b. The integral action then cancels
    the pole of the coil: I = command b / (p + b) with the coil at rest, while a velocity s' of the
    beam leaves the current -K_v p s' / ((L p + R)(p + b)), p the variable of Laplace. So the
    damping by the back-EMF vanishes as the bandwidth grows, and the shaker becomes a point force
    K_f times the command. Without `integral` the fraction R / (R + P) of a steady command is
    missing.

    >>> import jaxbeam as jb
    >>> shaker = jb.Electrodynamic(
    ...     0.3, 3.0, 1e-3, 8.0, inner_loop=jb.actuators.CurrentLoop(2e3, limits=(-1.0, 1.0))
    ... )
    >>> print(shaker.command_unit, f"{shaker.attachment().static_gain:.1f} N/A")
    A 8.0 N/A
    """

    kind: ClassVar[str] = "current"
    command_unit: ClassVar[str] = "A"

    bandwidth: Float[Number, ""] | None = number(
        "1/s", "bandwidth of the loop, from which its gains follow", POSITIVE, default=None
    )
    proportional: Float[Number, ""] | None = number(
        "V/A", "voltage per error of the current", POSITIVE, default=None
    )
    integral: Float[Number, ""] | None = number(
        "V/(A s)", "rate of the voltage per error of the current", POSITIVE, default=None
    )
    limits: Float[Number, "2"] | None = number(
        "A", "smallest and largest current commanded", INCREASING, default=None
    )

    def port(self, coil: Coil) -> LoopPort:
        gains = _gains(self, coil.inductance, coil.resistance)
        return _closed(coil, gains, -xp.ones(1), xp.zeros(3))


class ForceLoop(AbstractInnerLoop):
    """Force feedback: the command is a force in N, which the amplifier holds between coil and beam.

    The force F is that of a sensor at the tip, so that mass, suspension and back-EMF of the shaker
    stand within the loop and their effect vanishes as its gains grow; with integral action a steady
    command acts in full on a beam that gives way. Gains follow from the `bandwidth` b as
    P = L b / K_f and Q = R b / K_f: F = command b / (p + b) with the coil at rest. The signal of
    the sensor passes a first-order lag of `sensor_bandwidth`.

    A loop that is stable with the coil at rest need not be so on the beam: see `jb.check`.

    >>> import jaxbeam as jb
    >>> shaker = jb.Electrodynamic(
    ...     0.3, 3.0, 1e-3, 8.0, stiffness=2e3, inner_loop=jb.actuators.ForceLoop(bandwidth=500.0)
    ... )
    >>> attachment = shaker.attachment()
    >>> print(shaker.command_unit, f"{attachment.static_gain:.1f}, {attachment.stiffness:.1f} N/m")
    N 1.0, 0.0 N/m
    """

    kind: ClassVar[str] = "force"
    command_unit: ClassVar[str] = "N"

    bandwidth: Float[Number, ""] | None = number(
        "1/s", "bandwidth of the loop, from which its gains follow", POSITIVE, default=None
    )
    proportional: Float[Number, ""] | None = number(
        "V/N", "voltage per error of the force", POSITIVE, default=None
    )
    integral: Float[Number, ""] | None = number(
        "V/(N s)", "rate of the voltage per error of the force", POSITIVE, default=None
    )
    sensor_bandwidth: Float[Number, ""] | None = number(
        "1/s", "bandwidth of the lag of the force sensor; none if left out", POSITIVE, default=None
    )
    limits: Float[Number, "2"] | None = number(
        "N", "smallest and largest force commanded", INCREASING, default=None
    )

    @property
    def voltage_follows_states(self):
        return self.sensor_bandwidth is not None

    def port(self, coil: Coil) -> LoopPort:
        constant = coil.force_constant
        gains = _gains(self, coil.inductance / constant, coil.resistance / constant)
        suspension = xp.stack([coil.stiffness, coil.damping, coil.mass])
        lag = self.sensor_bandwidth
        if lag is None:
            return _closed(coil, gains, -constant[None], suspension)
        # The second state is what the sensor shows of the force.
        sensor = xp.stack([lag * constant, -lag]), -lag * suspension
        return _closed(coil, gains, xp.array([0.0, -1.0]), xp.zeros(3), sensor)


def coil_alone(coil: Coil) -> LoopPort:
    """Port of a coil whose command is its voltage; its state is the current."""
    velocity = xp.stack([xp.zeros(()), -coil.back_emf, xp.zeros(())])
    matrix, columns = -coil.resistance[None, None], velocity[None]
    voltage = PortSignal(xp.zeros(1), xp.ones(()), xp.zeros(3))
    on_voltage = 1 / coil.inductance[None]
    return _port(
        coil,
        matrix / coil.inductance,
        on_voltage,
        columns / coil.inductance,
        voltage,
        on_voltage,
    )


def _gains(loop: AbstractInnerLoop, inductance, resistance) -> tuple[Array, Array | None]:
    """Gains P and Q of a loop, given or from its bandwidth.

    `inductance` and `resistance` are those of the coil per unit of the output that is fed back.
    """
    if loop.bandwidth is None:
        return xp.asarray(loop.proportional), loop.integral
    return inductance * loop.bandwidth, resistance * loop.bandwidth


def _closed(coil: Coil, gains, error_states, error_port, sensor=None) -> LoopPort:
    """Port of a coil whose voltage follows from an error u + error_states z + error_port (s, ...).

    The states z are the current, the reading of the `sensor`, with its rows on both and on the
    port, and the integral of the error, if there are such.
    """
    proportional, integral = gains
    zero = xp.zeros(())
    states, port = proportional * error_states, proportional * error_port
    rows, columns = [], []
    if sensor is not None:
        rows.append(sensor[0])
        columns.append(sensor[1])
    commands = [proportional / coil.inductance] + [zero] * len(rows)
    on_missing = [1 / coil.inductance] + [zero] * len(rows)
    if integral is not None:
        states = xp.concatenate([states, integral[None]])
        rows = [xp.concatenate([row, xp.zeros(1)]) for row in rows]
        rows.append(xp.concatenate([error_states, xp.zeros(1)]))
        columns.append(error_port)
        commands.append(xp.ones(()))
        on_missing.append(1 / proportional)
    emf = xp.stack([zero, coil.back_emf, zero])
    resistance = coil.resistance * xp.eye(states.shape[0])[0]
    return _port(
        coil,
        xp.stack([(states - resistance) / coil.inductance, *rows]),
        xp.stack(commands),
        xp.stack([(port - emf) / coil.inductance, *columns]),
        PortSignal(states, proportional, port),
        xp.stack(on_missing),
    )


def _port(coil: Coil, matrix, commands, columns, voltage: PortSignal, on_missing) -> LoopPort:
    """Port of z' = matrix z + commands u + columns (s, s', s''), whose first state is the current.

    An attachment depends on s' alone. With z = y + a s + b s', a = -matrix^-1 columns_s and
    b = columns_s'', so does y' = matrix y + commands u + (columns_s' + matrix b - a) s'; what is
    left of s and s' adds to its stiffness and damping. At y = 0 the loop is at rest with s.
    """
    on_s, on_rate, on_acceleration = columns.T
    shift = -xp.linalg.solve(matrix, on_s)
    moved = xp.stack([shift, on_acceleration, xp.zeros_like(shift)], axis=1)

    def shown(signal: PortSignal) -> PortSignal:
        return PortSignal(signal.states, signal.command, signal.port + signal.states @ moved)

    first = xp.eye(matrix.shape[0])[0]
    current = shown(PortSignal(first, xp.zeros(()), xp.zeros(3)))
    attachment = Attachment(
        state_matrix=matrix,
        input_matrix=commands,
        velocity_matrix=on_rate + matrix @ on_acceleration - shift,
        output_matrix=coil.force_constant * first,
        feedthrough=xp.zeros(()),
        stiffness=coil.stiffness - coil.force_constant * current.port[0],
        damping=coil.damping - coil.force_constant * current.port[1],
        mass=coil.mass,
    )
    return LoopPort(attachment, current, shown(voltage), on_missing)


class Electrodynamic(AbstractActuator):
    """Electrodynamic shaker with coil, moving mass and suspension, fixed to the beam at `position`.

    L I' = u - R I - K_v w',   force = K_f I - m w'' - c w' - k w: eqs (2.26) to (2.34) of the
    thesis in the time domain. Its state is the current I. A positive voltage lifts the beam. A
    command of zero shorts the coil; its back-EMF then damps the beam.

    With an `inner_loop` the amplifier sets the voltage, and the command is a current in A
    (`CurrentLoop`) or a force in N (`ForceLoop`), bounded by the `limits` of the loop. The
    `limits` of the voltage then bound what the loop asks for, in runs under a controller; designs,
    margins and frequency responses are those within them. The voltage of a run is in
    `jaxbeam.analysis.sections.coil_history`, that per command in `jaxbeam frf`.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[
    ...         jb.Electrodynamic(0.3, resistance=3.0, inductance=1e-3, force_constant=8.0)
    ...     ],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.Feedback(gains=[1e3], period=0.005),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.769 mm
    """

    kind: ClassVar[str] = "electrodynamic"

    position: Float[Number, ""] = number("m", "distance from the left end", ON_BEAM)
    resistance: Float[Number, ""] = number("ohm", "coil resistance R", POSITIVE)
    inductance: Float[Number, ""] = number("H", "coil inductance L", POSITIVE)
    force_constant: Float[Number, ""] = number("N/A", "coil force per current K_f")
    back_emf: Float[Number, ""] | None = number(
        "V s/m", "back-EMF constant K_v; K_f if left out", default=None
    )
    mass: Float[Number, ""] = number("kg", "moving mass", NOT_NEGATIVE, default=0.0)
    stiffness: Float[Number, ""] = number("N/m", "suspension stiffness", NOT_NEGATIVE, default=0.0)
    damping: Float[Number, ""] = number("N s/m", "suspension damping", NOT_NEGATIVE, default=0.0)
    limits: Float[Number, "2"] | None = number(
        "V", "smallest and largest voltage", INCREASING, default=None
    )
    inner_loop: AbstractInnerLoop | None = part(
        "loop of the amplifier, by which commands are currents or forces", AbstractInnerLoop
    )

    def displacement_map(self):
        return ((self.position, 0, 1.0),)

    def attachment(self) -> Attachment:
        return self.coil_port().attachment

    def coil_port(self) -> LoopPort:
        """Attachment of the coil, with the current in it and the voltage across it as signals."""
        coil = Coil(
            self.resistance,
            self.inductance,
            self.force_constant,
            self.force_constant if self.back_emf is None else self.back_emf,
            self.mass,
            self.damping,
            self.stiffness,
        )
        return coil_alone(coil) if self.inner_loop is None else self.inner_loop.port(coil)

    @property
    def command_unit(self) -> str:
        return "V" if self.inner_loop is None else self.inner_loop.command_unit

    @property
    def has_limited_loop(self) -> bool:
        """Whether its voltage has limits within an inner loop."""
        return self.inner_loop is not None and self.limits is not None

    def command_limits(self) -> Float[Array, "2"] | None:
        return self.limits if self.inner_loop is None else self.inner_loop.limits

    def validate(self, address: str) -> str | None:
        if self.inner_loop is None:
            return None
        error = self.inner_loop.validate()
        if error is not None:
            return f"{address}.inner_loop.{error}"
        if self.limits is not None and not self.inner_loop.voltage_follows_states:
            return (
                f"{address}.inner_loop.sensor_bandwidth is missing: with limits of the voltage the"
                " signal of the force sensor needs a lag, as the force follows the acceleration of"
                f" {address}.mass at once"
            )
        return None
