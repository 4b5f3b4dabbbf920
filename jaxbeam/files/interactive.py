"""Interactive figures: a page in one file, in which histories are zoomed and read off.

It draws by the scripts of `jaxbeam app`, which it contains, and asks nothing of any server.
"""

import json
import re
from collections.abc import Mapping, Sequence
from html import escape
from importlib import resources

import numpy as np

SCRIPTS = ("dom.js", "plot.js")
DIGITS = 6  # of a value
STYLE = (
    "body { display: block; height: auto; overflow: auto; padding: 8px } canvas { height: 220px }"
)
SHOW = """
const plots = [];
const all = (call) => plots.forEach(call);
for (const { title, unit, series } of DATA.panels) {
  const seek = (x) => all((plot) => plot.setCursor(x));
  const zoomed = (range) => all((plot) => plot.setZoom(range));
  const plot = new Plot({ title, unit, axis: DATA.axis, seek, zoomed });
  plots.push(plot);
  document.body.append(plot.element);
  plot.show({ x: DATA.x, series: series.map((one, i) => ({ ...one, tint: i })) });
}
"""


def interactive_page(title: str, sentence: str, columns: Mapping[str, np.ndarray]) -> str:
    """HTML page of columns over the first of them, a plot for each quantity with unit.

    The end of a head is its quantity: "midspan deflection (m)", "sensor 1 deflection (m)".
    """
    (axis, x), *others = columns.items()
    panels: dict[str, dict] = {}
    for head, values in others:
        name, quantity, unit = re.fullmatch(r"(.*?) ?(\S+)(?: \(([^()]*)\))?", head).groups()
        panel = panels.setdefault(
            f"{quantity} ({unit})", {"title": quantity, "unit": unit or "1", "series": []}
        )
        panel["series"].append({"name": name or quantity, "y": plain_numbers(values)})
    data = {"axis": axis, "x": plain_numbers(x), "panels": list(panels.values())}
    return page_of(title, sentence, SCRIPTS, data, SHOW)


def page_of(title: str, sentence: str, scripts: Sequence[str], data: Mapping, show: str) -> str:
    """HTML page of data (DATA), shown by the JavaScript `show` and by scripts of `jaxbeam app`."""
    folder = resources.files("jaxbeam") / "app" / "static"
    texts = [(folder / name).read_text(encoding="utf-8") for name in scripts]
    modules = re.sub(r"^import .*$|^export ", "", "\n".join(texts), flags=re.MULTILINE)
    # A name may hold "</script>", which would end the script.
    content = json.dumps(data, allow_nan=False).replace("<", "\\u003c")
    style = (folder / "style.css").read_text(encoding="utf-8") + STYLE
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<style>{style}</style></head><body><h1>{escape(title)}</h1><p>{escape(sentence)}</p>"
        f'<script type="module">{modules}\nconst DATA = {content};{show}</script></body></html>'
    )


def plain_numbers(values) -> list[float | None]:
    """Numbers to `DIGITS` digits, None for those that are not finite."""
    numbers = np.asarray(values, float).tolist()
    return [float(f"{one:.{DIGITS}g}") if np.isfinite(one) else None for one in numbers]
