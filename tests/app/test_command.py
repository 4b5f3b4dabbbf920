"""The command `app`: one line for scripts, loopback only, and what is missing in a sentence."""

import re
import socket
import subprocess
import sys
import urllib.error
import urllib.request

import pytest


def test_the_address_is_on_one_line_and_answers(server):
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/\?token=[\w-]{20,}", server.address)
    with urllib.request.urlopen(server.address) as answer:
        assert answer.status == 200
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(server.address.split("?")[0])


def test_it_listens_to_the_loopback_address_alone(server):
    others = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    for address in others - {"127.0.0.1"}:
        with pytest.raises(OSError), socket.create_connection((address, server.port), timeout=1):
            pass


@pytest.mark.parametrize(
    "words, sentence",
    [(["none.toml"], "none.toml"), (["--port", "99999"], "--port must be from 0 to 65535")],
)
def test_wrong_words_are_refused(words, sentence):
    line = [sys.executable, "-m", "jaxbeam", "app", "--no-browser", *words]
    ended = subprocess.run(line, capture_output=True, text=True)
    assert ended.returncode in (1, 2) and sentence in ended.stderr and not ended.stdout


def test_a_missing_package_is_named_with_the_extra():
    code = (
        "import sys; sys.modules['tomlkit'] = None\n"
        "from jaxbeam.cli import main\nmain(['app', '--no-browser'])"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ended.returncode == 1 and "pip install 'jaxbeam[app]'" in ended.stderr
