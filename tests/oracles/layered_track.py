"""Beam under a track of layers by finite elements, with all of its damping, under moving loads.

Rail, sleepers and beam are Hermite cubics on equal elements, pads and ballast even along them; the
sleepers may jump at the ends of the beam. An oscillator's spring, or a force, moves over the rail.
Newmark's rule of average acceleration, whose matrix changes with the place of the spring by a
matrix of rank one.
"""

import dataclasses

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, csr_matrix, diags
from scipy.sparse.linalg import splu

from tests.oracles.finite_elements import hermite

POINTS, WEIGHTS = np.polynomial.legendre.leggauss(4)


def cubics(s, h, order=0):
    """Functions of an element at shares s of its length h, or their derivatives."""
    return hermite(s * h, h, order).T


@dataclasses.dataclass(frozen=True)
class TrackOnBeam:
    """A beam of `length` (m), pinned or on two springs `bearings` (N/m), and its track.

    The track is on it and on the ground beside it.
    `beam` and `rail` are bending stiffness and mass per length, `sleepers` mass, `pads` and
    `ballast` stiffness and damping, all per length; `ratio` is the damping ratio of the beam alone
    in its first two modes (Rayleigh).
    """

    length: float
    approach: float
    beam: tuple[float, float]
    rail: tuple[float, float]
    sleepers: float
    pads: tuple[float, float]
    ballast: tuple[float, float]
    ratio: float
    size: float  # of an element (m)
    bearings: float | None = None

    def matrices(self):
        """Mass, damping and stiffness of rail, sleepers and beam; rows at a place of each."""
        h = self.size
        total = round((self.length + 2 * self.approach) / h)
        before, own = round(self.approach / h), round(self.length / h)
        s, w = (POINTS + 1) / 2, WEIGHTS * h / 2
        unit = (w[:, None] * cubics(s, h)).T @ cubics(s, h)
        bend = (w[:, None] * cubics(s, h, 2)).T @ cubics(s, h, 2)

        number, size = np.arange(total), 2 * total + 2
        rail = 2 * number[:, None] + np.arange(4)
        piece = (number >= before) * 2 + (number >= before + own) * 2
        sleepers = size + rail + piece[:, None]
        first = 2 * size + 4  # unknown of the beam
        beam, above = first + rail[:own], sleepers[before : before + own]
        ground = np.delete(sleepers, np.s_[before : before + own], axis=0)
        unknowns = first + 2 * own + 2

        def put(element, index):
            rows, columns = np.repeat(index, index.shape[1], 1), np.tile(index, index.shape[1])
            values = np.tile(element.ravel(), len(index))
            places = rows.ravel(), columns.ravel()
            return csr_matrix(coo_matrix((values, places), (unknowns, unknowns)))

        stretch = np.kron([[1, -1], [-1, 1]], unit)
        of_pads = put(stretch, np.hstack([rail, sleepers]))
        of_ballast = put(stretch, np.hstack([above, beam])) + put(unit, ground)
        springs = [
            p * of_pads + b * of_ballast for p, b in zip(self.pads, self.ballast, strict=True)
        ]
        rigidity, density = self.beam
        lowest = np.pi**2 / self.length**2 * np.sqrt(rigidity / density)
        alpha, beta = 2 * self.ratio * lowest * 4 / 5, 2 * self.ratio / (5 * lowest)
        bent, heavy = rigidity * put(bend, beam), density * put(unit, beam)
        stiffness = springs[0] + self.rail[0] * put(bend, rail) + bent
        mass = self.rail[1] * put(unit, rail) + self.sleepers * put(unit, sleepers) + heavy
        damping = springs[1] + alpha * heavy + beta * bent
        ends = [first, unknowns - 2]
        if self.bearings is not None:
            at_ends = np.isin(np.arange(unknowns), ends)
            stiffness = stiffness + diags(self.bearings * at_ends)
            ends = []
        held = [0, 2 * total, size, 2 * size + 2, *ends]
        free = np.setdiff1d(np.arange(unknowns), held)
        parts = [csc_matrix(each)[free][:, free] for each in (mass, damping, stiffness)]

        def row(x, part):
            """Row of the deflection of the rail (0) or beam (2) at x (m) on the beam."""
            start, x = (0, x + self.approach) if part == 0 else (first, x)
            count = total if part == 0 else own
            element = min(int(x / h), count - 1)
            found = np.zeros(unknowns)
            found[start + 2 * element + np.arange(4)] = cubics(x / h - element, h)
            return found[free]

        return parts, row

    def run(self, force, speed, step, end, body=None, at=None):
        """Deflections and accelerations of the beam at `at` (m) and forces on the rail over time.

        `force` (N) presses at once from the left end of the rail on; a `body` is the mass, spring
        and damper of an oscillator of that weight, without mass below its spring.
        """
        (mass, damping, stiffness), row = self.matrices()
        count, extra = mass.shape[0], 0 if body is None else 1
        m, k, c = (0.0, 0.0, 0.0) if body is None else body
        gamma, beta = 0.5, 0.25
        matrix = mass / (beta * step**2) + gamma / (beta * step) * damping + stiffness
        solve = splu(csc_matrix(matrix)).solve
        u, v, a = (np.zeros(count + extra) for _ in range(3))
        place, times = row(at, 2), np.arange(1, round(end / step) + 1) * step
        deflections, accelerations, forces = [], [], []
        for t in times:
            x = speed * t - self.approach
            on = -self.approach < x < self.length + self.approach
            N = row(x, 0) if on else np.zeros(count)
            near = row(x + 1e-6, 0) if on else N
            slope = (near - N) / 1e-6 * speed
            predicted = u + step * v + step**2 * (0.5 - beta) * a
            rate = v + step * (1 - gamma) * a
            # M a + C v + K u = f with u = predicted + beta h^2 a, v = rate + gamma h a.
            own = slice(0, count)
            right = -(damping @ rate[own]) - stiffness @ predicted[own]
            # In terms of the acceleration: matrix * beta h^2.
            if body is None:
                new = solve(right - force * N) / (beta * step**2)
                pressing = force
            else:
                # s = k (N u - z) + c (N v + slope u - z'), on the rail -weight - s, on the body s.
                h1, h2 = gamma * step, beta * step**2
                free = solve(right - force * N) / h2
                flexible = solve(N) / h2
                s0 = k * (N @ predicted[own] - predicted[-1]) + c * (
                    N @ rate[own] + slope @ predicted[own] - rate[-1]
                )
                on_beam = (k * h2 + c * h1) * N + c * h2 * slope
                on_body = -(k * h2 + c * h1)
                # s = s0 + on_beam @ a_beam + on_body * s / m; a_beam = free - flexible * s
                s = (s0 + on_beam @ free) / (1 + on_beam @ flexible - on_body / m)
                new = np.append(free - flexible * s, s / m)
                pressing = force + s
            u, v, a = predicted + beta * step**2 * new, rate + gamma * step * new, new
            deflections.append(place @ u[own])
            accelerations.append(place @ a[own])
            forces.append(pressing)
        return times, np.array(deflections), np.array(accelerations), np.array(forces)
