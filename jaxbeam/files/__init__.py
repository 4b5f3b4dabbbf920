"""Files: cases as TOML, reports as Markdown and HTML, gains for real controllers."""
