"""Sweeps and derivatives: each public function is a case."""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxbeam as jb
from experiments.validation.same_results.arrays import (
    REPOSITORY,
    Arrays,
    named,
    of_command,
    of_sweep,
)
from experiments.validation.same_results.parts import (
    BEAM,
    CUBIC,
    MASS,
    MIDSPAN,
    PATCH,
    PATCH_BEAM,
    RUN,
    TWO_SPANS,
    read,
)


def sweep_of_peaks() -> Arrays:
    """Peaks of masses by speeds on two spans, open loop, in double and in single precision."""
    sensors = "[[sensors]]\nposition = 0.3\n[[sensors]]\nposition = 0.9\n"
    run = "[run]\nduration = 2.0\n"
    over = {"loads.0.mass": np.linspace(0.1, 1.0, 7), "loads.0.speed": np.linspace(0.7, 5.0, 6)}
    rig = read(TWO_SPANS, sensors, MASS, run)
    return named(
        double=of_sweep(rig, over),
        single=of_sweep(rig, over, precision="single", tolerance=1e-4),
    )


def sweep_of_histories() -> Arrays:
    """Histories of two loads on one span, at once or one after the other."""
    second = MASS.replace("0.05", "0.25").replace('"mass"', '"force"')
    over = {"loads.0.mass": [0.1, 0.5, 0.9], "loads.1.speed": [0.8, 1.5, 3.0, 6.0]}
    return of_sweep(read(BEAM, MIDSPAN, MASS, second, RUN), over, histories=True)


def sweep_of_closed_loops() -> Arrays:
    """Peaks under sampled cubic feedback, over masses and gains."""
    over = {"loads.0.mass": [0.2, 0.5, 0.8], "controller.gains.0": [1e9, 3e9, 1e10]}
    return of_sweep(read(PATCH_BEAM, PATCH, MIDSPAN, MASS, CUBIC, RUN), over)


def sweep_of_pairs() -> Arrays:
    """Runs listed one by one: other rigidities, support positions and entry times."""
    over = {
        "beam.flexural_rigidity": [10.0, 11.0, 12.0, 13.0, 14.0],
        "supports.0.position": [0.5, 0.55, 0.6, 0.65, 0.7],
        "loads.0.entry_time": [0.0, 0.1, 0.05, 0.2, 0.15],
    }
    run = "[run]\nduration = 1.5\n"
    return of_sweep(read(TWO_SPANS, MIDSPAN, MASS, run), over, paired=True)


def sweep_in_compiled_c() -> Arrays:
    """Peaks by the steps that `jaxbeam native` compiles; nothing where there is no C compiler."""
    if not any(map(shutil.which, ("cc", "gcc", "clang"))):
        return {}
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"XDG_CACHE_HOME": folder}
        command = [sys.executable, "-m", "jaxbeam", "native"]
        subprocess.run(command, check=True, capture_output=True, cwd=REPOSITORY, env=environment)
        over = ("--over", "loads.0.mass=0.1:1:6", "--over", "loads.0.speed=0.9:6:6")
        file = "".join((TWO_SPANS, MIDSPAN, MASS, "[run]\nduration = 2.0\n"))
        return of_command("sweep", *over, file=file, cache=Path(folder))


def derivatives() -> Arrays:
    """Derivatives of the largest deflection in reverse mode."""
    names = ["beam.flexural_rigidity", "beam.damping_ratio", "loads.0.mass", "loads.0.speed"]
    start = read(BEAM, MIDSPAN, MASS, "[run]\nduration = 0.6\nsample_rate = 100.0\n")
    values = jnp.array([float(jb.addresses(start)[name]) for name in names])

    def peak(values: jax.Array) -> jax.Array:
        varied = jb.replace(start, dict(zip(names, values, strict=True)))
        return jb.simulate(varied).peak_deflection[0]

    value, gradient = jax.value_and_grad(peak)(values)
    return {"peak": np.asarray(value), "gradient": np.asarray(gradient)}
