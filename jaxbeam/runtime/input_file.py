"""Files that are read: regular ones of a limited size, below a folder where a file names them."""

import os
import stat
from pathlib import Path

# Largest sizes in bytes, by what a file is to the user.
MAX_BYTES = {
    "profile": 64 * 2**20,
    "log": 4 * 2**30,
    "fit": 4 * 2**30,
    "checkpoint": 4 * 2**30,
    "record": 64 * 2**30,
    "part of a store": 4 * 2**30,
}
MAX_TEXT_BYTES = 32 * 2**20  # of all others: tables that people write

_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
)
# First bytes of files, for sentences about those that are not what their name says.
_STARTS = (
    (b"PK\x03\x04", "a ZIP archive, as .xlsx and .npz are"),
    (b"PK\x05\x06", "an empty ZIP archive"),
    (b"\x93NUMPY", "a single NumPy array (.npy)"),
    (b"\x89HDF\r\n\x1a\n", "an HDF5 file"),
    (b"MATLAB 7.3 MAT-file", "an HDF5 file of MATLAB 7.3"),
    (b"MATLAB 5.0 MAT-file", "a MATLAB file"),
    (b"CDF", "a classic netCDF file"),
    (b"PAR1", "a Parquet file"),
    (b"TDSm", "a TDMS file"),
    (b"LabVIEW Measurement", "a LabVIEW measurement file"),
    (b"\x89PNG", "a PNG picture"),
    (b"\xff\xd8\xff", "a JPEG picture"),
    (b"%PDF", "a PDF document"),
    (b"\x1f\x8b", "compressed by gzip"),
    (b"\xd0\xcf\x11\xe0", "a document of an old Office (.xls, .doc)"),
    (b"\x80\x04", "a pickle of Python"),
    (b"\x80\x05", "a pickle of Python"),
)


def check_input(
    path: str | os.PathLike, what: str, below: Path | None = None, address: str = ""
) -> None:
    """Check, before it is opened, that a file is regular, not too large, and in its place.

    `what` it is to the user. A file that another file names at an `address` must be `below` the
    folder of that one, links followed. Raises OSError (a FileNotFoundError, a PermissionError) if
    it cannot be read or is a pipe, a device or a folder; ValueError if it is too large or
    elsewhere.
    """
    if below is not None:
        _check_below(path, what, below, address)
    try:
        status = os.stat(path)
        if not os.access(path, os.R_OK):
            raise PermissionError(None, "permission denied")
    except (OSError, ValueError) as error:  # ValueError: a null byte in the name
        reason = (getattr(error, "strerror", None) or str(error)).lower()
        kind = type(error) if isinstance(error, OSError) else ValueError
        raise kind(f"cannot read the {what} {os.fspath(path)}: {reason}") from None
    if not stat.S_ISREG(status.st_mode):
        kind = next((words for test, words in _KINDS if test(status.st_mode)), "no regular file")
        error_class = IsADirectoryError if stat.S_ISDIR(status.st_mode) else OSError
        raise error_class(
            f"cannot read the {what} {os.fspath(path)}: it is {kind}, not a regular file"
        )
    _check_size(path, what, status.st_size)


def read_input(
    path: str | os.PathLike, what: str, below: Path | None = None, address: str = ""
) -> bytes:
    """Content of a file that `check_input` allows; raises as that does."""
    check_input(path, what, below, address)
    try:
        with open(path, "rb") as file:
            # A file of /proc says that it is empty, and may have no end.
            content = file.read(max_bytes(what) + 1)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise type(error)(f"cannot read the {what} {os.fspath(path)}: {reason}") from None
    _check_size(path, what, len(content))
    return content


def read_text_input(
    path: str | os.PathLike, what: str, below: Path | None = None, address: str = ""
) -> str:
    """Text of a file in UTF-8; raises as `check_input`, and ValueError for one that is no text."""
    content = read_input(path, what, below, address)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError(
            f"{os.fspath(path)}: a {what} is text in UTF-8, which this is not: it is"
            f" {describe_content(content)}"
        ) from None


def max_bytes(what: str) -> int:
    """Largest size of a file in bytes."""
    return MAX_BYTES.get(what, MAX_TEXT_BYTES)


def describe_content(content: bytes) -> str:
    """What a file is by its first bytes, in words; its content is not quoted.

    >>> describe_content(b"CDF\\x01")
    'a classic netCDF file'
    """
    if not content:
        return "empty"
    known = next((words for start, words in _STARTS if content.startswith(start)), None)
    if known is not None:
        return known
    start = content[:4096]
    if not start.strip(b"\0"):
        return "zeros only"
    try:
        start.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if error.start < len(start) - 4:  # a character that is cut off by the 4096 bytes is text
            return "binary data of an unknown kind"
    return "binary data of an unknown kind" if b"\0" in start else "text"


def not_as_named(path: str | os.PathLike, kind: str, *starts: bytes) -> ValueError:
    """Error for a file that cannot be read as the `kind` its ending says, as "NumPy archive".

    Files of the kind begin with one of the `starts`; one that does so is damaged.
    """
    try:
        with open(path, "rb") as file:
            content = file.read(4096)
    except OSError:
        content = b""
    if content.startswith(starts):
        return ValueError(f"{os.fspath(path)}: this {kind} is damaged or cut off")
    return ValueError(f"{os.fspath(path)} is no {kind}: it is {describe_content(content)}")


def _check_below(path: str | os.PathLike, what: str, folder: Path, address: str) -> None:
    place, top = os.path.realpath(path), os.path.realpath(folder)
    if not place.startswith(os.path.join(top, "")):
        raise ValueError(
            f"{address}: the {what} {os.fspath(path)} is not below the folder of the file that"
            f" names it; copy it there, or name it on the command line: --set {address}=PATH"
        )


def _check_size(path: str | os.PathLike, what: str, size: int) -> None:
    limit = max_bytes(what)
    if size > limit:
        raise ValueError(
            f"{os.fspath(path)} has {_in_words(size)}; a {what} may have {_in_words(limit)}"
            if size < 2**60
            else f"{os.fspath(path)} is too large for a {what}, {_in_words(limit)} at most"
        )


def _in_words(size: int) -> str:
    """Bytes as people say them, 64 MB."""
    scale, unit = next((s, u) for s, u in ((30, "GB"), (20, "MB"), (0, "bytes")) if size >> s)
    return f"{size / 2**scale:.3g} {unit}"
