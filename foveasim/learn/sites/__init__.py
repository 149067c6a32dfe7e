"""Networks on photosites."""
