"""A finite-element Euler-Bernoulli beam: matrices, modes and static deflection.

Hermite cubic elements, consistent mass, every support, patch edge and suspension on a node.
SI units; deflection is positive upwards, positions run from the left end.

The beam with its supports and patches gives the modes. Suspensions (a shaker's spring, damper and
moving mass) act on these modes, coupled. Modal damping belongs to the modes without suspensions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh


@dataclass(frozen=True)
class Support:
    """A support: rigid in deflection unless it has a stiffness; may also resist rotation."""

    position: float
    stiffness: float | None = None  # N/m; None is rigid, 0.0 leaves the deflection free
    damping: float = 0.0  # N s/m
    rotational_stiffness: float = 0.0  # N m/rad


@dataclass(frozen=True)
class Patch:
    """Stiffness and mass bonded to the beam between two positions."""

    start: float
    end: float
    flexural_rigidity: float = 0.0  # N m^2, added
    mass_per_length: float = 0.0  # kg/m, added


@dataclass(frozen=True)
class Suspension:
    """A point spring, damper and mass between beam and ground: a passive shaker."""

    position: float
    stiffness: float = 0.0  # N/m
    damping: float = 0.0  # N s/m
    mass: float = 0.0  # kg


@dataclass(frozen=True)
class Beam:
    length: float
    flexural_rigidity: float | Callable[[float], float]  # or a function of x, constant per element
    mass_per_length: float | Callable[[float], float]
    ends: str = "pinned-pinned"  # pinned, clamped, free or guided, left-right
    supports: Sequence[Support] = ()
    patches: Sequence[Patch] = ()
    suspensions: Sequence[Suspension] = ()
    damping_ratio: float | Sequence[float] = 0.0  # one for all modes, or the first few modes' own
    rayleigh: tuple[float, float] = (0.0, 0.0)  # damping matrix = first * mass + second * stiffness
    elements: int = 40  # at least so many


@dataclass(frozen=True)
class Model:
    """The assembled beam: matrices over the two degrees of freedom (deflection, slope) per node."""

    beam: Beam
    nodes: np.ndarray
    mass: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray  # of the supports alone
    free: np.ndarray  # indices of the unconstrained degrees of freedom

    def shape(self, x: float, derivative: int = 0, element: int | None = None) -> np.ndarray:
        """The row that takes nodal values to the deflection at x, or to its x-derivative."""
        if element is None:
            element = int(np.clip(np.searchsorted(self.nodes, x) - 1, 0, len(self.nodes) - 2))
        row = np.zeros(2 * len(self.nodes))
        left, right = self.nodes[element], self.nodes[element + 1]
        row[2 * element : 2 * element + 4] = hermite(x - left, right - left, derivative)
        return row

    def patch_row(self, start: float, end: float) -> np.ndarray:
        """Nodal forces of a unit patch moment: it lifts the beam between its two ends."""
        return self.shape(start, 1) - self.shape(end, 1)

    def modes(self, count: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Angular frequencies (mode,) and mass-normalised shapes (degree of freedom, mode)."""
        at = np.ix_(self.free, self.free)
        squares, vectors = eigh(self.stiffness[at], self.mass[at])
        squares[squares < 1e-13 * squares[-1]] = 0.0  # rigid-body modes
        shapes = np.zeros((len(self.mass), len(squares)))
        shapes[self.free] = vectors
        return np.sqrt(squares[:count]), shapes[:, :count]


def hermite(s: float, h: float, derivative: int = 0) -> np.ndarray:
    """The four cubic shape functions of an element of length h at distance s from its left end."""
    z = s / h
    rows = (
        (
            1 - 3 * z**2 + 2 * z**3,
            h * (z - 2 * z**2 + z**3),
            3 * z**2 - 2 * z**3,
            h * (z**3 - z**2),
        ),
        (6 * z**2 - 6 * z, h * (1 - 4 * z + 3 * z**2), 6 * z - 6 * z**2, h * (3 * z**2 - 2 * z)),
        (12 * z - 6, h * (6 * z - 4), 6 - 12 * z, h * (6 * z - 2)),
        (12.0, 6 * h, -12.0, 6 * h),
    )
    return np.array(rows[derivative]) / h**derivative


def mesh(beam: Beam, extra: Sequence[float] = ()) -> np.ndarray:
    """Nodes from 0 to the length, one on every support, patch edge, suspension and extra point."""
    points = {0.0, beam.length, *extra, *(p for b in beam.patches for p in (b.start, b.end))}
    points |= {b.position for b in (*beam.supports, *beam.suspensions)}
    fixed = np.array(sorted(points))
    fixed = fixed[np.append(True, np.diff(fixed) > 1e-9 * beam.length)]
    counts = np.ceil(np.diff(fixed) * beam.elements / beam.length - 1e-9).astype(int)
    spans = zip(fixed[:-1], fixed[1:], counts, strict=True)
    return np.append(np.concatenate([np.linspace(a, b, n, endpoint=False) for a, b, n in spans]),
                     beam.length)  # fmt: skip


def section(beam: Beam, x: float) -> tuple[float, float]:
    """Flexural rigidity and mass per length at x, patches included."""
    over = [p for p in beam.patches if p.start < x < p.end]
    rigidity, density = (
        value(x) if callable(value) else value
        for value in (beam.flexural_rigidity, beam.mass_per_length)
    )
    return (
        rigidity + sum(p.flexural_rigidity for p in over),
        density + sum(p.mass_per_length for p in over),
    )


def supports_on(beam: Beam, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Springs and dampers on the degrees of freedom, and which of these are free to move."""
    size = 2 * len(nodes)
    springs, dampers, fixed = np.zeros(size), np.zeros(size), []
    for end, dof in zip(beam.ends.split("-"), (0, size - 2), strict=True):
        fixed += {"pinned": [dof], "clamped": [dof, dof + 1], "free": [], "guided": [dof + 1]}[end]
    for support in beam.supports:
        dof = 2 * int(np.argmin(np.abs(nodes - support.position)))
        if support.stiffness is None:
            fixed.append(dof)
        else:
            springs[dof] += support.stiffness
            dampers[dof] += support.damping
        springs[dof + 1] += support.rotational_stiffness
    return springs, dampers, np.setdiff1d(np.arange(size), fixed)


def assemble(beam: Beam, extra_nodes: Sequence[float] = ()) -> Model:
    nodes = mesh(beam, extra_nodes)
    springs, dampers, free = supports_on(beam, nodes)
    stiffness, mass = np.diag(springs), np.zeros((len(springs), len(springs)))
    for e, (left, right) in enumerate(zip(nodes[:-1], nodes[1:], strict=True)):
        h, at = right - left, slice(2 * e, 2 * e + 4)
        rigidity, density = section(beam, 0.5 * (left + right))
        stiffness[at, at] += rigidity / h**3 * np.array(
            [[12, 6 * h, -12, 6 * h],
             [6 * h, 4 * h**2, -6 * h, 2 * h**2],
             [-12, -6 * h, 12, -6 * h],
             [6 * h, 2 * h**2, -6 * h, 4 * h**2]])  # fmt: skip
        mass[at, at] += density * h / 420 * np.array(
            [[156, 22 * h, 54, -13 * h],
             [22 * h, 4 * h**2, 13 * h, -3 * h**2],
             [54, 13 * h, 156, -22 * h],
             [-13 * h, -3 * h**2, -22 * h, 4 * h**2]])  # fmt: skip
    return Model(beam, nodes, mass, stiffness, np.diag(dampers), free)


def natural_frequencies(beam: Beam, count: int) -> np.ndarray:
    """The first natural frequencies in Hz, without suspensions."""
    return assemble(beam).modes(count)[0] / (2.0 * np.pi)


def static_deflection(
    beam: Beam,
    positions: Sequence[float],
    forces: Sequence[tuple[float, float]] = (),
    moments: Sequence[tuple[float, float]] = (),
    patch_moments: Sequence[tuple[float, float, float]] = (),
) -> np.ndarray:
    """Deflection at `positions` under (position, upward force), (position, moment that turns the
    beam anticlockwise) and (start, end, patch moment); exact, suspensions included."""
    extra = [*positions, *(f[0] for f in forces), *(m[0] for m in moments)]
    model = assemble(beam, [*extra, *(x for p in patch_moments for x in p[:2])])
    stiffness = model.stiffness.copy()
    for s in beam.suspensions:
        stiffness += s.stiffness * np.outer(model.shape(s.position), model.shape(s.position))
    load = np.zeros(len(stiffness))
    for x, force in forces:
        load += force * model.shape(x)
    for x, moment in moments:
        load += moment * model.shape(x, 1)
    for start, end, moment in patch_moments:
        load += moment * model.patch_row(start, end)
    at = model.free
    deflection = np.zeros(len(load))
    deflection[at] = np.linalg.solve(stiffness[np.ix_(at, at)], load[at])
    return np.array([model.shape(x) @ deflection for x in positions])
