"""The speed benchmark's problem, solved with scipy and with diffrax as well as each allows.

The problem: a point mass m enters a pinned beam of length L at t = 0 and crosses at constant
speed v. With mass-normalised sine modes phi_j and x = v t,

    q_j'' + 2 zeta w_j q_j' + w_j^2 q_j = -phi_j(x) R,
    R = m (g + w_tt + 2 v w_xt + v^2 w_xx)  at x,

which is the moving mass with its full convective acceleration. Wanted is the largest absolute
deflection at three sensors, over the crossing and the free vibration after it, to one part in
a million. w_tt holds the unknown q'', but only along phi, so R has a closed form (Sherman and
Morrison 1950); `crossing_rate` below is that form, shared by all.

The rules are the same for every solver: integrate the crossing, take the free vibration from
its closed form, and refine peaks between samples with the same cubic.
"""

import statistics
import time
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import DOP853

import jaxbeam  # noqa: F401 - switches JAX to double precision

GRAVITY = 9.81  # m/s^2


@dataclass(frozen=True)
class Rig:
    """The one-span pinned rig of the benchmark, in SI units, with `modes` sine modes."""

    modes: int
    length: float = 0.6
    flexural_rigidity: float = 11.68
    mass_per_length: float = 0.535
    damping_ratio: float = 0.03
    sensors: tuple[float, ...] = (0.15, 0.3, 0.45)

    @cached_property
    def wavenumbers(self):
        """j pi / L, (mode,) in 1/m."""
        return np.arange(1, self.modes + 1) * np.pi / self.length

    @cached_property
    def frequencies(self):
        """Undamped natural angular frequencies, (mode,) in rad/s."""
        return self.wavenumbers**2 * np.sqrt(self.flexural_rigidity / self.mass_per_length)

    @cached_property
    def amplitude(self):
        """The largest value of every mass-normalised mode shape, in 1/sqrt(kg)."""
        return np.sqrt(2 / (self.mass_per_length * self.length))

    @cached_property
    def sensor_shapes(self):
        """Mode shapes at the sensors, (sensor, mode) in 1/sqrt(kg)."""
        return self.amplitude * np.sin(np.outer(self.sensors, self.wavenumbers))

    @cached_property
    def exponents(self):
        """-zeta w + i w_d of the free vibration of every mode, (mode,) in 1/s."""
        zeta = self.damping_ratio
        return self.frequencies * (-zeta + 1j * np.sqrt(1 - zeta**2))

    @cached_property
    def state_sizes(self):
        """Scale of [q, q'] per kg of load, (2, mode): the first mode under it at rest.

        Errors are measured against it in every mode, since all add to the deflection alike.
        """
        size = GRAVITY * self.amplitude / self.frequencies[0] ** 2
        return size * np.stack([np.ones(self.modes), self.frequencies])


def reference_peaks(masses, speeds, modes, free=0.5):
    """Peaks to about 1e-10, (mass, speed, sensor) in m, for checking the others.

    As `scipy_peaks`, at the limit of double precision, with all masses of one speed integrated
    as one system, which shares their steps and Python's overhead.
    """
    rig, masses = Rig(modes), np.asarray(masses)
    times = free_times(rig, free, tolerance=1e-10)
    runs = [_scipy_runs(rig, masses, v, times, tolerance=1e-12, samples=8) for v in speeds]
    return np.stack(runs, axis=1)


def scipy_peaks(masses, speeds, modes, free=0.5):
    """Peaks by DOP853 in a loop, run by run, (mass, speed, sensor) in m.

    Masses in kg, speeds in m/s, `free` in s. With this tolerance no peak was worse
    than 5e-7 in samples of the benchmark's grid; twice as loose, some at 6 modes passed 1e-6.
    """
    rig = Rig(modes)
    times = free_times(rig, free)

    def run(mass, speed):
        return _scipy_runs(rig, np.array([mass]), speed, times, tolerance=5e-8, samples=4)[0]

    return np.array([[run(mass, speed) for speed in speeds] for mass in masses])


@partial(jax.jit, static_argnames=("modes", "free", "shared_steps"))
def diffrax_peaks(masses, speeds, modes, free=0.5, shared_steps=False):
    """Peaks by diffrax, mapped over speeds and batched over masses, (mass, speed, sensor) in m.

    Masses in kg, speeds in m/s, `free` in s. Every run has its own adaptive steps (`vmap`), or
    with `shared_steps` all masses of a speed are one system, with steps that suit the worst:
    that spares the selects which `vmap` puts around every step, and is several times faster.
    A run that fails is NaN.
    """
    rig = Rig(modes)
    times = free_times(rig, free)

    def at_speed(speed):
        if shared_steps:
            return _diffrax_runs(rig, masses, speed, times)
        return jax.vmap(lambda mass: _diffrax_runs(rig, mass[None], speed, times)[0])(masses)

    return jax.lax.map(at_speed, speeds).swapaxes(0, 1)


class Timing(NamedTuple):
    """Seconds of wall time: the median of warm calls, and what the first took beyond that."""

    run: float
    compile: float


def time_call(function, *args, repeat=5):
    """Time `function(*args)` until its results are ready: once cold, then `repeat` times warm."""

    def seconds():
        start = time.perf_counter()
        jax.block_until_ready(function(*args))
        return time.perf_counter() - start

    cold = seconds()
    run = statistics.median(seconds() for _ in range(repeat))
    return Timing(run, max(cold - run, 0.0))


def best_in_turn(functions, *args, rounds=40):
    """Shortest times of several functions, called in turn: disturbances meet them all alike."""
    times = []
    for function in functions:
        jax.block_until_ready(function(*args))
    for _ in range(rounds):
        for function in functions:
            start = time.perf_counter()
            jax.block_until_ready(function(*args))
            times.append(time.perf_counter() - start)
    return np.min(np.reshape(times, (rounds, -1)), axis=0)


def scipy_time(masses, speeds, modes, runs=12):
    """Seconds `scipy_peaks` would take for all masses and speeds, from a sample of `runs`.

    The cost of a run is a constant plus a share that grows with its duration, L / v; both are
    fitted to runs spread over the speeds, each with another mass, each timed thrice.
    """
    chosen = np.linspace(0, len(speeds) - 1, runs).round().astype(int)
    mixed = np.resize(np.asarray(masses)[:: max(len(masses) // runs, 1)], runs)
    pairs = zip(mixed, np.asarray(speeds)[chosen], strict=True)
    costs = [time_call(scipy_peaks, [m], [v], modes, repeat=3).run for m, v in pairs]
    growing, constant = np.polyfit(1 / np.asarray(speeds)[chosen], costs, 1)
    return len(masses) * np.sum(constant + growing / np.asarray(speeds))


def crossing_rate(rig, masses, speed):
    """The function (t, [q, q']) -> [q', q''] of all `masses` at one speed; (2, mode, run) each."""
    damping = (2 * rig.damping_ratio * rig.frequencies)[:, None]
    stiffness = (rig.frequencies**2)[:, None]
    travel_rates = speed * rig.wavenumbers
    squared_rates = (travel_rates**2)[:, None]

    def rate(t, state):
        xp = state.__array_namespace__()
        q, velocity = state
        phi = rig.amplitude * xp.sin(travel_rates * t)
        two_speed_slope = 2 * rig.amplitude * travel_rates * xp.cos(travel_rates * t)
        free = -damping * velocity - stiffness * q  # q'' without the mass
        convected = phi @ (free - squared_rates * q) + two_speed_slope @ velocity
        force = masses * (GRAVITY + convected) / (1 + masses * (phi @ phi))
        return xp.concatenate((velocity, free - phi[:, None] * force)).reshape(state.shape)

    return rate


def hermite_peaks(interval, value, rate):
    """Largest absolute value of the cubics through `value` and `rate` at successive times.

    `interval` is (time - 1,), `value` and `rate` are (time, ...); returns (...). The stationary
    point taken in each interval is the first of the kind its left slope leads to.
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


def free_times(rig, free, tolerance=1e-7):
    """Times at which cubics through the free vibration are right to `tolerance`, (time,) in s.

    A cubic errs by h^4 w'''' / 384. Mode j is taken to start with 1 / j^2 of the peak, which
    grants every mode the same largest bending moment; as high modes die out, h grows.
    """
    ratio = rig.frequencies / rig.frequencies[0]
    times = [0.0]
    while times[-1] < free:
        alive = np.exp(-rig.damping_ratio * rig.frequencies * times[-1]) / ratio
        times.append(times[-1] + (384 * tolerance / (alive @ rig.frequencies**4)) ** 0.25)
    return np.array([*times[:-1], free])


def free_peaks(rig, times, q, velocity):
    """Largest absolute deflection in free vibration, (sensor, run) in m.

    q_j = Re(a_j exp(p_j t)) with p_j = -zeta w_j + i w_d, from `q` and `velocity`, (mode, run),
    at time zero. `times` are those of `free_times`.
    """
    xp = q.__array_namespace__()
    exponents = rig.exponents[:, None]
    start = q - 1j * (velocity - exponents.real * q) / exponents.imag
    start = rig.sensor_shapes[:, :, None] * start  # (sensor, mode, run)
    decay = np.exp(np.outer(times, rig.exponents))
    value, rate = (
        xp.einsum("tm,smr->tsr", table.real, start.real)
        - xp.einsum("tm,smr->tsr", table.imag, start.imag)
        for table in (decay, decay * rig.exponents)
    )
    return hermite_peaks(np.diff(times), value, rate)


def _scipy_runs(rig, masses, speed, times, tolerance, samples):
    """Peaks of all `masses` at one speed, integrated as one system, (run, sensor) in m."""
    rate = crossing_rate(rig, masses, speed)
    size = rig.state_sizes[:, :, None] * masses
    solver = DOP853(
        lambda t, state: rate(t, state.reshape(size.shape)).ravel(),
        0.0,
        np.zeros(size.size),
        rig.length / speed,
        rtol=1e-13,  # so small that the absolute tolerance rules: it is peaks that matter
        atol=tolerance * size.ravel(),
    )
    fractions = np.linspace(0, 1, samples + 1)
    peaks = np.zeros((len(rig.sensors), len(masses)))
    while solver.status == "running":
        solver.step()
        states = solver.dense_output()(solver.t_old + fractions * solver.step_size)
        q, velocity = states.T.reshape(samples + 1, *size.shape).swapaxes(0, 1)
        interval = np.full(samples, solver.step_size / samples)
        value, slope = rig.sensor_shapes @ q, rig.sensor_shapes @ velocity
        np.maximum(peaks, hermite_peaks(interval, value, slope), out=peaks)
    if solver.status != "finished":
        raise RuntimeError(f"DOP853 gave up at t = {solver.t} s, speed {speed} m/s")
    q, velocity = solver.y.reshape(size.shape)
    return np.maximum(peaks, free_peaks(rig, times, q, velocity)).T


def _diffrax_runs(rig, masses, speed, times):
    """Peaks of all `masses` at one speed, integrated as one system, (run, sensor) in m."""
    rate = crossing_rate(rig, masses, speed)
    duration = rig.length / speed
    size = rig.state_sizes[:, :, None] * masses

    def worst_run(error):
        return jnp.sqrt(jnp.max(jnp.mean((error / size) ** 2, axis=(0, 1))))

    samples = jnp.linspace(0.0, duration, 200 + 50 * rig.modes)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, state, args: rate(t, state)),
        diffrax.Dopri8(),
        t0=0.0,
        t1=duration,
        dt0=0.1 / rig.frequencies[-1],
        y0=jnp.zeros_like(size),
        saveat=diffrax.SaveAt(
            subs=[
                diffrax.SubSaveAt(ts=samples, fn=lambda t, state, args: rig.sensor_shapes @ state),
                diffrax.SubSaveAt(t1=True),
            ]
        ),
        stepsize_controller=diffrax.PIDController(rtol=0.0, atol=1e-7, norm=worst_run),
        adjoint=diffrax.ForwardMode(),
        max_steps=None,
        throw=False,
    )
    deflection, end = jax.tree.leaves(solution.ys)
    crossing = hermite_peaks(jnp.diff(samples), deflection[:, 0], deflection[:, 1])
    peaks = jnp.maximum(crossing, free_peaks(rig, times, *end[0])).T
    return jnp.where(solution.result == diffrax.RESULTS.successful, peaks, jnp.nan)
