"""Chapter6."""
