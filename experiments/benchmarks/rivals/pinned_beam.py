"""The pinned beam of the speed benchmark, and the closed forms that all solvers share.

A point mass m enters a pinned beam at t = 0 and crosses at constant speed v; the beam has one span,
or two over a support in the middle. With mass-normalised modes phi_j and x = v t,

    q_j'' + 2 zeta w_j q_j' + w_j^2 q_j = -phi_j(x) R + p_j,
    R = m (g + w_tt + 2 v w_xt + v^2 w_xx)  at x,

which is the moving mass with its full convective acceleration. w_tt contains the unknown q'', but
only along phi, so R has a closed form (Sherman and Morrison 1950), that of `crossing_rate`. p are
modal forces of patches under control.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import brentq

GRAVITY = 9.81  # m/s^2
SPAN = 0.6  # m
PATCH = 0.2575, 0.3425  # m, edges of the patch on each span
MOMENT = 8.292e-4 * 0.35 * 200.0  # N m of a patch per volt of command


@dataclass(frozen=True)
class PinnedBeam:
    """The pinned beam of the benchmark, in SI units, with equal spans.

    With a `gain` (V/m) the command of patch i on span i is u = -gain y of sensor i: every `period`
    (s), held in between, or continuously without a period.
    """

    modes: int
    length: float = SPAN
    flexural_rigidity: float = 11.68
    mass_per_length: float = 0.535
    damping_ratio: float = 0.03
    sensors: tuple[float, ...] = (0.15, 0.3, 0.45)
    spans: int = 1
    gain: float | None = None
    period: float | None = None

    @cached_property
    def wavenumbers(self):
        """Wavenumbers of the modes, (mode,) in 1/m.

        Two spans, each of length a: in turn those of sines, k a = n pi, and those of spans clamped
        in the middle, tan k a = tanh k a.
        """
        if self.spans == 1:
            return np.arange(1, self.modes + 1) * np.pi / self.length

        def clamped(x):
            return np.sin(x) - np.cos(x) * np.tanh(x)

        turns = np.arange(1, self.modes // 2 + 2) * np.pi
        roots = [brentq(clamped, turn + 0.1, turn + np.pi / 2, xtol=1e-14) for turn in turns]
        return 2 / self.length * np.transpose([turns, np.array(roots)]).ravel()[: self.modes]

    @cached_property
    def sinh_share(self):
        """Share of sinh k s in mode shapes, (mode,): nonzero for modes clamped in the middle."""
        if self.spans == 1:
            return np.zeros(self.modes)
        angles = self.wavenumbers * self.length / 2
        return np.where(np.arange(self.modes) % 2 == 0, 0.0, np.sin(angles) / np.sinh(angles))

    @cached_property
    def frequencies(self):
        """Undamped natural angular frequencies, (mode,) in rad/s."""
        return self.wavenumbers**2 * np.sqrt(self.flexural_rigidity / self.mass_per_length)

    @cached_property
    def mode_amplitudes(self):
        """Amplitude of the mass-normalised modes, (mode,) in 1/sqrt(kg)."""
        return np.sqrt(2 / (self.mass_per_length * self.length * (1 - self.sinh_share**2)))

    def shapes(self, position, derivative=0):
        """Mode shapes at a position (m), (mode,) in 1/sqrt(kg), or slopes, in 1/(m sqrt(kg))."""
        right = self.spans == 2 and position > self.length / 2
        s, k = (self.length - position if right else position), self.wavenumbers
        wave, grown = (np.sin, np.sinh) if derivative == 0 else (np.cos, np.cosh)
        shape = (
            k**derivative * self.mode_amplitudes * (wave(k * s) - self.sinh_share * grown(k * s))
        )
        return self.symmetry_signs * (-1) ** derivative * shape if right else shape

    @cached_property
    def symmetry_signs(self):
        """Sign of each mode at the mirrored position, (mode,)."""
        return np.where(np.arange(self.modes) % 2 == 0, -1.0, 1.0)

    @cached_property
    def sensor_shapes(self):
        """Mode shapes at the sensors, (sensor, mode) in 1/sqrt(kg)."""
        return np.array([self.shapes(position) for position in self.sensors])

    @cached_property
    def patch_shapes(self):
        """Modal force of each patch per volt, (mode, patch) in 1/sqrt(kg) N/V."""
        starts = np.arange(self.spans) * self.length / self.spans
        edges = [[self.shapes(start + edge, 1) for edge in PATCH] for start in starts]
        return MOMENT * np.array([left - right for left, right in edges]).T

    @cached_property
    def poles(self):
        """Poles -zeta w + i w_d of the modes, (mode,) in 1/s."""
        zeta = self.damping_ratio
        return self.frequencies * (-zeta + 1j * np.sqrt(1 - zeta**2))

    @cached_property
    def state_scales(self):
        """Scales of [q, q'] per kg of load, (2, mode): those of the first mode under it at rest.

        They are the same for every mode, since all add to the deflection alike.
        """
        size = GRAVITY * self.mode_amplitudes[0] / self.frequencies[0] ** 2
        return size * np.stack([np.ones(self.modes), self.frequencies])

    def feedback_commands(self, q):
        """Commands (patch, run) in V, from coordinates (mode, run)."""
        return -self.gain * (self.sensor_shapes[: self.spans] @ q)


def crossing_rate(beam, masses, speed, span: int | None = 0, modal_forces=None):
    """The function (t, [q, q']) -> [q', q''] of all `masses` at one speed; (2, mode, run) each.

    It holds while they are on the span of that number, or with None off the beam. `modal_forces`
    is a function from coordinates to the modal forces of patches, (mode, run) each.
    """
    damping = (2 * beam.damping_ratio * beam.frequencies)[:, None]
    stiffness = (beam.frequencies**2)[:, None]
    off_beam, span = span is None, span or 0
    k = beam.wavenumbers
    signed_amplitude = beam.mode_amplitudes * (beam.symmetry_signs if span else 1.0)
    slope_factor = 2 * speed * (-1) ** span * signed_amplitude * k
    curvature_factor = -((speed * k) ** 2)
    has_sinh = np.any(beam.sinh_share != 0)

    def accelerations(q, velocity):
        """Accelerations of the modes without a mass, (mode, run)."""
        free = -damping * velocity - stiffness * q
        return free if modal_forces is None else free + modal_forces(q)

    def unloaded(t, state):
        xp = state.__array_namespace__()
        return xp.concatenate((state[1], accelerations(*state))).reshape(state.shape)

    def rate(t, state):
        xp = state.__array_namespace__()
        q, velocity = state
        angle = k * (beam.length - speed * t) if span else k * speed * t
        phi, two_speed_slope = signed_amplitude * xp.sin(angle), slope_factor * xp.cos(angle)
        curvature = curvature_factor * phi  # times speed^2
        if has_sinh:
            grown = signed_amplitude * beam.sinh_share * xp.sinh(angle)
            phi, curvature = phi - grown, curvature + curvature_factor * grown
            two_speed_slope = two_speed_slope - slope_factor * beam.sinh_share * xp.cosh(angle)
        free = accelerations(q, velocity)
        convected = phi @ free + curvature @ q + two_speed_slope @ velocity
        force = masses * (GRAVITY + convected) / (1 + masses * (phi @ phi))
        return xp.concatenate((velocity, free - phi[:, None] * force)).reshape(state.shape)

    return unloaded if off_beam else rate


def hermite_peaks(interval, value, rate):
    """Largest absolute value of the cubics through `value` and `rate` at successive times.

    `interval` is (time - 1,), `value` and `rate` are (time, ...); returns (...). In each interval
    it takes the first maximum where the left slope is positive, else the first minimum.
    """
    xp = value.__array_namespace__()
    interval = interval.reshape((-1,) + (1,) * (value.ndim - 1))
    left, right = interval * rate[:-1], interval * rate[1:]
    rise = value[1:] - value[:-1]
    square, cube = 3 * rise - 2 * left - right, left + right - 2 * rise
    root = xp.sqrt(xp.maximum(square**2 - 3 * cube * left, 0))
    denominator = root - xp.sign(left) * square
    s = xp.minimum(abs(left) / xp.maximum(denominator, 1e-300), 1)
    inside = value[:-1] + s * (left + s * (square + s * cube))
    return xp.maximum(abs(value).max(0), abs(inside).max(0))


def free_times(beam, free, tolerance=1e-7):
    """Times at which cubics through the free vibration are right to `tolerance`, (time,) in s.

    The error of a cubic is h^4 w'''' / 384. Mode j is assumed to start with w_1 / w_j of the peak,
    the same largest bending moment for every mode; as high modes decay, h grows.
    """
    ratio = beam.frequencies / beam.frequencies[0]
    times = [0.0]
    while times[-1] < free:
        alive = np.exp(-beam.damping_ratio * beam.frequencies * times[-1]) / ratio
        times.append(times[-1] + (384 * tolerance / (alive @ beam.frequencies**4)) ** 0.25)
    return np.array([*times[:-1], free])


def free_vibration(beam, times, q, velocity):
    """Deflections and their rates in free vibration, (time, sensor, run) in m and m/s.

    q_j = Re(a_j exp(p_j t)) with p_j = -zeta w_j + i w_d, from `q` and `velocity`, (mode, run),
    at time zero.
    """
    xp = q.__array_namespace__()
    exponents = beam.poles[:, None]
    start = q - 1j * (velocity - exponents.real * q) / exponents.imag
    start = beam.sensor_shapes[:, :, None] * start  # (sensor, mode, run)
    decay = np.exp(np.outer(times, beam.poles))
    return tuple(
        xp.einsum("tm,smr->tsr", table.real, start.real)
        - xp.einsum("tm,smr->tsr", table.imag, start.imag)
        for table in (decay, decay * beam.poles)
    )


def free_peaks(beam, times, q, velocity):
    """Largest absolute deflection in free vibration, (sensor, run) in m, times by `free_times`."""
    return hermite_peaks(np.diff(times), *free_vibration(beam, times, q, velocity))
