"""Ctrl-C: a command ends in one line, which says what is kept and how to go on."""

import contextlib
import contextvars
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator

from jaxbeam.runtime.early_interrupt import STATUS
from jaxbeam.runtime.output_file import WRITTEN

GRACE = 5.0  # s for the work to end; compilers in C do not hear of a signal before they have ended

# What is kept of the work in progress, innermost last, as sentences of the moment.
KEPT: contextvars.ContextVar[list[Callable[[], str]] | None] = contextvars.ContextVar(
    "kept", default=None
)


@contextlib.contextmanager
def keeping(sentence: Callable[[], str]) -> Iterator[None]:
    """Work of which something is kept if it is interrupted: `sentence` says what, or nothing."""
    kept = KEPT.get()
    if kept is not None:
        kept.append(sentence)
    yield  # not in a `finally`: what is kept is said after an interrupt has left this
    if kept is not None:
        kept.remove(sentence)


class Interrupted(SystemExit):
    """End of a command on SIGINT, with status 130."""

    def __init__(self):
        super().__init__(STATUS)


@contextlib.contextmanager
def interruptible(of_process: bool) -> Iterator[None]:
    """Run a command; whatever an interrupt makes of it ends it with one line and status 130.

    A command that is the whole process (`of_process`) ends at the latest GRACE seconds after the
    signal, though a compiler may still run or a library has swallowed the exception. Raises
    Interrupted (a SystemExit).
    """
    kept, written = [], []
    tokens = KEPT.set(kept), WRITTEN.set(written)
    signals = _Signals(lambda: _say(kept, written)) if of_process else None
    try:
        yield
    except KeyboardInterrupt:
        _end(signals, kept, written)
    except Exception:
        if signals is None or not signals.received:
            raise
        _end(signals, kept, written)  # libraries make other exceptions of it
    finally:
        KEPT.reset(tokens[0])
        WRITTEN.reset(tokens[1])
        if signals is not None:
            signals.close()


class _Signals:
    """Handler of SIGINT, and a thread that ends the process if the main one does not."""

    def __init__(self, say: Callable[[], None]):
        self.received = False
        self._say, self._ended = say, threading.Event()
        self._reading, self._writing = os.pipe()
        os.set_blocking(self._writing, False)
        threading.Thread(target=self._watch, daemon=True).start()
        signal.signal(signal.SIGINT, self._raise)
        signal.set_wakeup_fd(self._writing, warn_on_full_buffer=False)
        sys.unraisablehook = self._unraisable

    def close(self) -> None:
        """The command has ended: what it said is all."""
        self._ended.set()
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGINT, lambda *_: os._exit(STATUS))

    def ignore(self) -> None:
        """Do nothing on further signals."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)

    def _raise(self, _, frame):
        self.received = True
        if _is_importing(frame):  # modules in C print a traceback, or crash
            self._say()
            os._exit(STATUS)
        raise KeyboardInterrupt

    def _unraisable(self, unraisable):
        # Exceptions in callbacks of C are printed in place of being raised.
        if not self.received:
            sys.__unraisablehook__(unraisable)

    def _watch(self) -> None:
        while os.read(self._reading, 1) != bytes([signal.SIGINT]):
            pass
        if not self._ended.wait(GRACE):
            self._say()
            os._exit(STATUS)


def _is_importing(frame) -> bool:
    """Whether a frame is within an import."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def _end(signals: _Signals | None, kept, written) -> None:
    if signals is None:
        _say(kept, written)
        raise Interrupted from None
    signals.ignore()
    warnings.simplefilter("ignore")
    _say(kept, written)
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.flush()
    os._exit(STATUS)  # without waiting for threads that compile


def _say(kept, written) -> None:
    """Print what is kept: the innermost of the work in progress, and files that are whole."""
    said = [sentence() for sentence in reversed(list(kept))]
    said = [one for one in said if one][:1]
    # A checkpoint is written many times, and named as what is kept.
    files = [one for one in dict.fromkeys(written) if not any(one in kept for kept in said)]
    said += [f"written: {', '.join(files)}"] if files else []
    bars = getattr(getattr(sys.modules.get("tqdm"), "tqdm", None), "_instances", ())
    begin = "\n" if len(bars) else ""  # the line of a bar of progress is not ended
    line = f"{begin}jaxbeam: interrupted; {'; '.join(said) or 'nothing is kept'}\n"
    with contextlib.suppress(OSError, ValueError):
        sys.stderr.flush()
    os.write(2, line.encode())
