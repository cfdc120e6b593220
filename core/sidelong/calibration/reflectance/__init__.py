"""The Phong reflectance of a material from white images and the depth of the same scene, sprayed."""
