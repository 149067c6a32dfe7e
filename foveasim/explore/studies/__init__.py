"""Studies: search for the best settings."""
