"""Messages between page and session: their encoding, and models of those of the page."""
