"""From light to the probability of measuring depth.

Equation numbers are those of Yang and Waslander, "Next-Best-View Prediction for Active Stereo Cameras and Highly
Reflective Objects", with the two lines of (13) counted as one: (1) to (5) reflectance, (6), (8), (9) response, (7)
sensing, (10), (11) Phong fit, (12), (13) gain, (14) choice, (15) end.
"""
