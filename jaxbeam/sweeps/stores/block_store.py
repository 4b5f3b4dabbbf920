"""Interface of the stores of finished blocks, and the store in memory."""

from __future__ import annotations

import abc
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX


class BlockStore(abc.ABC):
    """Store of finished blocks, in memory or on disk."""

    @abc.abstractmethod
    def missing(self) -> list[int]:
        """Numbers of the blocks that are not stored."""

    @abc.abstractmethod
    def write(self, block: int, results: dict[str, np.ndarray]) -> None:
        """Store the results of a block by name; their shapes are the same for all blocks."""

    @abc.abstractmethod
    def collect(self) -> dict[str, np.ndarray]:
        """Results of all blocks by name, concatenated along the first axis."""

    @abc.abstractmethod
    def finish(self, dataset: xarray.Dataset) -> None:
        """Replace the blocks by the labelled dataset of the sweep."""


class MemoryStore(BlockStore):
    """Store in memory."""

    def __init__(self, blocks: int):
        self._blocks: list[dict[str, np.ndarray]] = [{} for _ in range(blocks)]

    def missing(self):
        return [i for i, block in enumerate(self._blocks) if not block]

    def write(self, block, results):
        self._blocks[block] = results

    def collect(self):
        names = self._blocks[0]
        return {name: np.concatenate([block[name] for block in self._blocks]) for name in names}

    def finish(self, dataset):
        pass
