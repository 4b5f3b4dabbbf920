"""Timoshenko beam under a moving force, against its series with both spectra."""

import numpy as np
import pytest

import jaxbeam as jb

LENGTH, RIGIDITY, MASS, FORCE, SPEED = 20.0, 6e9, 1e4, 2e5, 30.0
X, TIMES = np.array([0.5, 4.0, 7.3, 10.0]), np.linspace(0.0, LENGTH / SPEED, 41)


def series(shear_stiffness: float, rotary_inertia: float, terms: int = 6000) -> list[np.ndarray]:
    """Deflection, rotation, curvature and V / E I (time, position), V = -G (w' - phi).

    For each sin(k x) two modes of m, r with the stiffness

    [[G k^2, -G k], [-G k, E I k^2 + G]] of (w, phi) = (W sin k x, P cos k x), G being k G A.
    """
    k = np.arange(1, terms + 1) * np.pi / LENGTH
    stiffness = np.zeros((terms, 2, 2))
    stiffness[:, 0, 0], stiffness[:, 1, 1] = shear_stiffness * k**2, RIGIDITY * k**2
    stiffness[:, 1, 1] += shear_stiffness
    stiffness[:, 0, 1] = stiffness[:, 1, 0] = -shear_stiffness * k
    scale = np.diag([MASS**-0.5, rotary_inertia**-0.5])
    squares, shapes = np.linalg.eigh(scale @ stiffness @ scale)
    drive, w, phi = SPEED * k, 0.0, 0.0
    for spectrum in (0, 1):
        own = np.sqrt(squares[:, spectrum])
        shape = shapes[:, :, spectrum] * [MASS**-0.5, rotary_inertia**-0.5]
        modal = -2 * FORCE / LENGTH * shape[:, 0] / (own**2 - drive**2)
        angles = TIMES[:, None] * drive, TIMES[:, None] * own
        motion = modal * (np.sin(angles[0]) - drive / own * np.sin(angles[1]))
        w, phi = w + shape[:, 0] * motion, phi + shape[:, 1] * motion
    sines, cosines = np.sin(k[:, None] * X), np.cos(k[:, None] * X)
    shear = shear_stiffness * (phi - k * w) @ cosines
    return [w @ sines, phi @ cosines, -(k * phi) @ sines, shear / RIGIDITY]


@pytest.mark.parametrize(
    "shear_stiffness, rotary_inertia", [(5e8, 1e4), (5e9, 1e2), (1e12, 1e4)], ids=str
)
def test_correction_is_nearer_than_the_modes(shear_stiffness, rotary_inertia):
    """Of all fields; of the deflection by four times at every position with 20 modes or more.

    Shear forces jump at the force, so that they are compared a metre away from it.
    """
    fields, errors = series(shear_stiffness, rotary_inertia), {}
    away = np.abs(SPEED * TIMES[:, None] - X) > 1.0
    for modes in (5, 10, 20, 40):
        properties = {"shear_stiffness": shear_stiffness, "rotary_inertia": rotary_inertia}
        beam = jb.Beam(LENGTH, RIGIDITY, MASS, modes=modes, **properties)
        loads = [jb.MovingForce(force=FORCE, speed=SPEED)]
        record = jb.simulate(jb.Case(beam, loads=loads, run=jb.Run(LENGTH / SPEED)), TIMES)
        for order, exact in enumerate(fields):
            raw = np.asarray(record.coordinates) @ np.asarray(record.modes.fields(X, (order,))[0]).T
            found = raw, np.asarray(jb.sections.corrected_deflection(record, X, order))
            errors[modes, order] = [
                np.max(np.abs(one - exact) * (away if order == 3 else 1.0), axis=0)
                / np.abs(exact).max()
                for one in found
            ]
            of_modes, corrected = errors[modes, order]
            assert np.max(corrected) < np.max(of_modes), (modes, order)
    for modes in (20, 40):
        of_modes, corrected = errors[modes, 0]
        assert np.all(4 * corrected < of_modes)
    assert np.max(errors[40, 0][1]) < 0.7 * np.max(errors[20, 0][1])
