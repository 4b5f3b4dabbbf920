"""Moreau's time steps of rigid wheels on a simply supported beam, without events.

Sine modes of unit modal mass; rigid ground beside the beam. Velocities take midpoint steps, in
which impulses of all wheels without a gap at half a step are those after which none of them enters
the surface: u + D p >= 0, p >= 0, one of both zero for each wheel. No wheel is ever said to press
or to fly, so impacts that follow each other ever faster need no care. The error is of first order.
Moreau, J. J. (1988), Unilateral contact and dry friction in finite freedom dynamics.
"""

import itertools

import numpy as np


def moreau_steps(frequencies, damping_ratio, masses, weights, speeds, starts, end, step, every):
    """Coordinates of the modes (time, mode) after each `every` steps, from rest at time zero.

    The beam has unit length and mass; wheel i is at starts[i] + speeds[i] t.
    """
    masses, weights, speeds = map(np.asarray, (masses, weights, speeds))
    k = np.pi * np.arange(1, len(frequencies) + 1)
    stiffness, damping = frequencies**2, 2 * damping_ratio * frequencies
    softened = 1 + step * damping / 2 + step**2 * stiffness / 4
    q, rate = np.zeros((2, k.size))
    height, fall = np.zeros((2, masses.size))
    found = [q]
    for n in range(round(end / step)):
        x = starts + speeds * (n + 0.5) * step
        on = ((x > 0) & (x < 1))[:, None] * np.sqrt(2.0)
        shape, slope = np.sin(x[:, None] * k) * on, k * np.cos(x[:, None] * k) * on
        half = q + step / 2 * rate
        near = np.flatnonzero(height + step / 2 * fall - shape @ half <= 0)
        # Velocities at the end of the step without contact, and per impulse.
        free = ((2 - softened) * rate - step * stiffness * q) / softened
        falling = fall - step * weights / masses
        u = (falling - shape @ free - speeds * (slope @ half))[near]
        mobility = np.diag(1 / masses)[np.ix_(near, near)] + shape[near] / softened @ shape[near].T
        p = np.zeros(masses.size)
        p[near] = complementary(mobility, u)
        new, fall_new = free - shape.T @ p / softened, falling + p / masses
        q, height = q + step / 2 * (rate + new), height + step / 2 * (fall + fall_new)
        rate, fall = new, fall_new
        if (n + 1) % every == 0:
            found.append(q)
    return np.array(found)


def complementary(mobility, u):
    """Solution p of u + mobility p >= 0, p >= 0, one of both zero, by trying all sets."""
    for size in range(u.size + 1):
        for part in map(list, itertools.combinations(range(u.size), size)):
            p = np.zeros(u.size)
            p[part] = np.linalg.solve(mobility[np.ix_(part, part)], -u[part])
            if np.all(p >= 0) and np.all(
                u + mobility @ p >= -1e-12 * np.max(np.abs(u), initial=0.0)
            ):
                return p
    raise AssertionError("no impulses")
