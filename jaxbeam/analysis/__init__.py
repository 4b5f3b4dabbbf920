"""Stability, margins, the least achievable peak, comparison of controllers."""
