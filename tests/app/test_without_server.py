"""The page without a server: a worker answers, here with Python beside the browser for Pyodide."""

import importlib.util
import json
import re
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest

from jaxbeam.app.in_browser import Page
from tests.app.conftest import RIG
from tests.modules import ROOT

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
    runPythonAsync: async (code) => (code.includes("in_browser") ? ask : null),
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
