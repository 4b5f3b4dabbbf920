"""jaxbeam: structures under moving loads, simulated and differentiated with JAX."""

import os

import jax

# Peaks to one part in a million need double precision; whoever asks JAX for single keeps it.
if "JAX_ENABLE_X64" not in os.environ:
    jax.config.update("jax_enable_x64", True)
