"""Event pixels from recordings of a camera."""
