"""Time and memory of single runs as each of their dimensions grows."""
