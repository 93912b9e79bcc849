"""Studies with the model: design of dampers, motion map, cost of accuracy."""
