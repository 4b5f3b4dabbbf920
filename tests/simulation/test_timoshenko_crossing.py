"""Deflection of a Timoshenko beam under a moving force, against its series with both spectra."""

import numpy as np
import pytest

import jaxbeam as jb

LENGTH, RIGIDITY, MASS, FORCE, SPEED = 20.0, 6e9, 1e4, 2e5, 30.0
X, TIMES = np.array([0.5, 4.0, 7.3, 10.0]), np.linspace(0.0, LENGTH / SPEED, 41)


def series(shear_stiffness: float, rotary_inertia: float, terms: int = 6000) -> np.ndarray:
    """Deflection (time, position): for each sin(k x) two modes of m, r with the stiffness

    [[G k^2, -G k], [-G k, E I k^2 + G]] of (w, phi) = (W sin k x, P cos k x), G being k G A.
    """
    k = np.arange(1, terms + 1) * np.pi / LENGTH
    stiffness = np.zeros((terms, 2, 2))
    stiffness[:, 0, 0], stiffness[:, 1, 1] = shear_stiffness * k**2, RIGIDITY * k**2
    stiffness[:, 1, 1] += shear_stiffness
    stiffness[:, 0, 1] = stiffness[:, 1, 0] = -shear_stiffness * k
    scale = np.diag([MASS**-0.5, rotary_inertia**-0.5])
    squares, shapes = np.linalg.eigh(scale @ stiffness @ scale)
    drive, total = SPEED * k, 0.0
    for spectrum in (0, 1):
        own = np.sqrt(squares[:, spectrum])
        modal = -2 * FORCE / LENGTH * (shapes[:, 0, spectrum] ** 2 / MASS) / (own**2 - drive**2)
        angles = TIMES[:, None] * drive, TIMES[:, None] * own
        total = total + modal * (np.sin(angles[0]) - drive / own * np.sin(angles[1]))
    return total @ np.sin(k[:, None] * X)


@pytest.mark.parametrize(
    "shear_stiffness, rotary_inertia", [(5e8, 1e4), (5e9, 1e2), (1e12, 1e4)], ids=str
)
def test_correction_is_nearer_than_the_modes(shear_stiffness, rotary_inertia):
    """With 20 modes by four times at least, at every position; with 40 modes nearer still."""
    exact, errors = series(shear_stiffness, rotary_inertia), {}
    for modes in (20, 40):
        properties = {"shear_stiffness": shear_stiffness, "rotary_inertia": rotary_inertia}
        beam = jb.Beam(LENGTH, RIGIDITY, MASS, modes=modes, **properties)
        loads = [jb.MovingForce(force=FORCE, speed=SPEED)]
        record = jb.simulate(jb.Case(beam, loads=loads, run=jb.Run(LENGTH / SPEED)), TIMES)
        for name, found in (
            ("modes", record.at(X)),
            ("corrected", jb.corrected_deflection(record, X)),
        ):
            errors[name, modes] = (
                np.abs(np.asarray(found) - exact).max(axis=0) / np.abs(exact).max()
            )
    for modes in (20, 40):
        assert np.all(4 * errors["corrected", modes] < errors["modes", modes])
    assert np.max(errors["corrected", 40]) < 0.7 * np.max(errors["corrected", 20])
