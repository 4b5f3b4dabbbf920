"""Progress of work that takes long: a bar on standard error, or functions called at each step."""

import contextlib
import contextvars
import sys
from collections.abc import Callable, Iterator
from typing import Any

from tqdm import tqdm

# "512/512 runs [00:01<00:00]", and "8 points [00:10]" of work of unknown length.
KNOWN_LENGTH = "{l_bar}{bar}| {n_fmt}/{total_fmt} {units} [{elapsed}<{remaining}{postfix}]"
UNKNOWN_LENGTH = "{desc}: {n_fmt} {units} [{elapsed}{postfix}]"
# Called with the steps done, those of the whole, and what a step is; what it raises ends the work.
OnStep = Callable[[int, int, str], None]
_ON_STEP: contextvars.ContextVar[OnStep | None] = contextvars.ContextVar("on_step", default=None)
# Called with what a search has found so far.
OnFound = Callable[[Any], None]
_ON_FOUND: contextvars.ContextVar[OnFound | None] = contextvars.ContextVar("on_found", default=None)
BAR_DELAY = 2.0  # s, after which the bar of work of unknown length is shown


class ProgressBar(tqdm):
    """Bar of `total` steps, shown on request; the function of `watching` is called at each.

    A `total` of None is one that nobody knows, of which `watching` is told 0.
    """

    def __init__(self, total: int | None, unit: str, *, shown: bool, **options: Any):
        super().__init__(
            total=total,
            unit=unit,
            disable=not shown,
            file=sys.stderr,
            bar_format=UNKNOWN_LENGTH if total is None else KNOWN_LENGTH,
            **options,
        )
        self._done = options.get("initial", 0)
        self._words = unit
        self._tell()

    def update(self, n: float | None = 1) -> bool | None:
        """Count steps as done. Raises what the function of `watching` raises."""
        shown = super().update(n)
        self._done += int(n or 0)
        self._tell()
        return shown

    @property
    def format_dict(self) -> dict[str, Any]:
        found = super().format_dict
        number = found["n"] if found["total"] is None else found["total"]
        return found | {"units": f"{found['unit']}{'' if number == 1 else 's'}"}

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
            on_step(self._done, int(self.total or 0), self._words)


@contextlib.contextmanager
def watching(on_step: OnStep) -> Iterator[None]:
    """Call a function at each step of work within this context; what it raises ends the work."""
    token = _ON_STEP.set(on_step)
    try:
        yield
    finally:
        _ON_STEP.reset(token)


def found_so_far(found: Any) -> None:
    """Give what a search has found so far to the function of `following`, if there is one."""
    on_found = _ON_FOUND.get()
    if on_found is not None:
        on_found(found)


@contextlib.contextmanager
def following(on_found: OnFound) -> Iterator[None]:
    """Call a function with what fits and tunings find, at each step within this context.

    The functions of contexts around it are called, too.
    """
    outer = _ON_FOUND.get()

    def both(found):
        on_found(found)
        if outer is not None:
            outer(found)

    token = _ON_FOUND.set(both)
    try:
        yield
    finally:
        _ON_FOUND.reset(token)
