"""Uniform and standard normal samples: those of `jax.random`, computed without compiling.

The generator is Threefry 2x32 (Salmon et al., SC11, 2011): a hash of a key and a counter, so that
a sample depends on nothing but its key and its index.
"""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, UInt32

ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))  # bits, of four rounds each, in turn
ROUNDS_OF_FOUR = 5
KEY_PARITY = np.uint32(0x1BD11BDA)


def normal_samples(seed: int, stream: int, count: int) -> Float[np.ndarray, " sample"]:
    """Standard normal samples of a numbered stream; streams of one seed are independent.

    They equal `jax.random.normal(jax.random.fold_in(jax.random.key(seed), stream))` to rounding.
    """
    from scipy.special import erfinv  # 0.1 s, and most cases have no noise

    uniform, lowest = uniform_samples(seed, (stream,), count), np.nextafter(-1.0, 0.0)
    return np.sqrt(2) * erfinv(np.maximum(lowest, uniform * (1 - lowest) + lowest))


def uniform_samples(seed: int, streams: Iterable[int], count: int) -> Float[np.ndarray, " sample"]:
    """Uniform samples from 0 to below 1 of a stream, named by the numbers of nested `streams`.

    They equal those of `jax.random.uniform`, whose key is folded with each of the numbers.
    """
    key = _words(np.array([seed]))
    for stream in streams:
        key = _hash(key, _words(np.array([stream])))
    high, low = _hash(key, _words(np.arange(count)))
    bits = (high.astype(np.uint64) << np.uint64(32)) | low
    # The upper 52 bits as the fraction of a number from 1 to 2.
    return ((bits >> np.uint64(12)) | np.uint64(0x3FF0000000000000)).view(float) - 1


def _words(numbers: np.ndarray) -> UInt32[np.ndarray, "2 number"]:
    """Upper and lower 32 bits of whole numbers."""
    numbers = numbers.astype(np.uint64)
    return np.stack([numbers >> np.uint64(32), numbers & np.uint64(0xFFFFFFFF)]).astype(np.uint32)


def _hash(
    key: UInt32[np.ndarray, "2 1"], counter: UInt32[np.ndarray, "2 number"]
) -> UInt32[np.ndarray, "2 number"]:
    """Hash of counters under a key by Threefry 2x32 with 20 rounds."""
    keys = np.stack([*key, key[0] ^ key[1] ^ KEY_PARITY])
    first, second = counter + key
    for i in range(ROUNDS_OF_FOUR):
        for rotation in ROTATIONS[i % 2]:
            first = first + second
            rotated = (second << np.uint32(rotation)) | (second >> np.uint32(32 - rotation))
            second = first ^ rotated
        first = first + keys[(i + 1) % 3]
        second = second + keys[(i + 2) % 3] + np.uint32(i + 1)
    return np.stack([first, second])
