"""Settings on the page: controls, their words and initial values, and changes."""
