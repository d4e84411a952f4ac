"""Files: skin and calibration files in YAML."""
