"""Health of the pads: statistics, conditions, diagnosis, tare and drift of rest frequencies."""
