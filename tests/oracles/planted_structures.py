"""Random structures by finite elements, and their responses to several kinds of excitation.

Two parallel beams (girders) of Hermite elements, joined at their nodes by weak springs, on elastic
supports: modes come in pairs, the closer the weaker the springs. Damping ratios are drawn mode by
mode. Responses are sums of modes, each an exact recursion of its pole at `FINER` times the rate of
the log, so that poles are exact whatever the excitation. SI units.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh
from scipy.signal import lfilter

FINER = 4
RED = 0.95  # of coloured noise, from sample to sample
WEAK = 0.1  # random forces beside those of a shaker
ELEMENTS = 16


class Structure(NamedTuple):
    """Frequencies (Hz), damping ratios, shapes at the channels and at the exciters."""

    frequencies: np.ndarray
    damping_ratios: np.ndarray
    shapes: np.ndarray  # mode, channel
    inputs: np.ndarray  # mode, exciter

    @property
    def poles(self) -> np.ndarray:
        omega = 2 * np.pi * self.frequencies
        return omega * (-self.damping_ratios + 1j * np.sqrt(1 - self.damping_ratios**2))


def beam_matrices(length, rigidity, mass, elements=ELEMENTS):
    """Consistent mass and stiffness matrices of a free beam: deflection and slope of each node."""
    size = length / elements
    k = rigidity / size**3 * np.array(
        [[12, 6 * size, -12, 6 * size], [6 * size, 4 * size**2, -6 * size, 2 * size**2],
         [-12, -6 * size, 12, -6 * size], [6 * size, 2 * size**2, -6 * size, 4 * size**2]]
    )  # fmt: skip
    m = mass * size / 420 * np.array(
        [[156, 22 * size, 54, -13 * size], [22 * size, 4 * size**2, 13 * size, -3 * size**2],
         [54, 13 * size, 156, -22 * size], [-13 * size, -3 * size**2, -22 * size, 4 * size**2]]
    )  # fmt: skip
    dofs = 2 * (elements + 1)
    stiffness, masses = np.zeros((dofs, dofs)), np.zeros((dofs, dofs))
    for i in range(elements):
        rows = slice(2 * i, 2 * i + 4)
        stiffness[rows, rows] += k
        masses[rows, rows] += m
    return masses, stiffness


def random_structure(seed: int) -> Structure:
    """3 to 8 modes, pairs down to 1 % apart, damping 0.2 to 5 %, 1 to 8 channels."""
    random = np.random.default_rng(seed)
    modes, channels = int(random.integers(3, 9)), int(random.integers(1, 9))
    length, mass = 20.0, 400.0
    first = random.uniform(2.0, 5.0)  # Hz, of a pinned beam
    rigidity = mass * (2 * np.pi * first * length**2 / np.pi**2) ** 2
    m1, k1 = beam_matrices(length, rigidity, mass)
    m2, k2 = beam_matrices(length, rigidity * random.uniform(1.02, 1.1), mass)
    dofs = len(m1)
    masses, stiffness = np.zeros((2 * dofs, 2 * dofs)), np.zeros((2 * dofs, 2 * dofs))
    for part, (m, k) in enumerate(((m1, k1), (m2, k2))):
        rows = slice(part * dofs, (part + 1) * dofs)
        masses[rows, rows], stiffness[rows, rows] = m, k
    support = rigidity / length**3 * random.uniform(200, 5000, 4)
    for node, value in zip((0, dofs - 2, dofs, 2 * dofs - 2), support, strict=True):
        stiffness[node, node] += value
    link = rigidity / length**3 * random.uniform(0.05, 1.0)
    for node in range(0, dofs, 2):
        both = np.ix_((node, dofs + node), (node, dofs + node))
        stiffness[both] += link * np.array([[1, -1], [-1, 1]])
    squares, vectors = eigh(stiffness, masses, subset_by_index=[0, modes - 1])
    places = random.choice(
        np.r_[2 : dofs - 2 : 2, dofs + 2 : 2 * dofs - 2 : 2], channels, replace=False
    )
    exciters = random.choice(np.r_[2 : dofs - 2 : 2, dofs + 2 : 2 * dofs - 2 : 2], 4, replace=False)
    damping = np.exp(random.uniform(np.log(0.002), np.log(0.05), modes))
    frequencies = np.sqrt(squares) / (2 * np.pi)
    return Structure(frequencies, damping, vectors[places].T, vectors[exciters].T)


def response(structure: Structure, forces, rate: float):
    """Velocities (time, channel) for forces (time, exciter), impulse-invariant, both at `rate`."""
    found = 0.0
    for pole, shape, inputs in zip(
        structure.poles, structure.shapes, structure.inputs, strict=True
    ):
        root = np.exp(pole / rate)
        # Velocity of an oscillator after a unit impulse: Re(pole exp(pole t)) / Im(pole) ...
        residue = -1j * pole / pole.imag
        kernel_b = [residue.real, -(residue * np.conj(root)).real]
        kernel_a = [1.0, -2 * root.real, abs(root) ** 2]
        found = found + np.multiply.outer(lfilter(kernel_b, kernel_a, forces @ inputs), shape)
    return found


def coloured_noise(random, shape):
    """Noise of unit rms whose spectrum falls with frequency, beside white noise."""
    white = random.normal(size=shape)
    red = lfilter([1.0], [1.0, -RED], random.normal(size=shape), axis=0)
    return (white / white.std() + red / red.std()) / np.sqrt(2)


class Planted(NamedTuple):
    """Samples of a log with what was planted in it; `noise` is the rms of the coloured noise.

    `parts` are the responses of the modes, `decays` the samples (start, stop) without any force.
    """

    structure: Structure
    values: np.ndarray
    rate: float
    energies: np.ndarray  # share of each mode in the variance of the response (after a crossing)
    lines: tuple[float, ...] = ()
    noise: float = 0.0
    parts: np.ndarray | None = None  # mode, sample, channel
    decays: tuple[tuple[int, int], ...] = ()


def noise_spectrum(angles):
    """Spectral density (variance times sampling step) of coloured noise of unit rms; angles w h."""
    red = (1 - RED**2) / np.abs(1 - RED * np.exp(-1j * np.asarray(angles))) ** 2
    return (1 + red) / 2


def _finished(structure, clean, rate, random, lines=(), cycles=None):
    noise = random.uniform(0.05, 0.3) * clean.std()
    values = clean + noise * coloured_noise(random, clean.shape)
    times = np.arange(len(clean)) / rate
    for line in lines:
        size = clean.std() * random.uniform(0.3, 1.0)
        values = values + size * np.cos(2 * np.pi * line * times + 1.0)[:, None]
    drift = clean.std() * (random.uniform(0.5, 2) * times / times[-1])
    return values + 5 * clean.std() + drift[:, None], noise


def _shaken(forces, structure, random, fine):
    """Fill in a shaker's force with four harmonics and weak ambient forces; the harmonics (Hz)."""
    speed = structure.frequencies[0] * random.uniform(0.8, 1.2)
    turns = speed * np.arange(len(forces)) / fine
    forces[:] = WEAK * random.normal(size=forces.shape)
    for harmonic, size in ((1, 1.0), (2, 0.4), (3, 0.3), (4, 0.1)):
        forces[:, 0] += size * np.cos(2 * np.pi * harmonic * turns + harmonic)
    return tuple(speed * harmonic for harmonic in (1, 2, 3, 4))


def sampled(structure: Structure, kind: str, seed: int, duration: float) -> Planted:
    """A log of a structure; `kind` is ambient, motor (with harmonics), impacts, decay, shaken or
    crossing (a rough load over the exciters in the first half of the log)."""
    random = np.random.default_rng(1000 + seed)
    rate = 2.56 * structure.frequencies[-1] * random.uniform(1.2, 2.5)
    fine = FINER * rate
    count = int(duration * fine)
    forces = np.zeros((count, structure.inputs.shape[1]))
    lines: tuple[float, ...] = ()
    if kind in ("ambient", "motor"):
        forces[:] = random.normal(size=forces.shape)
    elif kind == "impacts":
        period = min(duration / 4, 12 / (structure.damping_ratios * structure.frequencies).min())
        starts = np.arange(0.05 * duration, duration - 0.5 * period, period)
        for start in starts:
            forces[int(start * fine), random.integers(4)] = fine
    elif kind == "shaken":
        lines = _shaken(forces, structure, random, fine)
    elif kind == "crossing":
        half = count // 2
        places = np.linspace(-0.5, 3.5, half)
        shares = np.maximum(1 - np.abs(np.subtract.outer(places, np.arange(4))), 0)
        forces[:half] = shares * (10 + random.normal(size=(half, 1)))
    else:
        forces[0] = random.normal(size=4) * fine
    if kind == "motor":
        speed = random.uniform(0.3, 0.9) * structure.frequencies[-1]
        gaps = np.abs(np.multiply.outer([1, 2], [speed]) / structure.frequencies - 1).min()
        lines = (speed, 2 * speed) if gaps > 0.03 and 2 * speed < 0.45 * rate else (speed,)
    parts = []
    for k in range(structure.frequencies.size):
        one = Structure(*(field[k : k + 1] for field in structure))
        parts.append(response(one, forces, fine)[::FINER])
    parts = np.stack(parts)
    clean = parts.sum(axis=0)
    free = slice(len(clean) // 2 + 1, None) if kind == "crossing" else slice(None)
    energies = np.mean(parts[:, free].var(axis=1) / clean[free].var(axis=0), axis=1)
    values, noise = _finished(structure, clean, rate, random, lines)
    # From the sample after the last force on, to the sample before the next.
    acting = np.flatnonzero(np.any(forces, axis=1))
    ends = np.append(acting, len(forces))
    decays = tuple(
        (int(start) // FINER + 1, int(stop) // FINER)
        for start, stop in zip(ends, ends[1:], strict=False)
        if stop - start > rate * FINER
    )
    return Planted(structure, values, rate, energies, lines, noise, parts, decays)
