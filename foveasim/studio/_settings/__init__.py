"""Settings on the page: controls with their words and initial values, changes, and the unknowns of generators."""
