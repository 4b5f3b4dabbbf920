"""Formats of log files, a module for each family; each `LogFormat` in a module is a format.

Each format reads a file into tables, one for each run. Files that are packed (.gz, .zip) are read
like those in them.
"""

import gzip
import importlib
import io
import pkgutil
import tempfile
import zipfile
import zlib
from pathlib import Path

from jaxbeam.runtime.input_file import describe_content, max_bytes
from tuning.logs.readers.table import (
    LogFormat,
    LogTable,
    damaged_file_error,
    is_time_name,
    parse_heading,
    read_bytes,
)

__all__ = ["LogTable", "is_time_name", "parse_heading", "read_tables"]

_MODULES = (
    importlib.import_module(f"{__name__}.{found.name}") for found in pkgutil.iter_modules(__path__)
)
FORMATS: tuple[LogFormat, ...] = tuple(
    found for m in _MODULES for found in vars(m).values() if isinstance(found, LogFormat)
)
_SUFFIXES = [suffix for log_format in FORMATS for suffix in log_format.suffixes]
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"


def read_tables(path: Path) -> dict[str, LogTable]:
    """Tables of the runs in a file, by name; a single run without a name is called "".

    The format is decided by the first bytes of the file, that of text without such a mark by the
    suffix. Raises ValueError if the format is unknown or the file is damaged or empty, ImportError
    if the library that reads it is not installed.
    """
    tables = _format_of(path, read_bytes(path, 128)).read(path)
    if not tables:
        raise ValueError(f"{path}: the log is empty: there are no lists of numbers in it")
    return tables


def _format_of(path: Path, start: bytes) -> LogFormat:
    text, suffix = start.removeprefix(_BYTE_ORDER_MARK), path.suffix.lower()
    found = [one for one in FORMATS if text.startswith(one.magics)]
    called = [one for one in found if suffix in one.suffixes]
    if called or found and found[0].suffixes != (".gz",):
        # Workbooks, archives of arrays and others are zip files.
        return (called or sorted(found, key=lambda one: ".xlsx" not in one.suffixes))[0]
    for log_format in FORMATS:
        if suffix not in log_format.suffixes:
            continue
        if log_format.is_text or not log_format.magics:
            return log_format
        raise ValueError(
            f"{path}: this is no {log_format.name} file, whatever it is called: it is"
            f" {describe_content(start)}"
        )
    known = ", ".join(_SUFFIXES)
    raise ValueError(f"{path}: unknown kind of log {path.suffix!r}; known are {known}")


def _read_gz(path: Path) -> dict[str, LogTable]:
    """Tables of the file in a file packed by gzip, whose name tells its kind.

    Raises ValueError for a damaged file, and as the reader of the file in it does.
    """
    name = path.with_suffix("").name
    if Path(name).suffix.lower() not in _SUFFIXES:
        raise ValueError(
            f"{path}: the name should end like run.csv.gz, which tells what kind of log is in it"
        )
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(read_bytes(path))) as file:
            content = file.read(max_bytes("log") + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise damaged_file_error(path, error) from None
    _check_size(path, len(content))
    return _unpacked(path, name, content, "")


# A place before the start of the file is a ValueError.
_DAMAGED_ZIP = (OSError, EOFError, RuntimeError, ValueError, zipfile.BadZipFile, zlib.error)


def _read_zip(path: Path) -> dict[str, LogTable]:
    """Tables of the logs in a zip archive; other files are passed over.

    The runs of several are named by the files. Raises ValueError for a damaged file, one without
    logs, and as the readers of the logs do.
    """
    packed = io.BytesIO(read_bytes(path))
    try:
        archive = zipfile.ZipFile(packed)
    except _DAMAGED_ZIP as error:
        raise damaged_file_error(path, error) from None
    sizes = {one.filename: one.file_size for one in archive.infolist() if not one.is_dir()}
    logs = [name for name in sizes if Path(name).suffix.lower() in _SUFFIXES]
    _check_size(path, sum(sizes[name] for name in logs))
    try:
        contents = {name: archive.read(name) for name in logs}
    except _DAMAGED_ZIP as error:
        raise damaged_file_error(path, error) from None
    if not logs:
        raise ValueError(f"{path}: there is no log in the archive: {', '.join([*sizes][:5])}")
    tables = {}
    for name, content in contents.items():
        for run, table in _unpacked(path, name, content, f", {name}").items():
            label = name if len(logs) > 1 else ""
            tables[f"{label}/{run}" if label and run else label or run] = table
    return tables


def _check_size(path: Path, size: int) -> None:
    """Raises ValueError for so many bytes as do not fit into memory."""
    if size > max_bytes("log"):
        raise ValueError(f"{path}: it unpacks to {size / 2**30:.3g} GB or more, which is too large")


def _unpacked(path: Path, name: str, content: bytes, place: str) -> dict[str, LogTable]:
    """Tables of a file by its name and content; errors name the file in which it is packed."""
    with tempfile.TemporaryDirectory() as folder:
        inner = Path(folder) / Path(name).name
        with open(inner, "wb") as file:
            file.write(content)
        try:
            return read_tables(inner)
        except ValueError as error:
            raise ValueError(str(error).replace(str(inner), f"{path}{place}")) from None


FORMATS += (
    LogFormat("gzip", _read_gz, suffixes=(".gz",), magics=(b"\x1f\x8b",)),
    LogFormat("zip", _read_zip, suffixes=(".zip",), magics=(b"PK\x03\x04",)),
)
_SUFFIXES += (".gz", ".zip")
