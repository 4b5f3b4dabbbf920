"""Memory that is free, and the part of it that blocks take."""

import subprocess
import sys

import pytest

from jaxbeam.runtime import memory
from jaxbeam.runtime.memory import block_memory, free_memory, size_text


@pytest.mark.parametrize(
    ("given", "size"), [("2 GB", 2e9), ("512MiB", 2.0**29), (3e8, 3e8), ("1e9", 1e9)]
)
def test_memory_as_given(given, size):
    assert block_memory(given) == size


@pytest.mark.parametrize("given", ["2 apples", "-1", 0, "1e999", True, [1]])
def test_no_memory(given):
    with pytest.raises(ValueError, match="a number of bytes or a text as '2 GB'"):
        block_memory(given)


def test_a_quarter_of_what_is_free_by_default():
    assert block_memory() == pytest.approx(free_memory() / 4, rel=0.2)
    assert size_text(1.53e9) == "1.53 GB" and size_text(2e4) == "20 kB"


def test_containers_limit_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "GROUPS", tmp_path)
    (tmp_path / "memory.max").write_text("1000000\n")
    (tmp_path / "memory.current").write_text("700000\n")
    (tmp_path / "memory.stat").write_text("anon 500000\ninactive_file 200000\n")
    assert free_memory() == 500_000
    (tmp_path / "memory.max").write_text("max\n")
    assert free_memory() > 1e7


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_limits_of_the_process():
    program = (
        "import resource, jaxbeam.runtime.memory as m;"
        "resource.setrlimit(resource.RLIMIT_AS, (8 * 2**30, 8 * 2**30));"
        "a = m.free_memory(); b = bytearray(2**27); print(a, a - m.free_memory())"
    )
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    free, taken = map(float, found.stdout.split())
    assert free < 8 * 2**30 and taken > 2**26
