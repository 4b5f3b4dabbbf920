"""Modal identification from spectra: decomposition of spectra and fits of matrix fractions."""
