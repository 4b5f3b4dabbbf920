"""Results of the batches on which step sizes are measured, which a sweep need not compute again."""

import numpy as np
from jaxtyping import Bool, Float, Int


class Trials:
    """Latest results of batches by name, with their steps (s).

    Four of the 64 batches of 4096 crossings are checked with their final steps: a sixteenth less
    is left to be computed.
    """

    def __init__(self):
        self._latest: dict[int, tuple[float, dict[str, np.ndarray]]] = {}

    def add(
        self,
        batch_indices: Int[np.ndarray, " path"],
        steps: Float[np.ndarray, " path"],
        results: dict[str, np.ndarray],
    ) -> None:
        """Keep the results (path, batch, ...) of batches."""
        for row, (batch, step) in enumerate(zip(batch_indices, steps, strict=True)):
            self._latest[int(batch)] = step, {name: part[row] for name, part in results.items()}

    def known(
        self, batch_indices: Int[np.ndarray, " path"], steps: Float[np.ndarray, " path"]
    ) -> Bool[np.ndarray, " path"]:
        """Whether the results of batches are known for these steps."""
        of_batches = (self._latest.get(batch, (None,))[0] for batch in batch_indices.tolist())
        return np.array([step == given for step, given in zip(of_batches, steps, strict=True)])

    def completed(
        self,
        results: dict[str, np.ndarray],
        batch_indices: Int[np.ndarray, " path"],
        known: Bool[np.ndarray, " path"],
    ) -> dict[str, np.ndarray]:
        """Results (path, batch, ...) of batches with those that are known; they may be all."""
        own = {row: self._latest[int(batch_indices[row])][1] for row in np.flatnonzero(known)}
        if known.all():
            return {name: np.stack([one[name] for one in own.values()]) for name in own[0]}
        results = {name: np.array(values) for name, values in results.items()}
        for row, of_batch in own.items():
            for name, values in of_batch.items():
                results[name][row] = values
        return results
