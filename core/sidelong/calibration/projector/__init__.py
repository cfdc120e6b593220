"""The light of the projector: from a matte plane, or from parts whose reflectance is taken for known."""
