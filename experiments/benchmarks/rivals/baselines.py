"""The crossing of `pinned_beam` solved by scipy and by diffrax, each as fast as it allows.

The results are the largest absolute deflections at the sensors, over the crossing and the free
vibration after it, to one part in a million; or deflections at given times. The rules are the same
for every solver: integrate the crossing, take the free vibration from its closed form where no
controller acts, and refine peaks between samples with the same cubic.

The pinned beam of the speed benchmark, and the closed forms that all solvers share.

A point mass m enters a pinned beam at t = 0 and crosses at constant speed v; the beam has one span,
or two over a support in the middle. With mass-normalised modes phi_j and x = v t,

    q_j'' + 2 zeta w_j q_j' + w_j^2 q_j = -phi_j(x) R + p_j,
    R = m (g + w_tt + 2 v w_xt + v^2 w_xx)  at x,

which is the moving mass with its full convective acceleration. w_tt contains the unknown q'', but
only along phi, so R has a closed form (Sherman and Morrison 1950), that of `crossing_rate`. p are
modal forces of patches under control.
"""

from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import DOP853
from scipy.optimize import brentq

import jaxbeam  # noqa: F401 - switches JAX to double precision
from experiments.benchmarks.common import Timing, time_call

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
    def sinh_factors(self):
        """Coefficient of sinh k s in mode shapes, (mode,): nonzero if clamped in the middle."""
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
        return np.sqrt(2 / (self.mass_per_length * self.length * (1 - self.sinh_factors**2)))

    def shapes(self, position, derivative=0):
        """Mode shapes at a position (m), (mode,) in 1/sqrt(kg), or slopes, in 1/(m sqrt(kg))."""
        right = self.spans == 2 and position > self.length / 2
        s, k = (self.length - position if right else position), self.wavenumbers
        wave, grown = (np.sin, np.sinh) if derivative == 0 else (np.cos, np.cosh)
        shape = (
            k**derivative * self.mode_amplitudes * (wave(k * s) - self.sinh_factors * grown(k * s))
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
    has_sinh = np.any(beam.sinh_factors != 0)

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
            grown = signed_amplitude * beam.sinh_factors * xp.sinh(angle)
            phi, curvature = phi - grown, curvature + curvature_factor * grown
            two_speed_slope = two_speed_slope - slope_factor * beam.sinh_factors * xp.cosh(angle)
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


def free_times(beam, tolerance=1e-7):
    """Times at which cubics through the free vibration are right to `tolerance`, (time,) in s.

    The error of a cubic is h^4 w'''' / 384. Mode j is assumed to start with w_1 / w_j of the peak,
    the same largest bending moment for every mode; as high modes decay, h grows.
    """
    ratio = beam.frequencies / beam.frequencies[0]
    times = [0.0]
    while times[-1] < FREE_VIBRATION:
        alive = np.exp(-beam.damping_ratio * beam.frequencies * times[-1]) / ratio
        times.append(times[-1] + (384 * tolerance / (alive @ beam.frequencies**4)) ** 0.25)
    return np.array([*times[:-1], FREE_VIBRATION])


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


FREE_VIBRATION = 0.5  # s of vibration after the exit
REFERENCE_TOLERANCE = 1e-12
SCIPY_TOLERANCE = 5e-8  # errors of peaks up to 5e-7; with twice that, some exceed 1e-6


def reference_peaks(beam, masses, speeds):
    """Reference peaks (mass, speed, sensor) in m, right to about 1e-10.

    As `scipy_peaks` at the limit of double precision, with all masses of one speed integrated as
    one system, which shares their steps and Python's overhead.
    """
    masses, times = np.asarray(masses), free_times(beam, tolerance=1e-10)
    runs = [
        _scipy_runs(beam, masses, v, times, tolerance=REFERENCE_TOLERANCE, samples=8)
        for v in speeds
    ]
    return np.stack(runs, axis=1)


def scipy_peaks(beam, masses, speeds):
    """Peaks by DOP853 in a loop, run by run, (mass, speed, sensor) in m, for kg and m/s."""
    times = free_times(beam)

    def run(mass, speed):
        return _scipy_runs(
            beam, np.array([mass]), speed, times, tolerance=SCIPY_TOLERANCE, samples=4
        )[0]

    return np.array([[run(mass, speed) for speed in speeds] for mass in masses])


def scipy_histories(beam, masses, speeds, times, tolerance=SCIPY_TOLERANCE):
    """Deflections at increasing times (s) by DOP853, run by run, (mass, speed, time, sensor)."""

    def run(mass, speed):
        return _scipy_samples(beam, np.array([mass]), speed, np.asarray(times), tolerance)

    return np.array([[run(mass, speed) for speed in speeds] for mass in masses])


def scipy_time(solve, beam, masses, speeds, runs=12, repeat=3, reference=None):
    """Time of `solve(beam, masses, speeds)` for all of these, scaled from a sample of `runs`.

    The time of a run is a constant plus a part proportional to its duration, L / v; both are
    fitted to runs at speeds spread over all, each with another mass, each timed `repeat` times. A
    function `reference` is called between them for the ratio.
    """
    sampled_speeds = np.linspace(0, len(speeds) - 1, runs).round().astype(int)
    mixed = np.resize(np.asarray(masses)[:: max(len(masses) // runs, 1)], runs)
    pairs = zip(mixed, np.asarray(speeds)[sampled_speeds], strict=True)
    timings = [
        time_call(solve, beam, [m], [v], repeat=repeat, reference=reference) for m, v in pairs
    ]

    def total_cost(costs):
        growing, constant = np.polyfit(1 / np.asarray(speeds)[sampled_speeds], costs, 1)
        return float(len(masses) * np.sum(constant + growing / np.asarray(speeds)))

    return Timing(
        total_cost([t.run for t in timings]),
        ratio=total_cost([t.ratio for t in timings]),
        shortest=total_cost([t.shortest for t in timings]),
        reference_shortest=min(t.reference_shortest for t in timings),
    )


@partial(jax.jit, static_argnames=("beam", "shared_steps"))
def diffrax_peaks(beam, masses, speeds, shared_steps=False):
    """Peaks by diffrax, mapped over speeds and batched over masses, (mass, speed, sensor) in m.

    Masses in kg, speeds in m/s. Every run has its own adaptive steps (`vmap`), or
    with `shared_steps` all masses of a speed are one system, with steps for the largest error: that
    avoids the selects which `vmap` puts around every step, and is several times faster. Failed runs
    are NaN.
    """
    times = free_times(beam)

    def at_speed(speed):
        if shared_steps:
            return _diffrax_runs(beam, masses, speed, times)
        return jax.vmap(lambda mass: _diffrax_runs(beam, mass[None], speed, times)[0])(masses)

    return jax.lax.map(at_speed, speeds).swapaxes(0, 1)


def _scipy_steps(beam, masses, speed, end, tolerance):
    """Steps of DOP853 from rest to a time `end` (s), with all `masses` as one system.

    Yields for each step its start (s), its length (s), and a function from times in it to states
    (2, mode, run, time). Steps end where a load passes a support and at sampling instants.
    """
    size = beam.state_scales[:, :, None] * masses
    passed = beam.length / speed * np.arange(1, beam.spans + 1) / beam.spans
    sampling_instants = (
        np.zeros(1) if beam.period is None else beam.period * np.arange(int(end / beam.period) + 1)
    )
    stops = np.unique(np.concatenate([sampling_instants, passed, [end]]).round(13))
    state, modal_forces = np.zeros_like(size), None
    if beam.gain is not None and beam.period is None:
        modal_forces = partial(
            np.matmul, beam.patch_shapes @ beam.feedback_commands(np.eye(beam.modes))
        )
    for start, stop in pairwise(stops[stops <= end + 1e-12]):
        span = int(np.sum(passed < start + 1e-12))
        if beam.period is not None and np.min(np.abs(sampling_instants - start)) < 1e-12:
            held = beam.patch_shapes @ beam.feedback_commands(state[0])
            modal_forces = lambda q, held=held: held  # noqa: E731
        rate = crossing_rate(beam, masses, speed, span if span < beam.spans else None, modal_forces)
        solver = DOP853(
            lambda t, y, rate=rate: rate(t, y.reshape(size.shape)).ravel(),
            start,
            state.ravel(),
            stop,
            rtol=1e-13,  # so small that the absolute tolerance decides, as for the error of peaks
            atol=tolerance * size.ravel(),
        )
        while solver.status == "running":
            solver.step()
            dense = solver.dense_output()
            yield solver.t_old, solver.step_size, partial(_states, dense, size.shape)
        if solver.status != "finished":
            raise RuntimeError(f"DOP853 gave up at t = {solver.t} s, speed {speed} m/s")
        state = solver.y.reshape(size.shape)


def _states(dense, shape, times):
    """States (2, mode, run, time) of a dense output at times (s)."""
    return dense(times).reshape(*shape, -1)


def _scipy_runs(beam, masses, speed, times, tolerance, samples):
    """Peaks of all `masses` at one speed, integrated as one system, (run, sensor) in m.

    `times` (s) are those of `free_times`.
    """
    fractions = np.linspace(0, 1, samples + 1)
    peaks = np.zeros((len(beam.sensors), len(masses)))
    exit_time = beam.length / speed
    end = exit_time if beam.gain is None else exit_time + times[-1]
    states = np.zeros(1)
    for start, length, dense in _scipy_steps(beam, masses, speed, end, tolerance):
        states = dense(start + fractions * length).transpose(3, 0, 1, 2)
        q, velocity = states.swapaxes(0, 1)
        interval = np.full(samples, length / samples)
        value, slope = beam.sensor_shapes @ q, beam.sensor_shapes @ velocity
        np.maximum(peaks, hermite_peaks(interval, value, slope), out=peaks)
    if beam.gain is None:
        np.maximum(peaks, free_peaks(beam, times, *states[-1]), out=peaks)
    return peaks.T


def _scipy_samples(beam, masses, speed, times, tolerance):
    """Deflections of one mass at increasing times, (time, sensor) in m."""
    deflections = np.zeros((len(times), len(beam.sensors)))
    exit_time = beam.length / speed
    end = min(exit_time, times[-1]) if beam.gain is None else times[-1]
    state = np.zeros(1)
    for start, length, dense in _scipy_steps(beam, masses, speed, end, tolerance):
        inside = (times > start) & (times <= start + length)
        sample_times = np.append(times[inside], start + length)
        states = dense(sample_times)
        deflections[inside] = (beam.sensor_shapes @ states[0, :, 0, :-1]).T
        state = states[..., -1]
    later = times > exit_time
    if beam.gain is None and later.any():
        deflections[later] = free_vibration(beam, times[later] - exit_time, *state)[0][:, :, 0]
    return deflections


def _diffrax_runs(beam, masses, speed, times):
    """Peaks of all `masses` at one speed, integrated as one system, (run, sensor) in m."""
    size = beam.state_scales[:, :, None] * masses
    state, peaks = jnp.zeros_like(size), jnp.zeros((len(beam.sensors), len(masses)))
    successful = True
    crossing_time = beam.length / speed / beam.spans  # of one span

    def worst_run(error):
        return jnp.sqrt(jnp.max(jnp.mean((error / size) ** 2, axis=(0, 1))))

    for span in range(beam.spans):
        rate = crossing_rate(beam, masses, speed, span)
        start, stop = span * crossing_time, (span + 1) * crossing_time
        samples = jnp.linspace(start, stop, 200 + 50 * beam.modes)
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, state, args, rate=rate: rate(t, state)),
            diffrax.Dopri8(),
            t0=start,
            t1=stop,
            dt0=0.1 / beam.frequencies[-1],
            y0=state,
            saveat=diffrax.SaveAt(
                subs=[
                    diffrax.SubSaveAt(
                        ts=samples, fn=lambda t, state, args: beam.sensor_shapes @ state
                    ),
                    diffrax.SubSaveAt(t1=True),
                ]
            ),
            stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e-7, norm=worst_run),
            adjoint=diffrax.ForwardMode(),
            max_steps=None,
            throw=False,
        )
        deflection, end = jax.tree.leaves(solution.ys)
        peaks_of_span = hermite_peaks(jnp.diff(samples), deflection[:, 0], deflection[:, 1])
        state, peaks = end[0], jnp.maximum(peaks, peaks_of_span)
        successful &= solution.result == diffrax.RESULTS.successful
    peaks = jnp.maximum(peaks, free_peaks(beam, times, *state)).T
    return jnp.where(successful, peaks, jnp.nan)
