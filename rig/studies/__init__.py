"""Questions about the model: design, map, cost of accuracy."""
