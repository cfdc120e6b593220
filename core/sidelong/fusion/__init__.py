"""From several depth maps to the completed depth of the reference view."""
