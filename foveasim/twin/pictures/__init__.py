"""Real pictures of a target beside simulated ones."""
