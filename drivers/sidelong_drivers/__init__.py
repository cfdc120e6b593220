"""Cameras and arms behind two small protocols."""
