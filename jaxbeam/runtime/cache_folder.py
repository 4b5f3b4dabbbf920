"""Folder of compiled code: private to its user, every file authenticated before it is used.

Compiled code runs with the rights of the user who loads it. So the folder has mode 0700, and a file
is used only if it is a regular file of this user that nobody else may write, and begins with its
HMAC-SHA256 (RFC 2104) under a random key that lies beside it with mode 0600. A file that was
damaged, renamed or copied here from elsewhere has the wrong HMAC. Windows has neither owners nor
modes in this sense; there the HMAC alone counts.

JAX's own cache of compiled programs is a folder in it, which commands switch on;
`docs/howto/speed.md` says how scripts do. A cache of our own, which found a program before it is
traced, saved 0.7 s of 2.6 s of a second command that compiles; it took a thousand lines and
pickles.
"""

import contextlib
import hashlib
import hmac
import logging
import os
import pathlib
import platform
import secrets
import stat
import sys
import tempfile
import warnings

KEY_BYTES = 32
HMAC_BYTES = 32
OTHERS_WRITE, OTHERS_ACCESS = 0o022, 0o077  # modes, of the group or of all others
KEY_FILE = "key"
LIBRARY_PREFIX = "native-"  # built on request, so never evicted
JAX_FOLDER = "jax"  # of JAX's own cache, in commands


class CacheError(RuntimeError):
    """Why a file of the cache folder is not read or written, in one clause."""


def cache_folder() -> pathlib.Path:
    """`$XDG_CACHE_HOME/jaxbeam`, by default `~/.cache/jaxbeam`.

    Raises CacheError if the user has no home folder.
    """
    base = os.environ.get("XDG_CACHE_HOME", "")
    if os.path.isabs(base):  # relative ones are to be ignored, says the XDG specification
        return pathlib.Path(base) / "jaxbeam"
    try:
        return pathlib.Path.home() / ".cache" / "jaxbeam"
    except RuntimeError:
        raise CacheError("there is no home folder; XDG_CACHE_HOME may name another") from None


def private_folder(name: str = "") -> pathlib.Path:
    """The cache folder, or a folder in it, created with mode 0700 if missing.

    Raises CacheError if it is a link, belongs to another user, others may write to it, or it cannot
    be created.
    """
    folder = cache_folder()
    if name:
        folder = private_folder() / name
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.lstat()
        if not stat.S_ISDIR(status.st_mode):
            raise CacheError(f"{folder} is a link, not a folder")
        _check_owner(folder, status, OTHERS_WRITE)
        if status.st_mode & OTHERS_ACCESS:
            folder.chmod(0o700)
    except OSError as error:
        raise CacheError(f"{folder} cannot be used ({error.strerror})") from None
    return folder


def read_file(name: str) -> bytes | None:
    """Content of a file, without its HMAC; None if there is no such file.

    Raises CacheError if others may have written it or it is damaged.
    """
    path = cache_folder() / name
    if not os.path.lexists(path):
        return None
    folder = private_folder()
    try:
        data = _read_private(path, OTHERS_WRITE)
    except FileNotFoundError:  # another process has evicted it
        return None
    code, content = data[:HMAC_BYTES], data[HMAC_BYTES:]
    if not hmac.compare_digest(code, _hmac(folder, name, content)):
        raise CacheError(f"{path} is damaged, or was not written with the key of this user")
    return content


def write_file(name: str, content: bytes) -> pathlib.Path:
    """Write a file with its HMAC, in one step, so that no process reads half of it; its path.

    Raises CacheError if it cannot be written.
    """
    folder = private_folder()
    path = folder / name
    try:
        with temporary_file(folder, _hmac(folder, name, content) + content) as temporary:
            os.replace(temporary, path)
    except OSError as error:
        raise CacheError(f"{path} cannot be written ({error.strerror})") from None
    return path


def evict(max_bytes: int) -> None:
    """Delete the least recently used files until the others have at most `max_bytes`.

    The key and built libraries stay and do not count.
    """
    folder = private_folder()
    found = []
    for directory in (folder, folder / JAX_FOLDER):
        with contextlib.suppress(OSError), os.scandir(directory) as entries:
            for entry in entries:
                with contextlib.suppress(OSError):  # another process may have deleted it
                    status = entry.stat(follow_symlinks=False)
                    evictable = entry.name != KEY_FILE and not entry.name.startswith(LIBRARY_PREFIX)
                    if evictable and not stat.S_ISDIR(status.st_mode):
                        found.append((status.st_mtime_ns, status.st_size, entry.path))
    for _, size, path in sorted(found, reverse=True):
        max_bytes -= size
        if max_bytes < 0:
            with contextlib.suppress(OSError):
                os.unlink(path)


@contextlib.contextmanager
def temporary_file(folder: pathlib.Path, data: bytes):
    """Path of a file with mode 0600 in a folder, deleted at the end if it is still there."""
    descriptor, path = tempfile.mkstemp(dir=folder)
    try:
        with open(descriptor, "wb") as file:
            file.write(data)
        yield path
    finally:
        with contextlib.suppress(OSError):
            os.unlink(path)


def link(own: str, target: pathlib.Path, content: bytes) -> None:
    """Give a file of some content a second name, in one step on network file systems too.

    A file system without links gets a copy. Raises FileExistsError if there is a file of this name.
    """
    try:
        os.link(own, target)
    except FileExistsError:
        raise
    except OSError:
        with open(target, "xb", opener=lambda name, flags: os.open(name, flags, 0o600)) as file:
            file.write(content)


def machine_description() -> str:
    """Operating system, architecture, and model and instruction sets of the processor."""
    try:
        lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        cpu = platform.processor()
    else:
        cpu_lines = {line for line in lines if line.startswith(("model name", "flags"))}
        cpu = "".join(sorted(cpu_lines))
    return "\n".join([sys.platform, platform.machine(), cpu])


def _check_owner(path: pathlib.Path, status: os.stat_result, forbidden: int) -> None:
    """Raise CacheError if a file is another user's, or others have a right of `forbidden`."""
    if not hasattr(os, "geteuid"):  # Windows
        return
    if status.st_uid != os.geteuid():
        raise CacheError(f"{path} belongs to another user; delete it or set XDG_CACHE_HOME")
    if status.st_mode & forbidden:
        right = "read" if forbidden & ~OTHERS_WRITE else "write to"
        raise CacheError(f"other users may {right} {path}; delete it")


def _read_private(path: pathlib.Path, forbidden: int) -> bytes:
    """Bytes of a regular file of this user; raises CacheError as `_check_owner` does.

    The file that is checked is the one that is read: the descriptor is the same.
    """
    # A pipe put there would block without O_NONBLOCK.
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    try:
        descriptor = os.open(path, flags | getattr(os, "O_BINARY", 0))
    except FileNotFoundError:
        raise
    except OSError as error:
        raise CacheError(f"{path} is a link or cannot be read ({error.strerror})") from None
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise CacheError(f"{path} is not a regular file")
        _check_owner(path, status, forbidden)
        with open(descriptor, "rb", closefd=False) as file:
            return file.read()
    finally:
        os.close(descriptor)


def _hmac(folder: pathlib.Path, name: str, content: bytes) -> bytes:
    """HMAC-SHA256 of name and content: a file under another's name is not that file."""
    code = hmac.new(_key(folder), f"{name}\0".encode(), hashlib.sha256)
    code.update(content)
    return code.digest()


def _key(folder: pathlib.Path) -> bytes:
    """Key of this user, created if missing. Raises CacheError if others may know it."""
    path = folder / KEY_FILE
    if not os.path.lexists(path):
        try:
            key = secrets.token_bytes(KEY_BYTES)
            with temporary_file(folder, key) as temporary:
                link(
                    temporary, path, key
                )  # not `replace`: the key of another process would be lost
        except FileExistsError:
            pass
        except OSError as error:
            raise CacheError(f"{path} cannot be written ({error.strerror})") from None
    key = _read_private(path, OTHERS_ACCESS)
    if len(key) != KEY_BYTES:
        raise CacheError(f"{path} is damaged; delete it")
    return key


LOGGER = logging.getLogger(__name__)
SIZE_VARIABLE = "JAXBEAM_CACHE_SIZE"  # MiB; 0 switches the cache off
DEFAULT_SIZE = 512  # MiB, some 1000 programs
MIN_COMPILE_TIME = "jax_persistent_cache_min_compile_time_secs"
STORED_FROM = 0.3  # s of compilation


def switch_on() -> None:
    """Cache the programs of this process, as all commands do.

    The settings of JAX that the user has made prevail. A folder that cannot be used, and a size
    that is no number, make a warning.
    """
    import jax  # late: files are written without it

    size = _max_bytes()
    off = not jax.config.jax_enable_compilation_cache or "JAX_COMPILATION_CACHE_DIR" in os.environ
    if off or not size:
        return
    try:
        folder = private_folder(JAX_FOLDER)
        evict(size)
    except CacheError as error:
        _warn(str(error))
        return
    LOGGER.info("compile cache in %s", folder)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    if MIN_COMPILE_TIME.upper() not in os.environ:
        jax.config.update(MIN_COMPILE_TIME, STORED_FROM)


def _max_bytes() -> int:
    """Size limit of the cache; 0 if it is off."""
    text = os.environ.get(SIZE_VARIABLE, str(DEFAULT_SIZE))
    try:
        return max(int(text), 0) << 20
    except ValueError:
        _warn(f"{SIZE_VARIABLE} is to be a whole number of MiB, not {text!r}")
        return 0


def _warn(reason: str) -> None:
    warnings.warn(f"compile cache not used: {reason}", stacklevel=3)
