"""What a rover's planner asks of a map: hazards of the ground, what driving costs, and a path."""
