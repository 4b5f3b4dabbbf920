"""Studies beyond the thesis: streams of loads, and controllers tuned by gradients."""
