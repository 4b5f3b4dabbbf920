"""Speed of an identification against scipy: five parameters from ten logged crossings.

    python -m experiments.benchmarks.identification

scipy's least squares takes finite differences over crossings integrated by DOP853; jaxbeam takes
exact derivatives. Both start at the same wrong values and minimise the same weighted squares.
DOP853 is as accurate as the differences need: with looser tolerances they are noise.
"""

import time
from dataclasses import replace

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import jaxbeam as jb
from experiments.benchmarks.rivals.pinned_beam import PinnedBeam, crossing_rate
from tuning import Log
from tuning.fit.dataset import make_dataset
from tuning.fit.least_squares import LeastSquares
from tuning.parameters.free import free_parameters

TRUTH = {
    "beam.flexural_rigidity": 11.68,
    "beam.mass_per_length": 0.535,
    "beam.damping_ratio": 0.03,
    "sensors.0.position": 0.15,
    "sensors.1.position": 0.3,
}
INITIAL_VALUES = np.array([11.0, 0.56, 0.02, 0.14, 0.31])  # N m^2, kg/m, 1, m, m
SPEEDS = np.linspace(0.8, 4.0, 10)  # m/s, one for each log
MASS, NOISE, SAMPLE_RATE, FREE_VIBRATION = 0.5, 1e-5, 500.0, 0.3  # kg, m, Hz, s
MODES = 3
TOLERANCE = 1e-11  # of DOP853, relative to the scales of the states
STEP = 1e-5  # of the differences, relative to each value


def scipy_deflections(values: np.ndarray, speed: float, times: np.ndarray) -> np.ndarray:
    """Deflections (time, sensor) in m of a crossing and the free vibration after it, by DOP853."""
    beam = replace(
        PinnedBeam(MODES),
        flexural_rigidity=values[0],
        mass_per_length=values[1],
        damping_ratio=values[2],
        sensors=(values[3], values[4]),
    )
    scales = (beam.state_scales[:, :, None] * MASS).ravel()
    exit_time = beam.length / speed
    settings = {"method": "DOP853", "rtol": 1e-13, "atol": TOLERANCE * scales}

    def flat_rate(masses):
        rate = crossing_rate(beam, np.array(masses), speed)
        return lambda t, y: rate(t, y.reshape(2, MODES, 1)).ravel()

    on = times < exit_time - 1e-9
    first = solve_ivp(
        flat_rate([MASS]), (0, exit_time), 0 * scales, t_eval=[*times[on], exit_time], **settings
    ).y
    later = np.maximum(times[~on], exit_time)
    second = solve_ivp(
        flat_rate([0.0]), (exit_time, later[-1]), first[:, -1], t_eval=later, **settings
    ).y
    states = np.hstack([first[:, :-1], second])
    return (beam.sensor_shapes @ states[:MODES]).T


def make_logs() -> list[Log]:
    """Ten crossings by DOP853, with white noise."""
    rng = np.random.default_rng(0)
    logs = []
    for i, speed in enumerate(SPEEDS):
        times = np.arange(int((0.6 / speed + FREE_VIBRATION) * SAMPLE_RATE)) / SAMPLE_RATE
        clean = scipy_deflections(np.array(list(TRUTH.values())), speed, times)
        values = clean + NOISE * rng.normal(size=clean.shape)
        load = jb.MovingMass(mass=MASS, speed=speed)
        labels = ("left", "middle"), ("deflection",) * 2, ("m",) * 2, f"log {i}"
        logs.append(Log(times, values, *labels, loads=(load,)))
    return logs


def initial_case() -> jb.Case:
    """The case with the start values."""
    beam = jb.Beam(
        length=0.6,
        flexural_rigidity=INITIAL_VALUES[0],
        mass_per_length=INITIAL_VALUES[1],
        damping_ratio=INITIAL_VALUES[2],
        modes=MODES,
    )
    return jb.Case(beam, sensors=[jb.Sensor(INITIAL_VALUES[3]), jb.Sensor(INITIAL_VALUES[4])])


def fit_by_scipy(logs: list[Log]) -> tuple[np.ndarray, int, float]:
    """Identification by scipy's least squares with finite differences.

    Returns the values (parameter,), the number of evaluations of all logs, and the wall time (s).
    """
    calls = 0

    def residuals(values):
        nonlocal calls
        calls += 1
        parts = [
            (log.values - scipy_deflections(values, speed, log.times)) / NOISE
            for log, speed in zip(logs, SPEEDS, strict=True)
        ]
        return np.concatenate([part.ravel() for part in parts])

    begin = time.perf_counter()
    solution = least_squares(
        residuals,
        INITIAL_VALUES,
        x_scale=INITIAL_VALUES,
        diff_step=STEP,
        xtol=1e-9,
        ftol=1e-12,
        gtol=1e-12,
    )
    return solution.x, calls, time.perf_counter() - begin


def time_fits() -> dict[str, float]:
    """Wall times (s) of both and their ratios, and the largest relative difference of the optima.

    "largest_error" is the largest standard error of a parameter, relative.
    """
    logs = make_logs()
    begin = time.perf_counter()
    dataset = make_dataset(initial_case(), logs)
    numbers = free_parameters(dataset.cases, dict.fromkeys(TRUTH), 1.0)
    search = LeastSquares(dataset, numbers)
    solution = search.solve(dataset.measured)
    first = time.perf_counter() - begin
    begin = time.perf_counter()
    solution = search.solve(dataset.measured)
    again = time.perf_counter() - begin
    values, calls, seconds = fit_by_scipy(logs)
    # A fit estimates the noise; here it is given, for the same weights as scipy.
    noise = np.full(solution.noise.shape, NOISE)
    weighting = (
        search.step_scale(solution.unbounded, noise),
        search.weights(noise),
        dataset.measured,
    )
    point, _ = search.minimise(solution.unbounded, *weighting, np.ones(len(numbers), bool))
    by_jaxbeam = search.values_at(point)
    return {
        "first_fit_s": first,
        "fit_s": again,
        "scipy_s": seconds,
        "scipy_evaluations": calls,
        "ratio": seconds / again,
        "ratio_first": seconds / first,
        "difference": float(np.max(np.abs(by_jaxbeam / values - 1))),
        "largest_error": float(np.max(solution.uncertainty.errors / np.abs(solution.values))),
    }


def main() -> None:
    """Print the comparison."""
    results = time_fits()
    print(f"jaxbeam, compiled:              {results['fit_s']:8.2f} s")
    print(f"jaxbeam, compiling included:    {results['first_fit_s']:8.2f} s")
    print(f"scipy, differences and DOP853:  {results['scipy_s']:8.2f} s, "
          f"{results['scipy_evaluations']:.0f} evaluations of ten logs")  # fmt: skip
    print(f"ratios: {results['ratio']:.0f}, with compiling {results['ratio_first']:.1f}")
    print(f"largest relative difference of the optima {results['difference']:.1e}, "
          f"of standard errors up to {results['largest_error']:.1e}")  # fmt: skip


if __name__ == "__main__":
    main()
