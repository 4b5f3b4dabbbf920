"""JAX's cache of compiled programs, in a folder private to the user.

Commands switch it on; `docs/howto/speed.md` says how scripts do. A cache of our own, which found a
program before it is traced, saved 0.7 s of 2.6 s of a second command that compiles; it took a
thousand lines and pickles.
"""

import logging
import os
import warnings

import jax

from jaxbeam.runtime.cache_folder import JAX_FOLDER, CacheError, evict, private_folder

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
