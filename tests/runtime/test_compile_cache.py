"""Commands keep compiled programs in JAX's cache, in a folder private to the user."""

import os
import subprocess
import sys

import jax
import pytest

from jaxbeam.runtime import cache_folder
from tests.modules import ROOT


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """The cache folder, not made yet; settings of JAX as before at the end."""
    names = "jax_compilation_cache_dir", cache_folder.MIN_COMPILE_TIME
    before = {name: getattr(jax.config, name) for name in names}
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for name in (cache_folder.SIZE_VARIABLE, "JAX_COMPILATION_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)
    jax.config.update("jax_compilation_cache_dir", None)
    yield tmp_path / "jaxbeam"
    for name, value in before.items():
        jax.config.update(name, value)


def used() -> str | None:
    """Folder of JAX's cache once it is switched on."""
    cache_folder.switch_on()
    return jax.config.jax_compilation_cache_dir


def test_programs_are_kept_in_a_private_folder(folder):
    assert used() == str(folder / "jax")
    assert (folder / "jax").stat().st_mode & 0o777 == 0o700


def test_settings_of_the_user_prevail(folder, monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "elsewhere")
    assert used() is None
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        assert used() is None
    finally:
        jax.config.update("jax_enable_compilation_cache", True)
    monkeypatch.setenv(cache_folder.SIZE_VARIABLE, "0")
    assert used() is None and not folder.exists()
    monkeypatch.setenv(cache_folder.SIZE_VARIABLE, "1 GB")
    with pytest.warns(UserWarning, match="JAXBEAM_CACHE_SIZE is to be a whole number of MiB, not"):
        assert used() is None


def test_a_folder_that_cannot_be_used_gives_one_warning(folder):
    folder.write_text("")
    with pytest.warns(UserWarning, match="compile cache not used: .*jaxbeam cannot be") as caught:
        assert used() is None
    assert len(caught) == 1
    folder.unlink()
    folder.mkdir(mode=0o700)
    (folder / "jax").mkdir()
    (folder / "jax").chmod(0o777)
    with pytest.warns(UserWarning, match="other users may write to .*jax; delete it"):
        assert used() is None


def test_the_oldest_programs_are_deleted_above_the_size(folder, monkeypatch):
    assert used()
    old, new = (folder / "jax" / name for name in ("old-cache", "new-cache"))
    for path in (old, new):
        path.write_bytes(bytes(3 << 19))  # 1.5 MiB
    os.utime(old, (1, 1))
    monkeypatch.setenv(cache_folder.SIZE_VARIABLE, "2")
    cache_folder.switch_on()
    assert new.exists() and not old.exists()


COMPILING = """
import jax
from jaxbeam.runtime.cache_folder import switch_on

switch_on()
jax.jit(jax.numpy.sin)(0.5)
"""


def test_compiled_programs_are_stored_there(folder, monkeypatch):
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    subprocess.run([sys.executable, "-c", COMPILING], cwd=ROOT, check=True)
    assert any("sin" in path.name for path in (folder / "jax").iterdir())
