"""From recorded captures to calibration files, and from calibration files to the settings of a scan."""
