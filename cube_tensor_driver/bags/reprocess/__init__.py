"""Reprocessing of bags: stress and contacts are computed again from recorded frequencies."""
