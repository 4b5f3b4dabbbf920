"""Exact modal propagation with collocated contact forces, step by step."""
