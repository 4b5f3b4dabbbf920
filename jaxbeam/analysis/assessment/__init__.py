"""Code checks of railway bridges: formulas and numbers of EN 1991-2, static loads and trains."""
