"""Files appear whole or not at all."""

import ast

import pytest

from jaxbeam.runtime.whole_file import whole_file
from tests.modules import module_files, parse


def test_a_write_that_stops_leaves_what_was_there(tmp_path):
    path = tmp_path / "fit.npz"
    path.write_text("precious")
    with pytest.raises(ZeroDivisionError), whole_file(path, overwrite=True) as beside:
        beside.write_text("half")
        raise ZeroDivisionError
    assert path.read_text() == "precious" and list(tmp_path.iterdir()) == [path]


def test_what_is_there_is_refused_before_and_after(tmp_path):
    path = tmp_path / "case.toml"
    refused = pytest.raises(FileExistsError, match=r"case.toml exists already")
    with refused, whole_file(path) as beside:
        beside.write_text("ours")
        path.write_text("of another process")
    with pytest.raises(FileExistsError), whole_file(path):
        pytest.fail("nothing is computed")
    assert path.read_text() == "of another process" and list(tmp_path.iterdir()) == [path]


def test_a_folder_takes_the_place_of_a_folder_and_links_stay(tmp_path):
    place, link = tmp_path / "runs.zarr", tmp_path / "link.zarr"
    place.mkdir()
    (place / "old").touch()
    link.symlink_to(place)
    with whole_file(link, overwrite=True) as beside:
        beside.mkdir()
        (beside / "new").touch()
    assert link.is_symlink() and [path.name for path in place.iterdir()] == ["new"]


def test_nothing_is_written_at_its_place():
    """Every call that writes a file by name is given the path `beside` its place.

    Except caches, and stores of sweeps, which are written in blocks under a lock.
    """
    by_themselves = "jaxbeam.runtime.", "jaxbeam.sweeps.stores.zarr_files"
    writing = {"write_text", "write_bytes", "savefig", "savez", "to_netcdf", "to_zarr", "savemat"}
    wrong = []
    for module, path in module_files().items():
        if not module.startswith(("jaxbeam", "tuning")) or module.startswith(by_themselves):
            continue
        for node in ast.walk(parse(path)):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                called = node.func
                if called.attr in writing:
                    names = {n.id for n in ast.walk(node) if isinstance(n, ast.Name)}
                    if not names & {"beside", "file", "self"}:
                        wrong.append(f"{module}: {ast.unparse(node)[:80]}")
    assert wrong == []
