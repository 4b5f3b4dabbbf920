"""Progress of work that takes long: a bar on standard error, or a function called at each step."""

import contextlib
import contextvars
import sys
from collections.abc import Callable, Iterator
from typing import Any

from tqdm import tqdm

# Called with the steps done, those of the whole, and what a step is; what it raises ends the work.
OnStep = Callable[[int, int, str], None]
_ON_STEP: contextvars.ContextVar[OnStep | None] = contextvars.ContextVar("on_step", default=None)


class ProgressBar(tqdm):
    """Bar of `total` steps, shown on request; the function of `watching` is called at each."""

    def __init__(self, total: int, unit: str, *, shown: bool, **options: Any):
        super().__init__(total=total, unit=unit, disable=not shown, file=sys.stderr, **options)
        self._done = options.get("initial", 0)
        self._words = unit
        self._tell()

    def update(self, n: float | None = 1) -> bool | None:
        """Count steps as done. Raises what the function of `watching` raises."""
        shown = super().update(n)
        self._done += int(n or 0)
        self._tell()
        return shown

    def skip(self, steps: int) -> None:
        """Count steps of an earlier attempt as done; they do not add to the rate."""
        if not self.disable:
            self.initial += steps
            self.n += steps
            self.refresh()
        self._done += steps
        self._tell()

    def _tell(self) -> None:
        on_step = _ON_STEP.get()
        if on_step is not None:
            on_step(self._done, int(self.total), self._words)


@contextlib.contextmanager
def watching(on_step: OnStep) -> Iterator[None]:
    """Call a function at each step of work within this context; what it raises ends the work."""
    token = _ON_STEP.set(on_step)
    try:
        yield
    finally:
        _ON_STEP.reset(token)
