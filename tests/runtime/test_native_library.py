"""The optional C library: compiled on request, refused if another user could have written it."""

import hashlib
import re
import shutil

import pytest

from jaxbeam.runtime import native_library
from jaxbeam.runtime.cache_folder import read_file
from jaxbeam.runtime.native_library import Library
from jaxbeam.simulation.integrator import native_peaks

pytestmark = pytest.mark.skipif(native_library.find_compiler() is None, reason="no C compiler here")

LIBRARY = Library(sources=("small.c",), headers=())


@pytest.fixture(autouse=True)
def source(tmp_path, monkeypatch):
    """Folder of the C source of a small library, and an empty cache folder."""
    (tmp_path / "small.c").write_text("int size(void) { return 3; }")
    monkeypatch.setattr(native_library, "C_FOLDER", tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "small.c"


def test_a_library_is_available_once_it_is_compiled_until_it_is_removed():
    assert not LIBRARY.available()
    path = LIBRARY.build()
    assert path == LIBRARY.library_path() and LIBRARY.available()
    assert LIBRARY.load().size() == 3
    assert LIBRARY.remove() == path
    assert not LIBRARY.available()
    LIBRARY.remove()


def test_a_library_is_compiled_beside_other_work_unless_it_was_removed():
    with LIBRARY.built_meanwhile():
        pass
    assert LIBRARY.available() and not LIBRARY.can_be_built()
    LIBRARY.remove()
    with LIBRARY.built_meanwhile():
        pass
    assert not LIBRARY.available() and not LIBRARY.can_be_built()


def test_a_compiler_that_fails_beside_other_work_changes_nothing(monkeypatch):
    monkeypatch.setenv("CC", "false")
    assert LIBRARY.can_be_built()
    with LIBRARY.built_meanwhile():
        pass
    assert not LIBRARY.library_path().exists()
    with pytest.raises(ZeroDivisionError), LIBRARY.built_meanwhile():
        raise ZeroDivisionError


def without_hmac(path, library):
    """A library without HMAC, which the dynamic loader alone would accept."""
    path.write_bytes(library)


def with_plain_digest(path, library):
    path.write_bytes(hashlib.sha256(library).digest() + library)


def truncated(path, library):
    path.write_bytes(path.read_bytes()[:1000])


def linked(path, library):
    path.replace(path.parent / "elsewhere")
    path.symlink_to("elsewhere")


def writable_by_others(path, library):
    path.chmod(0o666)


def in_a_folder_writable_by_others(path, library):
    path.parent.chmod(0o777)


def with_a_known_key(path, library):
    (path.parent / "key").chmod(0o644)


@pytest.mark.parametrize(
    ("attack", "message"),
    [
        (without_hmac, "was not written with the key of this user"),
        (with_plain_digest, "was not written with the key of this user"),
        (truncated, "is damaged"),
        (linked, "is a link"),
        (writable_by_others, "other users may write to"),
        (in_a_folder_writable_by_others, "other users may write to"),
        (with_a_known_key, "other users may read"),
    ],
)
def test_a_library_that_others_can_have_written_is_refused(attack, message, monkeypatch):
    path = LIBRARY.build()
    library = read_file(path.name)
    assert library is not None
    attack(path, library)
    monkeypatch.setattr(native_library, "_load", native_library._load.__wrapped__)
    with pytest.warns(UserWarning, match=f"C code not used: .*{message}.*`jaxbeam native` comp"):
        assert not LIBRARY.available()
    assert not LIBRARY.available()  # with no second warning


def test_a_change_of_source_flags_or_headers_is_another_library(source):
    names = {LIBRARY.file_name}
    names.add(LIBRARY._replace(architecture="core2").file_name)
    header = source.parent / "small.h"
    for text in ("int a;", "int b;"):
        header.write_text(text)
        native_library._fingerprint.cache_clear()
        names.add(LIBRARY._replace(headers=("small.h",)).file_name)
    assert len(names) == 4


def test_the_file_name_depends_on_all_headers_of_the_integrator(monkeypatch):
    monkeypatch.undo()
    folder, library = native_library.C_FOLDER, native_peaks.LIBRARY
    files = sorted(path.name for path in folder.iterdir())
    for name in ("translated.h", "algebra.h", "decompose.h"):  # of translated programs
        files.remove(name)
    assert files == sorted(library.sources + library.headers)
    texts = [(folder / name).read_text() for name in files]
    assert set(re.findall(r'#include "(\w+\.h)"', "".join(texts))) == set(library.headers)


def test_a_compiler_that_is_missing_or_fails_is_named(monkeypatch):
    monkeypatch.setenv("CC", "false")
    with pytest.raises(RuntimeError, match=r"the C compiler false cannot compile .*small\.c"):
        LIBRARY.build()
    monkeypatch.setenv("CC", "/nowhere/cc")
    with pytest.raises(RuntimeError, match="the C compiler /nowhere/cc cannot be run"):
        LIBRARY.build()
    monkeypatch.delenv("CC")
    monkeypatch.setattr(shutil, "which", lambda _: None)
    with pytest.raises(RuntimeError, match="there is no C compiler here: install gcc or clang"):
        LIBRARY.build()
    assert not LIBRARY.library_path().exists()


def test_a_cache_folder_that_cannot_be_used_is_named(tmp_path):
    (tmp_path / "jaxbeam").write_text("")
    with pytest.raises(RuntimeError, match="the C code cannot be stored: .*jaxbeam cannot be used"):
        LIBRARY.build()
    with pytest.raises(RuntimeError, match="the C code cannot be removed: "):
        LIBRARY.remove()


def test_without_a_home_folder_there_is_no_library(monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME")

    def no_home():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(native_library.pathlib.Path, "home", no_home)
    assert not LIBRARY.available()
    with pytest.raises(RuntimeError, match="the C code cannot be stored: there is no home folder"):
        LIBRARY.build()
