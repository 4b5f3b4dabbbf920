"""Sphinx settings of the site: `sphinx-build -W docs out/site`."""

import importlib.metadata
import os
import sys
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("MPLBACKEND", "agg")
sys.path[:0] = [str(Path(__file__).parent / "_ext"), str(Path(__file__).parent.parent)]

project = "jaxbeam"
author = "jaxbeam developers"
copyright = f"{author}, MIT licence"
version = release = importlib.metadata.version("jaxbeam")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
    "copied_pages",
    "generated_pages",
    "page_in_browser",
    "plain_docstrings",
    "run_code",
    "svg_math",
    "thumbnails",
]
exclude_patterns = ["_ext", "_static", "figures", "_run"]
suppress_warnings = ["myst.header", "mystnb.unknown_mime_type"]

# Notebooks are executed by the tests (`.ci/run`); the site shows the outputs that they have then.
smartquotes = False  # quotes in commands are to be copied
nb_execution_mode = "off"
myst_enable_extensions = [
    "amsmath",
    "attrs_block",
    "attrs_inline",
    "colon_fence",
    "deflist",
    "dollarmath",
]
myst_heading_anchors = 3
myst_dmath_double_inline = True
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

autodoc_member_order = "bysource"
add_module_names = False
toc_object_entries_show_parents = "hide"

html_theme = "pydata_sphinx_theme"
html_title = "jaxbeam"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_favicon = "_static/beam.svg"
html_copy_source = False
html_show_sourcelink = False
html_math_renderer = "svg"
html_theme_options = {
    "logo": {
        "text": f"jaxbeam {version}",
        "image_light": "_static/beam.svg",
        "image_dark": "_static/beam.svg",
    },
    "navbar_end": ["theme-switcher"],
    "navbar_align": "left",
    "header_links_before_dropdown": 6,
    "show_prev_next": True,
    "show_toc_level": 2,
    "navigation_depth": 2,
    "show_version_warning_banner": False,
    "footer_start": ["copyright"],
    "footer_end": [],
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
    "back_to_top_button": False,
}
html_sidebars = {"index": [], "gallery": [], "faq": []}
