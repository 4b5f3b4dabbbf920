"""Exported estimators: the C header and a file that is read estimate as in a simulation."""

import dataclasses
import subprocess

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.files.export import export_gains, read_gains, write_gains
from tests.files.test_export import COMPILER, ESTIMATED, WEIGHTS, shaker_case


@pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")
def test_c_header_gives_the_same_estimate(tmp_path):
    write_gains(ESTIMATED, tmp_path / "gains.h")
    (tmp_path / "run.c").write_text(
        '#include <stdio.h>\n#include "gains.h"\nint main(void) {\n'
        "double x[] = {1.0, 1.0/2, 1.0/3, 1.0/4, 1.0/5}, u[] = {1.0, 1.0/2};\n"
        "double y[] = {1.0, 1.0/2, 1.0/3}; int i; jaxbeam_estimate(x, u, u, y);\n"
        'for (i = 0; i < JAXBEAM_ESTIMATED; i++) printf("%a\\n", x[i]); return 0; }\n'
    )
    build = [COMPILER, "-std=c99", "-O2", "-ffp-contract=off", "-o", "run", "run.c"]
    subprocess.run(build, cwd=tmp_path, check=True)
    printed = subprocess.run(
        [tmp_path / "run"], capture_output=True, text=True, check=True
    ).stdout.split()
    assert_array_equal([float.fromhex(word) for word in printed], ESTIMATED.test_estimate)
    A, B, late, L = np.split(ESTIMATED.estimator[:5], [5, 7, 9], axis=1)
    C, _, D, offset = np.split(ESTIMATED.estimator[5:], [5, 7, 9], axis=1)
    x, u, y = (1 / np.arange(1.0, n + 1) for n in (5, 2, 3))
    prior = A @ x + (B + late) @ u
    expected = prior + L @ (y - C @ prior - D @ u - offset[:, 0])
    assert_allclose(ESTIMATED.test_estimate, expected, rtol=1e-12)


@pytest.mark.parametrize("estimator", [jb.Kalman(0.02, 1e-5), jb.Observer(speed=2.0)])
def test_exported_estimator_gives_the_commands_of_a_simulation(estimator, tmp_path):
    """From the readings of a run alone, with a digital filter and a delay in the loop."""
    law = jb.LQR(**WEIGHTS, delay=1e-3, estimator=estimator)
    case = shaker_case(law)
    if isinstance(estimator, jb.Kalman):
        delayed = dataclasses.replace(case.sensors[0], delay=jnp.asarray(1e-3))
        case = dataclasses.replace(case, sensors=(delayed, case.sensors[1]))
    write_gains(export_gains(case), tmp_path / "gains.csv")
    gains = read_gains(tmp_path / "gains.csv")
    times = 2e-3 * jnp.arange(60)
    record = jb.simulate(case, times)
    # A command begins half a period after its sample, so it acts at the next sample.
    commands, state = [np.zeros(1), np.zeros(1)], np.zeros(gains.estimator_size)
    for reading in np.asarray(record.measured):
        state = gains.estimate(state, commands[-2], commands[-1], reading)
        commands.append(gains.command(state[: len(gains.columns)]))
    found = np.array(commands[1:-1])[:, 0]
    size = np.max(np.abs(record.command))
    assert size > 0
    assert_allclose(found, record.command[:, 0], rtol=0, atol=1e-9 * size)
