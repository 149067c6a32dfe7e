"""Statistical model of a sensor: slopes and noise of its steps, predictions, inversion."""
