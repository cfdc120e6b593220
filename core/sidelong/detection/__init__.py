"""From one grayscale image and a CAD model to objects with pose hypotheses."""
