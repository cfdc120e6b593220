"""HTTP service, command line, processes and storage around the sidelong planner."""
