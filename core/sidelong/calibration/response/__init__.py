"""The photometric response of a sensor from an exposure bracket."""
