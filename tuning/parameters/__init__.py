"""Free parameters: addresses, bounds, scales and priors."""
