"""Studies: optimisation of settings."""
