"""First calls of transformed runs and of small sweeps: gradients, batches, closed loops, seeds.

    python -m experiments.benchmarks.engine [ROW ...]

Each row in a process of its own with an empty cache: processor seconds of the first call, those of
the second, and peak memory. A beam of five modes and a moving mass unless said.
"""

import os
import pathlib
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

import jaxbeam as jb
from experiments.benchmarks import trains
from experiments.benchmarks.common import one_span_case, parser
from jaxbeam.runtime import native_library
from jaxbeam.simulation.integrator import native_peaks

ROOT = pathlib.Path(__file__).parents[2]
MASS, RIGIDITY, SPEED = "loads.0.mass", "beam.flexural_rigidity", "loads.0.speed"
BEAM = jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.01, modes=5)
CASE = jb.Case(
    BEAM, sensors=[jb.Sensor(0.3)], loads=[jb.MovingMass(mass=0.3, speed=2.0)], run=jb.Run(0.5)
)
TWO_MODES = jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.01, modes=2)
FED_BACK = jb.Case(
    TWO_MODES,
    actuators=[jb.PointForce(0.3)],
    sensors=[jb.Sensor(0.3)],
    loads=[jb.MovingMass(mass=0.3, speed=2.0)],
    controller=jb.Feedback(gains=[200.0], period=2e-3),
    run=jb.Run(0.3, 500.0),
)
CONTINUOUS = jb.Case(
    TWO_MODES,
    actuators=[jb.PointForce(0.3)],
    sensors=[jb.Sensor(0.3)],
    loads=[
        jb.Oscillator(mass=0.3, stiffness=400.0, damping=0.5, speed=2.0),
        jb.QuarterCar(
            body_mass=0.2,
            axle_mass=0.05,
            suspension_stiffness=300.0,
            suspension_damping=0.5,
            tyre_stiffness=3e3,
            speed=1.5,
        ),
    ],
    profile=jb.profiles.TableProfile([0.0, 0.2, 0.4, 0.6], [0.0, 1e-4, -1e-4, 0.0]),
    controller=jb.Feedback(gains=[200.0]),
    run=jb.Run(0.5, 200.0),
)


def peak(values: dict, case: jb.Case = CASE):
    """Largest deflection for other numbers of a case."""
    return jb.simulate(jb.replace(case, values)).peak_deflection[0]


def _whole_case():
    numbers, rest = jax.tree.flatten(CASE)
    return jax.grad(lambda leaves: jb.simulate(rest.unflatten(leaves)).peak_deflection[0])(
        [jnp.asarray(number) for number in numbers]
    )


def _sweep(over: dict, case: jb.Case = CASE):
    return jb.sweep(case, over, progress=False).peak_deflection.values


def _crossings(histories: bool):
    """Peaks of 64 masses at 64 speeds at three sensors, or histories of 251 samples."""
    _build_c()
    over = {MASS: np.linspace(0.1, 1.0, 64), SPEED: np.linspace(0.3, 10.0, 64)}
    case = jb.replace(one_span_case(3), {"run.sample_rate": 100.0})
    runs = jb.sweep(case, over, histories=histories, progress=False)
    return (runs.deflection if histories else runs.peak_deflection).values


def _trains(count: int):
    """Peaks of deflection under the ten trains of `trains` at so many sensors."""
    case = trains.bridge()
    places = np.linspace(0.0, trains.LENGTH, count + 2)[1:-1]
    sensors = tuple(jb.Sensor(float(place)) for place in places)
    case = jb.Case(case.beam, sensors=sensors, loads=case.loads, run=case.run)
    return _sweep({"loads.0.train": trains.TRAINS, SPEED: np.linspace(40.0, 90.0, 101)}, case)


def _build_c() -> None:
    """Compile the C integrator, where there is a compiler."""
    if native_library.find_compiler() and not native_peaks.available():
        native_peaks.LIBRARY.build()


def _in_c(over: dict, case: jb.Case):
    """Peaks of a sweep, in C where there is a compiler."""
    _build_c()
    return _sweep(over, case)


def _on_rough_road(over: dict):
    """Sweep of the truck of five axles over its rough road."""
    return _in_c(over, jb.load_case(ROOT / "examples/road_bridge/case.toml"))


ROWS: dict[str, Callable] = {
    "grad by mass": lambda: jax.grad(lambda x: peak({MASS: x}))(0.3),
    "grad by E I": lambda: jax.grad(lambda x: peak({RIGIDITY: x}))(11.68),
    "jit by mass": lambda: jax.jit(lambda x: peak({MASS: x}))(0.3),
    "vmap over 100 masses": lambda: jax.vmap(lambda x: peak({MASS: x}))(np.linspace(0.1, 0.3, 100)),
    "hessian by mass and speed": lambda: jax.hessian(lambda x: peak({MASS: x[0], SPEED: x[1]}))(
        jnp.array([0.3, 2.0])
    ),
    "grad by a whole case": _whole_case,
    "grad through a sampled loop": lambda: jax.grad(
        lambda x: peak({"controller.gains.0": x}, FED_BACK)
    )(200.0),
    "sweep over 3 masses": lambda: _sweep({MASS: np.linspace(0.1, 0.3, 3)}),
    "sweep over 64 masses": lambda: _sweep({MASS: np.linspace(0.1, 0.3, 64)}),
    "sweep over 512 masses": lambda: _sweep({MASS: np.linspace(0.1, 0.3, 512)}),
    "sweep over 6 gains": lambda: _sweep(
        {"controller.gains.0": np.linspace(100.0, 300.0, 6)}, FED_BACK
    ),
    "sweep over 512 gains": lambda: _in_c(
        {"controller.gains.0": np.linspace(100.0, 300.0, 512)}, FED_BACK
    ),
    "4096 crossings": lambda: _crossings(False),
    "4096 histories": lambda: _crossings(True),
    "ten trains, 101 speeds, 1 sensor": lambda: _trains(1),
    "ten trains, 101 speeds, 41 sensors": lambda: _trains(41),
    "truck on a road, 16 speeds": lambda: _on_rough_road({SPEED: np.linspace(20.0, 30.0, 16)}),
    "truck on a road, 5 seeds, 5 speeds": lambda: _on_rough_road(
        {"profile.seed": range(5), SPEED: np.linspace(20.0, 30.0, 5)}
    ),
    "truck on a road, 100 seeds, 5 speeds": lambda: _on_rough_road(
        {"profile.seed": range(100), SPEED: np.linspace(20.0, 30.0, 5)}
    ),
    "a continuous loop under vehicles": lambda: jb.simulate(CONTINUOUS).peak_deflection,
}


def processor_seconds() -> float:
    """Processor time of this process and its children."""
    return sum(os.times()[:4])


def measure(row: str) -> None:
    """Print the figures of a row, whose first call is the first of this process."""
    jb.simulate, jb.replace  # noqa: B018  # imported before the first call
    seconds = []
    for _ in range(2):
        start = processor_seconds()
        jax.block_until_ready(ROWS[row]())
        seconds.append(processor_seconds() - start)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f"{row:34s} {seconds[0]:8.2f} {seconds[1]:8.2f} {memory:8.2f}", flush=True)


def main() -> None:
    """Print a table of the rows named, or of all."""
    options = parser(__doc__)
    options.add_argument("rows", nargs="*", metavar="ROW", help=", ".join(ROWS))
    options.add_argument("--one", default="", help="measure a row in this process")
    given = options.parse_args()
    if given.one:
        measure(given.one)
        return
    print(f"{'':34s} {'first, s':>8s} {'again, s':>8s} {'GB':>8s}", flush=True)
    for row in given.rows or ROWS:
        with tempfile.TemporaryDirectory() as folder:
            environment = os.environ | {"XDG_CACHE_HOME": folder}
            environment.pop("JAX_COMPILATION_CACHE_DIR", None)
            command = [sys.executable, "-m", "experiments.benchmarks.engine", "--one", row]
            subprocess.run(command, env=environment, check=True)


if __name__ == "__main__":
    main()
