"""Health of the pads, and their rest frequencies: statistics, diagnosis, tare and drift."""
