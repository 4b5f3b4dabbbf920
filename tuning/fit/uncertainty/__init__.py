"""Uncertainty of fitted parameters: covariance, profile likelihood, posterior."""
