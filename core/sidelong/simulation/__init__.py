"""Parts, bins and a sensor: the simulated cell that ships with sidelong."""
