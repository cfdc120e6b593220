"""What the planner believes about light, fitted to captures."""
