"""TOML files, and parts of a case from their tables."""
