"""Tables of numbers at many samples, computed block by block: whole tables would need more room."""

from collections.abc import Callable
from typing import Any

import jax

from jaxbeam.runtime.arrays import xp

BLOCK = 256  # samples, of which the intermediate results fit into a cache


def in_blocks(function: Callable[[int, int], Any], count: int) -> Any:
    """Arrays that a function of a first sample and a number of samples returns, for `count` ones.

    Their first axis is that of the samples.
    """
    starts = range(0, count, BLOCK)
    parts = [function(first, min(BLOCK, count - first)) for first in starts]
    return jax.tree.map(lambda *blocks: xp.concatenate(blocks), *parts)
