"""Progress of work that takes long: a bar on standard error, and who else is told of it."""

import contextlib
import contextvars
import sys
from collections.abc import Callable, Iterator
from typing import Any

from tqdm import tqdm

# Called with the steps done, those of the whole, and what a step is; what it raises ends the work.
Listener = Callable[[int, int, str], None]
_LISTENER: contextvars.ContextVar[Listener | None] = contextvars.ContextVar(
    "listener", default=None
)


class ProgressBar(tqdm):
    """Bar of `total` steps, shown on request; the listener of the context is told of each."""

    def __init__(self, total: int, unit: str, *, shown: bool, **options: Any):
        super().__init__(total=total, unit=unit, disable=not shown, file=sys.stderr, **options)
        self._done = options.get("initial", 0)
        self._words = unit
        self._tell()

    def update(self, n: float | None = 1) -> bool | None:
        """Count steps as done. Raises what the listener raises."""
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
        listener = _LISTENER.get()
        if listener is not None:
            listener(self._done, int(self.total), self._words)


@contextlib.contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Tell a listener of the progress of work within this context."""
    token = _LISTENER.set(listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)
