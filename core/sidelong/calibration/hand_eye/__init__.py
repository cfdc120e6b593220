"""Where the camera sits on the flange, from images of a board."""
