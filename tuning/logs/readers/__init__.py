"""Formats of log files, one module each; a module with a `FORMAT` is a format.

Each format reads a file into tables, one for each run.
"""

import importlib
import pkgutil
from pathlib import Path

from jaxbeam.runtime.input_file import describe_content
from tuning.logs.readers.table import (
    LogFormat,
    LogTable,
    is_time_name,
    parse_heading,
    read_bytes,
)

__all__ = ["LogTable", "is_time_name", "parse_heading", "read_tables"]

_MODULES = (
    importlib.import_module(f"{__name__}.{found.name}") for found in pkgutil.iter_modules(__path__)
)
FORMATS: tuple[LogFormat, ...] = tuple(m.FORMAT for m in _MODULES if hasattr(m, "FORMAT"))
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"


def read_tables(path: Path) -> dict[str, LogTable]:
    """Tables of the runs in a file, by name; a single run without a name is called "".

    The format is decided by the first bytes of the file, that of text without such a mark by the
    suffix. Raises ValueError if the format is unknown or the file is damaged or empty, ImportError
    if the library that reads it is not installed.
    """
    start = read_bytes(path, 128)
    log_format = _format_of(path, start)
    tables = log_format.read(path)
    if not tables:
        raise ValueError(f"{path}: the log is empty: there are no lists of numbers in it")
    return tables


def _format_of(path: Path, start: bytes) -> LogFormat:
    text = start.removeprefix(_BYTE_ORDER_MARK)
    for log_format in FORMATS:
        if text.startswith(log_format.magics):
            return log_format
    suffix = path.suffix.lower()
    for log_format in FORMATS:
        if suffix not in log_format.suffixes:
            continue
        if log_format.is_text:
            return log_format
        raise ValueError(
            f"{path}: this is no {log_format.name} file, whatever it is called: it is"
            f" {describe_content(start)}"
        )
    known = ", ".join(suffix for log_format in FORMATS for suffix in log_format.suffixes)
    raise ValueError(f"{path}: unknown kind of log {path.suffix!r}; known are {known}")
