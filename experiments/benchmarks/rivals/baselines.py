"""The crossing of `pinned_beam` solved by scipy and by diffrax, each as fast as it allows.

The results are the largest absolute deflections at the sensors, over the crossing and the free
vibration after it, to one part in a million; or deflections at given times. The rules are the same
for every solver: integrate the crossing, take the free vibration from its closed form where no
controller acts, and refine peaks between samples with the same cubic.
"""

from functools import partial
from itertools import pairwise

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import DOP853

import jaxbeam  # noqa: F401 - switches JAX to double precision
from experiments.benchmarks.common import Timing, time_call
from experiments.benchmarks.rivals.pinned_beam import (
    crossing_rate,
    free_peaks,
    free_times,
    free_vibration,
    hermite_peaks,
)

FREE_VIBRATION = 0.5  # s of vibration after the exit
REFERENCE_TOLERANCE = 1e-12
SCIPY_TOLERANCE = 5e-8  # errors of peaks up to 5e-7; with twice that, some exceed 1e-6


def reference_peaks(beam, masses, speeds, free=FREE_VIBRATION):
    """Reference peaks (mass, speed, sensor) in m, right to about 1e-10.

    As `scipy_peaks` at the limit of double precision, with all masses of one speed integrated as
    one system, which shares their steps and Python's overhead.
    """
    masses, times = np.asarray(masses), free_times(beam, free, tolerance=1e-10)
    runs = [
        _scipy_runs(beam, masses, v, times, tolerance=REFERENCE_TOLERANCE, samples=8)
        for v in speeds
    ]
    return np.stack(runs, axis=1)


def scipy_peaks(beam, masses, speeds, free=FREE_VIBRATION):
    """Peaks by DOP853 in a loop, run by run, (mass, speed, sensor) in m.

    Masses in kg, speeds in m/s, `free` in s.
    """
    times = free_times(beam, free)

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

    The time of a run is a constant plus a share proportional to its duration, L / v; both are
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


@partial(jax.jit, static_argnames=("beam", "free", "shared_steps"))
def diffrax_peaks(beam, masses, speeds, free=FREE_VIBRATION, shared_steps=False):
    """Peaks by diffrax, mapped over speeds and batched over masses, (mass, speed, sensor) in m.

    Masses in kg, speeds in m/s, `free` in s. Every run has its own adaptive steps (`vmap`), or
    with `shared_steps` all masses of a speed are one system, with steps for the largest error: that
    avoids the selects which `vmap` puts around every step, and is several times faster. Failed runs
    are NaN.
    """
    times = free_times(beam, free)

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
