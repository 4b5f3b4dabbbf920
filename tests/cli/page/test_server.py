"""What the server takes, and what it refuses, without a browser; the page without a server."""

import http.client
import importlib.util
import json
import re
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
import uvicorn

import jaxbeam as jb
from jaxbeam.cli.page.questions import KINDS, Page
from jaxbeam.cli.page.server import HEADERS, MAX_BYTES, application
from tests.cli.page.conftest import RIG
from tests.modules import ROOT

TOKEN = "a-token-of-the-tests"


class Answer:
    """Status, headers and content of an answer."""

    def __init__(self, response):
        self.status = response.status
        self.headers = {name.lower(): value for name, value in response.getheaders()}
        self.content = response.read()

    @property
    def text(self):
        return self.content.decode()

    def json(self):
        return json.loads(self.content)


class Client:
    """Questions to a server of this process, with whatever headers are wanted."""

    def __init__(self, port):
        self.port = port

    def request(self, method, path, body=None, headers=None):
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        try:
            connection.request(method, path, body, headers or {})
            return Answer(connection.getresponse())
        finally:
            connection.close()

    def get(self, path, **heads):
        return self.request("GET", path, headers=heads)


@pytest.fixture
def client(workspace):
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        port = listening.getsockname()[1]
        app = application(workspace, "rig.toml", TOKEN, port)
        server = uvicorn.Server(uvicorn.Config(app, log_level="error", lifespan="off", ws="none"))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
        thread.start()
        while not server.started:
            time.sleep(0.01)
        yield Client(port)
        server.should_exit = True
        thread.join()


def ask(client, name, question=None, **heads):
    headers = {"x-token": TOKEN} | {key.replace("_", "-"): value for key, value in heads.items()}
    return client.request("POST", f"/api/{name}", json.dumps(question or {}), headers)


def test_the_page_has_its_policy_and_no_markup_of_others(client):
    answer = client.get(f"/?token={TOKEN}")
    assert answer.status == 200 and "jaxbeam" in answer.text
    assert {name: answer.headers[name] for name in HEADERS} == HEADERS
    assert "unsafe" not in HEADERS["content-security-policy"]


@pytest.mark.parametrize("name", ["index.html", "main.js", "style.css", "icon.svg"])
def test_the_code_of_the_page_asks_nowhere_else(client, name):
    text = client.get(f"/static/{name}").text
    others = [word for word in ("http://", "https://", "//cdn") if word in text]
    assert [w for w in others if "http://www.w3.org/" not in text] == []
    assert "innerHTML" not in text and "eval(" not in text


@pytest.mark.parametrize(
    "heads",
    [
        {"x_token": ""},
        {"x_token": TOKEN[:-1]},
        {"x_token": "é"},
        {"host": "evil.example:PORT"},
        {"host": "127.0.0.1:1"},
        {"origin": "https://evil.example"},
        {"origin": "null"},
        {"origin": "http://127.0.0.1:1"},
        {"origin": "http://localhost:PORT"},
        {"sec_fetch_site": "cross-site"},
        {"sec_fetch_site": "same-site"},
    ],
)
def test_questions_from_elsewhere_are_refused(client, heads):
    heads = {name: value.replace("PORT", str(client.port)) for name, value in heads.items()}
    answer = ask(client, "hello", **heads)
    assert answer.status == 403 and answer.json()["problem"]["message"]


def test_the_page_itself_needs_the_token(client):
    assert client.get("/").status == 403
    assert client.get("/?token=wrong").status == 403


def test_the_page_of_this_origin_may_ask(client):
    origin = f"http://127.0.0.1:{client.port}"
    answer = ask(client, "hello", origin=origin, sec_fetch_site="same-origin")
    assert answer.status == 200 and answer.json()["opened"] == "rig.toml"


def test_oversized_questions_are_refused(client):
    heads = {"x-token": TOKEN, "content-length": str(MAX_BYTES + 1)}
    assert client.request("POST", "/api/model", headers=heads).status == 413


def test_oversized_questions_without_a_length_are_not_read_to_their_end(client):
    sent = []

    def chunks():
        for _ in range(40):
            sent.append(1)
            yield b"#" * (MAX_BYTES // 4)

    with pytest.raises((OSError, http.client.HTTPException)):
        answer = client.request("POST", "/api/model", chunks(), {"x-token": TOKEN})
        raise OSError(answer.status)  # a refusal is as good as an end
    assert len(sent) < 40


@pytest.mark.parametrize("name", ["../secret.toml", "/etc/passwd", "rig.toml/../x.toml"])
def test_paths_outside_of_the_folder_are_refused(client, name):
    for question in ({"name": name}, {"name": name, "text": RIG}):
        answer = ask(client, "save" if "text" in question else "open", question)
        assert answer.status == 422
        assert "no place for a case" in answer.json()["problem"]["message"]
    assert client.get(f"/static/{name}").status == 404


@pytest.mark.parametrize("content", ["", "[]", "{", "3", '"a"', '{"text": 3}', '{"a": 1}'])
def test_questions_that_make_no_sense_are_refused_in_a_sentence(client, content):
    answer = client.request("POST", "/api/model", content, {"x-token": TOKEN})
    assert answer.status == 422 and answer.json()["problem"]["message"]


def test_a_run_is_packed_and_equal_to_that_of_the_library(client, rig):
    content = ask(client, "run", {"text": RIG}).content
    (length,) = struct.unpack_from("<I", content)
    words = json.loads(content[4 : 4 + length])
    place, arrays = 4 + length, {}
    for name, shape in words["arrays"].items():
        size = int(np.prod(shape))
        arrays[name] = np.frombuffer(content, "<f4", size, place).reshape(shape)
        place += 4 * size
    assert place == len(content) and length % 4 == 0
    record = jb.simulate(jb.load_case(rig))
    np.testing.assert_allclose(arrays["sensors"], record.sensor_values, rtol=1e-6, atol=1e-12)
    assert words["verdict"] == record.verdict


def test_a_preview_has_its_own_scene(client):
    question = {"text": RIG, "values": {"sensors.0.position": 0.4}, "ranges": {}}
    content = ask(client, "preview", question).content
    (length,) = struct.unpack_from("<I", content)
    assert json.loads(content[4 : 4 + length])["scene"]["sensors"][0]["position"] == 0.4
    assert ask(client, "preview", question | {"prepare": True}).json() == {}


@pytest.mark.parametrize("what", sorted(KINDS))
def test_every_file_can_be_taken_away(client, what, few_frames):
    answer = ask(client, "take", {"text": RIG, "what": what})
    assert answer.status == 200, answer.text
    assert answer.headers["content-disposition"].endswith(f'.{what}"')
    starts = {"png": b"\x89PNG", "gif": b"GIF8", "nc": b"CDF", "xlsx": b"PK", "csv": b"time"}
    assert answer.content.startswith(starts.get(what, b"")) and answer.content


def test_the_report_shows_titles_as_text(client):
    text = RIG.replace("Rig of two spans", "<script>alert(1)</script>")
    page = ask(client, "take", {"text": text, "what": "html"}).text
    assert "<script>" not in page and "&lt;script&gt;" in page


@pytest.fixture
def few_frames(monkeypatch):
    """An animation of two frames, not of a hundred."""
    import jaxbeam.plot

    whole = jaxbeam.plot.animate
    short = lambda record, path: whole(record, path, frames=2)  # noqa: E731
    monkeypatch.setattr(jaxbeam.plot, "animate", short)


def test_the_words_to_copy_are_those_of_the_run(client, rig, monkeypatch, capsys):
    words = ask(client, "words", {"text": RIG, "name": "rig.toml"}).json()
    assert words["command"] == "jaxbeam simulate rig.toml --plot"
    monkeypatch.chdir(rig.parent)
    exec(words["python"], {})
    assert jb.simulate(jb.load_case(rig)).verdict in capsys.readouterr().out


# The command `app`: one line for scripts, loopback only, and what is missing in a sentence.


def test_the_address_is_on_one_line_and_answers(server):
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/\?token=[\w-]{20,}", server.address)
    with urllib.request.urlopen(server.address) as answer:
        assert answer.status == 200
    with pytest.raises(urllib.error.HTTPError, match="403") as refused:
        urllib.request.urlopen(server.address.split("?")[0])
    refused.value.close()


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


# The page without a server: a worker answers, here with Python beside the browser for Pyodide.

# What the worker asks of Pyodide; the function of Python is asked for over the network instead.
STAND_IN = """
export async function loadPyodide() {
  const ask = (name, text) => {
    const asked = new XMLHttpRequest();
    asked.open("POST", "/ask/" + name, false);
    asked.responseType = "arraybuffer";
    asked.send(text);
    const found = [asked.status === 200, new Uint8Array(asked.response),
      asked.getResponseHeader("content-type"), asked.getResponseHeader("x-file")];
    return { toJs: () => found, destroy() {} };
  };
  return {
    loadPackage: async () => null,
    unpackArchive(content, format) {
      if (format !== "zip" || content.byteLength < 1e5) throw new Error("no zip");
    },
    runPythonAsync: async (code) => (code.includes("Page") ? ask : null),
  };
}
"""


@pytest.fixture
def site(tmp_path):
    """Address of the files of the page on a server of files."""
    place = ROOT / "docs/_ext/page_in_browser.py"
    found = importlib.util.spec_from_file_location("page_in_browser", place)
    assert found is not None and found.loader is not None
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    module.write_page(tmp_path / "app")
    worker = tmp_path / "app/static/worker.js"
    worker.write_text(re.sub(r'"https://.*/full/"', '"/"', worker.read_text()))
    (tmp_path / "pyodide.mjs").write_text(STAND_IN)
    python = Page(tmp_path / "cases")

    class Handler(SimpleHTTPRequestHandler):
        extensions_map = SimpleHTTPRequestHandler.extensions_map | {".mjs": "text/javascript"}

        def do_POST(self):
            """Answer as the Python of the browser would."""
            text = self.rfile.read(int(self.headers["content-length"])).decode()
            answered, body, kind, file = python.ask(self.path.split("/")[-1], text)
            self.send_response(200 if answered else 422)
            self.send_header("content-type", kind)
            self.send_header("x-file", file)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *args):
            """Say nothing."""

    server = ThreadingHTTPServer(
        ("127.0.0.1", 0), lambda *args: Handler(*args, directory=str(tmp_path))
    )
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/app/index.html"
    server.shutdown()
    server.server_close()
    python.close()


def test_a_case_is_computed_and_saved_without_a_server(browser, site):
    context = browser.new_context(accept_downloads=True)
    page = context.new_page()
    wrong = []
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.goto(site)
    page.wait_for_selector("body[data-ready]")
    page.keyboard.press("Escape")
    tabs = page.get_by_role("tab").all_inner_texts()
    assert tabs[-3:] == ["Histories", "Envelopes", "Take away"]
    page.get_by_role("tab", name="Case file").click()
    page.get_by_label("case file, TOML").fill(RIG)
    page.wait_for_selector("h1:text('Rig of two spans')")
    page.wait_for_selector(".plot canvas")
    page.on("dialog", lambda dialog: dialog.accept("mine.toml"))
    with page.expect_download() as found:
        page.keyboard.press("Control+s")
    with open(found.value.path(), encoding="utf-8") as file:
        assert file.read() == RIG
    page.get_by_label("case file, TOML").fill(RIG.replace("mass = 0.4", "mass = -1.0"))
    page.wait_for_selector("#status:text('must not be negative')")
    assert wrong == []
    context.close()


def test_an_answer_is_bytes_with_what_they_are(tmp_path):
    page = Page(tmp_path / "cases")
    answered, body, kind, file = page.ask("take", json.dumps({"text": RIG, "what": "csv"}))
    assert (answered, kind, file) == (True, "text/csv", "run.csv")
    assert body.startswith(b"time (s)")
    answered, body, kind, _ = page.ask("run", json.dumps({"text": "[beam"}))
    assert not answered and kind == "application/json" and "problem" in json.loads(body)
    page.close()
