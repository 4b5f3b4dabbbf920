"""Cases as TOML, reports, gains for real controllers."""
