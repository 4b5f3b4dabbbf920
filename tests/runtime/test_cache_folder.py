"""The cache folder: files another user could have written are refused; old files are evicted.

Commands keep compiled programs in JAX's cache, in a folder private to the user.
"""

import hashlib
import hmac
import os
import stat
import subprocess
import sys

import jax
import pytest

from jaxbeam.runtime import cache_folder
from jaxbeam.runtime.cache_folder import CacheError, evict, read_file, write_file
from tests.modules import ROOT

NAME, CONTENT = "program-wave-0", b"machine code"
IS_ROOT = hasattr(os, "geteuid") and os.geteuid() == 0
needs_root = pytest.mark.skipif(not IS_ROOT, reason="only root may give a file to another user")


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


def test_a_file_is_read_as_it_was_written(folder):
    assert read_file(NAME) is None
    path = write_file(NAME, CONTENT)
    assert path == folder / NAME and read_file(NAME) == CONTENT
    write_file(NAME, b"")
    assert read_file(NAME) == b""
    assert sorted(entry.name for entry in folder.iterdir()) == ["key", NAME]


def test_folder_key_and_files_are_private_to_the_user_whatever_the_umask(folder):
    umask = os.umask(0)
    try:
        path = write_file(NAME, CONTENT)
        cache_folder.private_folder("jax")
    finally:
        os.umask(umask)
    for file, mode in ((path, 0o600), (folder / "key", 0o600), (folder, 0o700)):
        assert stat.S_IMODE(file.stat().st_mode) == mode
    assert stat.S_IMODE((folder / "jax").stat().st_mode) == 0o700


def test_a_folder_that_others_may_read_is_closed_to_them(folder):
    folder.mkdir(mode=0o755)
    write_file(NAME, CONTENT)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def with_plain_digest(path):
    """Other code with its own digest, as one could forge without a key."""
    path.write_bytes(hashlib.sha256(b"evil").digest() + b"evil")


def with_another_key(path):
    code = hmac.new(b"guess", f"{NAME}\0".encode() + b"evil", hashlib.sha256).digest()
    path.write_bytes(code + b"evil")


def under_another_name(path):
    write_file("program-other-1", b"evil").replace(path)


def cut_off(path):
    path.write_bytes(path.read_bytes()[:-1])


def empty(path):
    path.write_bytes(b"")


def changed(path):
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)


def linked(path):
    """Even to a file that would be accepted."""
    path.replace(path.parent / "elsewhere")
    path.symlink_to("elsewhere")


def a_pipe(path):
    path.unlink()
    os.mkfifo(path)


def a_folder(path):
    path.unlink()
    path.mkdir()


@pytest.mark.parametrize(
    ("attack", "message"),
    [
        (with_plain_digest, "is damaged, or was not written with the key of this user"),
        (with_another_key, "is damaged, or was not written with the key of this user"),
        (under_another_name, "is damaged, or was not written with the key of this user"),
        (cut_off, "is damaged"),
        (empty, "is damaged"),
        (changed, "is damaged"),
        (linked, "is a link or cannot be read"),
        (a_pipe, "is not a regular file"),
        (a_folder, "is not a regular file"),
        (lambda path: path.chmod(0o660), "other users may write to .*program-wave-0; delete it"),
        (lambda path: path.chmod(0o602), "other users may write to .*program-wave-0; delete it"),
        pytest.param(
            lambda path: os.chown(path, 65534, 65534),
            "program-wave-0 belongs to another user; delete it or set XDG_CACHE_HOME",
            marks=needs_root,
        ),
    ],
)
def test_a_file_that_others_can_have_written_is_refused(folder, attack, message):
    attack(write_file(NAME, CONTENT))
    with pytest.raises(CacheError, match=message):
        read_file(NAME)
    if attack is not a_folder:  # which is not replaced by a file
        write_file(NAME, CONTENT)
        assert read_file(NAME) == CONTENT


def moved_and_linked(folder):
    folder.rename(folder.parent / "elsewhere")
    folder.symlink_to("elsewhere")


@pytest.mark.parametrize(
    ("attack", "message"),
    [
        (lambda folder: folder.chmod(0o770), "other users may write to .*jaxbeam; delete it"),
        (lambda folder: folder.chmod(0o707), "other users may write to .*jaxbeam; delete it"),
        (moved_and_linked, "jaxbeam is a link, not a folder"),
        pytest.param(
            lambda folder: os.chown(folder, 65534, 65534),
            "jaxbeam belongs to another user",
            marks=needs_root,
        ),
        (lambda folder: (folder / "key").chmod(0o640), "other users may read .*key; delete it"),
        (lambda folder: (folder / "key").write_bytes(b""), "key is damaged; delete it"),
        pytest.param(
            lambda folder: os.chown(folder / "key", 65534, 65534),
            "key belongs to another user",
            marks=needs_root,
        ),
    ],
)
def test_a_folder_or_key_that_others_can_have_written_is_refused(folder, attack, message):
    write_file(NAME, CONTENT)
    attack(folder)
    for use in (lambda: read_file(NAME), lambda: write_file(NAME, CONTENT)):
        with pytest.raises(CacheError, match=message):
            use()


def test_the_owner_is_checked_without_root_too(folder, monkeypatch):
    write_file(NAME, CONTENT)
    monkeypatch.setattr(os, "geteuid", lambda: 12345)
    with pytest.raises(CacheError, match="jaxbeam belongs to another user"):
        read_file(NAME)


def test_a_file_written_with_a_key_that_is_gone_is_refused(folder):
    write_file(NAME, CONTENT)
    (folder / "key").unlink()
    with pytest.raises(CacheError, match="was not written with the key of this user"):
        read_file(NAME)


def test_without_a_home_folder_there_is_no_cache(monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(cache_folder.pathlib.Path, "home", no_home)
    for use in (lambda: read_file(NAME), lambda: write_file(NAME, CONTENT)):
        with pytest.raises(CacheError, match="there is no home folder; XDG_CACHE_HOME may name"):
            use()


def no_home():
    raise RuntimeError("Could not determine home directory.")


def test_a_relative_cache_folder_is_ignored(monkeypatch, tmp_path):
    """Else the folder a command is started in would be trusted."""
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_folder.cache_folder() == tmp_path / ".cache" / "jaxbeam"


def test_a_folder_that_cannot_be_created_is_an_error_message(tmp_path):
    (tmp_path / "jaxbeam").write_text("")
    with pytest.raises(CacheError, match=r"jaxbeam cannot be used \(File exists\)"):
        write_file(NAME, CONTENT)


def test_the_least_recently_used_files_are_evicted(folder):
    for age, name in enumerate(("program-c", "program-b", "program-a", "native-0")):
        path = write_file(name, bytes(1000))
        os.utime(path, (10**9 - age, 10**9 - age))
    cache_folder.private_folder("jax")
    (folder / "jax" / "jit_f-cache").write_bytes(bytes(1000))
    os.utime(folder / "jax" / "jit_f-cache", (1, 1))

    def remaining():
        files = (path.name for path in folder.rglob("*") if path.is_file())
        return sorted(set(files) - {"key", "native-0"})

    evict(5000)
    assert remaining() == ["jit_f-cache", "program-a", "program-b", "program-c"]
    evict(3200)
    assert remaining() == ["program-a", "program-b", "program-c"]
    os.utime(folder / "program-a")
    evict(2100)
    assert remaining() == ["program-a", "program-c"]
    evict(0)
    assert remaining() == []
    assert (folder / "key").exists() and read_file("native-0") == bytes(1000)


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
