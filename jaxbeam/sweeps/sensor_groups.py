"""Runner of a sweep whose sensors are too many for one integration: groups of them in turn."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float

from jaxbeam.sweeps.blocks import Runner
from jaxbeam.sweeps.step_size import largest_error

OF_SENSORS = {"peak_deflection": -1, "peak_time": -1, "deflection": -1}  # axis of the sensors


class SensorGroups:
    """Runners of the same batches with other sensors each, as one (see `blocks.Runner`).

    `groups` are the numbers of the sensors of each.
    """

    trials = None  # are not kept

    def __init__(self, runners: Sequence[Runner], groups: Sequence[Sequence[int]]):
        self.runners, self.groups = runners, groups
        self.batches, self.block_count = runners[0].batches, runners[0].block_count
        self.run_count = runners[0].run_count

    @property
    def pool(self) -> ThreadPoolExecutor:
        """Threads that compute blocks."""
        return self.runners[0].pool

    def choose_step_sizes(self) -> tuple[Float[np.ndarray, " path"], float]:
        """Step sizes (s) of all batches that suit all sensors, and the estimated error of peaks."""
        found = [runner.choose_step_sizes() for runner in self.runners]
        steps, errors = zip(*found, strict=True)
        return np.min(steps, axis=0), largest_error(errors)

    def block_function(
        self, steps: Float[np.ndarray, " path"], trials: None = None
    ) -> Callable[[int], dict[str, np.ndarray]]:
        """Function of a block's number: its results (path, batch, ...) by name."""
        functions = [runner.block_function(steps) for runner in self.runners]
        order = np.argsort(np.concatenate(self.groups))

        def compute(block: int) -> dict[str, np.ndarray]:
            parts = [function(block) for function in functions]
            joined = {
                name: np.concatenate([part[name] for part in parts], axis)[..., order]
                for name, axis in OF_SENSORS.items()
                if name in parts[0]
            }
            return parts[0] | joined

        return compute
